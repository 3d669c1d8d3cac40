"""The layers of an ONNX head, where it is a plain chain of them: weights and biases for our own kernels.

Owns the reading of the few operators that such heads consist of; never runs a model and never imports onnx. `read_layers` returns None
for any graph that is more than that: onnxruntime runs those. What was read is held against the golden vectors before it is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .onnx_file import Node, read_model


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
    plain = {
        name: node.attributes.get(name, default) for name, default in (("alpha", 1.0), ("beta", 1.0), ("transA", 0))
    }
    if plain != {"alpha": 1.0, "beta": 1.0, "transA": 0} or weights.ndim != 2:
        raise ValueError("a Gemm that scales")
    if node.attributes.get("transB", 0):
        weights = weights.T
    bias = tensors[node.inputs[2]].reshape(-1) if len(node.inputs) > 2 else np.zeros(weights.shape[1], np.float32)
    if bias.shape != (weights.shape[1],):
        raise ValueError("a bias of another length")
    layers.append(Layer(np.ascontiguousarray(weights), bias, False))
