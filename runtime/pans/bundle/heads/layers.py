"""An ONNX head that is a plain chain of layers in; weights and biases for our own kernels out, in float32 and in eight bits.

`read_layers` returns None for any other graph: onnxruntime runs those. Every column of a quantised layer has its own scale. The range of
each hidden value is folded into its column and out of the next layer's row, so that a hidden value is a whole step 0..255 of its own range.
Layer one needs no rounding of its input: clicks are whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .onnx_check import Node, read_model

WEIGHT_MAX = 127
STEP_MAX = 255
HEADROOM = 1.05  # of the largest hidden value that the calibration words gave
_SIGMAS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """scores = means @ weights + bias, then the rectifier if `relu`; weights float32 (n_in, n_out), bias float32 (n_out,)."""

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    relu: bool


def read_layers(model: bytes, n_features: int, n_classes: int) -> tuple[Layer, ...] | None:
    """Return the layers of `model`, a chain of Gemm, MatMul, Add and Relu from its input to its first output, or None."""
    try:
        layers = _chain(model)
    except (ValueError, KeyError, IndexError):
        return None
    if not layers or layers[0].weights.shape[0] != n_features or layers[-1].weights.shape[1] != n_classes:
        return None
    if any(first.weights.shape[1] != second.weights.shape[0] for first, second in pairwise(layers)):
        return None
    return layers


def reference_scores(layers: tuple[Layer, ...], means: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the scores (n, classes) of click means (n, d_f) in float64: what the other back ends are measured against."""
    values = means.astype(np.float64)
    for layer in layers:
        values = values @ layer.weights.astype(np.float64) + layer.bias.astype(np.float64)
        if layer.relu:
            values = np.maximum(values, 0.0)
    return values


def _chain(data: bytes) -> tuple[Layer, ...]:
    model = read_model(data)
    tensors = {name: values for name, values in model.tensors.items() if values.dtype == np.float32}
    layers: list[Layer] = []
    current = model.inputs[0].name
    for node in model.nodes:
        if current not in node.inputs:
            raise ValueError(f"{node.op} does not continue the chain")
        _append(layers, node, current, tensors)
        current = node.outputs[0]
    if current != model.outputs[0].name:
        raise ValueError("the chain does not end at the output")
    return tuple(layers)


def _append(layers: list[Layer], node: Node, current: str, tensors: Mapping[str, NDArray[np.float32]]) -> None:
    if node.op == "Identity":
        return
    if node.op == "Relu":
        layers[-1] = Layer(layers[-1].weights, layers[-1].bias, True)
        return
    if node.op == "Add":
        last = layers[-1]
        added = tensors[next(name for name in node.inputs if name != current)].reshape(-1)
        if last.relu or added.shape != last.bias.shape or last.bias.any():
            raise ValueError("an Add that is no bias")
        layers[-1] = Layer(last.weights, added, False)
        return
    if node.op not in ("Gemm", "MatMul") or node.inputs[0] != current:
        raise ValueError(f"operator {node.op}")
    weights = tensors[node.inputs[1]]
    plain = {"alpha": 1.0, "beta": 1.0, "transA": 0}
    if plain != {name: node.attributes.get(name, plain[name]) for name in plain} or weights.ndim != 2:
        raise ValueError("a Gemm that scales")
    if node.attributes.get("transB", 0):
        weights = weights.T
    bias = tensors[node.inputs[2]].reshape(-1) if len(node.inputs) > 2 else np.zeros(weights.shape[1], np.float32)
    if bias.shape != (weights.shape[1],):
        raise ValueError("a bias of another length")
    layers.append(Layer(np.ascontiguousarray(weights), bias, False))


@dataclass(frozen=True, slots=True, eq=False)
class Int8Head:
    """`sizes` int64 (layers + 1,); `weights` int8, the matrices (n_in, n_out) one after the other; `affine` float32 (2, sum of n_out).

    A layer gives `steps @ weights * affine[0] + affine[1]`; between layers that is rounded to the nearest step (halves up) in 0..255.
    The steps of layer one are clicks, and its result is divided by the shots before the bias is added.
    """

    sizes: NDArray[np.int64]
    weights: NDArray[np.int8]
    affine: NDArray[np.float32]

    def matrices(self) -> list[tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.float32]]]:
        """Return (weights (n_in, n_out), scale (n_out,), bias (n_out,)) of each layer."""
        found, start, column = [], 0, 0
        for n_in, n_out in zip(self.sizes.tolist(), self.sizes.tolist()[1:]):
            matrix = self.weights[start : start + n_in * n_out].reshape(n_in, n_out)
            found.append((matrix, self.affine[0, column : column + n_out], self.affine[1, column : column + n_out]))
            start, column = start + n_in * n_out, column + n_out
        return found


def quantise_head(layers: tuple[Layer, ...], calibration: NDArray[np.floating[Any]] | None = None) -> Int8Head:
    """Quantise a head whose hidden layers are rectified; `calibration` is click means (n, d_f) of typical objects.

    Without it, hidden ranges are taken from independent clicks that are as likely as not. ValueError for another kind of chain.
    """
    if any(not layer.relu for layer in layers[:-1]) or layers[-1].relu:
        raise ValueError("only heads with rectified hidden layers and a plain last one can be quantised")
    ranges = _hidden_ranges(layers, calibration)
    weights, affine = [], []
    before = np.ones(layers[0].weights.shape[0])
    for number, layer in enumerate(layers):
        wide = layer.weights.astype(np.float64) * before[:, None]
        top = np.abs(wide).max(axis=0)
        scale = np.where(top > 0, top, 1.0) / WEIGHT_MAX
        weights.append(np.rint(wide / scale).astype(np.int8).ravel())
        step = ranges[number] / STEP_MAX if number < len(layers) - 1 else np.ones_like(scale)
        affine.append(np.stack([scale / step, layer.bias.astype(np.float64) / step]))
        before = step
    sizes = np.array([layers[0].weights.shape[0], *(layer.weights.shape[1] for layer in layers)], np.int64)
    head = Int8Head(sizes, np.concatenate(weights), np.concatenate(affine, axis=1).astype(np.float32))
    if not np.isfinite(head.affine).all():
        raise ValueError("the head's weights are not finite, or too large for eight bits")
    return head


def _hidden_ranges(
    layers: tuple[Layer, ...], calibration: NDArray[np.floating[Any]] | None
) -> list[NDArray[np.float64]]:
    """The largest value that each hidden unit is to represent, by layer; 1 for a unit that never fires."""
    ranges = []
    values = None if calibration is None else calibration.astype(np.float64)
    mean, variance = np.full(layers[0].weights.shape[0], 0.5), np.full(layers[0].weights.shape[0], 0.25)
    for layer in layers[:-1]:
        wide, bias = layer.weights.astype(np.float64), layer.bias.astype(np.float64)
        if values is not None:
            values = np.maximum(values @ wide + bias, 0.0)
            top = values.max(axis=0) * HEADROOM
        else:
            mean, variance = mean @ wide + bias, variance @ wide**2
            top = np.minimum(mean + _SIGMAS * np.sqrt(variance), np.maximum(wide, 0).sum(axis=0) * mean.size + bias)
            mean, variance = np.maximum(mean, 0.0), variance
        ranges.append(np.where(top > 0, top, 1.0))
    return ranges
