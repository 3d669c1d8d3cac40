"""Heads that give back pictures as ONNX graphs.

Owns the nodes; never checks the result (export.py holds every bundle against the torch model). The normalisation is folded into the
first layer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import NodeProto, helper

from pans.trainer.model.heads import CHANNELS, DecoderHead, Decoders

from .conv_onnx import as_float32

F64 = NDArray[np.float64]


def picture_nodes(head: Decoders, weight: F64, bias: F64) -> tuple[list[NodeProto], dict[str, NDArray[Any]]]:
    """Return nodes from `clicks` (n, d_f) to `scores` (n, height * width), and their constants; the first layer is given, folded."""
    if isinstance(head, DecoderHead):
        return _decoder_nodes(head, weight, bias)
    constants: dict[str, NDArray[Any]] = {"w2": as_float32(head.spread.weight), "b2": as_float32(head.spread.bias)}
    for i, layer in enumerate(head.up):
        constants |= {f"kernel{i}": as_float32(layer.weight), f"offset{i}": as_float32(layer.bias)}
    constants |= {"w1": weight.astype(np.float32), "b1": bias.astype(np.float32)}
    constants["coarse"] = np.array([-1, CHANNELS[-1], *head.coarse], np.int64)
    constants |= {"first": np.array([0, 0], np.int64), "size": np.array(head.image_shape, np.int64)}
    constants["axes"] = np.array([2, 3], np.int64)
    up = {"strides": [2, 2], "pads": [1, 1, 1, 1]}
    nodes = [
        helper.make_node("Gemm", ["clicks", "w1", "b1"], ["sums"], transB=1),
        helper.make_node("Relu", ["sums"], ["hidden"]),
        helper.make_node("Gemm", ["hidden", "w2", "b2"], ["spread"], transB=1),
        helper.make_node("Relu", ["spread"], ["flat"]),
        helper.make_node("Reshape", ["flat", "coarse"], ["maps"]),
        helper.make_node("ConvTranspose", ["maps", "kernel0", "offset0"], ["finer"], **up),
        helper.make_node("Relu", ["finer"], ["fine"]),
        helper.make_node("ConvTranspose", ["fine", "kernel1", "offset1"], ["picture"], **up),
        helper.make_node("Slice", ["picture", "first", "size", "axes"], ["cut"]),
        helper.make_node("Flatten", ["cut"], ["scores"], axis=1),
    ]
    return nodes, constants


def _decoder_nodes(head: DecoderHead, weight: F64, bias: F64) -> tuple[list[NodeProto], dict[str, NDArray[Any]]]:
    constants: dict[str, NDArray[Any]] = {"w1": weight.astype(np.float32), "b1": bias.astype(np.float32)}
    for number, layer in (("2", head.second), ("3", head.output)):
        constants |= {"w" + number: as_float32(layer.weight), "b" + number: as_float32(layer.bias)}
    nodes = [
        helper.make_node("Gemm", ["clicks", "w1", "b1"], ["sums"], transB=1),
        helper.make_node("Relu", ["sums"], ["hidden"]),
        helper.make_node("Gemm", ["hidden", "w2", "b2"], ["sums2"], transB=1),
        helper.make_node("Relu", ["sums2"], ["hidden2"]),
        helper.make_node("Gemm", ["hidden2", "w3", "b3"], ["scores"], transB=1),
    ]
    return nodes, constants
