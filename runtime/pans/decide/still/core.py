"""The deterministic core: one stream frame in, decisions and events out; no I/O, no clock, no randomness.

A live run, a replay and a simulation all drive this class with the same frames, so that a recording gives the same decisions bit
for bit. `Core.step` returns an `Output`; a window that overlaps a gap gives a decision that is flagged and abstains, never a guess.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.bundle.backends import NO_LABEL, Decider
from pans.decide.dark.guard import DarkGuard, cut_out
from pans.decide.dark.health import Finding, any_click
from pans.decide.decision import Decision, DecisionFlag, Output
from pans.decide.follower import ANY_CLASS, Follower, Place
from pans.decide.plan.plan import Plan
from pans.protocol.wire import NO_OBJECT, UNKNOWN_TRUTH, ClickBlock, FrameBlock, Mark

from .kernel_state import CoreState, IdleSteps
from .tables import decision_tables, undecided
from .windows import DecisionWindows

_INCOMPLETE = int(DecisionFlag.INCOMPLETE | DecisionFlag.ABSTAINED)
_NOT_MEASURED = int(DecisionFlag.GAP | DecisionFlag.WRONG_PATTERN)


class Core(Follower):
    """Stream tracker, windows and back end joined up, for objects that stand still."""

    def __init__(self, plan: Plan, decider: Decider, shots: int, n_cycles: int, guard: DarkGuard | None = None) -> None:
        super().__init__(plan, n_cycles, decider.n_classes or ANY_CLASS)  # 0: pictures
        self.guard = guard  # of the dark counts; None: they are only added up
        self._tables = decision_tables(decider, shots, plan)
        own = self._tables if guard is None else undecided(self._tables)  # a guard sees each window, and has a say
        self.windows = DecisionWindows(plan, decider.n_features, shots, own, self.state, self.tracker.heard)
        self.shots = shots
        self.decider = decider
        self._visits_before = 0  # in streams that have ended
        self._bulk: CoreState | None = None
        self._session_known = False  # to it

    @property
    def tallies(self) -> NDArray[np.int64]:
        """Dark exposures, dark clicks and wrong patterns, int64 (still/windows.N_TALLIES,)."""
        return self.windows.tallies

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming."""
        self.windows.warm_up()
        if self.guard is not None:
            self.guard.warm_up()

    @property
    def takes(self) -> bool:
        """Whether the kernel may take messages: exposures are clicks, not numbers, and no guard changes decisions."""
        return self.plan.largest == 1 and (self.guard is None or self.guard.policy == "warn")

    def steps(self, session: int) -> CoreState | IdleSteps:
        """See Follower."""
        if not self.takes:
            return super().steps(session)
        if self._bulk is None:
            self._bulk = CoreState(self.tracker, self.marks, self.windows, self._tables, self.decider, self.shots)
        if not self._session_known:
            self._bulk.begin(session)
            self._session_known = True
        return self._bulk

    def remember(self, mark: Mark) -> None:
        """See Follower."""
        super().remember(mark)
        if self._bulk is not None:
            self._bulk.remember(mark)

    def begin(self, start_tick: int, n_cycles: int) -> Output:
        """See Follower."""
        self._session_known = False
        return super().begin(start_tick, n_cycles)

    def part(self) -> Place | None:
        """See Follower."""
        self._session_known = False  # of the marks that are forgotten here the kernel must not know either
        return super().part()

    def watch_blocks(self, stamps: NDArray[np.uint16], bits: NDArray[np.uint8], first: int) -> list[Finding]:
        """Let the guard, which only warns, see exposures from `first` on that kernels have taken; `watch_objects` follows."""
        assert self.guard is not None
        return self.guard.take(ClickBlock(0, 0, 0, first, 0, self.windows.object_index, stamps, bits))

    def watch_objects(self, rows: NDArray[np.void]) -> None:
        """Let the guard see the decisions that the exposures of `watch_blocks` gave, DECISION_DTYPE (n,)."""
        assert self.guard is not None
        measured = rows["flags"] & _NOT_MEASURED == 0
        self.guard.take_objects(rows["clicks"][measured, None] > 0, rows["object"][measured])

    def watch_frames(self, words: NDArray[np.uint8], heads: NDArray[np.void]) -> list[Finding]:
        """As `watch_blocks` for blocks of frames that follow one another: words uint8 (frames, bytes), heads BLOCK_DTYPE (blocks,).

        Of each object the guard sees which channels have clicked in lit frames.
        """
        assert self.guard is not None
        first = int(heads["exposure_index"][0])
        events = self.guard.take(FrameBlock(0, 0, 0, first, 0, self.windows.object_index, words))
        lit = cut_out(self.windows.lit, first, len(words))
        begins = np.cumsum(heads["count"], dtype=np.int64) - heads["count"]
        some = np.logical_or.reduceat(lit, begins)
        seen = any_click(words, begins, lit)[some]
        clicked = np.unpackbits(seen, axis=1, count=self.plan.n_patterns, bitorder="little").view(np.bool_)
        self.guard.take_objects(clicked, heads["object_index"][some])
        return events

    def cycles_left(self, n_cycles: int) -> int:
        """Return how many of a whole run's `n_cycles` cycles stand out when the visit under way is given up."""
        return n_cycles - (self._visits_before + self.windows.visits_begun) * self._cycles_per_object

    def _fits(self, block: ClickBlock | FrameBlock) -> bool:
        return self.windows.fits(block)

    def _take(self, block: ClickBlock | FrameBlock, n_exposures: int, end_tick: int) -> Output:
        parts = (
            [] if self.windows.follows(block.exposure_index) else self.windows.skip_to(block.exposure_index, block.tick)
        )
        decisions = self._decided(parts)
        events = [] if self.guard is None else self.guard.take(block)
        rows = self.windows.push(block, end_tick - (n_exposures - 1) * block.period_ticks)
        return Output([*decisions, *self._decided([rows])], events, None)

    def _skip_to(self, exposure_index: int, tick: int) -> Output:
        return Output(self._decided(self.windows.skip_to(exposure_index, tick)), [], None)

    def _give_up(self) -> Output:
        self._visits_before += self.windows.visits_begun
        if self.guard is not None:
            self.guard.restart()
        return Output(self._decided(self.windows.restart(self.last_tick, _INCOMPLETE)), [], None)

    def _place(self) -> dict[str, Any] | None:
        if self.guard is not None and self.guard.policy != "warn":
            return None  # what it has learnt decides too
        return None if self.windows.half_seen else {"windows": list(self.windows.position)}

    def _go_on_from(self, place: dict[str, Any]) -> None:
        visit, next_window, number = place["windows"]
        self.windows.position = (int(visit), int(next_window), int(number))

    def _nothing_left(self) -> bool:
        return self.windows.visits_begun * self.windows.visit_exposures >= self.end_exposure

    def _decided(self, parts: Iterable[NDArray[np.void]]) -> list[Decision]:
        """Return the decisions of rows, each part of one object, with the truth; where a back end is asked, it is here."""
        decisions = list[Decision]()
        for rows in parts:
            if not len(rows):
                continue
            number = int(rows["object"][0])
            mark = None if number == NO_OBJECT else self.marks.get(number)
            rows["truth"] = UNKNOWN_TRUTH if mark is None else mark.truth
            found = [Decision._make(row) for row in rows.tolist()]
            if not self.windows.decides:
                found = [self._judged(*both) for both in zip(found, self.windows.counts)]
            decisions += found
        return decisions

    def _judged(self, row: Decision, counts: NDArray[np.int64]) -> Decision:
        """Return a row that kernels have left to the back end, from the clicks of its window, int64 (d_f,)."""
        flags, guard, decider = DecisionFlag(row.flags), self.guard, self.decider
        label, probability = NO_LABEL, 0.0
        if guard is not None:
            if not flags:
                guard.take_object(counts, row.object)
            flags |= guard.flags
            decider = guard.decider(decider)
        if not flags & DecisionFlag.ABSTAINED:
            label, probability = decider.decide(counts, self.shots)
            if guard is not None:
                guard.count_word(counts)
            if not probability > 0:  # the scores were not finite: their label means nothing
                flags |= DecisionFlag.NOT_FINITE | DecisionFlag.ABSTAINED
                label, probability = NO_LABEL, 0.0
            elif label == NO_LABEL:
                flags |= DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED
        if flags & DecisionFlag.ABSTAINED and not row.flags:  # kernels have counted the others
            self.n_abstained += 1
        return row._replace(label=label, probability=probability, flags=int(flags))
