"""Decisions of runs that followed an automaton, as a lab would write it from docs/reference/formats.md, "Walks" and "Photon numbers".

Owns the steps of a walk, of clicks or of photon numbers; all else of a run is lab_decisions.py's. Imports nothing of the package.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from lab_automaton import Automaton
from lab_bundle import demand
from lab_decisions import DARK, Decisions, Plan, Window, run_again
from lab_recording import Recording
from numpy.typing import NDArray

ADAPTIVE = 0xFFFE


@dataclass
class Walk(Window):
    """One cycle: where its walk stands, and the exposure that brought it to a leaf."""

    node: int = 0
    broken: bool = False
    leaf_at: int = -1


class WalkDecisions(Decisions):
    """Follows the walks of one still run."""

    def __init__(self, plan: Plan, automaton: Automaton) -> None:
        self.automaton = automaton
        super().__init__(plan, lambda counts, shots: np.zeros(0), 1)

    def _open_visit(self) -> None:
        plan = self.plan
        steps = [slot for slot, (_, pattern, _) in enumerate(plan.slots) if pattern == ADAPTIVE]
        demand(len(steps) == self.automaton.slots, "as many adaptive slots as the longest walk has steps")
        self.windows = []
        self.window_of = {}
        for cycle in range(plan.cycles_per_object):
            members = [cycle * len(plan.slots) + slot for slot in steps]
            self.windows.append(Walk(members, np.zeros(len(steps), np.int64)))
            self.window_of |= dict.fromkeys(members, self.windows[-1])
        self.next_window, self.object = 0, 0xFFFFFFFF

    def _stamps_fit(self, stamps: Sequence[int]) -> bool:
        return all(one == DARK or one < len(self.automaton.successors) for one in stamps)

    def _count_one(self, exposure: int, shown: int, bit: int) -> None:
        within = exposure % self.plan.visit
        walk = self.window_of.get(within)
        if not isinstance(walk, Walk) or walk.broken or walk.leaf_at >= 0:
            return
        step = walk.members.index(within)
        if step != walk.right:  # one before it never came
            walk.broken = True
        elif shown != walk.node:
            walk.broken, walk.wrong = True, 1
        else:
            walk.counts[step] = bit
            walk.right += 1
            walk.node = self.automaton.successors[walk.node][bit]
            if walk.node >= len(self.automaton.successors):
                walk.leaf_at = within

    def _last(self, window: Window) -> int:
        assert isinstance(window, Walk)
        return window.leaf_at if window.leaf_at >= 0 else window.members[-1]

    def _needed(self, window: Window) -> int:
        assert isinstance(window, Walk)
        whole = window.leaf_at >= 0 or window.wrong
        return window.right + window.wrong if whole else len(window.members)

    def _verdict(self, window: Window) -> tuple[int, np.float32, int]:
        assert isinstance(window, Walk)
        posterior = self.automaton.posteriors[window.node]
        return int(posterior.argmax()), posterior.max(), 0

    def _exposures(self, window: Window) -> int:
        return window.right


def walk_again(recording: Recording, automaton: Automaton) -> NDArray[np.void]:
    """Return the rows that the messages of `recording` give, ROW (n,); it followed the whole `automaton`."""
    config = recording.header["config"]
    demand(config["drive"] in ("device", "host") and config["shots"] == 1 and not config["confidence"], "a whole walk")
    return run_again(recording, lambda plan: WalkDecisions(plan, automaton))
