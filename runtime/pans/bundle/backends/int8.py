"""A head that is a chain of layers, by our own kernels: click counts in, the same bits out alone, in a batch and from the core.

The padded layout of the layers, the room for one decision, and the back ends `sparse`, `int8` and `float64`; the loops are in kernels.py.
Not for several threads at once: each back end owns its scratch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.errors import UsageError
from pans.base.machine import inner, njit, outer
from pans.bundle.heads.layers import Int8Head, Layer, read_layers, reference_scores
from pans.bundle.sensor.facts import Bundle

from . import int8 as kernels
from .verdict import ScoredDecider, Verdict, Verdicts, checked_counts, demand_golden

GOLDEN_EXPOSURES_MAX = 16
GROUP_BITS = (5, 4, 3)  # fewer save nothing: few patterns click
GROUP_BYTES_MAX = 1 << 18  # a part of a level-2 cache
Room = tuple[NDArray[np.float32], NDArray[np.uint16], NDArray[np.float32]]  # scores, labels, probabilities


class Padded(NamedTuple):
    """A chain of layers as kernels.py describes it."""

    meta: NDArray[np.int64]
    numbers: Any


class _KernelDecider(ScoredDecider):
    """What the two compiled heads share: one kernel for one object and for many."""

    def __init__(self, bundle: Bundle, run: Callable[..., None], layers: Padded, dtype: Any) -> None:
        super().__init__(bundle)
        self.layers, self.room, self.kernel = layers, make_room(layers.meta, dtype), run
        self._one, self._out = np.zeros((1, self.n_features), np.int64), _room(1, self.n_classes)
        run(self._one, 1, *layers, self.room, *self._out)  # compiles or loads the kernel

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); the caller answers for 0 <= counts <= shots * largest and shots >= 1."""
        self._one[0] = counts
        self.kernel(self._one, shots * self.largest, *self.layers, self.room, *self._out)
        return Verdict(int(self._out[1][0]), float(self._out[2][0]))

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Return labels and probabilities of click counts, int64 (n, d_f), that are known to be 0..shots * largest."""
        return Verdicts(*self._decide_all(counts, shots * self.largest)[1:])

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), of click counts, integers (n, d_f)."""
        checked = checked_counts(counts, shots * self.largest, self.n_features)
        return self.verdicts(checked, shots).labels.astype(np.int64)

    def _scores(self, counts: NDArray[np.int64], exposures: int) -> NDArray[np.float32]:
        return self._decide_all(counts, exposures)[0]

    def _decide_all(self, counts: NDArray[np.int64], exposures: int) -> Room:
        room = _room(len(counts), self.n_classes)
        self.kernel(np.ascontiguousarray(counts), exposures, *self.layers, self.room, *room)
        return room


class SparseDecider(_KernelDecider):
    """The columns of the patterns that clicked, then the dense layers, in float32 and in a fixed order."""

    name = "sparse"

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle, kernels.float_run, pad_float(bundle_layers(bundle)), np.float32)
        rows, counts, exposures = golden_counts(bundle.golden_means)
        found = np.empty((len(rows), self.n_classes), np.float32)
        for k in np.unique(exposures):
            found[exposures == k] = self._scores(counts[exposures == k], int(k))
        demand_golden(self.name, found, bundle.golden_scores[rows], bundle)


class Int8Decider(_KernelDecider):
    """The quantised head: int8 weights, exact integer sums. It may decide otherwise than the float head; asked for by name only."""

    name = "int8"

    def __init__(self, bundle: Bundle) -> None:
        if bundle.int8_head is None:
            remedy = "export it again with one, or use another back end"
            raise UsageError(f"{bundle.name} has no int8 head", remedy=remedy)
        super().__init__(bundle, kernels.int8_run, pad_int8(bundle.int8_head), np.int32)


class ReferenceDecider(ScoredDecider):
    """The head in float64, slowly: what the errors of the others are measured against."""

    name = "float64"

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle)
        self._layers = bundle_layers(bundle)
        found = reference_scores(self._layers, bundle.golden_means).astype(np.float32)
        demand_golden(self.name, found, bundle.golden_scores, bundle)

    def _scores(self, counts: NDArray[np.int64], exposures: int) -> NDArray[np.float64]:
        return reference_scores(self._layers, counts / exposures)


def golden_counts(means: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of `means` (g, d_f) that are counts over a number of shots up to GOLDEN_EXPOSURES_MAX, their counts and shots."""
    counts, shots = np.zeros(means.shape, np.int64), np.zeros(len(means), np.int64)
    for k in range(GOLDEN_EXPOSURES_MAX, 0, -1):  # the least number of shots is taken last
        whole = np.rint(means.astype(np.float64) * k)
        exact = (whole.astype(np.float32) / np.float32(k) == means).all(axis=1)
        counts[exact], shots[exact] = whole[exact].astype(np.int64), k
    rows = np.flatnonzero(shots)
    return rows, counts[rows], shots[rows]


def bundle_layers(bundle: Bundle) -> tuple[Layer, ...]:
    """Return the layers of the bundle's head; UsageError when it has none, or is no plain chain of finite layers."""
    chain = None
    if bundle.head_onnx is not None:
        chain = read_layers(bundle.head_onnx, bundle.n_features, bundle.n_classes)
    if chain is None or not all(np.isfinite(layer.weights).all() and np.isfinite(layer.bias).all() for layer in chain):
        what = f"{bundle.name} has no head that is a plain chain of layers (Gemm or MatMul and Add, Relu)"
        raise UsageError(what, remedy="use the back end onnx, or the table")
    return chain


def pad_float(chain: tuple[Layer, ...]) -> Padded:
    """Return the layers as the kernel reads them, padded with zeros."""
    sizes = _padded_sizes([chain[0].weights.shape[0], *(layer.weights.shape[1] for layer in chain)])
    bits, groups = _groups(chain[0], sizes[1])
    n_weights = sum(n_in * n_out for n_in, n_out in pairwise(sizes))
    # large heads are in memory once more, not thrice
    numbers = np.zeros(n_weights + sum(sizes[1:]) + len(groups), np.float32)
    _lay_out([layer.weights for layer in chain], sizes, numbers)
    start = n_weights
    for n_out, layer in zip(sizes[1:], chain):
        numbers[start : start + len(layer.bias)] = layer.bias
        start += n_out
    numbers[start:] = groups
    meta = np.array([len(chain), *sizes, *(layer.relu for layer in chain), bits, start], np.int64)
    return Padded(meta, numbers)


def _groups(layer: Layer, width: int) -> tuple[int, NDArray[np.float32]]:
    """Return bits per group and the first layer's sums for every word of each group, padded to `width`, an even number of groups.

    The larger the groups, the fewer rows are added for a decision; GROUP_BYTES_MAX keeps them all in a cache. 0 bits where that cannot be.
    Sums are taken in float64 and rounded once; one that is no float32 is infinite, and what it leads to abstains.
    """
    n_features = layer.weights.shape[0]
    for bits in GROUP_BITS:
        sizes = [min(bits, n_features - first) for first in range(0, n_features, bits)]
        sizes += [0] * (len(sizes) % 2)
        if sum(1 << size for size in sizes) * width * 4 > GROUP_BYTES_MAX:
            continue
        tables, first = [], 0
        for number, size in enumerate(sizes):
            clicked = np.arange(1 << size)[:, None] >> np.arange(size) & 1
            sums = clicked @ layer.weights[first : first + size].astype(np.float64)
            with np.errstate(over="ignore"):
                rounded = (sums + layer.bias * (number == 0)).astype(np.float32)
            tables.append(_pad(rounded, (1 << size, width)).ravel())
            first += size
        return bits, np.concatenate(tables)
    return 0, np.zeros(0, np.float32)


def pad_int8(head: Int8Head) -> Padded:
    """Return the quantised layers as the kernel reads them, padded with zeros."""
    matrices = head.matrices()
    sizes = _padded_sizes(head.sizes.tolist())
    weights = np.zeros(sum(n_in * n_out for n_in, n_out in pairwise(sizes)), np.int8)
    _lay_out([matrix for matrix, _, _ in matrices], sizes, weights)
    affine = [np.stack([_pad(scale, (n,)), _pad(bias, (n,))]) for n, (_, scale, bias) in zip(sizes[1:], matrices)]
    meta = np.array([len(matrices), *sizes, *[1] * (len(matrices) - 1), 0], np.int64)
    return Padded(meta, (weights, np.concatenate(affine, axis=1)))


def make_room(meta: NDArray[np.int64], dtype: Any) -> tuple[NDArray[Any], ...]:
    """Return the kernel's room for one decision through layers of these sizes: (work, rows), with `hidden` for int32."""
    n_layers, n_features = int(meta[0]), int(meta[1])
    widest = max(int(meta[2 : n_layers + 2].max()), n_features + kernels.STEP)
    room = np.zeros((3, widest), dtype), np.zeros(n_features + kernels.STEP, np.int64)
    return room if dtype == np.float32 else (*room, np.zeros(widest, np.int16))


def _room(n: int, n_classes: int) -> Room:
    return np.empty((n, n_classes), np.float32), np.empty(n, np.uint16), np.empty(n, np.float32)


def _padded_sizes(sizes: list[int]) -> list[int]:
    """Hidden widths become multiples of LANES, the last one even; d_f stays."""
    hidden = [-(-width // kernels.LANES) * kernels.LANES for width in sizes[1:-1]]
    return [sizes[0], *hidden, sizes[-1] + sizes[-1] % 2]


def _lay_out(matrices: list[NDArray[Any]], sizes: list[int], out: NDArray[Any]) -> None:
    """Write matrices into zeros: the first row by row, since clicks select rows; the others column by column, for dot products."""
    start = 0
    for number, (matrix, (n_in, n_out)) in enumerate(zip(matrices, pairwise(sizes))):
        room = out[start : start + n_in * n_out]
        wide = room.reshape(n_in, n_out) if number == 0 else room.reshape(n_out, n_in).T
        wide[: matrix.shape[0], : matrix.shape[1]] = matrix
        start += n_in * n_out


def _pad(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    wide = np.zeros(shape, array.dtype)
    wide[tuple(slice(n) for n in array.shape)] = array
    return wide


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
