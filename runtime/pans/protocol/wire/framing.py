"""Framing: COBS and CRC-32 around every message, and the decoder that resynchronises after any garbage; sans-I/O.

`encode_frame` returns the bytes of one frame. `FrameDecoder.feed` returns frames whose CRC was right and counts what was damaged: damage
is a measurement, not a failure. Its kernels are loaded when the first decoder is made.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from .schema import HEADER, MAX_FRAME_BYTES, MAX_PAYLOAD_BYTES, SCHEMA, UNSEEDED, MalformedMessage

CHUNK_BYTES = 1 << 18  # decoded at a time: large against a frame, small against a level-2 cache
SMALLEST_FRAME_BYTES = 14  # on the wire: header, CRC, a code byte and the delimiter

U8 = npt.NDArray[np.uint8]
I64 = npt.NDArray[np.int64]
Scalar = TypeVar("Scalar", bound=np.generic)
_CODES = tuple(bytes((length + 1,)) for length in range(254))
_CRC_SEEDS = tuple(0 if message_type in UNSEEDED else SCHEMA for message_type in range(256))


class Frame(NamedTuple):
    """One whole frame whose CRC was right."""

    type: int
    flags: int
    session: int
    payload: bytes


def pack_body(frame: Frame) -> bytes:
    """Return header and payload as they stood inside the frame: what a recording keeps."""
    return HEADER.pack(frame.type, frame.flags, frame.session) + frame.payload


def unpack_body(body: bytes) -> Frame:
    """Invert `pack_body`; MalformedMessage when there is no whole header."""
    if len(body) < HEADER.size:
        raise MalformedMessage(f"a message has {len(body)} bytes, at least {HEADER.size} expected")
    message_type, flags, session = HEADER.unpack_from(body)
    return Frame(message_type, flags, session, body[HEADER.size :])


def content_crc(frame: Frame) -> int:
    """Return the CRC-32 that a stream frame has on the wire with flags and reserved bits 0: those are ignored (rule 1.10)."""
    return zlib.crc32(frame.payload, zlib.crc32(HEADER.pack(frame.type, 0, frame.session), SCHEMA))


class Messages(NamedTuple):
    """Stream messages of one read, decoded: bodies (header and payload) at the spans int64 (n, 2) of `buffer` uint8.

    Both belong to the decoder and are valid until it is given the next bytes.
    """

    buffer: npt.NDArray[np.uint8]
    spans: npt.NDArray[np.int64]

    def frame(self, place: int) -> Frame:
        """Return message `place` as a frame of its own."""
        first, stop = self.spans[place].tolist()
        return unpack_body(self.buffer[first:stop].tobytes())


@dataclass(slots=True)
class DecoderCounters:
    """What the decoder has seen since it was made; every byte is in a good frame or counted as discarded."""

    frames: int = 0
    bytes_in: int = 0
    crc_errors: int = 0
    cobs_errors: int = 0
    short_frames: int = 0
    oversized_frames: int = 0
    bytes_discarded: int = 0


def read_only(array: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
    """Return a view that cannot be written to, as those of a message are.

    To the compiler an array that can be written to is another type, for which it compiles every kernel that the array reaches once more.

    >>> read_only(np.zeros(2)).flags.writeable
    False
    """
    view = array.view()
    view.flags.writeable = False
    return view


def cobs_encode(data: bytes) -> bytes:
    """Return `data` without any zero byte (Cheshire and Baker 1999), at most 1 + len/254 bytes longer; no delimiter added."""
    # The plain form: every zero becomes the code of the run behind it; of long frames numpy is ten times as quick.
    if len(data) < 254:
        return b"".join([_CODES[len(run)] + run for run in data.split(b"\0")])
    coded = np.frombuffer(b"\0" + data, np.uint8).copy()
    zeros = np.flatnonzero(coded == 0)
    steps = np.diff(zeros, append=len(coded))
    if steps.max() <= 254:
        coded[zeros] = steps
        return coded.tobytes()
    out = bytearray()
    for run in data.split(b"\0"):
        while len(run) >= 254:
            out += b"\xff" + run[:254]
            run = run[254:]
        out.append(len(run) + 1)
        out += run
    return bytes(out)


def encode_frame(message_type: int, payload: bytes, session: int, flags: int = 0) -> bytes:
    """Return one frame ready to send, delimiter included; `MalformedMessage` above MAX_PAYLOAD_BYTES."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise MalformedMessage(f"payload has {len(payload)} bytes, allowed {MAX_PAYLOAD_BYTES}")
    body = HEADER.pack(message_type, flags, session) + payload
    crc = zlib.crc32(body, _CRC_SEEDS[message_type])
    # A run that ends exactly at a 254-byte boundary would cost one code byte more; cobs_encode keeps the plain form.
    return cobs_encode(body + crc.to_bytes(4, "little")) + b"\0"


class FrameDecoder:
    """Incremental decoder of one direction of a link; it resynchronises at every delimiter.

    Memory is MAX_FRAME_BYTES and one chunk, allocated here.
    """

    def __init__(self) -> None:
        from . import kernels  # numba is loaded only by who decodes

        self._take_in = kernels.take_in
        self.buffer: U8 = np.empty(MAX_FRAME_BYTES + CHUNK_BYTES, np.uint8)
        self._view = self.buffer.data
        self._bodies: I64 = np.empty((len(self.buffer) // SMALLEST_FRAME_BYTES + 1, 2), np.int64)
        self._tally: I64 = np.zeros(kernels.N_TALLIES, np.int64)

    @property
    def counters(self) -> DecoderCounters:
        """What has been seen since the decoder was made."""
        return DecoderCounters(*self._tally[: len(fields(DecoderCounters))].tolist())

    @property
    def arrays(self) -> tuple[U8, I64, I64]:
        """The buffer, the spans of its bodies and the tally: what compiled code continues (decide/kernel/receive.py)."""
        return self.buffer, self._bodies, self._tally

    def feed(self, data: bytes | bytearray | memoryview) -> list[Frame]:
        """Return the frames that `data` completes, in order; damaged ones are counted and dropped."""
        return [
            unpack_body(bytes(self._view[first:stop])) for spans in self.bodies(data) for first, stop in spans.tolist()
        ]

    def bodies(self, data: bytes | bytearray | memoryview | U8) -> Iterator[I64]:
        """Yield, chunk by chunk, the spans (n, 2) of header + payload in `buffer`, valid until the next chunk.

        The iterator must be used up: it takes `data` in as it goes.
        """
        for piece in self.pieces(bytes(data)):
            count = self._take_in(piece, self.buffer, MAX_FRAME_BYTES, SCHEMA, self._bodies, self._tally)
            yield self._bodies[:count]

    @staticmethod
    def pieces(data: bytes) -> list[bytes]:
        """Return `data` in pieces of CHUNK_BYTES."""
        return [data[first : first + CHUNK_BYTES] for first in range(0, max(1, len(data)), CHUNK_BYTES)]
