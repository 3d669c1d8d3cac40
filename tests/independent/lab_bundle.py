"""Bundles and the chain of layers in their heads, read as a lab would from docs/reference/formats.md alone."""

from __future__ import annotations

import hashlib
import json
import struct
from collections import defaultdict
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


def varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a protobuf integer and the place behind it."""
    value = shift = 0
    while data[at] >= 0x80:
        value, shift, at = value | (data[at] & 0x7F) << shift, shift + 7, at + 1
    return value | data[at] << shift, at + 1


def fields(data: bytes) -> dict[int, list[Any]]:
    """Return the values of one protobuf message by field number: integers, or bytes for all else."""
    found: dict[int, list[Any]] = defaultdict(list)
    at = 0
    while at < len(data):
        key, at = varint(data, at)
        value: Any
        if key & 7 == 0:
            value, at = varint(data, at)
        else:
            size, at = varint(data, at) if key & 7 == 2 else ({1: 8, 5: 4}[key & 7], at)
            demand(at + size <= len(data), "protobuf length")
            value, at = data[at : at + size], at + size
        found[key >> 3].append(value)
    return found


def chain_of_layers(model: bytes) -> list[Layer]:
    """Return the layers of an ONNX model that is a chain of Gemm and Relu."""
    graph = fields(fields(model)[7][0])
    tensors = {}
    for tensor in map(fields, graph[5]):
        values = np.frombuffer((tensor[9] or tensor[4])[0], "<f4")
        tensors[tensor[8][0]] = values.reshape(tensor[1])
    current, layers = fields(graph[11][0])[1][0], list[Layer]()
    for node in map(fields, graph[1]):
        operator = node[4][0].decode()
        demand(operator in ("Gemm", "Relu") and node[1][0] == current, f"{operator} does not continue the chain")
        if operator == "Relu":
            layers[-1] = layers[-1]._replace(relu=True)
        else:
            weights, bias = (tensors[name] for name in node[1][1:])
            transposed = any(one[1] == [b"transB"] and one[3] == [1] for one in map(fields, node[5]))
            layers.append(Layer(weights.T if transposed else weights, bias.reshape(-1), False))
        current = node[2][0]
    demand(current == fields(graph[12][0])[1][0] and bool(layers), "the chain does not end at the output")
    return layers
