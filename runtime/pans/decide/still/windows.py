"""Exposures -> windows: the K-shot click counts of each object, complete or reported incomplete, in a fixed order.

`DecisionWindows.push` returns a row for each window that a block completes, `skip_to` one for each that can no longer become complete.
Each exposure is counted once, and dark slots are tallied apart. Both are for the irregular message: the kernel of a call (kernels.py)
goes on from the same `walk` with all others.

A *visit* is the time one object stands before the detector (`cycles_per_object` cycles); its shots are grouped by K into windows. With an
automaton a window is one walk, and a cycle holds one: its clicks so far say which state each exposure must have shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.base.errors import PlanError
from pans.bundle.automaton import exposures_to_leaf
from pans.decide.core_state import CORE_DTYPE
from pans.decide.decision import DECISION_DTYPE
from pans.decide.plan.plan import Plan
from pans.protocol.tracker import StateField
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, NO_OBJECT, ClickBlock, FrameBlock, read_only

from . import kernels
from .kernels import DecisionTables, FrameWalkArrays, WalkArrays, make_marks
from .tables import no_tables
from .window_kernels import N_TALLIES, Walks, WindowArrays

_NO_WORDS = np.zeros(0, np.uint8)
CLICKS_MAX = 1 << 16  # exposures of one block: its count is a u16
MAX_VISIT_EXPOSURES = 1 << 24
WINDOWS_SEEN = 64

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
Rows = npt.NDArray[np.void]


def signed(number: int) -> int:
    """Return the int64 with the low 64 bits of `number`: rows hold ticks and exposures as uint64, in which sums come out right."""
    return number if number < 1 << 63 else number - (1 << 64)


class DecisionWindows:
    """Follows the visits of a run by the compiled steps of kernels.py; all memory is allocated here, before arming.

    `walk` is what these steps go on from. `state` is the record of the core, CORE_DTYPE (1,), `heard` its tracker's; without them it
    has its own. Without `tables` no window is decided, and `counts` are for a back end.
    """

    visit = StateField(CORE_DTYPE)  # under way
    next_window = StateField(CORE_DTYPE)  # of the visit, to be settled
    object_index = StateField(CORE_DTYPE)  # before the detector
    n_rows = StateField(CORE_DTYPE)

    def __init__(
        self,
        plan: Plan,
        n_features: int,
        shots: int,
        tables: DecisionTables | None = None,
        state: npt.NDArray[np.void] | None = None,
        heard: I64 | None = None,
    ) -> None:
        shots_per_object = plan.shots_per_cycle * plan.cycles_per_object
        if shots < 1 or shots_per_object % shots:
            raise PlanError(
                f"{shots_per_object} shots per object cannot be cut into windows of {shots}",
                remedy="choose a multiple: --trials N gives N windows of --shots K each",
            )
        self.shots = shots
        self.n_windows = shots_per_object // shots
        self.parallel = plan.mode == "parallel"
        self.largest = plan.largest
        self.visit_exposures = plan.slots_per_cycle * plan.cycles_per_object
        if self.visit_exposures > MAX_VISIT_EXPOSURES:
            raise PlanError(f"an object takes {self.visit_exposures} exposures, allowed {MAX_VISIT_EXPOSURES}")
        self.tallies: I64 = np.zeros(N_TALLIES, np.int64)
        self._channels = plan.channels_at_once  # of several, a slot's clicks are one number until its window is settled
        slots = n_features // self._channels
        self._counts: I64 = np.zeros((self.n_windows, slots), np.int64)
        self._seen: I64 = np.zeros((self.n_windows, 2), np.int64)
        self._feature_at, self._window_at = visit_maps(plan, shots)
        self._last = _last_exposures(self._window_at, self.n_windows, self.visit_exposures)
        self.walks = _make_walks(plan, slots, shots, self._last)
        longest: I64 = np.stack([self.walks.need, self._last])  # at the beginning of a visit
        self.lit: npt.NDArray[np.bool_] = self._window_at >= 0  # by exposure of a visit
        facts = np.zeros(1, CORE_DTYPE) if state is None else state
        facts[0].visit_exposures, facts[0].shots, facts[0].object_index = self.visit_exposures, shots, NO_OBJECT
        self.cells = facts.view(np.int64)
        self._pushed = -1  # the exposure behind the latest block of `push`
        one_by_one = 0 if self.parallel else CLICKS_MAX
        arrays = WindowArrays(
            *(
                self._feature_at,
                self._window_at,
                self._last,
                self._counts,
                self._seen,
                self.tallies,
                self.walks,
                longest,
            ),
            np.zeros(-(-n_features // 8), np.uint64),
            np.zeros(n_features, np.int64),
            plan.slot_offset_ticks.astype(np.int64),
            np.full(one_by_one, 0, np.uint16),
            np.full(one_by_one, 0, np.uint8),
        )
        if tables is None:
            tables = no_tables(n_features, shots * plan.largest)
        self.decides = bool(tables.labels.size)
        rows = np.zeros(self.block_rows + 1, DECISION_DTYPE)  # more than one visit fills
        self.counts: I64 = np.zeros((0 if self.decides else len(rows), n_features), np.int64)  # of the latest rows
        marks, heard = make_marks(), np.full((1, 2), -1, np.int64) if heard is None else heard
        kind = FrameWalkArrays if self.parallel else WalkArrays
        self.walk = kind(facts, marks, arrays, tables, rows, self.counts, heard)

    def fits(self, block: ClickBlock | FrameBlock) -> bool:
        """Whether `block` is of the plan's kind, lies within one visit and has a bit for every channel: what `push` relies on.

        No number of it is above the largest, so that each is a successor of the automaton.
        """
        if isinstance(block, FrameBlock):
            n_exposures, word_bytes = block.words.shape
            if not self.parallel or 8 * word_bytes < self._counts.shape[1]:
                return False
        else:
            n_exposures = len(block.patterns)
            if self.parallel or block.largest != self.largest:
                return False
        return block.exposure_index % self.visit_exposures + n_exposures <= self.visit_exposures

    @property
    def block_rows(self) -> int:
        """Most decisions of one block."""
        return min(self.n_windows, CLICKS_MAX)

    def push(self, block: ClickBlock | FrameBlock, end_tick: int = 0) -> Rows:
        """Count a block that fits, and before which no window waits: after `skip_to`, or where it `follows` the latest block.

        Its first exposure ends at `end_tick`. Returns the decisions on the windows that it completes, oldest first; they are valid until
        the next call.
        """
        visit, relative = divmod(block.exposure_index, self.visit_exposures)
        times = signed(end_tick - relative * block.period_ticks), block.period_ticks, 0
        if isinstance(block, FrameBlock):
            n, width = block.words.shape
            words = np.array(block.words, np.uint8).reshape(-1)  # one type to the compiler, whatever the message is
            rows, _ = self._run(kernels.step_frames, words, width, visit, relative, block.object_index, *times)
        else:
            n, arrays = len(block.patterns), self.walk.windows
            arrays.stamps[:n], arrays.bits[:n] = block.patterns, block.bits
            rows, _ = self._run(kernels.step_clicks, visit, relative, n, block.object_index, *times)
        self._pushed = block.exposure_index + n
        return rows

    def follows(self, exposure_index: int) -> bool:
        """Whether `exposure_index` follows the latest `push`, so that no window before it waits."""
        return exposure_index == self._pushed

    def skip_to(self, exposure_index: int, tick: int = 0, flags: int = 0) -> Iterator[Rows]:
        """Settle every window before `exposure_index` that will never be complete (a gap, or the end of the stream).

        Yields decisions at `tick`, with `flags`, which are valid until the next ones.
        """
        visit, relative = divmod(exposure_index, self.visit_exposures)
        done = False
        while not done:
            rows, done = self._settled(visit, relative, signed(tick), flags)
            yield rows

    def _settled(self, visit: int, relative: int, tick: int, flags: int) -> tuple[Rows, bool]:
        if self.parallel:
            return self._run(kernels.step_frames, _NO_WORDS, 1, visit, relative, NO_OBJECT, tick, 0, flags)
        return self._run(kernels.step_clicks, visit, relative, 0, NO_OBJECT, tick, 0, flags)

    def _run(self, kernel: Any, *arguments: Any) -> tuple[Rows, Any]:
        """Return the rows of `walk` that a compiled step writes, and what it returns; the rows of a call, and their number, stay."""
        kept, self.n_rows = self.n_rows, 0
        result = kernel(self.walk, *arguments)
        rows, self.n_rows = self.walk.rows[: self.n_rows], kept
        return rows, result

    @property
    def position(self) -> tuple[int, int, int]:
        """The visit under way, its next window to be settled, and the object before the detector; the kernel continues from here."""
        return self.visit, self.next_window, self.object_index

    @position.setter
    def position(self, value: tuple[int, int, int]) -> None:
        self.visit, self.next_window, self.object_index = value
        # at a leaf: what is left of the cycle is dark
        self.walks.nodes[: self.next_window] = len(self.walks.successors)

    def walk_state(self, visit: int, window: int, step: int) -> int:
        """Return the state that a walk must show in its exposure number `step`; -1 when it is over, or what came before is not known."""
        if visit != self.visit:
            return 0 if step == 0 else -1
        state = int(self.walks.nodes[window])
        known = 0 <= state < len(self.walks.successors) and self._seen[window, 0] == step
        return state if known else -1

    def seen_now(self) -> I64:
        """Return a copy of the clicks of the visit's first WINDOWS_SEEN windows as they are decided on, int64 (windows, d_f).

        For a view beside the loop, in another thread: a row that the loop writes meanwhile is no window's, as its checksum shows.
        """
        return np.stack([self._clicks(at) for at in range(min(self.n_windows, WINDOWS_SEEN))])

    def _clicks(self, window: int) -> I64:
        """The counts of a window as they are decided on: of several channels bit t * channels + k is the click of channel k in slot t."""
        counts = self._counts[window]
        return counts if self._channels == 1 else (counts[:, None] >> np.arange(self._channels) & 1).reshape(-1)

    @property
    def half_seen(self) -> bool:
        """Whether a window that is not settled holds exposures already."""
        return bool(self._seen[self.next_window :].any())

    @property
    def visits_begun(self) -> int:
        """Visits of which something has been seen or settled."""
        return self.visit + (self.next_window > 0 or bool(self._seen.any()))

    def restart(self, tick: int, flags: int) -> Iterator[Rows]:
        """Give up the visit under way and count from exposure 0 again; yield its windows that were still open, as `skip_to` does."""
        yield from self.skip_to(self.visits_begun * self.visit_exposures, tick, flags)
        self.visit, self._pushed = 0, -1

    def warm_up(self) -> None:
        """Compile or load the kernel of `push` and `skip_to`, without counting anything."""
        self._settled(self.visit, 0, 0, 0)


def _make_walks(plan: Plan, n_features: int, shots: int, last: I64) -> Walks:
    """Return what the windows of `plan` need and, of an automaton, its walks; PlanError if they cannot be followed."""
    automaton = plan.automaton
    if automaton is None:
        none: I64 = np.zeros(0, np.int64)
        need = np.full(len(last), shots * n_features, np.int64)
        return Walks(read_only(np.zeros((0, 2), np.uint32)), none, none, need, last, none, none)
    slots = int(np.count_nonzero(plan.slot_pattern == ADAPTIVE_PATTERN))
    if shots != 1:
        raise PlanError(
            f"{shots} walks make one decision; allowed: 1",
            remedy="one walk is one decision: --shots 1, and --trials N for more of them",
        )
    if not automaton.n_slots <= slots <= n_features:
        raise PlanError(f"walks of {automaton.n_slots} exposures in cycles of {slots} for numbers of {n_features}")
    nodes, (shown, clicked) = np.zeros(len(last), np.int64), np.zeros((2, automaton.n_states), np.int64)
    successors, need = read_only(automaton.successors), np.full(len(last), slots, np.int64)
    return Walks(successors, exposures_to_leaf(automaton), nodes, need, last, shown, clicked)


def visit_maps(plan: Plan, shots: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return, for each exposure of a visit, its pattern or its slot in the walk (-1: dark) and its window, both int32 (visit,)."""
    pattern = plan.slot_pattern.astype(np.int32)
    adaptive = pattern == ADAPTIVE_PATTERN
    feature = np.where(adaptive, np.cumsum(adaptive) - 1, np.where(pattern == DARK_PATTERN, -1, pattern))
    cycles = np.arange(plan.cycles_per_object, dtype=np.int64)[:, None]
    shot = cycles * plan.shots_per_cycle + plan.slot_shot.astype(np.int64)[None, :]
    window = np.where(feature[None, :] < 0, -1, shot // shots)
    return np.tile(feature, plan.cycles_per_object).astype(np.int32), window.ravel().astype(np.int32)


def _last_exposures(window_at: npt.NDArray[np.int32], n_windows: int, visit_exposures: int) -> I64:
    last: I64 = np.full(n_windows, -1, np.int64)
    lit = window_at >= 0
    np.maximum.at(last, window_at[lit], np.arange(visit_exposures, dtype=np.int64)[lit])
    return last
