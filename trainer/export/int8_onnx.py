"""The quantised head as an ONNX model: the same integers and scales as the bundle's arrays, in operators that every runtime has.

Owns the graph only; the quantisation is pans.runtime.int8_head's. Clicks come as means in [0, 1] and are taken as whole 255ths, which is
exact for one shot; means of several shots round to the nearest of them.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from pans.runtime.bundle.int8 import STEP_MAX, Int8Head

OPSET = 17
IR_VERSION = 8


def int8_onnx(head: Int8Head) -> bytes:
    """Return `head` as a model: QuantizeLinear and MatMulInteger per layer, float32 means (n, d_f) -> scores (n, classes)."""
    nodes: list[onnx.NodeProto] = []
    constants = [
        numpy_helper.from_array(np.array(1 / STEP_MAX, np.float32), "click_step"),
        numpy_helper.from_array(np.array(1, np.float32), "hidden_step"),
        numpy_helper.from_array(np.array(0, np.uint8), "zero"),
    ]
    matrices = head.matrices()
    current = "clicks"
    for number, (weights, scale, bias) in enumerate(matrices):
        is_last = number == len(matrices) - 1
        w, s, b = f"w{number}", f"s{number}", f"b{number}"
        constants.append(numpy_helper.from_array(np.ascontiguousarray(weights), w))
        constants.append(numpy_helper.from_array((scale / STEP_MAX if number == 0 else scale).astype(np.float32), s))
        constants.append(numpy_helper.from_array(np.ascontiguousarray(bias, np.float32), b))
        step = "click_step" if number == 0 else "hidden_step"
        result = "scores" if is_last else f"h{number}"
        nodes += [
            helper.make_node(
                "QuantizeLinear", [current, step, "zero"], [f"q{number}"]
            ),  # cuts to 0..255: the rectifier
            helper.make_node("MatMulInteger", [f"q{number}", w], [f"i{number}"]),
            helper.make_node("Cast", [f"i{number}"], [f"f{number}"], to=TensorProto.FLOAT),
            helper.make_node("Mul", [f"f{number}", s], [f"m{number}"]),
            helper.make_node("Add", [f"m{number}", b], [result]),
        ]
        current = result
    source = helper.make_tensor_value_info("clicks", TensorProto.FLOAT, ["n", int(head.sizes[0])])
    scores = helper.make_tensor_value_info("scores", TensorProto.FLOAT, ["n", int(head.sizes[-1])])
    graph = helper.make_graph(nodes, "int8_head", [source], [scores], constants)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="pans-runtime")
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())
