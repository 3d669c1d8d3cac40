"""Photon numbers of fixed patterns: drawn, and all vectors of their sums with their chances.

Owns both, from the chance of each number; never the law of counts (instrument/count_law.py) and never a decision. numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """P(number) of every exposure, float64 (objects, d_f, outcomes)."""

    chances: F64

    def mean(self) -> F64:
        """Return the mean number of each exposure, float64 (objects, d_f)."""
        return self.chances @ np.arange(self.chances.shape[2])

    def counts(self, shots: int, rng: np.random.Generator, rows: slice = slice(None)) -> NDArray[np.int64]:
        """Draw the sums of `shots` exposures of every pattern, int64 (objects, d_f), for the objects in `rows`."""
        upto = self.chances[rows].cumsum(axis=2)[:, :, :-1]
        found = np.zeros(upto.shape[:2], np.int64)
        for _ in range(shots):
            found += (rng.random(found.shape)[:, :, None] >= upto).sum(axis=2)
        return found

    def sums(self, shots: int, rows: slice = slice(None)) -> F64:
        """Return the chance of every sum of `shots` exposures, float64 (objects, d_f, shots * largest + 1)."""
        one = self.chances[rows]
        found = one
        for _ in range(shots - 1):
            wider = np.zeros((*found.shape[:2], found.shape[2] + one.shape[2] - 1))
            for number in range(one.shape[2]):
                wider[:, :, number : number + found.shape[2]] += found * one[:, :, number, None]
            found = wider
        return found


def vector_chances(of_pattern: F64) -> F64:
    """Return the chance of every vector, (n, base**d_f), of independent counts with chances (n, d_f, base); pattern 0 varies fastest."""
    chance = np.ones((len(of_pattern), 1))
    for i in range(of_pattern.shape[1]):
        chance = (of_pattern[:, i, :, None] * chance[:, None, :]).reshape(len(chance), -1)
    return chance
