"""What every node knows: class posteriors from training objects, calibrated on objects held back.

Owns smoothing (pseudo-objects of every class) and sharpness (a power per level), both chosen by the log loss of the held-back objects,
and how far stated confidence is from the share of right decisions. Numpy in float64; exact expectations, nothing is sampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .machine import Machine, Sight, forward
from .objects import Block

F64 = NDArray[np.float64]
SMOOTHINGS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # pseudo-objects of every class
SHARPNESSES = tuple(0.5 + 0.02 * i for i in range(36))
BINS = 15


@dataclass(frozen=True, slots=True, eq=False)
class Posteriors:
    """Per level 0..T the posteriors of its nodes, float64 (nodes, classes), states first; the error on the held-back objects."""

    levels: list[F64]
    smoothing: float
    calibration_error: float
    loss: float


def node_counts(machine: Machine, sight: Sight, blocks: list[Block]) -> list[F64]:
    """Return the expected class counts of the nodes before every exposure and at the end, T + 1 arrays (nodes, classes)."""
    totals: list[torch.Tensor] = []
    with torch.no_grad():
        for block in blocks:
            passed = forward(machine, sight, block.grey)
            nodes = [passed.steps[0].alpha]
            for number, leaves in enumerate(passed.leaves):
                states = passed.steps[number + 1].alpha if number + 1 < len(passed.steps) else leaves[:0]
                nodes.append(torch.cat([states, leaves]))
            counted = [(part @ block.one_hot.T).double() for part in nodes]
            totals = counted if not totals else [a + b for a, b in zip(totals, counted)]
    return [total.cpu().numpy() for total in totals]


def smoothed(counts: F64, smoothing: float, sharpness: float = 1.0) -> F64:
    """Return posteriors of class counts (nodes, classes) with pseudo-objects, to a power, rows summing to 1."""
    share = counts + smoothing
    logs = sharpness * np.log(share / share.sum(axis=1, keepdims=True))
    powers = np.exp(logs - logs.max(axis=1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=1, keepdims=True))


def log_loss(posterior: F64, arrived: F64) -> float:
    """Return the sum of -log posterior over arrivals (nodes, classes)."""
    return float(-(arrived * np.log(posterior)).sum())


def calibrated(fitted: list[F64], held_back: list[F64], leaf_from: list[int]) -> Posteriors:
    """Return posteriors of all nodes from the counts of fitted objects, smoothed and sharpened by those of held-back ones.

    `leaf_from[t]`: number of states of level t, behind which its leaves stand. The smoothing is chosen on the leaves, the sharpness for
    every level.
    """
    ends = [(f[n:], h[n:]) for f, h, n in zip(fitted, held_back, leaf_from) if len(f) > n]
    smoothing = min(SMOOTHINGS, key=lambda a: sum(log_loss(smoothed(f, a), h) for f, h in ends))
    levels = []
    for counts, arrived in zip(fitted, held_back):
        best = min(SHARPNESSES, key=lambda k: log_loss(smoothed(counts, smoothing, k), arrived))
        levels.append(smoothed(counts, smoothing, best))
    leaves = np.concatenate([level[n:] for level, n in zip(levels, leaf_from)])
    arrived = np.concatenate([h[n:] for h, n in zip(held_back, leaf_from)])
    total = float(arrived.sum())
    error = calibration_error(leaves, arrived)
    return Posteriors(levels, smoothing, error, log_loss(leaves, arrived) / total)


def calibration_error(posterior: F64, arrived: F64) -> float:
    """Return the expected calibration error: mean distance of confidence and share of right decisions, over bins of confidence."""
    confidence, decided = posterior.max(axis=1), posterior.argmax(axis=1)
    mass, right = arrived.sum(axis=1), arrived[np.arange(len(arrived)), decided]
    bins = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
    stated = np.bincount(bins, mass * confidence, BINS)
    found = np.bincount(bins, right, BINS)
    return float(np.abs(stated - found).sum() / mass.sum())
