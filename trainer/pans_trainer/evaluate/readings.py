"""Readings of fixed patterns whose exposures are more than independent clicks: afterpulses (`Chain`) and photon numbers (`Numbers`).

Exposures come pattern after pattern, shot after shot, object after object without a break. An object begins with the memory of all that
objects leave.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.instrument.detector import Afterpulses

F64 = NDArray[np.float64]
ROUNDS = 4  # by which the memory is found with which an object comes


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """`first`: chances of a click without memory, (objects, d_f); `mean`: -log(1 - first); `begins`: memory at an object's begin, (2,)."""

    first: F64
    mean: F64
    afterpulses: Afterpulses
    begins: F64

    @classmethod
    def of(cls, first: F64, afterpulses: Afterpulses) -> Chain:
        """Return the chain of objects that come in any order, each about as often as the others."""
        mean, begins = -np.log1p(-np.minimum(first, 1 - 2.0**-53)), np.zeros(2)
        for _ in range(ROUNDS if len(first) else 0):
            begins = cls(first, mean, afterpulses, begins)._passed()[1]
        return cls(first, mean, afterpulses, begins)

    def mean_chances(self) -> F64:
        """Return the chance of each click of one shot, of the shape of `first`.

        The memory before an exposure is that of all words with the same last click. Without a time constant that is exact.
        """
        return self._passed()[0]

    def _began(self, *shape: int) -> F64:
        return np.broadcast_to(self.begins.reshape(2, *[1] * len(shape)), (2, *shape))

    def _passed(self) -> tuple[F64, F64]:
        """`mean_chances`, and the memory of all that is left to the next object."""
        law, found = self.afterpulses, np.empty_like(self.first)
        n = len(self.first)
        chance, memory = np.zeros((2, n)), self._began(2, n)
        chance[0] = 1.0
        for i in range(self.first.shape[1]):
            click, mean = law.chance(self.first[:, i], memory), self.mean[:, i]
            parts = np.stack([chance * (1 - click), chance * click])  # (last click now, last click before, objects)
            left = np.stack([law.after(mean, memory, clicked) for clicked in (0, 1)], axis=1)
            chance = parts.sum(axis=1)
            memory = law.mixed(parts, left, axis=1)
            found[:, i] = chance[1]
        return found, law.mixed(chance, memory, axis=(0, 1))

    def word_chances(self, rows: slice) -> F64:
        """Return P(word | object) of one shot, (objects, 2**d_f); bit i of the word is pattern i."""
        first, mean = self.first[rows], self.mean[rows]
        chance, memory = np.ones((len(first), 1)), self._began(len(first), 1)
        for i in range(first.shape[1]):
            click, m = self.afterpulses.chance(first[:, i : i + 1], memory), mean[:, i : i + 1]
            chance = np.concatenate([chance * (1 - click), chance * click], axis=1)
            if i < first.shape[1] - 1:
                after = [self.afterpulses.after(m, memory, clicked) for clicked in (0, 1)]
                memory = np.concatenate(after, axis=2)
        return chance

    def counts(self, shots: int, rng: np.random.Generator, rows: slice) -> NDArray[np.int64]:
        """Draw the clicks of `shots` exposures of every pattern, int64 (objects, d_f): shot after shot."""
        first, mean = self.first[rows], self.mean[rows]
        counts, memory = np.zeros(first.shape, np.int64), self._began(len(first))
        for _ in range(shots):
            for i in range(first.shape[1]):
                clicks = rng.random(len(first)) < self.afterpulses.chance(first[:, i], memory)
                counts[:, i] += clicks
                memory = self.afterpulses.after(mean[:, i], memory, clicks)
        return counts


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


def outcome_probabilities(probability: F64, shots: int) -> F64:
    """Return P(count vector | object), (n, (shots + 1)**d_f), from click probabilities (n, d_f); pattern 0 varies fastest."""
    k = np.arange(shots + 1)
    ways = np.array([math.comb(shots, int(j)) for j in k], dtype=np.float64)
    p = probability[:, :, None]
    return vector_chances(ways * p**k * (1 - p) ** (shots - k))


def vector_chances(of_pattern: F64) -> F64:
    """Return the chance of every vector, (n, base**d_f), of independent counts with chances (n, d_f, base); pattern 0 varies fastest."""
    chance = np.ones((len(of_pattern), 1))
    for i in range(of_pattern.shape[1]):
        chance = (of_pattern[:, i, :, None] * chance[:, None, :]).reshape(len(chance), -1)
    return chance
