"""Bundles and the chain of layers in their heads, read as a lab would from docs/reference/formats.md alone.

Owns the file's layout and checksums, and as much of ONNX as that page names. Imports nothing of the package.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

MIB = 1 << 20
DTYPES = {
    **dict.fromkeys(["matrix", "table", "int8_affine", "golden_means", "golden_scores", "posteriors"], "<f4"),
    **dict.fromkeys(["pattern_levels", "state_pattern", "state_dwell"], "<u2"),
    **dict.fromkeys(["int8_sizes", "successors", "golden_walks"], "<u4"),
    **dict.fromkeys(["head_onnx", "int8_onnx", "pattern_bits", "pattern_bytes", "golden_words"], "|u1"),
    **{"golden_posteriors": "<f4", "matrix_complex": "<c8", "int8_weights": "|i1"},
}
KEYS = {"name", "task", "encoder", "classes", "image_shape", "levels", "photons_per_level", "provenance", "parts"}
MORE_KEYS = {"sensor", "picture_shape", "outcomes", "automaton", "expected"}


class Damaged(Exception):
    """The file is not as it was written."""


class Layer(NamedTuple):
    """y = x @ weights + bias, then the rectifier where `relu`; float32 (n_in, n_out) and (n_out,)."""

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    relu: bool


@dataclass
class Bundle:
    """Header and parts of one bundle."""

    header: dict[str, Any]
    parts: dict[str, NDArray[Any]]
    sha256: str

    @property
    def largest(self) -> int:
        """The largest number that an exposure of fixed patterns can have: 1 of clicks."""
        return int(self.header.get("outcomes", 2)) - 1

    def layers(self) -> list[Layer]:
        """Return the layers of the head."""
        return chain_of_layers(self.parts["head_onnx"].tobytes())


def demand(fine: bool, what: str) -> None:
    """Raise Damaged unless `fine`."""
    if not fine:
        raise Damaged(what)


def strict_json(data: bytes) -> dict[str, Any]:
    """Return one JSON object without a key twice."""

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        demand(len(dict(items)) == len(items), "a key stands twice")
        return dict(items)

    value = json.loads(data.decode(), object_pairs_hook=pairs)
    demand(isinstance(value, dict), "no JSON object")
    return dict(value)


def read_bundle(data: bytes) -> Bundle:
    """Return the bundle in `data`, every checksum checked."""
    demand(data[:8] == b"PANSBNDL" and 48 <= len(data) <= 64 * MIB, "no bundle")
    version, length = struct.unpack_from("<II", data, 8)
    demand(version == 1 and length <= MIB and 16 + length + 32 <= len(data), "version or header length")
    demand(hashlib.sha256(data[:-32]).digest() == data[-32:], "the closing SHA-256")
    header = strict_json(data[16 : 16 + length])
    demand(set(header) >= KEYS and set(header) <= KEYS | MORE_KEYS, "header keys")
    demand(("automaton" in header) == (header["encoder"] == "automaton"), "an encoder")
    parts: dict[str, NDArray[Any]] = {}
    begin, offset = 16 + length, 0
    for row in header["parts"]:
        name, shape = row["name"], row["shape"]
        demand(name in DTYPES and name not in parts and row["dtype"] == DTYPES[name], f"part {name}")
        size = int(np.prod(shape, dtype=object)) * np.dtype(DTYPES[name]).itemsize
        demand(row["offset"] == offset and row["length"] == size, f"place of {name}")
        blob = data[begin + offset : begin + offset + size]
        demand(hashlib.sha256(blob).hexdigest() == row["sha256"], f"SHA-256 of {name}")
        parts[name] = np.frombuffer(blob, DTYPES[name]).reshape(shape)
        offset += size
    demand(begin + offset + 32 == len(data), "a rest behind the last part")
    return Bundle(header, parts, hashlib.sha256(data).hexdigest())


# ---- as much of ONNX as a chain of layers needs; field numbers are those of onnx.proto ----


def fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield (field number, value) of one protobuf message: integers, or bytes for all else."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(data):
        key = varint()
        number, kind = key >> 3, key & 7
        demand(kind in (0, 1, 2, 5), "protobuf wire type")
        if kind == 0:
            yield number, varint()
            continue
        size = varint() if kind == 2 else {1: 8, 5: 4}[kind]
        demand(at + size <= len(data), "protobuf length")
        yield number, data[at : at + size]
        at += size


def chain_of_layers(model: bytes) -> list[Layer]:
    """Return the layers of an ONNX model that is a chain of Gemm, or MatMul and Add, with Relu between."""
    graph = next(value for number, value in fields(model) if number == 7)
    assert isinstance(graph, bytes)
    inside = [(number, value) for number, value in fields(graph) if isinstance(value, bytes)]
    tensors = dict(_tensor(value) for number, value in inside if number == 5)
    current = next(_text(value, 1) for number, value in inside if number == 11)
    result = next(_text(value, 1) for number, value in inside if number == 12)
    layers: list[Layer] = []
    for value in (value for number, value in inside if number == 1):
        inputs, outputs, operator, transposed = _node(value)
        demand(current in inputs, f"{operator} does not go on from {current}")
        constants = [tensors[name] for name in inputs if name != current]
        if operator == "Relu":
            layers[-1] = layers[-1]._replace(relu=True)
        elif operator == "Add":
            layers[-1] = layers[-1]._replace(bias=constants[0].reshape(-1))
        elif operator in ("Gemm", "MatMul"):
            weights = constants[0].T if transposed else constants[0]
            bias = constants[1].reshape(-1) if len(constants) > 1 else np.zeros(weights.shape[1], np.float32)
            layers.append(Layer(weights, bias, False))
        else:
            raise Damaged(f"operator {operator} is none of a chain of layers")
        current = outputs[0]
    demand(current == result and bool(layers), "the chain does not end at the output")
    return layers


def _text(data: bytes, wanted: int) -> str:
    return next(value.decode() for number, value in fields(data) if number == wanted and isinstance(value, bytes))


def _node(data: bytes) -> tuple[list[str], list[str], str, bool]:
    inputs, outputs, operator, transposed = [], [], "", False
    for number, value in fields(data):
        assert isinstance(value, bytes)
        if number == 1:
            inputs.append(value.decode())
        elif number == 2:
            outputs.append(value.decode())
        elif number == 4:
            operator = value.decode()
        elif number == 5 and _text(value, 1) == "transB":
            transposed = any(inner == (3, 1) for inner in fields(value))
    return inputs, outputs, operator, transposed


def _tensor(data: bytes) -> tuple[str, NDArray[np.float32]]:
    shape = [value for number, value in fields(data) if number == 1]
    blobs = {number: value for number, value in fields(data) if number in (4, 9)}
    floats = blobs.get(9, blobs.get(4, b""))
    assert isinstance(floats, bytes)
    return _text(data, 8), np.frombuffer(floats, "<f4").reshape([int(size) for size in shape])
