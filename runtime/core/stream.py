"""The streaming core for fast parallel measurements: wire bytes in, rows of the decision log out, in compiled kernels.

Owns the hand-over between the kernels, which take what is ordinary, and `core.Core`, which takes everything else: both continue the same
state, so that the rows are those that Core alone would give. Never waits, records or acts. `StreamCore.feed` yields `Batch`es.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pans.runtime.decide.verdict import Decider, verdicts_of
from pans.runtime.errors import UsageError
from pans.runtime.wire import walk as place
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.frame import Frame, unpack_body
from pans.runtime.wire.messages import Mark, MessageType

from . import stream_kernels as kernels
from .decision import DECISION_DTYPE, NO_LABEL, CoreEvent, Decision, DecisionFlag
from .plan import Plan
from .still import Core
from .stream_kernels import DecisionTables, MarkArrays, WindowArrays

ROWS_PER_BATCH = 8192
_STREAM_TYPES = (MessageType.CLICKS, MessageType.FRAMES, MessageType.MARK, MessageType.STATUS)

U8 = npt.NDArray[np.uint8]


class Batch(NamedTuple):
    """What came of some messages: rows (n,) of DECISION_DTYPE, a view that is valid until the next batch, events, and other frames."""

    rows: npt.NDArray[np.void]
    events: Sequence[CoreEvent]
    others: list[Frame]


class StreamCore:
    """A decoder and a core in parallel mode, for the session `session`; all memory is allocated here, before arming."""

    def __init__(self, plan: Plan, decider: Decider, shots: int, n_cycles: int, session: int) -> None:
        if plan.mode != "parallel":
            raise UsageError(
                f"the streaming core is for parallel plans, this one is {plan.mode}", remedy="use core.Core"
            )
        self.core = Core(plan, decider, shots, n_cycles)
        self.decoder = BulkDecoder()
        self.wrong_session = 0
        self._decider, self._shots = decider, shots
        self._rows: npt.NDArray[np.void] = np.zeros(ROWS_PER_BATCH, DECISION_DTYPE)
        self._counts = np.zeros((ROWS_PER_BATCH, decider.n_features), np.int64)
        self._marks = MarkArrays(
            np.full(kernels.MARK_SLOTS, -1, np.int64),
            np.zeros(kernels.MARK_SLOTS, np.int16),
            np.zeros(kernels.MARK_SLOTS, np.float32),
        )
        self._tables = decision_tables(decider, shots)
        windows = self.core.windows
        self._windows = WindowArrays(
            *windows.arrays(),
            np.zeros(-(-decider.n_features // 8), np.uint64),
            np.zeros(decider.n_features, np.int64),
            plan.slot_offset_ticks.astype(np.int64),
        )
        self._state = np.zeros(kernels.N_STATE, np.int64)
        self._state[kernels.SESSION] = session
        self._state[kernels.EXPOSURE_TICKS] = plan.exposure_ticks
        self._state[kernels.VISIT_EXPOSURES] = windows.visit_exposures
        self._state[kernels.SHOTS] = shots
        self._state[kernels.PERIOD_TICKS], self._state[kernels.CYCLE_TICKS] = plan.slot_period_ticks, plan.cycle_ticks
        self._state[kernels.N_CLASSES] = decider.n_classes

    def warm_up(self) -> None:
        """Compile or load every kernel of the path, before arming."""
        self.decoder.warm_up()
        self.core.warm_up()
        self._load()
        self._walk(np.zeros((0, 2), np.int64))

    def photons_of(self, objects: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.float32]:
        """Return the expected photoelectrons of one shot on each object, float32 (n,), NaN where no mark told them."""
        slots = objects.astype(np.int64) % kernels.MARK_SLOTS
        known = self._marks.objects[slots] == objects
        return np.where(known, self._marks.photons[slots], np.float32(np.nan))

    def feed(self, data: bytes | bytearray | memoryview | U8) -> Iterator[Batch]:
        """Take bytes as they arrived, whatever they hold; the iterator must be used up."""
        for spans in self.decoder.bodies(data):
            yield from self._take(spans)

    def _take(self, spans: npt.NDArray[np.int64]) -> Iterator[Batch]:
        state = self._state
        state[kernels.MESSAGE] = state[kernels.FRAME] = 0
        while state[kernels.MESSAGE] < len(spans):
            self._load()
            ended = self._walk(spans) if self.core.tracker.open else kernels.ODD
            self._store()
            if state[kernels.N_ROWS]:
                yield Batch(self._labelled(int(state[kernels.N_ROWS])), [], [])
            if ended == kernels.ODD:
                first, stop = spans[state[kernels.MESSAGE]].tolist()
                state[kernels.MESSAGE] += 1
                yield from self._take_one(unpack_body(self.decoder.buffer[first:stop].tobytes()))

    def _walk(self, spans: npt.NDArray[np.int64]) -> int:
        return int(
            kernels.walk_frames(
                self.decoder.buffer,
                spans,
                self._state,
                self._marks,
                self._windows,
                self._tables,
                self._rows,
                self._counts,
            )
        )

    def _labelled(self, n: int) -> npt.NDArray[np.void]:
        """Rows that the kernel could not label from a table get their verdicts here, all at once."""
        rows = self._rows[:n]
        if self._tables.labels.size:
            return rows
        whole = np.flatnonzero(rows["flags"] == 0)
        labels, probabilities = verdicts_of(self._decider, self._counts[whole], self._shots)
        finite = probabilities > 0
        rows["label"][whole] = np.where(finite, labels, NO_LABEL)
        rows["probability"][whole] = np.where(finite, probabilities, 0.0)
        if not finite.all():
            rows["flags"][whole[~finite]] = DecisionFlag.NOT_FINITE | DecisionFlag.ABSTAINED
            self.core.n_abstained += int((~finite).sum())
        return rows

    def _take_one(self, frame: Frame) -> Iterator[Batch]:
        """Let Core take a message that is not ordinary: one out of order, with a gap before it, or no block at all."""
        if frame.session != self._state[kernels.SESSION]:
            self.wrong_session += 1
            return
        if frame.type not in _STREAM_TYPES:
            yield Batch(self._rows[:0], [], [frame])
            return
        self._marks_to_core()
        output = self.core.step(frame)
        self._marks_from_core(frame)
        others = [frame] if frame.type == MessageType.STATUS else []
        yield from self._python_rows(output.decisions)
        if output.events or others:
            yield Batch(self._rows[:0], output.events, others)

    def _python_rows(self, decisions: list[Decision]) -> Iterator[Batch]:
        for start in range(0, len(decisions), ROWS_PER_BATCH):
            part = decisions[start : start + ROWS_PER_BATCH]
            for position, decision in enumerate(part):
                self._rows[position] = decision
            yield Batch(self._rows[: len(part)], [], [])

    def _load(self) -> None:
        """Copy what Core, its tracker and its windows know into the kernel's state."""
        core, state = self.core, self._state
        state[kernels.N_ROWS], state[kernels.START_TICK] = 0, core.start_tick
        state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE], state[place.DROPS] = core.tracker.position
        state[place.MESSAGES] = state[place.EXPOSURES] = 0
        state[kernels.VISIT], state[kernels.NEXT_WINDOW], state[kernels.OBJECT] = core.windows.position
        state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED] = core.n_decisions, core.n_abstained
        state[place.END_EXPOSURE], state[kernels.LAST_TICK] = min(core.end_exposure, (1 << 62)), core.last_tick

    def _store(self) -> None:
        """Copy what the kernel did back."""
        core, state = self.core, self._state.tolist()
        if state[place.MESSAGES]:
            core.tracker.advance(
                (state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE]),
                state[place.MESSAGES],
                state[place.EXPOSURES],
            )
            core.windows.position = (state[kernels.VISIT], state[kernels.NEXT_WINDOW], state[kernels.OBJECT])
            core.last_tick = state[kernels.LAST_TICK]
        core.n_decisions, core.n_abstained = state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED]

    def _marks_to_core(self) -> None:
        known = np.flatnonzero(self._marks.objects >= 0)
        for slot in known.tolist():
            number = int(self._marks.objects[slot])
            truth, photons = int(self._marks.truths[slot]), float(self._marks.photons[slot])
            self.core.marks[number] = Mark(0, number, truth, 0, 0, photons)
        if len(self.core.marks) > kernels.MARK_SLOTS:
            self.core.marks = {number: self.core.marks[number] for number in self._marks.objects[known].tolist()}

    def _marks_from_core(self, frame: Frame) -> None:
        if frame.type != MessageType.MARK or not self.core.marks:
            return
        mark = self.core.marks[next(reversed(self.core.marks))]
        if struct.pack("<II", mark.seq, mark.object_index) != frame.payload[:8]:
            return  # it was not taken
        slot = mark.object_index % kernels.MARK_SLOTS
        self._marks.objects[slot], self._marks.truths[slot] = mark.object_index, mark.truth
        self._marks.photons[slot] = mark.photons


def decision_tables(decider: Decider, shots: int) -> DecisionTables:
    """Return the tables of a table back end (empty for any other) and those of the counts' checksum for K = `shots`."""
    n_features = decider.n_features
    labels, probabilities = np.zeros(0, np.uint16), np.zeros(0, np.float32)
    radix = np.zeros(n_features, np.int64)
    found = getattr(decider, "radix", None)
    if found is not None:
        labels = np.ascontiguousarray(getattr(decider, "labels"), np.uint16)  # noqa: B009
        probabilities, radix = np.array(getattr(decider, "probabilities")), found  # noqa: B009
    table, zero = count_crc_tables(n_features, shots)
    n_bytes = -(-n_features // 8) if shots == 1 and found is not None else 0
    word_rows, word_crc = np.zeros((n_bytes, 256), np.int64), np.zeros((n_bytes, 256), np.uint32)
    for feature in range(n_features if n_bytes else 0):
        byte, bit = feature >> 3, feature & 7
        clicked = np.flatnonzero(np.arange(256) >> bit & 1)
        word_rows[byte, clicked] += radix[feature]
        word_crc[byte, clicked] ^= table[0, feature, 1]
    return DecisionTables(labels, probabilities, radix, table, zero, word_rows, word_crc)


def count_crc_tables(n_features: int, shots: int) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32]]:
    """Return what each byte of each count adds (by exclusive or) to the CRC-32 of all counts as int64, and that of zeros."""
    n_bytes = max(1, (shots.bit_length() + 7) // 8)
    zeros = bytes(8 * n_features)
    base = zlib.crc32(zeros)
    table = np.zeros((n_bytes, n_features, 256), np.uint32)
    for byte in range(n_bytes):
        for feature in range(n_features):
            single = np.zeros(8, np.uint32)  # CRC-32 is linear in the bits: eight of them make all 256 values
            for bit in range(8):
                data = bytearray(zeros)
                data[8 * feature + byte] = 1 << bit
                single[bit] = zlib.crc32(data) ^ base
            for bit in range(8):
                table[byte, feature, 1 << bit : 2 << bit] = table[byte, feature, : 1 << bit] ^ single[bit]
    return table, np.array([base], np.uint32)
