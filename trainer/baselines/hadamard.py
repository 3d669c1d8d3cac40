"""Single-pixel classification by Hadamard patterns: pairs of binary patterns, counts, and a network on their differences.

Owns the patterns and the network's view of the counts; light, detector and score are those of common.py. SIMULATED, ideal shot noise.

After Kanwal et al., arXiv 2603.12036: a microLED projector shows Hadamard patterns of 12 x 12 fields, one detector sums the light, and a
small network classifies the series of readings without a picture in between. Taken from there: 12 x 12 fields, at most 144 patterns, no
reconstruction. Assumed here, as only the abstract and summaries were at hand: every pattern is followed by its inverse (330 000 patterns/s
for 1200 digits/s leave 275 per digit, about two for each of 144), the network sees the differences (method `differences`), patterns are
taken from the coarsest on, H12 is Paley's, and the network is that of every other baseline, trained on noisy counts of each photon level.
With `counts` it sees all 2 x pairs counts.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .common import Decide, Measurement, Report, named, silent
from .nets import feature_net, fitted, seeded, shown

FIELDS = 12  # along each side
PAIRS_MAX = FIELDS**2
EPOCHS = 10

F64 = NDArray[np.float64]


def hadamard_12() -> F64:
    """Return Paley's Hadamard matrix of order 12 (-1 and 1), rows by their number of sign changes, the constant one first."""
    squares = {k * k % 11 for k in range(1, 11)}
    character = [0] + [1 if k in squares else -1 for k in range(1, 11)]
    skew = np.zeros((12, 12))
    skew[0, 1:], skew[1:, 0] = 1, -1
    for i in range(11):
        for j in range(11):
            skew[i + 1, j + 1] = character[(j - i) % 11]
    matrix = skew + np.eye(12)
    matrix = matrix * matrix[0]  # the first row all 1
    changes = (np.diff(matrix, axis=1) != 0).sum(axis=1)
    return matrix[np.argsort(changes, kind="stable")]


def pairs(n_pairs: int, shape: tuple[int, int]) -> F64:
    """Return patterns of 0 and 1, float64 (2 x n_pairs, pixels): the coarsest Hadamard patterns, and then their inverses.

    A field covers the pixels whose row and column, times 12 / side and rounded down, are its own.
    """
    if not 1 <= n_pairs <= PAIRS_MAX:
        raise ValueError(f"features is {n_pairs} pairs, allowed: 1 to {PAIRS_MAX}")
    signs = hadamard_12()
    changes = (np.diff(signs, axis=1) != 0).sum(axis=1)
    order = sorted(
        ((u, v) for u in range(FIELDS) for v in range(FIELDS)), key=lambda uv: (changes[uv[0]] + changes[uv[1]], uv)
    )
    rows, columns = (np.arange(side) * FIELDS // side for side in shape)
    positive = np.array([np.outer(signs[u, rows], signs[v, columns]).ravel() for u, v in order[:n_pairs]]) / 2 + 0.5
    return np.concatenate([positive, 1 - positive])


class Differences(nn.Module):
    """The feature network behind the differences of pairs: counts (n, 2 x pairs) -> scores."""

    def __init__(self, n_pairs: int, n_classes: int) -> None:
        super().__init__()
        self.n_pairs = n_pairs
        self.head = feature_net(n_pairs, n_classes)

    def forward(self, counts: Tensor) -> Tensor:
        """Return scores (n, classes)."""
        scores: Tensor = self.head(counts[:, : self.n_pairs] - counts[:, self.n_pairs :])
        return scores


def pair_net(
    measurement: Measurement,
    photons: float,
    detector: str,
    *,
    seed: int,
    differences: bool = True,
    dark: float = 0.0,
    epochs: int = EPOCHS,
    report: Report = silent,
) -> Decide:
    """Return the network trained on fresh counts of pairs (`measure` by `pairs`) at this photon level."""
    n, n_classes = measurement.train.shape[1], measurement.n_classes

    def net() -> torch.nn.Module:
        return Differences(n // 2, n_classes) if differences else feature_net(n, n_classes)

    told = named(f"Hadamard pairs at {photons:g} photons", report)
    inputs = shown(measurement, photons, detector, dark)
    return fitted(seeded(net, seed), measurement, inputs, seed=seed, epochs=epochs, report=told)
