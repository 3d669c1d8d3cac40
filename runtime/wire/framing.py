"""Framing: COBS and CRC-32 around every message, and the decoder that resynchronises after any garbage; sans-I/O.

Owns the way from bytes to whole frames; never looks into a payload. `FrameDecoder.feed` returns frames whose CRC was right and counts
what was damaged: damage is a measurement, not a failure.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np

from .frame import DecoderCounters, Frame, unpack_body
from .schema import HEADER, MAX_FRAME_BYTES, MAX_PAYLOAD_BYTES, SCHEMA, UNSEEDED, MalformedMessage

if TYPE_CHECKING:
    from .bulk import BulkDecoder


_LONG = 512  # from about here on arrays are quicker: ten microseconds in any case
_CODES = tuple(bytes((length + 1,)) for length in range(254))
_CRC_SEEDS = tuple(0 if message_type in UNSEEDED else SCHEMA for message_type in range(256))


def cobs_encode(data: bytes) -> bytes:
    """Return `data` without any zero byte (Cheshire and Baker 1999), at most 1 + len/254 bytes longer; no delimiter added."""
    if len(data) >= _LONG:
        coded = np.frombuffer(b"\0" + data, np.uint8).copy()
        zeros = np.flatnonzero(coded == 0)
        steps = np.diff(zeros, append=len(coded))
        if steps.max() <= 254:
            coded[zeros] = steps
            return coded.tobytes()
    runs = data.split(b"\0")
    if len(data) < 254 or len(max(runs, key=len)) < 254:
        # The plain form: every zero becomes the code of the run behind it, which is what makes short frames quick.
        return b"".join([_CODES[len(run)] + run for run in runs])
    out = bytearray()
    for run in runs:
        while len(run) >= 254:
            out += b"\xff" + run[:254]
            run = run[254:]
        out.append(len(run) + 1)
        out += run
    return bytes(out)


def cobs_decode(data: bytes) -> bytes | None:
    """Invert `cobs_encode`; None when `data` (without its delimiter) is no COBS string."""
    size, plain, position = len(data), bytearray(data), 0
    while position < size:  # in place: every code byte becomes the zero before its group
        code = plain[position]
        if code == 0 or code == 0xFF:  # damage, or a group without a zero
            break
        plain[position] = 0
        position += code
    else:
        return bytes(plain[1:]) if position == size else None
    out, position = bytearray(), 0
    while position < size:
        code = data[position]
        end = position + code
        if code == 0 or end > size:
            return None
        out += data[position + 1 : end]
        position = end
        if code != 0xFF and position < size:
            out.append(0)
    return bytes(out)


def encode_frame(message_type: int, payload: bytes, session: int, flags: int = 0) -> bytes:
    """Return one frame ready to send, delimiter included; `MalformedMessage` above MAX_PAYLOAD_BYTES."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise MalformedMessage(f"payload has {len(payload)} bytes, allowed {MAX_PAYLOAD_BYTES}")
    body = HEADER.pack(message_type, flags, 0, session) + payload
    crc = zlib.crc32(body, _CRC_SEEDS[message_type])
    # A run that ends exactly at a 254-byte boundary would cost one code byte more; cobs_encode keeps the plain form.
    return cobs_encode(body + crc.to_bytes(4, "little")) + b"\0"


class FrameDecoder:
    """Incremental decoder of one direction of a link; holds at most MAX_FRAME_BYTES and resynchronises at every delimiter."""

    def __init__(self) -> None:
        self._counters = DecoderCounters()
        self._buffer = bytearray()
        self._skipping = False
        self._bulk: BulkDecoder | None = None

    @property
    def counters(self) -> DecoderCounters:
        """What has been seen since the decoder was made."""
        return self._counters if self._bulk is None else self._bulk.counters

    @property
    def held_bytes(self) -> int:
        """Bytes of a frame whose delimiter has not come yet."""
        return len(self._buffer) if self._bulk is None else self._bulk.held_bytes

    @property
    def bulk(self) -> BulkDecoder | None:
        """The compiled decoder that does the work since `use_kernels`; None before it."""
        return self._bulk

    def use_kernels(self) -> None:
        """Decode in compiled kernels from here on: before arming, since loading them takes time and Python's loops would show."""
        if self._bulk is None:
            from .bulk import BulkDecoder  # numba is loaded only for those who need it

            bulk = BulkDecoder()
            bulk.warm_up()
            bulk.resume(self._counters, bytes(self._buffer), self._skipping)
            self._bulk = bulk

    def feed(self, data: bytes | bytearray | memoryview) -> list[Frame]:
        """Return the frames that `data` completes, in order; damaged ones are counted and dropped."""
        if self._bulk is not None:
            return self._bulk.feed(data)
        self._counters.bytes_in += len(data)
        *ended, rest = bytes(data).split(b"\0")
        frames: list[Frame] = []
        for piece in ended:
            self._append(piece)
            if not self._skipping and self._buffer:
                frame = self._decode(bytes(self._buffer))
                if frame is not None:
                    frames.append(frame)
            self._buffer.clear()
            self._skipping = False
        self._append(rest)
        return frames

    def _append(self, piece: bytes) -> None:
        if self._skipping:
            self._counters.bytes_discarded += len(piece)
        elif len(self._buffer) + len(piece) > MAX_FRAME_BYTES:
            self._counters.oversized_frames += 1
            self._counters.bytes_discarded += len(self._buffer) + len(piece)
            self._buffer.clear()
            self._skipping = True
        else:
            self._buffer += piece

    def _decode(self, raw: bytes) -> Frame | None:
        counters = self._counters
        body = cobs_decode(raw)
        if body is None:
            counters.cobs_errors += 1
        elif len(body) < HEADER.size + 4:
            counters.short_frames += 1
        elif zlib.crc32(body[:-4], _CRC_SEEDS[body[0]]) != int.from_bytes(body[-4:], "little"):
            counters.crc_errors += 1
        else:
            counters.frames += 1
            return unpack_body(body[:-4])
        counters.bytes_discarded += len(raw) + 1
        return None
