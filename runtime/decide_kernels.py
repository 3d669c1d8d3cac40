"""The compiled kernels of the decision back ends: click words or counts in, labels and scores out.

Owns the loops; never allocates and never judges. Imported only where it pays: a look-up in a table must not wait for numba.

The heads' kernels add in a fixed order (rows of 8 in a fixed tree), so that batch, single decision and loop give the same bits. They are
compiled with `contract` alone of fastmath, which lets a product and a sum be one instruction; tests/test_decide_mlp.py bounds the error.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

STEP = 8  # rows taken at once; hidden sizes are padded to it
LANES = 16  # columns are padded to it: one vector of float32 or int32 at most


@njit(cache=True, nogil=True)
def label_words(labels: NDArray[Any], words: NDArray[Any], out: NDArray[Any]) -> int:
    """Write labels[words[i]] to out[i]; return -1, or the first i whose word is beyond the table (the rest is untouched).

    labels (2**d_f,) and out (n,) share uint8 or uint16; words (n,) is uint16, uint32 or uint64.
    """
    size = np.uint64(labels.size)
    for i in range(words.size):
        word = np.uint64(words[i])
        if word >= size:
            return i
        out[i] = labels[word]
    return -1


@njit(cache=True, nogil=True)
def label_checked_words(labels: NDArray[Any], words: NDArray[Any], out: NDArray[Any]) -> int:
    """As `label_words`, for tables whose size is a power of two: looks for words beyond it first, 1024 at a time.

    Without a way out of the loop the compiler takes several words at once. The words before the first bad piece are labelled.
    """
    mask = np.uint64(labels.size - 1)
    n = words.size
    for start in range(0, n, 1024):
        stop = min(start + 1024, n)
        seen = np.uint64(0)
        for i in range(start, stop):
            seen |= np.uint64(words[i])
        if seen & ~mask:
            return label_words(labels, words[start:stop], out[start:stop]) + start
        for i in range(start, stop):
            out[i] = labels[np.uint64(words[i])]
    return -1


def warm_up(label_dtype: Any = np.uint8, word_dtype: Any = np.uint64) -> None:
    """Compile (or load from the cache) the kernel for these dtypes, so that no deadline pays for it."""
    label_checked_words(np.zeros(2, dtype=label_dtype), np.zeros(1, dtype=word_dtype), np.zeros(1, dtype=label_dtype))


class FloatLayers(NamedTuple):
    """A chain of layers: `sizes` int64 (layers + 1,): d_f, then padded widths; weights row by row, biases one after the other, float32.

    `relu` int64 (layers,). Padding is zero, so that it changes no sum.
    """

    sizes: NDArray[np.int64]
    weights: NDArray[np.float32]
    biases: NDArray[np.float32]
    relu: NDArray[np.int64]


class Int8Layers(NamedTuple):
    """As FloatLayers, with int8 weights, float32 `scales` per column, and hidden values that are whole steps 0..255."""

    sizes: NDArray[np.int64]
    weights: NDArray[np.int8]
    scales: NDArray[np.float32]
    biases: NDArray[np.float32]


class Scratch(NamedTuple):
    """Room for one decision: values float32 and sums int32 (2, widest), rows int64 and steps int32 (d_f + STEP,), factors float32."""

    values: NDArray[np.float32]
    sums: NDArray[np.int32]
    rows: NDArray[np.int64]
    factors: NDArray[np.float32]
    steps: NDArray[np.int32]


# ------------------------------------------------------------------------------------------------------------ float32 heads


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_rows(weights, start, width, n_rows, scratch, out):  # type: ignore[no-untyped-def]
    """out[j] += sum over r < n_rows (padded to STEP) of factors[r] * row rows[r] of the matrix at weights[start:]."""
    rows, f = scratch.rows, scratch.factors
    for r in range(0, n_rows, STEP):
        f0, f1, f2, f3, f4, f5, f6, f7 = f[r], f[r + 1], f[r + 2], f[r + 3], f[r + 4], f[r + 5], f[r + 6], f[r + 7]
        a0, a1 = start + rows[r] * width, start + rows[r + 1] * width
        a2, a3 = start + rows[r + 2] * width, start + rows[r + 3] * width
        a4, a5 = start + rows[r + 4] * width, start + rows[r + 5] * width
        a6, a7 = start + rows[r + 6] * width, start + rows[r + 7] * width
        for j in range(width):
            out[j] += (
                (f0 * weights[a0 + j] + f1 * weights[a1 + j]) + (f2 * weights[a2 + j] + f3 * weights[a3 + j])
            ) + ((f4 * weights[a4 + j] + f5 * weights[a5 + j]) + (f6 * weights[a6 + j] + f7 * weights[a7 + j]))


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_all(weights, start, width, n_rows, x, out):  # type: ignore[no-untyped-def]
    """out[j] += sum over r < n_rows (a multiple of STEP) of x[r] * row r of the matrix at weights[start:]."""
    for r in range(0, n_rows, STEP):
        b = start + r * width
        f0, f1, f2, f3, f4, f5, f6, f7 = x[r], x[r + 1], x[r + 2], x[r + 3], x[r + 4], x[r + 5], x[r + 6], x[r + 7]
        for j in range(width):
            out[j] += (
                (f0 * weights[b + j] + f1 * weights[b + width + j])
                + (f2 * weights[b + 2 * width + j] + f3 * weights[b + 3 * width + j])
            ) + (
                (f4 * weights[b + 4 * width + j] + f5 * weights[b + 5 * width + j])
                + (f6 * weights[b + 6 * width + j] + f7 * weights[b + 7 * width + j])
            )


@njit(cache=True, nogil=True)
def float_scores(counts, shots, layers, scratch):  # type: ignore[no-untyped-def]
    """Scores of one object from its clicks per pattern (integers (d_f,)); they stand in the row of scratch.values that is returned."""
    sizes, n_features = layers.sizes, layers.sizes[0]
    n_fired = 0
    for i in range(n_features):
        if counts[i]:
            scratch.rows[n_fired] = i
            scratch.factors[n_fired] = np.float32(counts[i]) / np.float32(shots)
            n_fired += 1
    for r in range(n_fired, -(-n_fired // STEP) * STEP):
        scratch.rows[r] = 0
        scratch.factors[r] = 0
    width = sizes[1]
    values = scratch.values[0]
    for j in range(width):
        values[j] = layers.biases[j]
    _add_rows(layers.weights, 0, width, n_fired, scratch, values)
    start, bias = n_features * width, width
    for layer in range(1, sizes.size - 1):
        if layers.relu[layer - 1]:
            for j in range(width):
                values[j] = np.float32(0) if values[j] < 0 else values[j]  # written so that a NaN stays one
        n_rows, width = width, sizes[layer + 1]
        following = scratch.values[layer & 1]
        for j in range(width):
            following[j] = layers.biases[bias + j]
        _add_all(layers.weights, start, width, n_rows, values, following)
        values = following
        start += n_rows * width
        bias += width
    if layers.relu[sizes.size - 2]:
        for j in range(width):
            values[j] = np.float32(0) if values[j] < 0 else values[j]
    return (sizes.size - 2) & 1


@njit(cache=True, nogil=True)
def winner(values, n_classes):  # type: ignore[no-untyped-def]
    """Label and softmax probability of one row of scores, as verdict.softmax_winner; probability 0.0 if not finite."""
    label, best = 0, np.float64(values[0])
    total = 0.0
    for k in range(n_classes):
        score = np.float64(values[k])
        if math.isnan(score):
            return k, 0.0
        if score > best:
            label, best = k, score
    if math.isinf(best):
        return label, 0.0
    for k in range(n_classes):
        total += math.exp(np.float64(values[k]) - best)
    return label, 1.0 / total


@njit(cache=True, nogil=True)
def float_run(counts, shots, layers, scratch, scores, labels, probabilities):  # type: ignore[no-untyped-def]
    """Decide many objects or one: counts int64 (n, d_f) -> scores float32 (n, classes), labels uint16 (n,), probabilities float32 (n,)."""
    n_classes = scores.shape[1]
    for i in range(counts.shape[0]):
        values = scratch.values[float_scores(counts[i], shots, layers, scratch)]
        for k in range(n_classes):
            scores[i, k] = values[k]
        labels[i], probabilities[i] = winner(values, n_classes)


# --------------------------------------------------------------------------------------------------------------- int8 heads


@njit(cache=True, nogil=True)
def _add_steps(weights, start, width, n_rows, scratch, out):  # type: ignore[no-untyped-def]
    """out[j] += sum over r < n_rows (padded to STEP) of steps[r] * row rows[r] of an int8 matrix; exact in int32."""
    rows, f = scratch.rows, scratch.steps
    for r in range(0, n_rows, STEP):
        f0, f1, f2, f3, f4, f5, f6, f7 = f[r], f[r + 1], f[r + 2], f[r + 3], f[r + 4], f[r + 5], f[r + 6], f[r + 7]
        a0, a1 = start + rows[r] * width, start + rows[r + 1] * width
        a2, a3 = start + rows[r + 2] * width, start + rows[r + 3] * width
        a4, a5 = start + rows[r + 4] * width, start + rows[r + 5] * width
        a6, a7 = start + rows[r + 6] * width, start + rows[r + 7] * width
        for j in range(width):
            out[j] += np.int32(
                (f0 * weights[a0 + j] + f1 * weights[a1 + j])
                + (f2 * weights[a2 + j] + f3 * weights[a3 + j])
                + (f4 * weights[a4 + j] + f5 * weights[a5 + j])
                + (f6 * weights[a6 + j] + f7 * weights[a7 + j])
            )


@njit(cache=True, nogil=True)
def _add_all_steps(weights, start, width, n_rows, x, out):  # type: ignore[no-untyped-def]
    """out[j] += sum over r < n_rows (a multiple of STEP) of x[r] * row r of an int8 matrix; exact in int32."""
    for r in range(0, n_rows, STEP):
        b = start + r * width
        f0, f1, f2, f3, f4, f5, f6, f7 = x[r], x[r + 1], x[r + 2], x[r + 3], x[r + 4], x[r + 5], x[r + 6], x[r + 7]
        for j in range(width):
            out[j] += np.int32(
                (f0 * weights[b + j] + f1 * weights[b + width + j])
                + (f2 * weights[b + 2 * width + j] + f3 * weights[b + 3 * width + j])
                + (f4 * weights[b + 4 * width + j] + f5 * weights[b + 5 * width + j])
                + (f6 * weights[b + 6 * width + j] + f7 * weights[b + 7 * width + j])
            )


@njit(cache=True, nogil=True)
def int8_scores(counts, shots, layers, scratch):  # type: ignore[no-untyped-def]
    """Scores of one object by integer sums; they stand in scratch.values[0].

    Layer one is an exact integer column sum of the clicks. A hidden value is rounded to a whole step (the export has folded its range
    into the scales) and cut to 0..255.
    """
    sizes, n_features = layers.sizes, layers.sizes[0]
    n_fired = 0
    for i in range(n_features):
        if counts[i]:
            scratch.rows[n_fired] = i
            scratch.steps[n_fired] = counts[i]
            n_fired += 1
    for r in range(n_fired, -(-n_fired // STEP) * STEP):
        scratch.rows[r] = 0
        scratch.steps[r] = 0
    width = sizes[1]
    sums = scratch.sums[0]
    sums[:width] = 0
    _add_steps(layers.weights, 0, width, n_fired, scratch, sums)
    start, column = n_features * width, 0
    unit = np.float32(1) / np.float32(shots)
    for layer in range(1, sizes.size - 1):
        for j in range(width):
            value = np.float32(sums[j]) * (layers.scales[column + j] * unit) + layers.biases[column + j]
            sums[j] = np.int32(min(max(value, np.float32(0)), np.float32(255)) + np.float32(0.5))
        column += width
        n_rows, width, unit = width, sizes[layer + 1], np.float32(1)
        following = scratch.sums[layer & 1]
        following[:width] = 0
        _add_all_steps(layers.weights, start, width, n_rows, sums, following)
        sums = following
        start += n_rows * width
    values = scratch.values[0]
    for j in range(width):
        values[j] = np.float32(sums[j]) * (layers.scales[column + j] * unit) + layers.biases[column + j]


@njit(cache=True, nogil=True)
def int8_run(counts, shots, layers, scratch, scores, labels, probabilities):  # type: ignore[no-untyped-def]
    """As `float_run`, with the quantised head."""
    n_classes = scores.shape[1]
    for i in range(counts.shape[0]):
        int8_scores(counts[i], shots, layers, scratch)
        for k in range(n_classes):
            scores[i, k] = scratch.values[0, k]
        labels[i], probabilities[i] = winner(scratch.values[0], n_classes)
