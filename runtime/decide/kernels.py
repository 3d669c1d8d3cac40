"""The compiled loops of the decision back ends: click words or counts in, labels and scores out, into arrays of the caller.

The same bits for one object and for many. Two freedoms of fastmath are taken where they pay: `contract` (a product and a sum in one
instruction) and `reassoc` (the order of a sum), so that another processor may round another last bit; test_mlp.py holds
the error below the bound that any order has. NaN and infinity keep their meaning.
"""

from __future__ import annotations

import math

import numpy as np

from pans.runtime.wire.inner import inner, njit, outer

STEP = 8  # rows of the first matrix taken at once
_U = np.uint64  # unsigned indices: a signed one is tested for being negative, and then nothing is vectorised
LANES = 16  # hidden widths are padded to it: one vector of float32 or int32 at most


# A chain of layers is two arrays. `meta` int64: number of layers L, then L + 1 sizes (d_f, then padded widths), then L flags
# "rectified", and for float32 two more: patterns per group (0: no groups) and where in `numbers` the groups stand. `numbers` float32:
# the first matrix row by row (n_in, n_out), the others column by column, then all biases, then the groups: the first layer's sums for
# every click word of a few neighbouring patterns, an even number of groups, the bias within the first; single shots are decided from
# them. For int8 the matrices are an array of their own and `affine` float32 (2, sum of widths) holds scales and biases. Padding is
# zero, so that it changes no sum. Few arrays, because each one costs a call from Python a tenth of a microsecond. Room for one
# decision: `work` (3, widest), whose last row holds the clicks that fired, `rows` int64, and for int8 `hidden` int16.


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_rows(weights, width, n_rows, rows, f, out):  # type: ignore[no-untyped-def]
    """out[0, j] += sum over r < n_rows (padded to STEP) of f[r] * row rows[r] of the matrix at the start of weights.

    float32, or exact in int32 from int8 weights: `kind` keeps the sums as narrow as `out` is.
    """
    columns, kind = _U(width), out.dtype.type
    for r in range(0, n_rows, STEP):
        f0, f1, f2, f3, f4, f5, f6, f7 = f[r], f[r + 1], f[r + 2], f[r + 3], f[r + 4], f[r + 5], f[r + 6], f[r + 7]
        a0, a1 = _U(rows[r]) * columns, _U(rows[r + 1]) * columns
        a2, a3 = _U(rows[r + 2]) * columns, _U(rows[r + 3]) * columns
        a4, a5 = _U(rows[r + 4]) * columns, _U(rows[r + 5]) * columns
        a6, a7 = _U(rows[r + 6]) * columns, _U(rows[r + 7]) * columns
        for j in range(columns):
            out[0, j] += kind(
                ((f0 * weights[a0 + j] + f1 * weights[a1 + j]) + (f2 * weights[a2 + j] + f3 * weights[a3 + j]))
                + ((f4 * weights[a4 + j] + f5 * weights[a5 + j]) + (f6 * weights[a6 + j] + f7 * weights[a7 + j]))
            )


@inner
def _add_groups(counts, i, n_features, bits, tables, start, width, out):  # type: ignore[no-untyped-def]
    """out[0, :width] = the first layer of the single shot counts[i]: one row for each group of `bits` patterns, two groups at a time.

    Sums run over pairs of groups: ((g0 + g1) + (g2 + g3)) + ..., each group's row being its exact sum, rounded once.
    """
    columns = _U(width)
    at, feature = _U(start), 0
    first = True
    while feature < n_features:
        a, feature, at = _group_row(counts, i, n_features, bits, feature, at, columns)
        b, feature, at = _group_row(counts, i, n_features, bits, feature, at, columns)
        if first:
            for j in range(columns):
                out[0, j] = tables[a + j] + tables[b + j]
        else:
            for j in range(columns):
                out[0, j] += tables[a + j] + tables[b + j]
        first = False


@inner
def _group_row(counts, i, n_features, bits, feature, at, columns):  # type: ignore[no-untyped-def]
    """Where the row of the group that begins at `feature` stands, then the next group's first pattern and place; no branch on a click."""
    word, size = _U(0), min(bits, n_features - feature)
    for k in range(size):
        word |= _U(counts[i, feature + k]) << _U(k)
    return at + word * columns, feature + size, at + (columns << _U(size))


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _dots(weights, start, n_out, n_in, x, out):  # type: ignore[no-untyped-def]
    """out[k] += x . weights[start + k * n_in:][:n_in], two rows at a time; n_out is even, n_in a multiple of LANES."""
    length = _U(n_in)
    for k in range(0, n_out, 2):
        p = _U(start) + _U(k) * length
        q = p + length
        a, b = np.float32(0), np.float32(0)
        for j in range(length):
            a += x[j] * weights[p + j]
            b += x[j] * weights[q + j]
        out[k] += a
        out[k + 1] += b


@inner
def _fired(counts, i, n_features, shots, rows, factors):  # type: ignore[no-untyped-def]
    """Write down which patterns clicked and how often per shot, padded to STEP; return how many."""
    n_fired = 0
    for feature in range(n_features):
        count = counts[i, feature]
        if count:
            rows[n_fired] = feature
            factors[n_fired] = np.float32(count) / np.float32(shots)
            n_fired += 1
    for r in range(n_fired, -(-n_fired // STEP) * STEP):
        rows[r] = 0
        factors[r] = 0
    return n_fired


@inner
def float_scores(counts, i, shots, meta, numbers, work, rows):  # type: ignore[no-untyped-def]
    """Scores of the object whose clicks are counts[i], integers (n, d_f); they stand in the row of `work` that is returned."""
    n_layers, n_features, width = meta[0], meta[1], meta[2]
    bias, bits = 0, meta[2 * n_layers + 2]
    for layer in range(n_layers):
        bias += meta[layer + 1] * meta[layer + 2]
    if shots == 1 and bits > 0:
        _add_groups(counts, i, n_features, bits, numbers, meta[2 * n_layers + 3], width, work)
    else:
        n_fired = _fired(counts, i, n_features, shots, rows, work[2])
        first, constants = work[0], numbers[bias : bias + width]
        for j in range(width):
            first[j] = constants[j]
        _add_rows(numbers, width, n_fired, rows, work[2], work)
    start, source = n_features * width, 0
    bias += width
    for layer in range(1, n_layers + 1):
        if meta[n_layers + 1 + layer]:
            values = work[source]
            for j in range(width):
                values[j] = np.float32(0) if values[j] < 0 else values[j]  # written so that a NaN stays one
        if layer == n_layers:
            break
        n_rows, width = width, meta[layer + 2]
        values, following, constants = work[source], work[1 - source], numbers[bias : bias + width]
        for j in range(width):
            following[j] = constants[j]
        _dots(numbers, start, width, n_rows, values, following)
        start += n_rows * width
        bias += width
        source = 1 - source
    return source


@outer
def winner(rows, i, n_classes):  # type: ignore[no-untyped-def]
    """Label and softmax probability of the scores rows[i], as verdict.softmax_winner; probability 0.0 if not finite."""
    label, best = 0, np.float64(rows[i, 0])
    total = 0.0
    for k in range(n_classes):
        score = np.float64(rows[i, k])
        if math.isnan(score):
            return k, 0.0
        if score > best:
            label, best = k, score
    if math.isinf(best):
        return label, 0.0
    for k in range(n_classes):
        total += math.exp(np.float64(rows[i, k]) - best)
    return label, 1.0 / total


@outer
def float_run(counts, shots, meta, numbers, room, scores, labels, probabilities):  # type: ignore[no-untyped-def]
    """Decide many objects or one: counts int64 (n, d_f) -> scores float32 (n, classes), labels uint16 (n,), probabilities float32 (n,).

    `room` is (work, rows). The clicks that fired select rows of the first matrix; the other layers are dense.
    """
    work, rows = room
    n_classes = scores.shape[1]
    for i in range(counts.shape[0]):
        last = float_scores(counts, i, shots, meta, numbers, work, rows)
        for k in range(n_classes):
            scores[i, k] = work[last, k]
        labels[i], probabilities[i] = winner(scores, i, n_classes)


@inner
def _dots_of_steps(weights, start, n_out, n_in, x, out):  # type: ignore[no-untyped-def]
    """out[k] = x . weights[start + k * n_in:][:n_in], x int16, weights int8; exact in int32."""
    for k in range(n_out):
        w = weights[start + k * n_in : start + (k + 1) * n_in]
        total = np.int32(0)
        for j in range(n_in):
            total += np.int32(np.int32(x[j]) * np.int32(w[j]))
        out[k] = total


@inner
def int8_scores(counts, i, shots, meta, numbers, room, scores):  # type: ignore[no-untyped-def]
    """Scores scores[i] of the object whose clicks are counts[i], integers (n, d_f), by integer sums.

    `numbers` and `room` as in `int8_run`. Layer one is an exact integer column sum of the clicks. A hidden value is rounded to a whole
    step (the export has folded its range into the scales) and cut to 0..255.
    """
    weights, affine = numbers
    work, rows, hidden = room
    n_layers, n_features, width, n_fired = meta[0], meta[1], meta[2], 0
    steps = work[2]
    for feature in range(n_features):
        count = counts[i, feature]
        if count:
            rows[n_fired] = feature
            steps[n_fired] = count
            n_fired += 1
    for r in range(n_fired, -(-n_fired // STEP) * STEP):
        rows[r] = 0
        steps[r] = 0
    for j in range(width):
        work[0, j] = 0
    _add_rows(weights, width, n_fired, rows, steps, work)
    start, column, sums = n_features * width, 0, work[0]
    unit = np.float32(1) / np.float32(shots)
    for layer in range(1, n_layers):
        scales, biases = affine[0, column : column + width], affine[1, column : column + width]
        for j in range(width):
            value = np.float32(sums[j]) * (scales[j] * unit) + biases[j]
            hidden[j] = np.int16(min(max(value, np.float32(0)), np.float32(255)) + np.float32(0.5))
        column += width
        n_rows, width, unit = width, meta[layer + 2], np.float32(1)
        _dots_of_steps(weights, start, width, n_rows, hidden, sums)
        start += n_rows * width
    for k in range(scores.shape[1]):
        scores[i, k] = np.float32(sums[k]) * (affine[0, column + k] * unit) + affine[1, column + k]


@outer
def int8_run(counts, shots, meta, numbers, room, scores, labels, probabilities):  # type: ignore[no-untyped-def]
    """As `float_run`, with the quantised head; `numbers` is (weights int8, affine), `room` (work int32, rows, hidden)."""
    n_classes = scores.shape[1]
    for i in range(counts.shape[0]):
        int8_scores(counts, i, shots, meta, numbers, room, scores)
        labels[i], probabilities[i] = winner(scores, i, n_classes)
