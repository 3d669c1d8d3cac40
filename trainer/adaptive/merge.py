"""Merging states by the agglomerative information bottleneck (Slonim and Tishby 1999): the pair goes first that tells least apart.

Owns the cost, which is the information on the class that is lost (Jensen-Shannon divergence times mass), and the greedy order. Works on
class counts alone: (nodes, classes), float64; memory is the square of the number of nodes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@njit(cache=True)
def _entropy(counts: F64) -> float:
    """Mass times entropy of the class, nats."""
    mass = 0.0
    total = 0.0
    for count in counts:
        mass += count
        if count > 0.0:
            total -= count * math.log(count)
    return total + mass * math.log(mass) if mass > 0.0 else 0.0


@njit(cache=True)
def _cost(a: F64, b: F64, own: float) -> float:
    """Information lost when a and b become one; `own` is the sum of their entropies."""
    mass = 0.0
    total = 0.0
    for c in range(len(a)):
        count = a[c] + b[c]
        mass += count
        if count > 0.0:
            total -= count * math.log(count)
    return max(0.0, total + mass * math.log(mass) - own) if mass > 0.0 else 0.0


@njit(cache=True)
def _nearest(costs: F64, alive: NDArray[np.bool_], row: int) -> int:
    """The partner of a row with the least cost, -1 without one; the lower number wins a draw."""
    best = -1
    for column in range(len(alive)):
        if alive[column] and column != row and (best < 0 or costs[row, column] < costs[row, best]):
            best = column
    return best


@njit(cache=True)
def _merge(counts: F64, wanted: int, label: NDArray[np.int64]) -> None:
    n = len(counts)
    alive = np.ones(n, np.bool_)
    entropy = np.empty(n)
    costs = np.zeros((n, n))
    nearest = np.empty(n, np.int64)
    for i in range(n):
        entropy[i] = _entropy(counts[i])
        for j in range(i):
            costs[i, j] = costs[j, i] = _cost(counts[i], counts[j], entropy[i] + entropy[j])
    for i in range(n):
        nearest[i] = _nearest(costs, alive, i)
    for _ in range(n - wanted):
        kept = -1
        for i in range(n):
            if alive[i] and (kept < 0 or costs[i, nearest[i]] < costs[kept, nearest[kept]]):
                kept = i
        gone = nearest[kept]
        if gone < kept:
            kept, gone = gone, kept
        counts[kept] += counts[gone]
        entropy[kept] = _entropy(counts[kept])
        alive[gone] = False
        for i in range(n):
            if label[i] == gone:
                label[i] = kept
        for i in range(n):
            if alive[i] and i != kept:
                costs[i, kept] = costs[kept, i] = _cost(counts[i], counts[kept], entropy[i] + entropy[kept])
        for i in range(n):
            if not alive[i]:
                continue
            if i == kept or nearest[i] == gone or nearest[i] == kept:
                nearest[i] = _nearest(costs, alive, i)
            elif costs[i, kept] < costs[i, nearest[i]]:
                nearest[i] = kept


def merged(counts: F64, wanted: int) -> NDArray[np.int64]:
    """Return the new number 0..wanted-1 of every node, int64 (nodes,), after merging `counts` (nodes, classes) down to `wanted`.

    Nodes keep their order; a group has the place of its lowest member. ValueError for counts that are negative or not finite, or
    fewer than one group.
    """
    if counts.ndim != 2 or wanted < 1 or not (np.isfinite(counts).all() and (counts >= 0).all()):
        raise ValueError(
            f"counts {counts.shape} to {wanted} groups, allowed: finite counts of at least 0, a group or more"
        )
    label = np.arange(len(counts), dtype=np.int64)
    if wanted < len(counts):
        _merge(np.array(counts, np.float64), wanted, label)
    return np.asarray(np.unique(label, return_inverse=True)[1], np.int64)
