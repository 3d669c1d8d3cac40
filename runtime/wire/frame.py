"""What a decoder gives: a frame, or the spans of many in one buffer, and the counts of what was damaged.

Owns these tuples and the body (header and payload) that a recording keeps; never looks into a payload and decodes no bytes of a link:
framing.py and bulk.py do.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from .schema import HEADER, SCHEMA, MalformedMessage

Scalar = TypeVar("Scalar", bound=np.generic)


class Frame(NamedTuple):
    """One whole frame whose CRC was right."""

    type: int
    flags: int
    session: int
    payload: bytes


def pack_body(frame: Frame) -> bytes:
    """Return header and payload as they stood inside the frame: what a recording keeps."""
    return HEADER.pack(frame.type, frame.flags, 0, frame.session) + frame.payload


def unpack_body(body: bytes) -> Frame:
    """Invert `pack_body`; MalformedMessage when there is no whole header."""
    if len(body) < HEADER.size:
        raise MalformedMessage(f"a message has {len(body)} bytes, at least {HEADER.size} expected")
    message_type, flags, _, session = HEADER.unpack_from(body)
    return Frame(message_type, flags, session, body[HEADER.size :])


def content_crc(frame: Frame) -> int:
    """Return the CRC-32 that a stream frame has on the wire with flags and reserved bits 0: those are ignored (rule 1.10)."""
    return zlib.crc32(frame.payload, zlib.crc32(HEADER.pack(frame.type, 0, 0, frame.session), SCHEMA))


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

    def kept(self) -> Messages:
        """Return a copy that the decoder's next bytes do not touch."""
        end = int(self.spans[-1, 1]) if len(self.spans) else 0
        return Messages(self.buffer[:end].copy(), self.spans.copy())


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
