"""Bulk decoding of one direction of a fast link: the compiled twin of `framing.FrameDecoder`.

Owns one preallocated buffer and the bytes that wait for the rest of their frame; never looks into a payload. `bodies` hands out
spans of that buffer without copying, `feed` the same frames as FrameDecoder; counters are equal after every call.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from . import kernels
from .frame import DecoderCounters, Frame
from .schema import HEADER, MAX_FRAME_BYTES, SCHEMA

CHUNK_BYTES = 1 << 18  # decoded at a time: large against a frame, small against a level-2 cache
SMALLEST_FRAME_BYTES = kernels.SMALLEST_BODY + 2  # on the wire: a code byte and the delimiter come with every body

U8 = npt.NDArray[np.uint8]
I64 = npt.NDArray[np.int64]


class BulkDecoder:
    """Incremental decoder; memory is MAX_FRAME_BYTES and one chunk, allocated here."""

    def __init__(self) -> None:
        self._raw = bytearray(MAX_FRAME_BYTES + CHUNK_BYTES)
        self.buffer: U8 = np.frombuffer(self._raw, np.uint8)
        self.buffer[:] = 0  # touched, as what np.full makes: else each page is a fault when it is first used
        self._view = memoryview(self._raw)
        self._bodies: I64 = np.full((len(self.buffer) // SMALLEST_FRAME_BYTES + 1, 2), 0, np.int64)
        self._tally: I64 = np.zeros(kernels.N_TALLIES, np.int64)

    @property
    def counters(self) -> DecoderCounters:
        """What has been seen since the decoder was made."""
        tally = self._tally.tolist()
        return DecoderCounters(
            frames=tally[kernels.FRAMES],
            bytes_in=tally[kernels.BYTES_IN],
            crc_errors=tally[kernels.CRC_ERRORS],
            cobs_errors=tally[kernels.COBS_ERRORS],
            short_frames=tally[kernels.SHORT_FRAMES],
            oversized_frames=tally[kernels.OVERSIZED],
            bytes_discarded=tally[kernels.DISCARDED],
        )

    @property
    def arrays(self) -> tuple[U8, I64, I64]:
        """The buffer, the spans of its bodies and the tally: what compiled code continues (turn/kernels.py)."""
        return self.buffer, self._bodies, self._tally

    @property
    def held_bytes(self) -> int:
        """Bytes of a frame whose delimiter has not come yet."""
        return int(self._tally[kernels.HELD])

    def bodies(self, data: bytes | bytearray | memoryview | U8) -> Iterator[I64]:
        """Yield, chunk by chunk, the spans (n, 2) of header + payload in `buffer`, valid until the next chunk.

        The iterator must be used up: it takes `data` in as it goes.
        """
        source = np.frombuffer(data, np.uint8)
        tally = self._tally
        tally[kernels.BYTES_IN] += len(source)
        for start in range(0, len(source), CHUNK_BYTES):
            part = source[start : start + CHUNK_BYTES]
            waiting, held = int(tally[kernels.CONSUMED]), int(tally[kernels.HELD])
            if waiting and held:
                self.buffer[:held] = self.buffer[waiting : waiting + held].copy()
            used = held + len(part)
            self.buffer[held:used] = part
            count = kernels.unstuff_frames(self.buffer, used, MAX_FRAME_BYTES, SCHEMA, self._bodies, tally)
            tally[kernels.HELD] = used - tally[kernels.CONSUMED]
            yield self._bodies[:count]

    def feed(self, data: bytes | bytearray | memoryview) -> list[Frame]:
        """Return the frames that `data` completes, in order; damaged ones are counted and dropped."""
        if len(data) > CHUNK_BYTES:
            return [self.frame(first, stop) for spans in self.bodies(data) for first, stop in spans.tolist()]
        return [self.frame(first, stop) for first, stop in self.take(bytes(data)).tolist()]

    @staticmethod
    def pieces(data: bytes) -> list[bytes]:
        """Return `data` in pieces that `take` takes; all but very long reads are one."""
        if len(data) <= CHUNK_BYTES:
            return [data]
        return [data[first : first + CHUNK_BYTES] for first in range(0, len(data), CHUNK_BYTES)]

    def take(self, data: bytes) -> I64:
        """Return the spans (n, 2) in `buffer` of what at most CHUNK_BYTES of `data` complete, valid until the next bytes.

        One call of one kernel: what a small message costs is Python's way there and back.
        """
        count = kernels.take_in(data, self.buffer, MAX_FRAME_BYTES, SCHEMA, self._bodies, self._tally)
        return self._bodies[:count]

    def stream_stop(self, spans: I64, first: int, session: int) -> int:
        """Return the place of the first of `spans` from `first` on that is no stream message of `session`."""
        return int(kernels.stream_stop(self.buffer, spans, first, session))

    def frame(self, first: int, stop: int) -> Frame:
        """Return what lies between `first` and `stop` in `buffer` as a frame of its own."""
        kind, flags, _, session = HEADER.unpack_from(self._raw, first)
        return Frame(kind, flags, session, bytes(self._view[first + HEADER.size : stop]))

    def resume(self, counters: DecoderCounters, unfinished: bytes, skipping: bool) -> None:
        """Take over from another decoder: its counts, the bytes of its unfinished frame, and whether it skips an oversized one."""
        tally = self._tally
        tally[kernels.FRAMES], tally[kernels.CRC_ERRORS] = counters.frames, counters.crc_errors
        tally[kernels.COBS_ERRORS], tally[kernels.SHORT_FRAMES] = counters.cobs_errors, counters.short_frames
        tally[kernels.OVERSIZED], tally[kernels.DISCARDED] = counters.oversized_frames, counters.bytes_discarded
        tally[kernels.SKIPPING] = skipping
        tally[kernels.BYTES_IN] = counters.bytes_in
        tally[kernels.HELD], tally[kernels.CONSUMED] = len(unfinished), 0
        self.buffer[: len(unfinished)] = np.frombuffer(unfinished, np.uint8)

    def warm_up(self) -> None:
        """Compile or load the kernels, without counting anything."""
        tally = np.zeros(kernels.N_TALLIES, np.int64)
        kernels.unstuff_frames(self.buffer, 0, MAX_FRAME_BYTES, SCHEMA, self._bodies, tally)
        kernels.take_in(b"", self.buffer, MAX_FRAME_BYTES, SCHEMA, self._bodies, tally)
        kernels.stream_stop(self.buffer, self._bodies[:0], 0, 1)
