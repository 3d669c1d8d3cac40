"""A chain of layers as an ONNX model, written without the onnx package: Gemm and Relu, one float32 input, one output.

Owns the bytes (onnx.proto, as `bundle.onnx_model` reads them) and the place of a log-linear correction in the layers; checks nothing:
a bundle holds every head against its golden vectors when it is made.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pans.runtime.bundle.layers import Layer

from .evidence import F64
from .loglinear import Correction

OPSET, IR_VERSION = 17, 8  # as the trainer's heads
_FLOAT = 1


def corrected_layers(layers: tuple[Layer, ...], correction: Correction) -> tuple[Layer, ...] | None:
    """Return the layers whose scores are the corrected ones; None where the last one is rectified.

    Where the correction reads the clicks, each hidden layer passes them on beside its own values: they are 0 or more, which a rectifier
    leaves as it is.
    """
    last = layers[-1]
    if last.relu:
        return None
    n_classes, n_clicks = last.weights.shape[1], layers[0].weights.shape[0]
    of_scores, of_clicks = _parts(correction, n_classes, n_clicks)
    centred = np.eye(n_classes) - 1.0 / n_classes
    mixed = centred + centred @ of_scores
    weights, bias = last.weights.astype(np.float64) @ mixed, last.bias.astype(np.float64) @ mixed + correction.offset
    if len(layers) == 1:
        return (_layer(weights + of_clicks, bias, relu=False),)
    if not of_clicks.any():
        return (*layers[:-1], _layer(weights, bias, relu=False))
    beside = [_layer_beside(layer, n_clicks, first=number == 0) for number, layer in enumerate(layers[:-1])]
    return (*beside, _layer(np.concatenate([weights, of_clicks]), bias, relu=False))


def chain_onnx(layers: tuple[Layer, ...]) -> bytes:
    """Return the layers as an ONNX model: `clicks` float32 (n, d_f) -> `scores` float32 (n, classes)."""
    nodes, tensors, current = b"", b"", "clicks"
    for number, layer in enumerate(layers):
        result = "scores" if number == len(layers) - 1 and not layer.relu else f"x{number}"
        nodes += _field(1, _node("Gemm", [current, f"w{number}", f"b{number}"], result))
        tensors += _field(5, _tensor(f"w{number}", layer.weights)) + _field(5, _tensor(f"b{number}", layer.bias))
        current = result
        if layer.relu:
            result = "scores" if number == len(layers) - 1 else f"h{number}"
            nodes += _field(1, _node("Relu", [current], result))
            current = result
    n_in, n_out = layers[0].weights.shape[0], layers[-1].weights.shape[1]
    ends = _field(11, _value("clicks", n_in)) + _field(12, _value("scores", n_out))
    graph = nodes + _field(2, b"head") + tensors + ends
    opset = _field(8, _field(1, b"") + _number(2, OPSET))
    return _number(1, IR_VERSION) + _field(2, b"pans-runtime") + _field(7, graph) + opset


def _parts(correction: Correction, n_classes: int, n_clicks: int) -> tuple[F64, F64]:
    """The gains of scores (classes, classes) and clicks (d_f, classes), zeros where there is no such block."""
    sizes = {"bias": 0, "scores": n_classes, "clicks": n_clicks}
    found = {"scores": np.zeros((n_classes, n_classes)), "clicks": np.zeros((n_clicks, n_classes))}
    ends = np.cumsum([0, *(sizes[block] for block in correction.blocks)])
    for block, (start, end) in zip(correction.blocks, pairwise(ends)):
        if sizes[block]:
            found[block] = correction.gain[start:end]
    return found["scores"], found["clicks"]


def _layer(weights: F64, bias: F64, *, relu: bool) -> Layer:
    return Layer(weights.astype(np.float32), bias.astype(np.float32), relu)


def _layer_beside(layer: Layer, n_clicks: int, *, first: bool) -> Layer:
    """The layer with the clicks passed on behind its own values."""
    n_in, n_out = layer.weights.shape
    wide = np.zeros((n_in if first else n_in + n_clicks, n_out + n_clicks))
    wide[:n_in, :n_out] = layer.weights
    wide[-n_clicks:, n_out:] = np.eye(n_clicks)
    return _layer(wide, np.concatenate([layer.bias, np.zeros(n_clicks)]), relu=layer.relu)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _field(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _node(op: str, inputs: list[str], output: str) -> bytes:
    ends = b"".join(_field(1, name.encode()) for name in inputs)
    return ends + _field(2, output.encode()) + _field(4, op.encode())


def _tensor(name: str, values: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> bytes:
    dims = b"".join(_number(1, size) for size in values.shape)
    return dims + _number(2, _FLOAT) + _field(8, name.encode()) + _field(9, values.astype("<f4").tobytes())


def _value(name: str, width: int) -> bytes:
    shape = _field(1, _field(2, b"n")) + _field(1, _number(1, width))
    return _field(1, name.encode()) + _field(2, _field(1, _number(1, _FLOAT) + _field(2, shape)))
