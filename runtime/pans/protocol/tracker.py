"""Stream messages -> blocks in order, with every gap made visible.

`StreamTracker.accept` returns the block or
mark of a stream frame (None when it is damaged or repeated) and the gap before it (None when there is none). A repeat is compared with
the message whose number it has: `differs` says where it holds something else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pans.protocol.wire.framing import Frame, content_crc
from pans.protocol.wire.messages import STREAM_DECODERS, ClickBlock, FrameBlock, Mark
from pans.protocol.wire.schema import MAX_GAP_EXPOSURES, RECEIVE_WINDOW, MalformedMessage

SEQUENCE = 1 << 32
HALF_SEQUENCE = 1 << 31
MEMORY_BYTES = RECEIVE_WINDOW * 4 + RECEIVE_WINDOW // 8  # of StreamTracker.memory


class Gap(NamedTuple):
    """Exposures that will never arrive: from `first_exposure` on, `exposures` of them, `dropped_by_device` of those on the device."""

    first_exposure: int
    exposures: int
    messages: int
    dropped_by_device: int

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        return {"kind": "gap", **self._asdict()}


class Differs(NamedTuple):
    """A repeat of another content than the message that came first under its number: the CRC-32 of both (framing.content_crc)."""

    exposure_index: int
    found: int
    expected: int


@dataclass(slots=True)
class StreamCounters:
    """Totals since ARM. `lost_exposures` includes those that the device dropped, `repeated` those that differ or are not compared."""

    messages: int = 0
    exposures: int = 0
    gaps: int = 0
    lost_messages: int = 0
    lost_exposures: int = 0
    device_drops: int = 0
    repeated: int = 0
    repeats_differing: int = 0  # of another content than what came first under their number
    repeats_unchecked: int = (
        0  # overtaken and reported lost, or more than RECEIVE_WINDOW numbers ago: nothing to compare with
    )
    malformed: int = 0
    unexplained_drops: int = 0  # messages whose drops do not agree with what is missing


COUNTED = tuple(one.name for one in fields(StreamCounters))
# What kernels and StreamTracker know of a stream: what comes next, the device's drop counter, the messages lost since the last block
# (reported with the next gap in the exposures), and the totals.
STREAM_FIELDS = ("next_seq", "next_exposure", "drops", "lost_before", *COUNTED)


def state_dtype(names: Sequence[str]) -> np.dtype[np.void]:
    """Return the record of a state that kernels and Python share: one int64 for each of `names`.

    Kernels and the uncompiled code read `state.next_seq` of its rows. `StateField` makes the same an attribute of a Python object.
    """
    return np.dtype((np.record, np.dtype([(name, np.int64) for name in names], align=True)))


STREAM_DTYPE = state_dtype(STREAM_FIELDS)
_TOTALS = STREAM_FIELDS.index(COUNTED[0])


class StateField:
    """A field of a state as an attribute of an object with `cells`, the state as int64 (n,).

    Any thread may read it while a kernel runs; Python writes only while no kernel does. The record holds at most `largest`: of a number
    above, which kernels do not see, `beyond` of the object remembers the exact value until the field changes.
    """

    def __init__(self, dtype: np.dtype[np.void], largest: int | None = None) -> None:
        self._dtype, self._largest = dtype, largest

    def __set_name__(self, owner: type, name: str) -> None:
        self._name, self._cell = name, (self._dtype.names or ()).index(name)

    def __get__(self, one: Any, owner: type) -> int:
        found: int = one.cells.item(self._cell)
        return one.beyond.get(self._name, found) if found == self._largest else found

    def __set__(self, one: Any, value: int) -> None:
        if self._largest is not None and value > self._largest:
            one.beyond[self._name], value = value, self._largest
        elif self._largest is not None:
            one.beyond.pop(self._name, None)
        one.cells[self._cell] = value


class StreamTracker:
    """Follows one stream from ARM on; sequence numbers and drop counters may wrap.

    `state` is a record (1,) that begins with STREAM_FIELDS, for a kernel to go on from; without one it has its own.
    """

    next_seq = StateField(STREAM_DTYPE)
    next_exposure = StateField(STREAM_DTYPE, (1 << 63) - 1)  # that of a block at the end of its range is above
    drops = StateField(STREAM_DTYPE)
    lost_before = StateField(STREAM_DTYPE)

    def __init__(self, state: npt.NDArray[np.void] | None = None) -> None:
        self.cells: npt.NDArray[np.int64] = (np.zeros(1, STREAM_DTYPE) if state is None else state).view(np.int64)
        self.beyond: dict[str, int] = {}
        self._finished = False
        # number and CRC-32 of what was taken last, in row number % RECEIVE_WINDOW; kernels write to it too (wire/kernels.hear)
        self.heard: npt.NDArray[np.int64] = np.full((RECEIVE_WINDOW, 2), -1, np.int64)
        self.differs: Differs | None = None  # of the latest frame

    def accept(self, frame: Frame) -> tuple[ClickBlock | FrameBlock | Mark | None, Gap | None]:
        """Take one stream frame; see the module's docstring."""
        self.differs = None
        try:
            message = STREAM_DECODERS[frame.type](frame.payload)
        except (KeyError, MalformedMessage):  # another type, or a payload that makes no sense
            self._count("malformed")
            return None, None
        ahead = (message.seq - self.next_seq) % SEQUENCE
        if ahead >= HALF_SEQUENCE or self._finished:  # seen before, or overtaken: a late photon is useless
            self._take_repeat(frame, message)
            return None, None
        if ahead >= RECEIVE_WINDOW or not self._in_reach(message):
            self._count("malformed")
            return None, None
        self.lost_before += ahead
        self._count("lost_messages", ahead)
        self._count("messages")
        self.next_seq = (message.seq + 1) % SEQUENCE
        self.heard[message.seq % RECEIVE_WINDOW] = message.seq, content_crc(frame)
        if isinstance(message, Mark):
            return message, None
        n_exposures = len(message.patterns) if isinstance(message, ClickBlock) else len(message.words)
        gap = self._gap_before(message.exposure_index, message.drops)
        self.next_exposure = message.exposure_index + n_exposures
        self._count("exposures", n_exposures)
        return message, gap

    def _take_repeat(self, frame: Frame, message: ClickBlock | FrameBlock | Mark) -> None:
        """Count a message whose number has passed, and compare it with the one that was taken under that number."""
        self._count("repeated")
        number, expected = self.heard[message.seq % RECEIVE_WINDOW].tolist()
        if number != message.seq:
            self._count("repeats_unchecked")
        elif (found := content_crc(frame)) != expected:
            self._count("repeats_differing")
            self.differs = Differs(message.exposure_index, found, expected)

    def _in_reach(self, message: ClickBlock | FrameBlock | Mark) -> bool:
        """Whether a block lies ahead, and not too far: a device that counts backwards never rewrites the past."""
        return isinstance(message, Mark) or 0 <= message.exposure_index - self.next_exposure <= MAX_GAP_EXPOSURES

    @property
    def counters(self) -> StreamCounters:
        """The totals by now; any thread may ask."""
        return StreamCounters(*self.cells[_TOTALS : _TOTALS + len(COUNTED)].tolist())

    def _count(self, name: str, by: int = 1) -> None:
        self.cells[_TOTALS + COUNTED.index(name)] += by

    @property
    def open(self) -> bool:
        """Whether the stream has not been finished."""
        return not self._finished

    @property
    def position(self) -> tuple[int, int, int]:
        """The sequence number and exposure that come next, and the device's drop counter."""
        return self.next_seq, self.next_exposure, self.drops

    def resume(self, position: tuple[int, int, int], memory: bytes = b"") -> None:
        """Go on from a `position` that another tracker had, with its `memory`; without one, earlier messages are not known."""
        self.next_seq, self.next_exposure, self.drops = position
        self.heard[:] = -1
        if memory:
            numbers = self._numbers()
            known = np.unpackbits(np.frombuffer(memory, np.uint8, offset=4 * RECEIVE_WINDOW)).astype(bool)
            crcs = np.frombuffer(memory, "<u4", RECEIVE_WINDOW)
            self.heard[numbers[known] % RECEIVE_WINDOW] = np.column_stack((numbers, crcs))[known]

    @property
    def memory(self) -> bytes:
        """The CRC-32 of the RECEIVE_WINDOW messages before the next one, u32 each, then a bit each: whether it was taken."""
        rows = self.heard[(numbers := self._numbers()) % RECEIVE_WINDOW]
        known = rows[:, 0] == numbers
        return bytes(np.where(known, rows[:, 1], 0).astype("<u4").tobytes() + np.packbits(known).tobytes())

    def _numbers(self) -> npt.NDArray[np.int64]:
        return (self.next_seq - RECEIVE_WINDOW + np.arange(RECEIVE_WINDOW)) % SEQUENCE

    def finish(self, next_exposure: int, drops: int) -> Gap | None:
        """Close the stream: the device says it stopped before `next_exposure`; return the gap at the end, if any.

        What still comes is counted as repeated: it was taken, or has been reported lost.
        """
        self._finished = True
        if not 0 <= next_exposure - self.next_exposure <= MAX_GAP_EXPOSURES:
            self._count("unexplained_drops")
            return None
        gap = self._gap_before(next_exposure, drops, at_end=True)
        self.next_exposure = next_exposure
        return gap

    def restart(self) -> None:
        """Follow the stream of another ARM; the totals go on."""
        self.next_seq = self.next_exposure = self.drops = self.lost_before = 0
        self._finished = False
        self.heard[:] = -1

    def _gap_before(self, exposure_index: int, drops: int, *, at_end: bool = False) -> Gap | None:
        """Account for what is missing before `exposure_index`: dropped by the device, or lost with messages that it sent.

        At the end it is not known how many messages those are.
        """
        missing = exposure_index - self.next_exposure
        dropped = (drops - self.drops) % SEQUENCE
        self.drops = drops
        if dropped > missing or (dropped < missing and not self.lost_before and not at_end):
            self._count("unexplained_drops")
            dropped = min(dropped, missing)
        self._count("device_drops", dropped)
        lost_messages, self.lost_before = self.lost_before, 0
        if missing == 0:
            return None
        self._count("gaps")
        self._count("lost_exposures", missing)
        return Gap(self.next_exposure, missing, lost_messages, dropped)
