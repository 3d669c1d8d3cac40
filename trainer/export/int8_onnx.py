"""The quantised head as an ONNX model: the same integers and scales as the bundle's arrays, in operators that every runtime has.

Owns the graph only; the quantisation is `pans.runtime.bundle.layers`'s. Clicks come as means in [0, 1] and are taken as whole 255ths,
which is exact for one shot; means of several shots round to the nearest of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from onnx import NodeProto, TensorProto, helper

from pans.runtime.bundle.layers import STEP_MAX, Int8Head

from .onnx_heads import model_bytes


def int8_onnx(head: Int8Head) -> bytes:
    """Return `head` as a model: QuantizeLinear and MatMulInteger per layer, float32 means (n, d_f) -> scores (n, classes)."""
    nodes: list[NodeProto] = []
    constants: dict[str, NDArray[np.generic]] = {
        "click_step": np.array(1 / STEP_MAX, np.float32),
        "hidden_step": np.array(1, np.float32),
        "zero": np.array(0, np.uint8),
    }
    matrices = head.matrices()
    current = "clicks"
    for number, (weights, scale, bias) in enumerate(matrices):
        is_last = number == len(matrices) - 1
        w, s, b = f"w{number}", f"s{number}", f"b{number}"
        constants[w] = np.ascontiguousarray(weights)
        constants[s] = (scale / STEP_MAX if number == 0 else scale).astype(np.float32)
        constants[b] = np.ascontiguousarray(bias, np.float32)
        step = "click_step" if number == 0 else "hidden_step"
        result = "scores" if is_last else f"h{number}"
        nodes += [
            # cuts to 0..255: the rectifier
            helper.make_node("QuantizeLinear", [current, step, "zero"], [f"q{number}"]),
            helper.make_node("MatMulInteger", [f"q{number}", w], [f"i{number}"]),
            helper.make_node("Cast", [f"i{number}"], [f"f{number}"], to=TensorProto.FLOAT),
            helper.make_node("Mul", [f"f{number}", s], [f"m{number}"]),
            helper.make_node("Add", [f"m{number}", b], [result]),
        ]
        current = result
    return model_bytes("int8_head", nodes, constants, int(head.sizes[0]), int(head.sizes[-1]))
