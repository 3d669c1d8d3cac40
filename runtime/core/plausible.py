"""What a device that carries out the plan can say, and what it cannot: messages against the plan, each by itself.

Owns the rules and what breaks one; never drops a message (follower.py does) and never reads a clock, so that a replay finds the same. The
ranges of single fields are wire/fields.py's, the account of sequence numbers and drops is wire/tracker.py's, and what the host's own clock
says against a tick is timing/clock_check.py's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pans.runtime.wire.messages import DARK_PATTERN, NO_OBJECT, UNKNOWN_TRUTH, ClickBlock, FrameBlock, Mark, Status
from pans.runtime.wire.tracker import MAX_GAP_EXPOSURES

from .plan import Plan


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A message that the plan, the clock or the device's other messages exclude: in `what`, `found` stands where `expected` is due."""

    what: str
    exposure_index: int
    found: int
    expected: int

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        facts = {"exposure_index": self.exposure_index, "found": self.found, "expected": self.expected}
        return {"kind": "contradiction", "what": self.what, **facts}


class PlanRules:
    """The rules of one plan; `moving` where objects flow past, and blocks therefore name none."""

    def __init__(self, plan: Plan, n_classes: int, *, moving: bool) -> None:
        self._offsets = plan.slot_offset_ticks.tolist()
        self._period, self._cycle_ticks, self._slots = plan.slot_period_ticks, plan.cycle_ticks, plan.slots_per_cycle
        self._visit = plan.slots_per_cycle * plan.cycles_per_object
        self._n_classes, self._moving = n_classes, moving
        self._n_states = 0 if plan.automaton is None else plan.automaton.n_states

    def planned(self, exposure_index: int) -> int:
        """Ticks from the start of the run to the start of an exposure."""
        cycle, slot = divmod(exposure_index, self._slots)
        return int(cycle * self._cycle_ticks + self._offsets[slot])

    def begun_by(self, ticks: int) -> int:
        """How many exposures have begun `ticks` after the start of the run."""
        if ticks < 0:
            return 0
        cycle, rest = divmod(ticks, self._cycle_ticks)
        return cycle * self._slots + int(np.searchsorted(self._offsets, rest, "right"))

    def of_block(self, block: ClickBlock | FrameBlock, start_tick: int) -> Contradiction | None:
        """Spacing, object, time and stamps of a block: an exposure may be late, but never a whole period early.

        With an automaton an exposure is dark or shows one of its states; whether it is the right one, the walk says (window_kernels.py).
        """
        first = block.exposure_index
        if block.period_ticks != self._period:
            return Contradiction("period", first, block.period_ticks, self._period)
        expected = NO_OBJECT if self._moving else first // self._visit % NO_OBJECT
        if block.object_index not in (expected, NO_OBJECT):
            return Contradiction("object", first, block.object_index, expected)
        earliest = start_tick + self.planned(first) - self._period
        if block.tick < earliest:
            return Contradiction("early", first, block.tick, earliest)
        if self._n_states and isinstance(block, ClickBlock):
            strange = (block.patterns >= self._n_states) & (block.patterns != DARK_PATTERN)
            if strange.any():
                return Contradiction("stamp", first, int(block.patterns[strange.argmax()]), self._n_states - 1)
        return None

    def of_mark(self, mark: Mark, next_exposure: int, end_exposure: int) -> Contradiction | None:
        """Class, object and place of a mark."""
        first = mark.exposure_index
        if not UNKNOWN_TRUTH <= mark.truth < self._n_classes:
            return Contradiction("truth", first, mark.truth, self._n_classes - 1)
        if first >= end_exposure + MAX_GAP_EXPOSURES or abs(first - next_exposure) > MAX_GAP_EXPOSURES:
            return Contradiction("mark_exposure", first, first, next_exposure)
        if not self._moving and mark.half_exposures:
            return Contradiction("mark_half", first, mark.half_exposures, 0)
        if not self._moving:
            visit, within = divmod(first, self._visit)
            if within or mark.object_index not in (visit % NO_OBJECT, NO_OBJECT):
                return Contradiction("mark_object", first, mark.object_index, visit % NO_OBJECT)
        return None

    def of_status(self, status: Status, start_tick: int, end_exposure: int) -> Contradiction | None:
        """The exposures that a STATUS of this run claims: no more than the plan has, and than time has allowed; drops among them."""
        claimed = status.next_exposure
        most = min(end_exposure, self.begun_by(status.tick - start_tick) + 1)  # one for the rounding of ticks
        if claimed > most:
            return Contradiction("claimed_exposures", claimed, claimed, most)
        if status.drops > claimed and claimed < 1 << 32:
            return Contradiction("claimed_drops", claimed, status.drops, claimed)
        return None
