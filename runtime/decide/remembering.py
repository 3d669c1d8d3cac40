"""Sums over an automaton's walks on a detector whose clicks depend on several exposures before: afterpulses with a time constant.

Owns the step from one slot to the next; expectation.py owns the whole. Beside the chance of every node, by the outcome of the last
exposure, stands the mean memory (detector/afterpulses.py) of the walks that came so. A state with one walk into it for each outcome is
exact in this; where several walks meet, their mean stands for all of them, which errs in the second order of the memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.detector import Afterpulses

F64 = NDArray[np.float64]


class _Sums(NamedTuple):
    """As `Remembered` has them."""

    chance: F64
    memory: F64
    ends: F64


class Remembered:
    """The walks of some objects: `chance` and `memory` are float64 (2, objects, nodes), the first axis is the last outcome.

    `memory` is times the chance. `ends` (objects,) sums up what memory is left when the last slot of a walk is over, the slots behind
    its leaf being silent.
    """

    def __init__(self, automaton: Automaton, afterpulses: Afterpulses, n: int, begins: float) -> None:
        self._automaton, self._afterpulses = automaton, afterpulses
        nodes = (2, n, len(automaton.posteriors))
        self._sums = _Sums(np.zeros(nodes), np.zeros(nodes), np.zeros(n))
        self.chance, self.memory, self.ends = self._sums
        self.chance[0, :, 0], self.memory[0, :, 0] = 1.0, begins
        self._of_law = np.array([afterpulses.decay, *afterpulses.steps])

    def go_on(self, states: NDArray[np.int64], mean: F64) -> tuple[F64, F64]:
        """Leave `states` (m,) of one slot, whose exposures have `mean` (objects, m), -log of silence without memory.

        Returns the chances with which the objects reached them (objects, m), and the expected clicks (objects,).
        """
        automaton = self._automaton
        reached = self.chance[:, :, states].sum(axis=0)
        clicks = np.zeros(len(mean))
        behind = automaton.n_slots - 1 - int(automaton.depth[states[0]])
        left_behind = self._afterpulses.after_silences(behind)
        _pass_memory_on(self._sums, states, automaton.successors, mean, self._of_law, left_behind, clicks)
        return reached, clicks


@njit(cache=True, nogil=True)
def _pass_memory_on(sums, states, successors, mean, of_law, left_behind, clicks):  # type: ignore[no-untyped-def]
    """Add what leaves `states` (m,) to its successors in `sums`, with its memory, and the expected clicks to `clicks` (objects,).

    of_law float64 (5,): decay and the four steps of `Afterpulses`; left_behind: what is left of a memory when the slots behind are over.
    """
    chance, memory, ends = sums
    n_states = successors.shape[0]
    decay, fixed, per_mean, per_memory, in_pause = of_law[0], of_law[1], of_law[2], of_law[3], of_law[4]
    for before in range(2):
        for i in range(mean.shape[0]):
            for k in range(states.size):
                state = states[k]
                reached = chance[before, i, state]
                if reached <= 0.0:
                    continue
                m, x = mean[i, k], memory[before, i, state] / reached
                click = -np.expm1(-(m + x))
                silent = decay * x + in_pause * m
                added = fixed + (per_mean * m + per_memory * x) / max(click, 1e-300)
                for outcome in range(2):
                    part = reached * (click if outcome else np.exp(-(m + x)))
                    carried = part * (silent + added if outcome else silent)
                    after = successors[state, outcome]
                    chance[outcome, i, after] += part
                    memory[outcome, i, after] += carried
                    if after >= n_states:
                        ends[i] += carried * left_behind
                clicks[i] += reached * click
