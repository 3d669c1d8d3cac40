"""The layers of an ONNX head, where it is a plain chain of them: weights and biases for our own kernels.

Owns the reading of the few operators that such heads consist of; never runs a model and never imports onnx. `read_layers` returns None
for any graph that is more than that: onnxruntime runs those. What was read is held against the golden vectors before it is used.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import DamagedFileError

from .head import protobuf_fields

_GRAPH, _NODE, _INITIALIZER, _INPUT, _OUTPUT = 7, 1, 5, 11, 12
_FLOAT = 1


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """scores = means @ weights + bias, then the rectifier if `relu`; weights float32 (n_in, n_out), bias float32 (n_out,)."""

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    relu: bool


@dataclass(slots=True)
class _Node:
    op: str = ""
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    attributes: dict[str, Any] = field(default_factory=dict)


def read_layers(model: bytes, n_features: int, n_classes: int) -> tuple[Layer, ...] | None:
    """Return the layers of `model`, a chain of Gemm, MatMul, Add and Relu from its input to its first output, or None."""
    try:
        layers = _chain(model)
    except (DamagedFileError, ValueError, KeyError, IndexError, UnicodeDecodeError, struct.error):
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


def _chain(model: bytes) -> tuple[Layer, ...]:
    graph = next(value for number, value in _messages(memoryview(model)) if number == _GRAPH)
    nodes, tensors, source, result = [], {}, "", ""
    for number, value in _messages(graph):
        if number == _NODE:
            nodes.append(_node(value))
        elif number == _INITIALIZER:
            name, array = _tensor(value)
            tensors[name] = array
        elif number == _INPUT:
            source = source or _text(value, 1)
        elif number == _OUTPUT:
            result = result or _text(value, 1)
    layers: list[Layer] = []
    current = source
    for node in nodes:
        if current not in node.inputs:
            raise ValueError(f"{node.op} does not continue the chain")
        _append(layers, node, current, tensors)
        current = node.outputs[0]
    if current != result:
        raise ValueError("the chain does not end at the output")
    return tuple(layers)


def _append(layers: list[Layer], node: _Node, current: str, tensors: dict[str, NDArray[np.float32]]) -> None:
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


def _messages(data: memoryview) -> list[tuple[int, memoryview]]:
    return [(number, value) for number, value in protobuf_fields(data, "head") if isinstance(value, memoryview)]


def _text(data: memoryview, wanted: int) -> str:
    return next(bytes(value).decode() for number, value in _messages(data) if number == wanted)


def _node(data: memoryview) -> _Node:
    node = _Node()
    for number, value in _messages(data):
        if number == 1:
            node.inputs.append(bytes(value).decode())
        elif number == 2:
            node.outputs.append(bytes(value).decode())
        elif number == 4:
            node.op = bytes(value).decode()
        elif number == 5:
            name, content = _attribute(value)
            node.attributes[name] = content
    return node


def _attribute(data: memoryview) -> tuple[str, Any]:
    name, content = "", None
    for number, value in protobuf_fields(data, "head"):
        if number == 1 and isinstance(value, memoryview):
            name = bytes(value).decode()
        elif number == 2 and isinstance(value, memoryview):
            content = struct.unpack("<f", value)[0]
        elif number == 3:
            content = value
    return name, content


def _tensor(data: memoryview) -> tuple[str, NDArray[np.float32]]:
    dims, name, raw, packed = [], "", b"", b""
    for number, value in protobuf_fields(data, "head"):
        if number == 1 and isinstance(value, int):
            dims.append(value)
        elif number == 1 and isinstance(value, memoryview):
            raise ValueError("packed dims")  # no exporter writes them so
        elif number == 2 and value != _FLOAT:
            return _late_name(data), np.zeros(0, np.float32)  # shapes and the like: no weights
        elif number == 4 and isinstance(value, memoryview):
            packed += bytes(value)
        elif number == 8 and isinstance(value, memoryview):
            name = bytes(value).decode()
        elif number == 9 and isinstance(value, memoryview):
            raw = bytes(value)
    return name, np.frombuffer(raw or packed, "<f4").reshape(dims).astype(np.float32)


def _late_name(data: memoryview) -> str:
    return _text(data, 8)
