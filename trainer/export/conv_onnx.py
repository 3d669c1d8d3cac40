"""A convolutional head as an ONNX graph.

Owns the nodes; never checks the result (export.py holds every bundle against the torch model). The normalisation stays a scale and a
shift in front: a convolution pads with zeros behind it, so that it cannot be folded in.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from onnx import NodeProto, helper

from pans.trainer.model.heads import ConvHead

F64 = NDArray[np.float64]


def conv_nodes(head: ConvHead, scale: F64, shift: F64) -> tuple[list[NodeProto], dict[str, NDArray[np.generic]]]:
    """Return nodes from `clicks` (n, d_f) to `scores`, and their constants by name; `scale` and `shift` (d_f,) normalise."""
    constants: dict[str, NDArray[np.generic]] = {
        "scale": scale.astype(np.float32),
        "shift": shift.astype(np.float32),
        "channel": np.array([1], np.int64),
    }
    nodes = [
        helper.make_node("Mul", ["clicks", "scale"], ["scaled"]),
        helper.make_node("Add", ["scaled", "shift"], ["normal"]),
        helper.make_node("Unsqueeze", ["normal", "channel"], ["maps0"]),
    ]
    for i, convolution in enumerate(head.convolutions):
        constants |= {f"kernel{i}": as_float32(convolution.weight), f"offset{i}": as_float32(convolution.bias)}
        half = constants[f"kernel{i}"].shape[-1] // 2
        inputs = [f"maps{i}", f"kernel{i}", f"offset{i}"]
        nodes.append(helper.make_node("Conv", inputs, [f"sums{i}"], strides=[2], pads=[half, half]))
        nodes.append(helper.make_node("Relu", [f"sums{i}"], [f"maps{i + 1}"]))
    nodes.append(helper.make_node("Flatten", [f"maps{len(head.convolutions)}"], ["flat"], axis=1))
    constants |= {"w1": as_float32(head.hidden.weight), "b1": as_float32(head.hidden.bias)}
    constants |= {"w2": as_float32(head.output.weight), "b2": as_float32(head.output.bias)}
    nodes += [
        helper.make_node("Gemm", ["flat", "w1", "b1"], ["sums"], transB=1),
        helper.make_node("Relu", ["sums"], ["hidden"]),
        helper.make_node("Gemm", ["hidden", "w2", "b2"], ["scores"], transB=1),
    ]
    return nodes, constants


def as_float32(parameter: object) -> NDArray[np.generic]:
    """Return a weight of a torch module, as an exporter needs it."""
    assert isinstance(parameter, torch.Tensor)
    return np.asarray(parameter.detach().float().numpy())
