"""A head that is a chain of layers, by our own kernels: click counts in, the same bits out alone, in a batch and from the core.

The padded layout of the layers, the room for one decision, and the back ends `sparse`, `int8` and `float64`; the loops are in kernels.py.
Not for several threads at once: each back end owns its scratch.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.bundle.layers import Int8Head, Layer, read_layers, reference_scores
from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError

from . import kernels
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
