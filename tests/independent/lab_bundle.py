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
    "pattern_levels": "<u2",
    "matrix": "<f4",
    "matrix_complex": "<c8",
    "head_onnx": "|u1",
    "table": "<f4",
    "int8_sizes": "<u4",
    "int8_weights": "|i1",
    "int8_affine": "<f4",
    "int8_onnx": "|u1",
    "golden_means": "<f4",
    "golden_scores": "<f4",
}
AUTOMATON_DTYPES = {
    "pattern_bits": "|u1",
    "pattern_bytes": "|u1",
    "pattern_levels": "<u2",
    "state_pattern": "<u2",
    "state_dwell": "<u2",
    "successors": "<u4",
    "posteriors": "<f4",
    "golden_words": "|u1",
    "golden_walks": "<u4",
    "golden_posteriors": "<f4",
}
VERSIONS = (1,)
NEW_KEYS = {"sensor", "picture_shape", "outcomes"}
AUTOMATON_KEYS = {"automaton", "expected"}
KEYS = {"name", "task", "encoder", "classes", "image_shape", "levels", "photons_per_level", "provenance", "parts"}


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
    """Return one JSON object without NaN, Infinity or a key twice."""

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        demand(len(dict(items)) == len(items), "a key stands twice")
        return dict(items)

    def constant(name: str) -> Any:
        raise Damaged(f"{name} is no number")

    try:
        value = json.loads(data.decode(), object_pairs_hook=pairs, parse_constant=constant)
    except (ValueError, RecursionError) as error:
        raise Damaged(str(error)) from error
    demand(isinstance(value, dict), "no JSON object")
    _within_limits(value, 1)
    return dict(value)


def _within_limits(value: Any, depth: int) -> None:
    """Demand nesting of at most 64, whole numbers of 64 bits and finite others."""
    demand(depth <= 64, "nested too deep")
    if isinstance(value, int):
        demand(-(1 << 63) <= value < 1 << 64, "a whole number beyond 64 bits")
    elif isinstance(value, float):
        demand(abs(value) <= 1.7976931348623157e308, "a number beyond float64")
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            _within_limits(item, depth + isinstance(item, dict | list))


def read_bundle(data: bytes) -> Bundle:
    """Return the bundle in `data`, every checksum checked."""
    demand(data[:8] == b"PANSBNDL" and 48 <= len(data) <= 64 * MIB, "no bundle")
    version, length = struct.unpack_from("<II", data, 8)
    demand(version in VERSIONS and length <= MIB and 16 + length + 32 <= len(data), "version or header length")
    demand(hashlib.sha256(data[:-32]).digest() == data[-32:], "the closing SHA-256")
    header = strict_json(data[16 : 16 + length])
    walks = "automaton" in header
    more = set(header) - KEYS
    demand(set(header) >= KEYS and more <= (AUTOMATON_KEYS if walks else NEW_KEYS), "header keys")
    demand(walks == (header["encoder"] == "automaton"), "an encoder")
    demand(not walks or isinstance(header["automaton"], dict), "an automaton that is no object")
    dtypes = AUTOMATON_DTYPES if walks else DTYPES
    parts: dict[str, NDArray[Any]] = {}
    begin, offset = 16 + length, 0
    for row in header["parts"]:
        name, shape = row["name"], row["shape"]
        demand(name in dtypes and name not in parts and row["dtype"] == dtypes[name], f"part {name}")
        size = int(np.prod(shape, dtype=object)) * np.dtype(dtypes[name]).itemsize
        demand(row["offset"] == offset and row["length"] == size, f"place of {name}")
        blob = data[begin + offset : begin + offset + size]
        demand(hashlib.sha256(blob).hexdigest() == row["sha256"], f"SHA-256 of {name}")
        parts[name] = np.frombuffer(blob, dtypes[name]).reshape(shape)
        offset += size
    demand(begin + offset + 32 == len(data), "a rest behind the last part")
    height, width = header["image_shape"]
    if "pattern_levels" in parts:
        levels = parts["pattern_levels"]
        demand(levels.shape[1] == height * width and bool((levels < header["levels"]).all()), "patterns")
    if "outcomes" in header:
        _check_numbers(header, parts)
    return Bundle(header, parts, hashlib.sha256(data).hexdigest())


def _check_numbers(header: dict[str, Any], parts: dict[str, NDArray[Any]]) -> None:
    """Fixed patterns read as photon numbers: `outcomes`, the table in its base, and the golden rows that it answers."""
    outcomes = header["outcomes"]
    demand(type(outcomes) is int and 3 <= outcomes <= 16 and header["encoder"] == "active", "outcomes")
    means = parts["golden_means"]
    demand(means.shape[1] == len(parts["pattern_levels"]) and bool(((means >= 0) & (means <= 1)).all()), "golden means")
    if "table" not in parts:
        return
    table, largest = parts["table"], np.float32(outcomes - 1)
    demand(table.shape == (outcomes ** means.shape[1], len(header["classes"])) and len(table) <= 1 << 20, "table")
    for row, scores in zip(means, parts["golden_scores"]):
        numbers = [round(float(value) * int(largest)) for value in row]
        if all(np.float32(number) / largest == value for number, value in zip(numbers, row)):
            found = table[sum(number * outcomes**i for i, number in enumerate(numbers))].astype(np.float64)
            demand(bool((np.abs(found - scores) <= 1e-5 * np.maximum(1, np.abs(scores))).all()), "a golden row")


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
