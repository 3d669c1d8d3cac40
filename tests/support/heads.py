"""Heads and bundles for tests, made by hand: chains of layers as ONNX without a trainer."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from bundles import made_bundle

from pans.bundle.heads.layers import Layer
from pans.bundle.sensor import Bundle


def random_layers(sizes: list[int], seed: int = 0) -> tuple[Layer, ...]:
    """Layers with weights of the size that training starts from, rectified but for the last."""
    rng = np.random.default_rng(seed)
    layers = []
    for number, (n_in, n_out) in enumerate(pairwise(sizes)):
        weights, bias = rng.normal(size=(n_in, n_out)) * np.sqrt(2 / n_in), rng.normal(size=n_out) * 0.3
        layers.append(Layer(weights.astype(np.float32), bias.astype(np.float32), number < len(sizes) - 2))
    return tuple(layers)


def onnx_chain(
    layers: tuple[Layer, ...], style: str = "gemm", float_data: bool = False, batch: str | int = "n"
) -> bytes:
    """`layers` as a model in one of the ways that exporters write them: gemm, transposed or matmul."""
    pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    nodes: list[Any] = []
    weights: list[Any] = []

    def constant(name: str, array: np.ndarray) -> str:
        if float_data:
            weights.append(helper.make_tensor(name, TensorProto.FLOAT, array.shape, array.ravel().tolist()))
        else:
            weights.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    current = "means"
    for number, layer in enumerate(layers):
        following = "scores" if number == len(layers) - 1 else f"sums{number}"
        if style == "matmul":
            nodes.append(helper.make_node("MatMul", [current, constant(f"w{number}", layer.weights)], [f"p{number}"]))
            nodes.append(helper.make_node("Add", [f"p{number}", constant(f"b{number}", layer.bias)], [following]))
        else:
            matrix = layer.weights.T if style == "transposed" else layer.weights
            names = [current, constant(f"w{number}", matrix), constant(f"b{number}", layer.bias)]
            nodes.append(helper.make_node("Gemm", names, [following], transB=int(style == "transposed")))
        current = following
        if layer.relu:
            nodes.append(helper.make_node("Relu", [current], [f"hidden{number}"]))
            current = f"hidden{number}"
    n_in, n_out = layers[0].weights.shape[0], layers[-1].weights.shape[1]
    source = helper.make_tensor_value_info("means", TensorProto.FLOAT, [batch, n_in])
    result = helper.make_tensor_value_info("scores", TensorProto.FLOAT, [batch, n_out])
    graph = helper.make_graph(nodes, "head", [source], [result], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


def affine_head(weights: np.ndarray, bias: np.ndarray, batch: str | int = "n") -> bytes:
    """A model of scores = means @ weights + bias, weights (d_f, classes)."""
    return onnx_chain((Layer(weights.astype(np.float32), bias.astype(np.float32), False),), batch=batch)


def head_bundle(layers: tuple[Layer, ...], **parts: Any) -> Bundle:
    """A bundle whose head is `layers`; its patterns are one pixel each."""
    n_features, n_classes = layers[0].weights.shape[0], layers[-1].weights.shape[1]
    return made_bundle(n_features, n_classes, **{"name": "chain", "head_onnx": onnx_chain(layers)} | parts)
