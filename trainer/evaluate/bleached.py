"""Objects that bleach while an automaton walks: what each still gives depends on the patterns of its own walk.

Owns the state of the samples during sampled walks; the law is `pans.runtime.imaging.bleaching`, the walks are walks.py's. SIMULATED.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.imaging import Bleaching, mean_left

BLEACHED_AT_ONCE = 512  # objects, whose pixels stand in memory

F64 = NDArray[np.float64]


class BleachedObjects:
    """Objects (n, pixels) of transmission `seen` under the states of an automaton; `patterns` times `scale` are the light."""

    def __init__(
        self, automaton: Automaton, patterns: NDArray[Any], seen: NDArray[Any], scale: float, law: Bleaching
    ) -> None:
        self.n = len(seen)
        self._automaton, self._patterns, self._scale, self._law = automaton, patterns, scale, law
        self._first = np.asarray(seen, np.float64)
        self._left = self._first.copy()

    def fresh(self) -> None:
        """Begin with objects that no light has met."""
        self._left[:] = self._first

    def photoelectrons(self, rows: NDArray[np.int64], states: NDArray[np.int64]) -> F64:
        """Show `states` (k,) to the objects `rows` (k,): return the photoelectrons expected (k,), and bleach what was lit."""
        which, of_row = np.unique(states, return_inverse=True)
        shown = self._automaton.pattern[which]
        share = self._automaton.dwell[which] / self._automaton.dwell_steps
        light = self._patterns[shown].astype(np.float64) * (self._scale * share)[:, None]
        dose = self._law.doses(light)
        acts, stays = light * mean_left(dose), np.exp(-dose)
        left = self._left[rows]
        found = np.einsum("kp,kp->k", left, acts[of_row])
        left *= stays[of_row]
        self._left[rows] = left
        return np.asarray(found)
