"""Sums over an automaton's walks on a detector whose clicks depend on several exposures before: afterpulses with a time constant.

Beside the chance of every node, by the outcome of the last exposure, stands the memory (detector/afterpulses.py) of the walks that came
so, as the sums of its mean and of its mean square. Where several walks meet, their moments are those of all of them together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.detector import Afterpulses
from pans.runtime.detector.afterpulses import LEAST_MEAN, SMALL_RATIO

F64 = NDArray[np.float64]


class _Sums(NamedTuple):
    """As `Remembered` has them."""

    chance: F64
    memory: F64
    squares: F64
    ends: F64


class Remembered:
    """The walks of some objects: `chance` is float64 (2, objects, nodes), the first axis is the last outcome.

    `begins` is the memory, mean and variance, with which every walk begins. `ends` (2, objects) are the mean and the mean square of what
    is left when the last slot of a walk is over; the slots behind its leaf are dark.
    """

    def __init__(self, automaton: Automaton, afterpulses: Afterpulses, n: int, begins: tuple[float, float]) -> None:
        self._automaton, self._afterpulses = automaton, afterpulses
        nodes = (2, n, len(automaton.posteriors))
        self._sums = _Sums(np.zeros(nodes), np.zeros(nodes), np.zeros(nodes), np.zeros((2, n)))
        self.chance, self.ends = self._sums.chance, self._sums.ends
        self.chance[0, :, 0], self._sums.memory[0, :, 0] = 1.0, begins[0]
        self._sums.squares[0, :, 0] = begins[1] + begins[0] ** 2
        self._of_law = np.array([*afterpulses.steps, afterpulses.dead])

    def go_on(self, states: NDArray[np.int64], mean: F64) -> tuple[F64, F64]:
        """Leave `states` (m,) of one slot, whose exposures have `mean` (objects, m), -log of silence without memory.

        Returns the chances with which the objects reached them (objects, m), and the expected clicks (objects,).
        """
        automaton = self._automaton
        reached = self.chance[:, :, states].sum(axis=0)
        clicks = np.zeros(len(mean))
        behind = automaton.n_slots - 1 - int(automaton.depth[states[0]])
        of_law = np.append(self._of_law, self._afterpulses.dark_flow(behind))
        _pass_memory_on(self._sums, states, automaton.successors, mean, of_law, clicks)
        return reached, clicks


@njit(cache=True, nogil=True)
def _pass_memory_on(sums, states, successors, mean, of_law, clicks):  # type: ignore[no-untyped-def]
    """Add what leaves `states` (m,) to its successors in `sums`, with its memory, and the expected clicks to `clicks` (objects,).

    of_law float64 (14,): the steps of `Afterpulses`, its dead time, and its flow through the slots behind. The same as `Afterpulses.after`.
    """
    chance, memory, squares, ends = sums
    n_states = successors.shape[0]
    to_x, of_m, spread_m, spread_x = of_law[0], of_law[1], of_law[2], of_law[3]
    pause_x, pause_m, pause_spread_m, pause_spread_x = of_law[4], of_law[5], of_law[6], of_law[7]
    seen, kept, dead, behind, behind_spread = of_law[8], of_law[9], of_law[11], of_law[12], of_law[13]
    for before in range(2):
        for i in range(mean.shape[0]):
            for k in range(states.size):
                state = states[k]
                reached = chance[before, i, state]
                if reached <= 0.0:
                    continue
                m, x = mean[i, k], memory[before, i, state] / reached
                found, varied = m / (1.0 + dead * m), m / (1.0 + dead * m) ** 3
                variance = max(squares[before, i, state] / reached - x * x, 0.0)
                ratio = seen * variance / max(x, LEAST_MEAN)
                sight = seen * x * (np.log1p(ratio) / ratio if ratio > SMALL_RATIO else 1.0 - ratio / 2.0)
                click, fewer = -np.expm1(-(m + sight)), 1.0 / (1.0 + ratio)
                silent_x, silent_v = x * kept * fewer, variance * (kept * fewer) ** 2
                more_x = of_m * found + x * (to_x - kept) + x * kept * (1.0 - fewer)
                more_v = spread_m * varied + spread_x * x + variance * (to_x**2 - (kept * fewer) ** 2)
                for outcome in range(2):
                    part, here, spread = reached * np.exp(-(m + sight)), silent_x, silent_v
                    if outcome:
                        part, chance_of = reached * click, max(click, LEAST_MEAN)
                        here = silent_x + more_x / chance_of
                        square = silent_x**2 + (more_v + more_x * (2.0 * silent_x + more_x)) / chance_of
                        spread = max(silent_v + square - here**2, 0.0)
                    spread = pause_x**2 * spread + pause_spread_m * varied + pause_spread_x * here
                    here = pause_x * here + pause_m * found
                    after = successors[state, outcome]
                    chance[outcome, i, after] += part
                    memory[outcome, i, after] += part * here
                    squares[outcome, i, after] += part * (spread + here**2)
                    if after >= n_states:
                        ends[0, i] += part * behind * here
                        ends[1, i] += part * (behind**2 * (spread + here**2) + behind_spread * here)
                clicks[i] += reached * click
