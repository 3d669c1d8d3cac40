"""t-SNE, exact (van der Maaten and Hinton 2008): a map of click features in two dimensions, for pictures only.

Owns the map of at most `OBJECTS_MAX` points in plain numpy; never draws and never decides. Distances on the map mean nothing beyond
"near"; the same seed gives the same map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import UsageError

OBJECTS_MAX = 2000  # n x n matrices, several of them
PERPLEXITY = 30.0
STEPS = 500
EXAGGERATION, EXAGGERATED_STEPS = 12.0, 120
_TINY = 1e-12

F64 = NDArray[np.float64]


def tsne(features: NDArray[np.floating], *, perplexity: float = PERPLEXITY, steps: int = STEPS, seed: int = 0) -> F64:
    """Return positions, float64 (n, 2), of `features` (n, d); UsageError for too few or too many points."""
    n = len(features)
    if features.ndim != 2 or not 3 * perplexity < n <= OBJECTS_MAX:
        raise UsageError(
            f"{n} points, allowed for a map at perplexity {perplexity:g}: {int(3 * perplexity) + 1} to {OBJECTS_MAX}"
        )
    wide = features.astype(np.float64)
    near = joint_neighbours(wide, perplexity)
    start = wide - wide.mean(axis=0)
    axes = np.linalg.svd(start, full_matrices=False)[2][:2]
    place = np.zeros((n, 2))
    place[:, : len(axes)] = start @ axes.T  # principal components: the same map for the same features
    place *= 1e-4 / max(float(place.std()), _TINY)
    place += np.random.default_rng(seed).normal(0, 1e-5, place.shape)  # equal features must be able to part
    speed, gains = np.zeros_like(place), np.ones_like(place)
    rate = max(n / EXAGGERATION / 4, 50.0)
    for step in range(steps):
        early = step < EXAGGERATED_STEPS
        slope = gradient(near * EXAGGERATION if early else near, place)
        gains = np.maximum(np.where(np.sign(slope) != np.sign(speed), gains + 0.2, gains * 0.8), 0.01)
        speed = (0.5 if early else 0.8) * speed - rate * gains * slope
        place = place + speed
        place -= place.mean(axis=0)
    return place


def joint_neighbours(features: F64, perplexity: float) -> F64:
    """Return how near any two points are, (n, n), summing to 1: Gaussians of that perplexity around every point, made symmetric."""
    squared = _squared_distances(features)
    n = len(features)
    low, high = np.full(n, 1e-20), np.full(n, 1e20)
    spread = squared.sum(axis=1) / (n - 1)
    beta = 1 / np.maximum(spread, _TINY)
    target = np.log(perplexity)
    for _ in range(60):
        weight = np.exp(-squared * beta[:, None])
        np.fill_diagonal(weight, 0.0)
        total = np.maximum(weight.sum(axis=1), _TINY)
        entropy = np.log(total) + beta * (squared * weight).sum(axis=1) / total
        low, high = np.where(entropy > target, beta, low), np.where(entropy > target, high, beta)
        beta = np.where(high > 1e19, beta * 2, np.where(low < 1e-19, beta / 2, (low + high) / 2))
    share = weight / total[:, None]
    return np.maximum((share + share.T) / (2 * n), _TINY)


def gradient(near: F64, place: F64) -> F64:
    """Return the slope of the Kullback-Leibler divergence, (n, 2)."""
    kernel = 1 / (1 + _squared_distances(place))
    np.fill_diagonal(kernel, 0.0)
    pull = (near - kernel / kernel.sum()) * kernel
    return 4 * (pull.sum(axis=1)[:, None] * place - pull @ place)


def divergence(near: F64, place: F64) -> float:
    """Return the Kullback-Leibler divergence between `near` and the nearness on the map."""
    kernel = 1 / (1 + _squared_distances(place))
    np.fill_diagonal(kernel, 0.0)
    away = ~np.eye(len(near), dtype=bool)
    return float((near[away] * np.log(near[away] / np.maximum(kernel / kernel.sum(), _TINY)[away])).sum())


def _squared_distances(points: F64) -> F64:
    norms = (points**2).sum(axis=1)
    return np.maximum(norms[:, None] + norms[None, :] - 2 * points @ points.T, 0.0)
