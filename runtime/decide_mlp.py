"""The head's own kernels as back ends: float32, int8, and the float64 reference.

Owns the padded layout of a chain of layers and the room for one decision; the loops are in decide_kernels.py. A back end gives the same
bits for one object alone, in a batch and from the streaming core. Not for several threads at once: each owns its scratch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import decide_kernels as kernels
from .bundle import Bundle
from .errors import UsageError
from .head_layers import Layer, read_layers, reference_scores
from .int8_head import Int8Head
from .verdict import Verdict, Verdicts, checked_counts, demand_golden, softmax_winner, softmax_winners

SHOTS_MAX = 16  # of golden vectors
Room = tuple[NDArray[np.float32], NDArray[np.uint16], NDArray[np.float32]]  # scores, labels, probabilities


class _KernelDecider:
    """What the two compiled heads share: one kernel for one object and for many."""

    name = ""

    def __init__(self, bundle: Bundle, run: Callable[..., None], layers: Any) -> None:
        self.choice: Mapping[str, Any] = {}
        self.n_features, self.n_classes = bundle.n_features, bundle.n_classes
        self.layers, self.scratch = layers, make_scratch(layers.sizes)
        self._run = run
        self._one = np.zeros((1, self.n_features), np.int64)
        self._out = _room(1, self.n_classes)
        run(self._one, 1, layers, self.scratch, *self._out)  # compiles or loads the kernel

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); the caller answers for 0 <= counts <= shots and shots >= 1."""
        self._one[0] = counts
        self._run(self._one, shots, self.layers, self.scratch, *self._out)
        return Verdict(int(self._out[1][0]), float(self._out[2][0]))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the scores, float32 (n, classes), for click counts (n, d_f)."""
        return self._decide_all(checked_counts(counts, shots, self.n_features), shots)[0]

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), for click counts (n, d_f)."""
        return self._decide_all(checked_counts(counts, shots, self.n_features), shots)[1].astype(np.int64)

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Return labels and probabilities for click counts, int64 (n, d_f), that are known to be 0..shots."""
        return Verdicts(*self._decide_all(counts, shots)[1:])

    def _decide_all(self, counts: NDArray[np.int64], shots: int) -> Room:
        room = _room(len(counts), self.n_classes)
        self._run(np.ascontiguousarray(counts), shots, self.layers, self.scratch, *room)
        return room


class SparseDecider(_KernelDecider):
    """The columns of the patterns that clicked, then the dense layers, in float32 and in a fixed order."""

    name = "sparse"

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle, kernels.float_run, pad_float(bundle_layers(bundle)))
        rows, counts, shots = golden_counts(bundle.golden_means)
        found = np.empty((len(rows), self.n_classes), np.float32)
        for k in np.unique(shots):
            found[shots == k] = self.scores_batch(counts[shots == k], int(k))
        demand_golden(self.name, found, bundle.golden_scores[rows], bundle)


class Int8Decider(_KernelDecider):
    """The quantised head: int8 weights, exact integer sums. It may decide otherwise than the float head; asked for by name only."""

    name = "int8"

    def __init__(self, bundle: Bundle) -> None:
        if bundle.int8_head is None:
            raise UsageError(
                f"{bundle.name} has no int8 head", remedy="export it again with one, or use another back end"
            )
        super().__init__(bundle, kernels.int8_run, pad_int8(bundle.int8_head))


class ReferenceDecider:
    """The head in float64, slowly: what the errors of the others are measured against."""

    name = "float64"

    def __init__(self, bundle: Bundle) -> None:
        self._layers = bundle_layers(bundle)
        self.choice: Mapping[str, Any] = {}
        self.n_features, self.n_classes = bundle.n_features, bundle.n_classes
        found = reference_scores(self._layers, bundle.golden_means).astype(np.float32)
        demand_golden(self.name, found, bundle.golden_scores, bundle)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,), over `shots` shots."""
        return softmax_winner(self.scores_wide(counts[None], shots)[0])

    def scores_wide(self, counts: ArrayLike, shots: int) -> NDArray[np.float64]:
        """Return the scores, float64 (n, classes), for click counts (n, d_f)."""
        return reference_scores(self._layers, checked_counts(counts, shots, self.n_features) / shots)

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the scores, rounded to float32 (n, classes), for click counts (n, d_f)."""
        return self.scores_wide(counts, shots).astype(np.float32)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), for click counts (n, d_f)."""
        return self.scores_wide(counts, shots).argmax(axis=1).astype(np.int64)

    def verdicts(self, counts: NDArray[Any], shots: int) -> Verdicts:
        """Return labels and probabilities for click counts (n, d_f)."""
        return softmax_winners(self.scores_wide(counts, shots))


def golden_counts(means: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of `means` (g, d_f) that are counts over a number of shots up to SHOTS_MAX, their counts and shots."""
    counts, shots = np.zeros(means.shape, np.int64), np.zeros(len(means), np.int64)
    for k in range(SHOTS_MAX, 0, -1):  # the least number of shots is taken last
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
        raise UsageError(
            f"{bundle.name} has no head that is a plain chain of layers (Gemm or MatMul and Add, Relu)",
            remedy="use the back end onnx, or the table",
        )
    return chain


def pad_float(chain: tuple[Layer, ...]) -> kernels.FloatLayers:
    """Return the layers as the kernel reads them, padded with zeros."""
    sizes = [chain[0].weights.shape[0], *(_padded(layer.weights.shape[1]) for layer in chain)]
    weights, biases = [], []
    for n_in, n_out, layer in zip(sizes, sizes[1:], chain):
        weights.append(_pad(layer.weights, (n_in, n_out)).ravel())
        biases.append(_pad(layer.bias, (n_out,)))
    relu = np.array([layer.relu for layer in chain], np.int64)
    return kernels.FloatLayers(np.array(sizes, np.int64), np.concatenate(weights), np.concatenate(biases), relu)


def pad_int8(head: Int8Head) -> kernels.Int8Layers:
    """Return the quantised layers as the kernel reads them, padded with zeros."""
    matrices = head.matrices()
    sizes = [int(head.sizes[0]), *(_padded(weights.shape[1]) for weights, _, _ in matrices)]
    parts = [
        (_pad(weights, (n_in, n_out)).ravel(), _pad(scale, (n_out,)), _pad(bias, (n_out,)))
        for n_in, n_out, (weights, scale, bias) in zip(sizes, sizes[1:], matrices)
    ]
    arrays = [np.concatenate(column) for column in zip(*parts)]
    return kernels.Int8Layers(np.array(sizes, np.int64), *arrays)


def make_scratch(sizes: NDArray[np.int64]) -> kernels.Scratch:
    """Return the room that one decision through layers of these sizes needs."""
    widest, rows = int(sizes[1:].max()), int(sizes[0]) + kernels.STEP
    return kernels.Scratch(
        np.zeros((2, widest), np.float32),
        np.zeros((2, widest), np.int32),
        np.zeros(rows, np.int64),
        np.zeros(rows, np.float32),
        np.zeros(rows, np.int32),
    )


def _room(n: int, n_classes: int) -> Room:
    return np.empty((n, n_classes), np.float32), np.empty(n, np.uint16), np.empty(n, np.float32)


def _padded(width: int) -> int:
    return -(-width // kernels.LANES) * kernels.LANES


def _pad(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    wide = np.zeros(shape, array.dtype)
    wide[tuple(slice(n) for n in array.shape)] = array
    return wide
