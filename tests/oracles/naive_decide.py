"""Slow oracles for the decision back ends: plain loops over Python numbers, one object at a time."""

import math
from collections.abc import Sequence

import numpy as np

from pans.bundle.heads.layers import STEP_MAX, Int8Head


def word_of(clicks: Sequence[int]) -> int:
    """The table row of single clicks: bit i is pattern i."""
    word = 0
    for pattern, click in enumerate(clicks):
        if click:
            word += 2**pattern
    return word


def winner(scores: Sequence[float]) -> tuple[int, float]:
    """The lowest label with the largest score, and its softmax probability."""
    best = 0
    for label in range(1, len(scores)):
        if scores[label] > scores[best]:
            best = label
    return best, 1.0 / math.fsum(math.exp(score - scores[best]) for score in scores)


def affine_scores(
    counts: Sequence[int], shots: int, weights: Sequence[Sequence[float]], bias: Sequence[float]
) -> list[float]:
    """Scores of an affine head: weights (d_f, classes), bias (classes)."""
    result = []
    for label in range(len(bias)):
        terms = [counts[pattern] / shots * weights[pattern][label] for pattern in range(len(counts))]
        result.append(math.fsum(terms) + bias[label])
    return result


def mlp_scores(
    counts: Sequence[int], shots: int, layers: Sequence[tuple[Sequence[Sequence[float]], Sequence[float], bool]]
) -> list[float]:
    """Scores of a chain of layers (weights (n_in, n_out), bias, rectified) in Python floats."""
    values = [count / shots for count in counts]
    for weights, bias, relu in layers:
        sums = [math.fsum(values[i] * weights[i][k] for i in range(len(values))) + bias[k] for k in range(len(bias))]
        values = [max(value, 0.0) for value in sums] if relu else sums
    return values


def int8_reference(head: Int8Head, counts: np.ndarray, shots: int) -> np.ndarray:
    """Return the scores (n, classes) of click counts (n, d_f): integer sums, and float32 between them as the kernel has it."""
    steps = counts.astype(np.int64)
    unit = np.float32(1) / np.float32(shots)
    matrices = head.matrices()
    for weights, scale, bias in matrices[:-1]:
        value = (steps @ weights.astype(np.int64)).astype(np.float32) * (scale * unit) + bias
        steps = np.floor(np.clip(value, 0, STEP_MAX) + np.float32(0.5)).astype(np.int64)
        unit = np.float32(1)
    weights, scale, bias = matrices[-1]
    sums = (steps @ weights.astype(np.int64)).astype(np.float32)
    return np.asarray(sums * (scale * unit) + bias, np.float64)
