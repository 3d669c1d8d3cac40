"""Heads as ONNX graphs, with the normalisation folded in; and the quantised head in operators that every runtime has.

Float32 click means (n, d_f) go in as `clicks`, scores or pixels (n, outputs) come out as `scores`. The quantised head takes means as whole
255ths, which is exact for one shot; means of several shots round to the nearest of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import NodeProto, TensorProto, helper, numpy_helper
from torch import Tensor

from pans.base import __version__
from pans.bundle.heads import STEP_MAX, Int8Head
from pans_trainer.model.heads import CHANNELS, EPSILON, ConvHead, DecoderHead, DeepHead, Heads, MlpHead, PictureHead

OPSET = 17  # the newest of IR version 8
IR_VERSION = 8  # onnxruntime 1.18 reads up to 10, and every later one reads this
WEIGHT_ZERO = 128  # the byte that stands for a weight of 0
DEAD_VARIANCE = 1e-7  # a pattern that clicks, or stays dark, less than once in ten million times says nothing

F64 = NDArray[np.float64]
Graph = tuple[list[NodeProto], dict[str, NDArray[Any]]]  # nodes from `clicks` to `scores`, and constants by name


def fold_normalisation(
    weight: F64, bias: F64, gain: F64, shift: F64, click_mean: F64
) -> tuple[F64, F64, tuple[int, ...]]:
    """Fold normalisation by `click_mean` (d_f,) into a linear layer: weight (hidden, d_f), bias (hidden,).

    The population variance of a click is p(1-p), exactly. A pattern that always or never clicks has none: its scale would
    explode, so its column is dropped (set to 0) and its constant part goes into the bias. Returns the folded weight and
    bias, float64, and the dropped patterns.
    """
    variance = click_mean * (1 - click_mean)
    dead = variance < DEAD_VARIANCE
    scale = np.where(dead, 0.0, gain / np.sqrt(variance + EPSILON))
    folded_bias = bias + weight @ (shift - click_mean * scale)
    return weight * scale, folded_bias, tuple(int(i) for i in np.flatnonzero(dead))


def head_onnx(head: Heads, click_mean: F64) -> tuple[bytes, tuple[int, ...]]:
    """Return the head as ONNX and the dropped patterns."""
    if isinstance(head, ConvHead):  # it pads with zeros behind the normalisation, which stays a scale and a shift
        first, first_bias = np.eye(len(click_mean)), np.zeros(len(click_mean))
    else:
        first, first_bias = _doubles(*head.hidden.parameters())
    gain, shift = _doubles(head.norm.gain, head.norm.bias)
    weight, bias, dead = fold_normalisation(first, first_bias, gain, shift, click_mean)
    if isinstance(head, ConvHead):
        nodes, constants = _conv(head, np.diag(weight), bias)
    else:
        folded = {"w1": weight.astype(np.float32), "b1": bias.astype(np.float32)}
        of_head = {MlpHead: _mlp, DeepHead: _deep, PictureHead: _picture, DecoderHead: _deep}[type(head)]
        nodes, constants = of_head(head, folded)  # type: ignore[operator]
    n_outputs = math.prod(head.image_shape) if isinstance(head, PictureHead) else head.output.out_features
    return model_bytes("head", nodes, constants, len(click_mean), n_outputs), dead


def model_bytes(
    name: str, nodes: Iterable[NodeProto], constants: Mapping[str, NDArray[Any]], n_inputs: int, n_outputs: int
) -> bytes:
    """Return a checked model of these nodes, serialised."""
    initializers = [numpy_helper.from_array(value, key) for key, value in constants.items()]
    means, told = (
        "mean clicks (photons of a detector that counts) per exposure of each pattern",
        "class scores or pixels",
    )
    source = helper.make_tensor_value_info("clicks", TensorProto.FLOAT, ["decisions", n_inputs], means)
    result = helper.make_tensor_value_info("scores", TensorProto.FLOAT, ["decisions", n_outputs], told)
    graph = helper.make_graph(nodes, name, [source], [result], initializers)
    opset = helper.make_opsetid("", OPSET)
    producer = {"producer_name": "pans-runtime", "producer_version": __version__}
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, **producer)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _mlp(head: MlpHead, folded: dict[str, NDArray[Any]]) -> Graph:
    return [*_hidden("clicks"), _gemm(2, "hidden", "scores")], folded | _float32("w2 b2", head.output)


def _deep(head: DeepHead, folded: dict[str, NDArray[Any]]) -> Graph:
    nodes = [*_hidden("clicks"), _gemm(2, "hidden", "sums2"), _relu("sums2", "hidden2"), _gemm(3, "hidden2", "scores")]
    return nodes, folded | _float32("w2 b2", head.second) | _float32("w3 b3", head.output)


def _picture(head: PictureHead, folded: dict[str, NDArray[Any]]) -> Graph:
    constants = _float32("w2 b2", head.spread)
    for i, layer in enumerate(head.up):
        constants |= _float32(f"kernel{i} offset{i}", layer)
    constants |= folded
    constants["coarse"] = np.array([-1, CHANNELS[-1], *head.coarse], np.int64)
    constants |= {"first": np.array([0, 0], np.int64), "size": np.array(head.image_shape, np.int64)}
    constants["axes"] = np.array([2, 3], np.int64)
    up = {"strides": [2, 2], "pads": [1, 1, 1, 1]}
    nodes = [
        *_hidden("clicks"),
        _gemm(2, "hidden", "spread"),
        _relu("spread", "flat"),
        helper.make_node("Reshape", ["flat", "coarse"], ["maps"]),
        helper.make_node("ConvTranspose", ["maps", "kernel0", "offset0"], ["finer"], **up),
        _relu("finer", "fine"),
        helper.make_node("ConvTranspose", ["fine", "kernel1", "offset1"], ["picture"], **up),
        helper.make_node("Slice", ["picture", "first", "size", "axes"], ["cut"]),
        helper.make_node("Flatten", ["cut"], ["scores"], axis=1),
    ]
    return nodes, constants


def _conv(head: ConvHead, scale: F64, shift: F64) -> Graph:
    constants: dict[str, NDArray[Any]] = {"scale": scale.astype(np.float32), "shift": shift.astype(np.float32)}
    constants["channel"] = np.array([1], np.int64)
    nodes = [
        helper.make_node("Mul", ["clicks", "scale"], ["scaled"]),
        helper.make_node("Add", ["scaled", "shift"], ["normal"]),
        helper.make_node("Unsqueeze", ["normal", "channel"], ["maps0"]),
    ]
    for i, convolution in enumerate(head.convolutions):
        constants |= _float32(f"kernel{i} offset{i}", convolution)
        half = constants[f"kernel{i}"].shape[-1] // 2
        inputs = [f"maps{i}", f"kernel{i}", f"offset{i}"]
        nodes.append(helper.make_node("Conv", inputs, [f"sums{i}"], strides=[2], pads=[half, half]))
        nodes.append(_relu(f"sums{i}", f"maps{i + 1}"))
    nodes.append(helper.make_node("Flatten", [f"maps{len(head.convolutions)}"], ["flat"], axis=1))
    constants |= _float32("w1 b1", head.hidden) | _float32("w2 b2", head.output)
    return [*nodes, *_hidden("flat"), _gemm(2, "hidden", "scores")], constants


def _hidden(source: str) -> list[NodeProto]:
    return [_gemm(1, source, "sums"), _relu("sums", "hidden")]


def _gemm(number: int, source: str, result: str) -> NodeProto:
    return helper.make_node("Gemm", [source, f"w{number}", f"b{number}"], [result], transB=1)


def _relu(source: str, result: str) -> NodeProto:
    return helper.make_node("Relu", [source], [result])


def _float32(names: str, layer: Any) -> dict[str, NDArray[Any]]:
    """Weight and bias of a torch layer under the two names."""
    parts = (layer.weight, layer.bias)
    return {name: np.asarray(part.detach().float().numpy()) for name, part in zip(names.split(), parts)}


def _doubles(*parts: Tensor) -> list[F64]:
    return [np.asarray(part.detach().double().numpy()) for part in parts]


def int8_onnx(head: Int8Head) -> bytes:
    """Return `head` as a model: QuantizeLinear and MatMulInteger per layer, float32 means (n, d_f) -> scores (n, classes).

    Weights are stored as bytes around 128. For signed weights ONNX Runtime adds pairs of products in 16 bits on an x86 processor without
    VNNI, where two products of up to 255 x 127 do not fit: scores were off by 0.4. For unsigned ones it adds in 32 bits on every make.
    """
    nodes: list[NodeProto] = []
    constants: dict[str, NDArray[np.generic]] = {
        "click_step": np.array(1 / STEP_MAX, np.float32),
        "hidden_step": np.array(1, np.float32),
        "zero": np.array(0, np.uint8),
        "middle": np.array(WEIGHT_ZERO, np.uint8),
    }
    matrices = head.matrices()
    current = "clicks"
    for number, (weights, scale, bias) in enumerate(matrices):
        is_last = number == len(matrices) - 1
        w, s, b = f"w{number}", f"s{number}", f"b{number}"
        constants[w] = (weights.astype(np.int16) + WEIGHT_ZERO).astype(np.uint8)
        constants[s] = (scale / STEP_MAX if number == 0 else scale).astype(np.float32)
        constants[b] = np.ascontiguousarray(bias, np.float32)
        step = "click_step" if number == 0 else "hidden_step"
        result = "scores" if is_last else f"h{number}"
        nodes += [
            # cuts to 0..255: the rectifier
            helper.make_node("QuantizeLinear", [current, step, "zero"], [f"q{number}"]),
            helper.make_node("MatMulInteger", [f"q{number}", w, "zero", "middle"], [f"i{number}"]),
            helper.make_node("Cast", [f"i{number}"], [f"f{number}"], to=TensorProto.FLOAT),
            helper.make_node("Mul", [f"f{number}", s], [f"m{number}"]),
            helper.make_node("Add", [f"m{number}", b], [result]),
        ]
        current = result
    return model_bytes("int8_head", nodes, constants, int(head.sizes[0]), int(head.sizes[-1]))
