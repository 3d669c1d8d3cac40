"""Many of a core's steps at once: ordinary messages through compiled kernels, on the state of the core itself.

Owns the hand-over between `still.Core` and stream_kernels.py: both continue the same state, so that the rows are those that Core alone
would give. What is not ordinary (out of order, behind a gap, no stream message) it leaves to the caller, who gives it to the core by
`step`. Never waits, records or acts.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.runtime.decide.verdict import Decider, verdicts_of
from pans.runtime.wire import walk as place
from pans.runtime.wire.frame import Frame, Messages
from pans.runtime.wire.messages import Mark, MessageType

from . import stream_kernels as kernels
from .decision import (
    DECISION_DTYPE,
    NO_LABEL,
    RUN_DTYPE,
    VERDICT_DTYPE,
    DecisionFlag,
    NumberedDecisions,
    Output,
    RowDecisions,
)
from .follower import Follower
from .plan import Plan
from .stream_arrays import DecisionTables, FrameWalkArrays, MarkArrays, NumberArrays, WalkArrays
from .window import DecisionWindows
from .window_kernels import ONES, WindowArrays

ROWS_PER_BATCH = 65536  # fewer and longer ways through Python; memory for them is a megabyte per 18 000
NUMBERS_PER_BATCH = 1 << 17  # of decisions that are numbered: at a frame a microsecond, those between two clock probes
ASKED_FOR = 1 << 12  # of them, rows that are asked for again and again: as many as a recorder's buffer holds
WORD_FEATURES = 24  # of tables by word: what stream_kernels.py looks up at once
CLICKS_MAX = 1 << 16  # exposures of one block: its count is a u16
_KINDS = {"parallel": place.FRAMES, "sequential": place.CLICKS}
_LARGEST = (1 << 62) - 1

Rows = npt.NDArray[np.void]


def rows_needed(n_windows: int, aim: int = ROWS_PER_BATCH) -> int:
    """Return how many rows hold `aim` decisions and those of one block more."""
    return aim + min(n_windows, CLICKS_MAX)


class BulkSteps:
    """The compiled steps of `core`, whose windows are `windows`; all memory is allocated here, before arming.

    `rows_max` decisions are given at once.
    """

    def __init__(
        self,
        core: Follower,
        windows: DecisionWindows,
        plan: Plan,
        decider: Decider,
        shots: int,
        rows_max: int = ROWS_PER_BATCH,
    ) -> None:
        self.core, self.windows = core, windows
        self._decider, self._shots = decider, shots
        self.tables = decision_tables(decider, shots, plan)
        self._verdicts = word_verdicts(self.tables, decider.n_features)
        # np.full touches what it makes; np.zeros would leave that to the first use, a fault of a page each
        self._numbered = _numbers(rows_max if len(self._verdicts) else 0, windows)
        self._rows: Rows = np.zeros(rows_max, DECISION_DTYPE)
        self._rows[: ASKED_FOR if len(self._verdicts) else rows_max] = np.zeros((), DECISION_DTYPE)
        self._counts = np.full((0 if self.tables.labels.size else rows_max, decider.n_features), 0, np.int64)
        self._marks, self._told = _no_marks(), _no_marks()  # as the kernel knows them, and as the core does
        sequential = plan.mode != "parallel"
        self._windows = WindowArrays(
            *windows.arrays(),
            np.zeros(-(-decider.n_features // 8), np.uint64),
            np.zeros(decider.n_features, np.int64),
            plan.slot_offset_ticks.astype(np.int64),
            np.full(CLICKS_MAX if sequential else 0, 0, np.uint16),
            np.full(CLICKS_MAX if sequential else 0, 0, np.uint8),
        )
        self._state = np.zeros(kernels.N_STATE, np.int64)
        self._state[kernels.EXPOSURE_TICKS] = plan.exposure_ticks
        self._state[kernels.VISIT_EXPOSURES] = windows.visit_exposures
        self._state[kernels.SHOTS] = shots
        self._state[kernels.PERIOD_TICKS], self._state[kernels.CYCLE_TICKS] = plan.slot_period_ticks, plan.cycle_ticks
        self._state[kernels.N_CLASSES] = core.n_classes
        self._state[kernels.KIND] = _KINDS[plan.mode]
        out = self._rows, self._counts, self._numbered
        self._walk = WalkArrays(self._state, self._marks, self._windows, self.tables, *out, core.tracker.heard)

    @property
    def walk(self) -> WalkArrays:
        """What a kernel continues between `load` and `store`."""
        made = FrameWalkArrays if self._state[kernels.KIND] == place.FRAMES else WalkArrays
        return made(*self._walk)

    @property
    def decides(self) -> bool:
        """Whether kernels give the labels, too: with a table or an automaton. Else `labelled` asks the back end for many at once."""
        return bool(self.tables.labels.size)

    @property
    def block_rows(self) -> int:
        """Most decisions of one block."""
        return min(self.windows.n_windows, CLICKS_MAX)

    @property
    def stamps(self) -> npt.NDArray[np.uint16]:
        """The patterns shown of the latest CLICKS block that a kernel looked at, and whatever stood behind them before."""
        return self._windows.stamps

    @property
    def bits(self) -> npt.NDArray[np.uint8]:
        """The clicks that belong to `stamps`."""
        return self._windows.bits

    def warm_up(self) -> None:
        """Compile or load the kernels, before arming."""
        self.begin(0)
        self.take(Messages(np.zeros(8, np.uint8), np.zeros((0, 2), np.int64)), 0)

    def begin(self, session: int) -> None:
        """Follow the stream of `session`, from where the core stands: its marks are known, others forgotten."""
        self._state[kernels.SESSION] = session
        self._marks.objects[:] = self._told.objects[:] = -1
        for mark in self.core.marks.values():
            self._remember(mark)

    def take(self, messages: Messages, first: int, blocks: int = 0) -> tuple[int, Rows, bool]:
        """Take messages from `first` on: how far that went, the decisions (n,) of it, and whether the message there is not ordinary.

        It ends at what is not ordinary, when there is no room for more decisions, and behind `blocks` blocks (0: any number). Rows are
        valid until the next call.
        """
        state = self._state
        state[kernels.MESSAGE] = first
        state[kernels.STEPS] = blocks
        self.load()
        ended = kernels.ODD
        if self.core.tracker.open:
            ended = kernels.walk_messages(*messages, self._walk)
        self.store()
        return int(state[kernels.MESSAGE]), self.labelled(int(state[kernels.N_ROWS])), ended == kernels.ODD

    def step(self, frame: Frame) -> Output:
        """Let the core take a message that is not ordinary."""
        self.hand_over()
        output = self.core.step(frame)
        if frame.type == MessageType.MARK and self.core.marks:
            mark = self.core.marks[next(reversed(self.core.marks))]
            if struct.pack("<II", mark.seq, mark.object_index) == frame.payload[:8]:  # it was taken
                self._remember(mark)
        return output

    def photons_of(self, objects: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.float32]:
        """Return the expected photoelectrons of one shot on each object, float32 (n,), NaN where no mark told them."""
        slots = objects.astype(np.int64) % kernels.MARK_SLOTS
        known = self._marks.objects[slots] == objects
        return np.where(known, self._marks.photons[slots], np.float32(np.nan))

    def labelled(self, n: int) -> Rows:
        """Return the first `n` rows; those that the kernel could not label from a table get their verdicts here, all at once."""
        if self._numbered.numbers.size:
            return self.decisions(slice(0, n)).rows
        rows = self._rows[:n]
        if self.tables.labels.size or not n:
            return rows
        whole = np.flatnonzero(rows["flags"] == 0)
        labels, probabilities = _finite(*verdicts_of(self._decider, self._counts[whole], self._shots))
        rows["label"][whole], rows["probability"][whole] = labels, probabilities
        silent = labels == NO_LABEL
        if silent.any():
            why = np.where(probabilities > 0, int(DecisionFlag.AMBIGUOUS), int(DecisionFlag.NOT_FINITE))
            rows["flags"][whole[silent]] = why[silent] | int(DecisionFlag.ABSTAINED)
            self.core.n_abstained += int(silent.sum())
        return rows

    def decisions(self, place: slice) -> RowDecisions:
        """Return the decisions at `place`, as `labelled` gives them; their rows are made when somebody asks for them, if that can be."""
        if not self._numbered.numbers.size:
            return RowDecisions(self.labelled(place.stop))
        decided = self._verdicts, self._numbered.numbers[place], self._numbered.runs[place]

        def rows_of(first: int, stop: int) -> Rows:
            rows = self._rows[: stop - first]
            kernels.write_rows(*decided, first, stop, rows)
            return rows

        return NumberedDecisions(*decided, rows_of)

    def load(self) -> None:
        """Copy what Core, its tracker and its windows know into the kernel's state."""
        core, state = self.core, self._state
        state[kernels.N_ROWS], state[kernels.START_TICK] = 0, min(core.start_tick, _LARGEST)
        state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE], state[place.DROPS] = core.tracker.position
        state[place.MESSAGES] = state[place.EXPOSURES] = 0
        state[kernels.VISIT], state[kernels.NEXT_WINDOW], state[kernels.OBJECT] = self.windows.position
        state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED] = core.n_decisions, core.n_abstained
        state[place.END_EXPOSURE], state[kernels.LAST_TICK] = (
            min(core.end_exposure, (1 << 62)),
            min(core.last_tick, _LARGEST),
        )
        state[kernels.JITTER] = min(core.jitter_ticks, _LARGEST)

    def store(self) -> None:
        """Copy what the kernel did back."""
        core, state = self.core, self._state.tolist()
        if state[place.MESSAGES] or state[kernels.N_ROWS]:
            core.tracker.advance(
                (state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE]),
                state[place.MESSAGES],
                state[place.EXPOSURES],
            )
            self.windows.go_on((state[kernels.VISIT], state[kernels.NEXT_WINDOW], state[kernels.OBJECT]))
            if state[kernels.LAST_TICK] != min(core.last_tick, _LARGEST):  # a larger one only Python's integers hold
                core.last_tick = state[kernels.LAST_TICK]
            core.jitter_ticks = max(core.jitter_ticks, state[kernels.JITTER])
        core.n_decisions, core.n_abstained = state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED]

    def hand_over(self) -> None:
        """Tell the core of the marks that the kernel has taken: before the core does anything by itself."""
        marks, core = self._marks, self.core
        new = np.flatnonzero((marks.objects != self._told.objects) | (marks.truths != self._told.truths))
        for slot in new.tolist():
            core.marks.pop(int(self._told.objects[slot]), None)
            number = int(marks.objects[slot])
            core.marks[number] = Mark(0, number, int(marks.truths[slot]), 0, 0, float(marks.photons[slot]))
        self._told.objects[new], self._told.truths[new] = marks.objects[new], marks.truths[new]

    def told(self, mark: Mark) -> None:
        """Note that the core knows of a mark which the kernel has taken."""
        slot = mark.object_index % kernels.MARK_SLOTS
        self._told.objects[slot], self._told.truths[slot] = mark.object_index, mark.truth
        self._told.photons[slot] = mark.photons

    def _remember(self, mark: Mark) -> None:
        slot = mark.object_index % kernels.MARK_SLOTS
        for marks in (self._marks, self._told):
            marks.objects[slot], marks.truths[slot] = mark.object_index, mark.truth
            marks.photons[slot] = mark.photons


def _no_marks() -> MarkArrays:
    n = kernels.MARK_SLOTS
    return MarkArrays(np.full(n, -1, np.int64), np.full(n, 0, np.int16), np.full(n, 0, np.float32))


def _numbers(n: int, windows: DecisionWindows) -> NumberArrays:
    """Return room for `n` numbered decisions in memory that has been touched; of a plan's stretches only with room."""
    _, window_at, *_ = windows.arrays()
    goes_on = np.where(window_at[:-1] < 0, window_at[1:] == window_at[:-1], window_at[1:] == window_at[:-1] + 1)
    ends = np.append(np.flatnonzero(~goes_on) + 1, len(window_at))
    ends = ends[np.searchsorted(ends, np.arange(len(window_at) if n else 0), side="right")]
    return NumberArrays(np.full(n, 0, np.uint32), np.full(n, 0, RUN_DTYPE), ends.astype(np.int32))


def word_verdicts(tables: DecisionTables, n_features: int) -> Rows:
    """Return the verdict on each row of the table, VERDICT_DTYPE (rows,), where words are looked up at once; else none."""
    n_bytes = len(tables.word_rows)
    verdicts: Rows = np.zeros(len(tables.labels) if n_bytes else 0, VERDICT_DTYPE)
    words = np.arange(1 << n_features if n_bytes else 0)
    rows, clicks, crc = np.zeros_like(words), np.zeros_like(words), np.full(len(words), tables.crc_zero[0])
    for byte in range(n_bytes):
        part = words >> 8 * byte & 0xFF
        rows += tables.word_rows[byte, part]
        clicks += ONES[part]
        crc ^= tables.word_crc[byte, part]
    if n_bytes:
        verdicts["label"], verdicts["probability"] = tables.labels, tables.probabilities
        why = np.where(tables.probabilities > 0, int(DecisionFlag.AMBIGUOUS), int(DecisionFlag.NOT_FINITE))
        verdicts["flags"] = np.where(tables.labels == NO_LABEL, why | int(DecisionFlag.ABSTAINED), 0)
        verdicts["clicks"][rows], verdicts["counts_crc"][rows] = clicks, crc
    return verdicts


def is_numbered(decider: Decider, shots: int, plan: Plan) -> bool:
    """Whether frames of parallel channels are decided word by word: by a table, each by itself."""
    by_table = hasattr(decider, "radix") and decider.n_features <= WORD_FEATURES
    return shots == 1 and plan.mode == "parallel" and by_table


def decision_tables(decider: Decider, shots: int, plan: Plan) -> DecisionTables:
    """Return what decides without asking `decider`: its table, or the leaves of the plan's automaton (empty arrays for any other), and the
    tables of the counts' checksum for K = `shots`.
    """
    n_features = decider.n_features
    labels, probabilities = np.zeros(0, np.uint16), np.zeros(0, np.float32)
    radix = np.zeros(n_features, np.int64)
    found = getattr(decider, "radix", None) if plan.automaton is None else None
    radix = radix if found is None else np.array(found, np.int64)  # writable, always: one type to the compiler
    if found is not None or (plan.automaton is not None and getattr(decider, "automaton", None) is plan.automaton):
        labels, probabilities = _finite(getattr(decider, "labels"), getattr(decider, "probabilities"))  # noqa: B009
    table, zero = count_crc_tables(n_features, shots)
    n_bytes = -(-n_features // 8) if is_numbered(decider, shots, plan) else 0
    word_rows, word_crc = np.zeros((n_bytes, 256), np.int64), np.zeros((n_bytes, 256), np.uint32)
    for feature in range(n_features if n_bytes else 0):
        byte, bit = feature >> 3, feature & 7
        clicked = np.flatnonzero(np.arange(256) >> bit & 1)
        word_rows[byte, clicked] += radix[feature]
        word_crc[byte, clicked] ^= table[0, feature, 1]
    return DecisionTables(labels, probabilities, radix, table, zero, word_rows, word_crc)


def _finite(
    labels: npt.NDArray[Any], probabilities: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.float32]]:
    """Labels, NO_LABEL where the probability is not above 0, and probabilities, 0.0 there."""
    finite = probabilities > 0
    return np.where(finite, labels, NO_LABEL).astype(np.uint16), np.where(finite, probabilities, np.float32(0.0))


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
