"""Frame blocks and marks as bytes on the wire, by a compiled kernel: a parallel instrument sends thousands of them a second.

Owns one buffer for each direction of the work; the bytes are those of `wire.encode_frames` and `wire.encode_mark`, which stay the reference
(tests/test_moving.py holds them against each other). Never keeps a message.
"""

from __future__ import annotations

import struct

import numpy as np
from numba import njit

from pans.runtime.wire import FrameBlock, Mark
from pans.runtime.wire_kernels import crc32_span
from pans.runtime.wire_schema import HEADER, LAYOUTS, MAX_FRAME_BYTES, MAX_PAYLOAD_BYTES, SCHEMA, MessageType

_BLOCK = struct.Struct(LAYOUTS["HEADER"] + LAYOUTS["FRAMES"].removeprefix("<"))
_MARK = struct.Struct(LAYOUTS["HEADER"] + LAYOUTS["MARK"].removeprefix("<"))


class FrameWriter:
    """Writes one message at a time; the kernel is compiled, or loaded, when it is made."""

    def __init__(self) -> None:
        self._body = np.zeros(HEADER.size + MAX_PAYLOAD_BYTES + 4, np.uint8)
        self._raw = memoryview(self._body.data)
        self._out = np.zeros(MAX_FRAME_BYTES + 1, np.uint8)
        self.mark(Mark(0, 0, 0, 0, 0, 0.0), 0, 0)

    def block(self, block: FrameBlock, sequence: int, drops: int, session: int) -> bytes:
        """Return `block` as a frame with this sequence number and drop count."""
        words = block.words
        count, word_bytes = words.shape
        _BLOCK.pack_into(
            self._raw, 0, MessageType.FRAMES, 0, 0, session, sequence, drops, block.tick, block.exposure_index,
            block.period_ticks, count, word_bytes, block.object_index,
        )  # fmt: skip
        stop = _BLOCK.size + words.size
        self._body[_BLOCK.size : stop] = words.reshape(-1)
        return self._frame(stop)

    def mark(self, mark: Mark, sequence: int, session: int) -> bytes:
        """Return `mark` as a frame with this sequence number."""
        _MARK.pack_into(
            self._raw, 0, MessageType.MARK, 0, 0, session, sequence, mark.object_index, mark.truth,
            mark.half_exposures, mark.exposure_index, mark.tick, mark.photons,
        )  # fmt: skip
        return self._frame(_MARK.size)

    def _frame(self, n_bytes: int) -> bytes:
        return self._out[: _finish(self._body, n_bytes, SCHEMA, self._out)].tobytes()


@njit(cache=True, nogil=True)
def _finish(body, n_bytes, schema, out):  # type: ignore[no-untyped-def]
    """Append the CRC to body[:n_bytes], and write the COBS string of all of it and a delimiter to `out`; return its length."""
    crc = crc32_span(body, 0, n_bytes, schema)
    for k in range(4):
        body[n_bytes + k] = (crc >> np.uint64(8 * k)) & np.uint64(0xFF)
    code_at, at, code = 0, 1, 1
    for i in range(n_bytes + 4):
        byte = body[i]
        if byte != 0:
            out[at] = byte
            at += 1
            code += 1
        if byte == 0 or code == 255:
            out[code_at] = code
            code_at = at
            at += 1
            code = 1
    out[code_at] = code
    out[at] = 0
    return at + 1
