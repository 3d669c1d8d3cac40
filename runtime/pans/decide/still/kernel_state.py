"""The state of a `still.Core` as arrays that the kernel continues: loaded before a call, stored after it.

Both continue the same state, so that the kernel's rows are those that the core alone would give. `Core.steps` makes it;
decide/kernel/calls.py calls the kernel.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.bundle.backends import NO_LABEL, Decider, verdicts_of
from pans.decide.decision import DECISION_DTYPE, DecisionFlag
from pans.decide.plan.plan import Plan
from pans.protocol.wire import Mark
from pans.protocol.wire import kernels as place

from . import kernels
from .kernels import DecisionTables, FrameWalkArrays, IdleArrays, MarkArrays, WalkArrays
from .windows import DecisionWindows, WindowArrays

ROWS_PER_CALL = 1 << 17  # decisions of one call, beside those of a block; a megabyte per 18 000
COUNTS_PER_CALL = 1 << 21  # counts of theirs that a back end is asked for: 16 MiB
WORD_FEATURES = 24  # of tables by word: what kernels.py looks up at once
CLICKS_MAX = 1 << 16  # exposures of one block: its count is a u16
_LARGEST = (1 << 62) - 1

Rows = npt.NDArray[np.void]


class CoreState:
    """What the kernel continues of `core` (a still.Core), whose windows are `windows`; all memory is allocated here, before arming."""

    def __init__(self, core: Any, windows: DecisionWindows, plan: Plan, decider: Decider, shots: int) -> None:
        self.core, self.windows = core, windows
        self._decider, self._shots = decider, shots
        self.tables = decision_tables(decider, shots, plan)
        asked = 0 if self.decides else decider.n_features
        rows_max = 2 * self.block_rows + min(ROWS_PER_CALL, COUNTS_PER_CALL // max(asked, 1))
        # np.full touches what it makes; np.zeros would leave that to the first use, a fault of a page each
        self._rows: Rows = np.full(rows_max, 0, DECISION_DTYPE)
        self._counts = np.full((rows_max if asked else 0, decider.n_features), 0, np.int64)
        n = kernels.MARK_SLOTS
        self._marks = MarkArrays(np.full(n, -1, np.int64), np.full(n, 0, np.int16), np.full(n, 0, np.float32))
        one_by_one = 0 if windows.parallel else CLICKS_MAX
        arrays = WindowArrays(
            *windows.arrays(),
            np.zeros(-(-decider.n_features // 8), np.uint64),
            np.zeros(decider.n_features, np.int64),
            plan.slot_offset_ticks.astype(np.int64),
            np.full(one_by_one, 0, np.uint16),
            np.full(one_by_one, 0, np.uint8),
        )
        state = self._state = np.zeros(kernels.N_STATE, np.int64)
        state[kernels.EXPOSURE_TICKS], state[kernels.VISIT_EXPOSURES] = plan.exposure_ticks, windows.visit_exposures
        state[kernels.PERIOD_TICKS], state[kernels.CYCLE_TICKS] = plan.slot_period_ticks, plan.cycle_ticks
        state[kernels.SHOTS], state[kernels.N_CLASSES] = shots, core.n_classes
        kind = FrameWalkArrays if windows.parallel else WalkArrays
        self.walk = kind(state, self._marks, arrays, self.tables, self._rows, self._counts, core.tracker.heard)

    @property
    def takes(self) -> bool:
        """Whether the kernel may take the core's messages."""
        return bool(self.core.tracker.open)

    @property
    def decides(self) -> bool:
        """Whether the kernel gives the labels, too: with a table or an automaton. Else `rows` asks the back end for many at once."""
        return bool(self.tables.labels.size)

    @property
    def block_rows(self) -> int:
        """Most decisions of one block."""
        return min(self.windows.n_windows, CLICKS_MAX)

    def begin(self, session: int) -> None:
        """Follow the stream of `session`, from where the core stands: its marks are known, others forgotten."""
        self._state[kernels.SESSION] = session
        self._marks.objects[:] = -1
        for mark in self.core.marks.latest():
            self.remember(mark)

    def remember(self, mark: Mark) -> None:
        """Know a mark from here on."""
        slot = mark.object_index % kernels.MARK_SLOTS
        self._marks.objects[slot], self._marks.truths[slot] = mark.object_index, mark.truth
        self._marks.photons[slot] = mark.photons

    def photons_of(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return the expected photoelectrons of one shot on each of objects (n,), float32 (n,), NaN where no mark told them."""
        slots = numbers & (kernels.MARK_SLOTS - 1)  # a power of two
        return np.where(self._marks.objects[slots] == numbers, self._marks.photons[slots], np.float32(np.nan))

    def rows(self, first: int, stop: int) -> Rows:
        """Return the rows from `first` to `stop`; those that the kernel could not decide get their verdicts here, all at once."""
        rows = self._rows[first:stop]
        if self.decides or not len(rows):
            return rows
        whole = np.flatnonzero(rows["flags"] == 0)
        labels, probabilities = _finite(*verdicts_of(self._decider, self._counts[first + whole], self._shots))
        rows["label"][whole], rows["probability"][whole] = labels, probabilities
        silent = labels == NO_LABEL
        why = np.where(probabilities > 0, int(DecisionFlag.AMBIGUOUS), int(DecisionFlag.NOT_FINITE))
        rows["flags"][whole[silent]] = why[silent] | int(DecisionFlag.ABSTAINED)
        self.core.n_abstained += int(silent.sum())
        return rows

    def load(self) -> None:
        """Copy what Core, its tracker and its windows know into the kernel's state."""
        state = self._state
        load_core(self.core, state)
        state[kernels.VISIT], state[kernels.NEXT_WINDOW], state[kernels.OBJECT] = self.windows.position

    def store(self, state: npt.NDArray[np.int64]) -> None:
        """Copy what the kernel did back: its state, or what that was when a batch was handed over."""
        found = state.tolist()
        if store_core(self.core, found):
            self.windows.advance((found[kernels.VISIT], found[kernels.NEXT_WINDOW], found[kernels.OBJECT]))


def load_core(core: Any, state: npt.NDArray[np.int64]) -> None:
    """Copy where a core (a Follower) and its tracker stand into the kernel's state."""
    state[kernels.N_ROWS], state[kernels.START_TICK] = 0, min(core.start_tick, _LARGEST)
    state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE], state[place.DROPS] = core.tracker.position
    state[place.MESSAGES] = state[place.EXPOSURES] = 0
    state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED] = core.n_decisions, core.n_abstained
    state[place.END_EXPOSURE] = min(core.end_exposure, 1 << 62)
    state[kernels.LAST_TICK], state[kernels.JITTER] = min(core.last_tick, _LARGEST), min(core.jitter_ticks, _LARGEST)


def store_core(core: Any, state: list[int]) -> bool:
    """Copy what the kernel did back; return whether it took any message."""
    core.n_decisions, core.n_abstained = state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED]
    if not state[place.MESSAGES]:
        return False
    core.tracker.advance(
        (state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE]), state[place.MESSAGES], state[place.EXPOSURES]
    )
    if state[kernels.LAST_TICK] != min(core.last_tick, _LARGEST):  # a larger one only Python's integers hold
        core.last_tick = state[kernels.LAST_TICK]
    core.jitter_ticks = max(core.jitter_ticks, state[kernels.JITTER])
    return True


class IdleSteps:
    """What the kernel has of a core (a Follower) that takes every message itself: it only receives and checks."""

    takes, decides, block_rows = False, False, 1

    def __init__(self, core: Any) -> None:
        self.walk = IdleArrays(np.zeros(kernels.N_STATE, np.int64), np.zeros(1, DECISION_DTYPE), core.tracker.heard)

    def begin(self, session: int) -> IdleSteps:
        """Receive messages of `session`."""
        self.walk.state[kernels.SESSION] = session
        return self

    def rows(self, first: int, stop: int) -> Rows:
        """Return no rows."""
        return self.walk.rows[:0]

    def load(self) -> None:
        """Nothing is continued."""

    def store(self, state: npt.NDArray[np.int64]) -> None:
        """Nothing was."""


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
    by_word = shots == 1 and plan.mode == "parallel" and found is not None and n_features <= WORD_FEATURES
    n_bytes = -(-n_features // 8) if by_word else 0
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
