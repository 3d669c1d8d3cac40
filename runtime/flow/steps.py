"""A flow's steps for the compiled turn: the state of a `FlowCore` lent to kernels, and what they decided given back to it.

Owns the hand-over between `FlowCore` and deciding.py, as core/bulk_steps.py does for objects that stand still: both continue the same
state. `settle` gives the core, in order, what it would have seen by itself: its guard, and the comparison with the truth.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pans.runtime.core import stream_kernels as kernels
from pans.runtime.core.bulk_steps import decision_tables
from pans.runtime.core.decision import (
    DECISION_DTYPE,
    Action,
    CoreEvent,
    Decision,
    DecisionFlag,
    Output,
    Passage,
    Rows,
)
from pans.runtime.core.plan import Plan
from pans.runtime.wire import walk as place
from pans.runtime.wire.messages import NO_OBJECT, FrameBlock

from . import columns
from .arrays import FlowWalk
from .core import FlowCore
from .settings import WATCHED_FRAMES

I64 = npt.NDArray[np.int64]

ROWS_MORE = 2048  # decisions of one call, beside those of a block
MOST_BLOCKS = 4096  # whose empty frames have not been told yet: as many as the turn keeps times of (turn/rings.py)
LEAVE, N_PASSAGE, N_EDGES = 3, 5, 5  # of core.decision.Passage, in its order; of kernels.count_edges
_LARGEST = (1 << 62) - 1
_GAP = int(DecisionFlag.GAP)


class FlowSteps:
    """The compiled steps of `core`, which nothing excludes, for `plan`; all memory is allocated here, before arming."""

    def __init__(self, core: FlowCore, plan: Plan) -> None:
        self.core, decider = core, core.decider
        self.decides = True
        self.block_rows = plan.block_exposures + 1
        n, n_rows = decider.n_features, self.block_rows + ROWS_MORE
        gated = np.zeros(decider.n_classes, np.uint8)
        gated[sorted(core.gated)] = 1
        # np.full touches what it makes; np.zeros would leave that to the first use, a fault of a page each
        self.walk = FlowWalk(
            core.new_facts(),
            core.arrays,
            plan.slot_offset_ticks.astype(np.int64),
            np.full(1, (1 << n) - 1, np.uint64),
            decision_tables(decider, core.shots, plan),
            np.full(1, core.settings.sure, np.float64),
            gated,
            np.full(n_rows, 0, DECISION_DTYPE),
            np.full((n_rows, N_PASSAGE), 0, np.int64),
            np.full((n_rows, n), 0, np.int64),
            np.full((MOST_BLOCKS, 2 + n), 0, np.int64),
            np.zeros(N_EDGES, np.int64),
            core.tracker.heard,
        )
        self.walk.state[columns.FRAMES] = core.frames
        self._told = 0  # of walk.empty

    def begin(self, session: int) -> None:
        """Follow the stream of `session` from where the core stands."""
        self.walk.state[kernels.SESSION] = session

    def labelled(self, n: int) -> npt.NDArray[np.void]:
        """Return the first `n` rows."""
        return self.walk.rows[:n]

    def load(self) -> None:
        """Copy what the core and its tracker know into the kernel's state."""
        core, state = self.core, self.walk.state
        state[kernels.N_ROWS] = state[place.MESSAGES] = state[place.EXPOSURES] = state[columns.ASKS] = 0
        state[columns.START_TICK] = min(core.start_tick, _LARGEST)
        state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE], state[place.DROPS] = core.tracker.position
        state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED] = core.n_decisions, core.n_abstained
        state[columns.OBJECTS] = core.n_passages
        state[place.END_EXPOSURE] = min(core.end_exposure, 1 << 62)
        state[columns.END_TICK], state[columns.JITTER_TICKS] = (
            min(core.last_tick, _LARGEST),
            min(core.jitter_ticks, _LARGEST),
        )
        state[columns.WATCH_AT] = core.watched_frames + WATCHED_FRAMES if core.watches_empty else 1 << 62
        core.lend(state)

    def store(self) -> None:
        """Copy what the kernel did back."""
        core, state = self.core, self.walk.state.tolist()
        if state[place.MESSAGES]:
            position = state[place.NEXT_SEQ], state[place.NEXT_EXPOSURE]
            core.tracker.advance(position, state[place.MESSAGES], state[place.EXPOSURES])
            if state[columns.END_TICK] != min(core.last_tick, _LARGEST):  # a larger one only Python's integers hold
                core.last_tick = state[columns.END_TICK]
            core.jitter_ticks = max(core.jitter_ticks, state[columns.JITTER_TICKS])
        core.n_decisions, core.n_abstained = state[kernels.N_DECISIONS], state[kernels.N_ABSTAINED]
        core.n_passages = state[columns.OBJECTS]
        core.take_back(state)

    def told(self) -> list[list[int]]:
        """Return what the empty field gave and has not been settled: rows of `FlowWalk.empty`."""
        first, self._told = self._told, int(self.walk.state[columns.TOLD])
        return self.walk.empty[np.arange(first, self._told) % MOST_BLOCKS].tolist()

    def pulses(self, rows: slice) -> list[Action]:
        """Return the pulses that `rows` of the walk's ask for, in order."""
        core, labels = self.core, self.walk.rows["label"][rows]
        places = np.flatnonzero(np.isin(labels, sorted(core.gated))) if core.gated else ()
        numbers, leaves = self.walk.rows["index"][rows], self.walk.passages[rows, LEAVE]
        return [core.pulse(int(numbers[place]), int(leaves[place])) for place in places]

    def watch(self, empty: list[int] | None) -> list[CoreEvent]:
        """Let the guard see what the empty field gave with a block; return what it found with that, and with objects before."""
        core, guard = self.core, self.core.guard
        if guard is None:
            return []
        told = core.watched_frames if empty is None else empty[1]
        return list(core.watch_empty(guard, told, np.array([] if empty is None else empty[2:], np.int64)))

    def settle(
        self, rows: slice, behind: int, end_tick: int, empty: list[int] | None, block: FrameBlock | None
    ) -> Output:
        """Let the core see what kernels decided on a block that ended at `end_tick`; exposure `behind` follows.

        `rows` of the walk's are its decisions, `empty` what the empty field gave with it; `block` is for the guard of dark frames.
        """
        core, walk, guard = self.core, self.walk, self.core.guard
        events: list[CoreEvent] = [] if block is None or guard is None else [*guard.take(block)]
        out = Rows()
        decided = zip(walk.rows[rows].tolist(), walk.passages[rows].tolist(), walk.counts[rows])
        for row, passage, counts in decided:
            decision = Decision(*row)
            if guard is not None and not decision.flags & _GAP:
                guard.take_object(counts, NO_OBJECT)
            core.put_row(decision, Passage(*passage), out)
        if core.watches_empty:
            events = self.watch(empty)
        core.matcher.settle(behind)
        found = out.output()
        return Output(found.decisions, events, end_tick, found.passages, found.actions)
