"""Protobuf messages of an ONNX model as dicts: only known fields, each of its wire type, within limits on their number and size.

Owns the list of allowed fields and the bytes; what the fields mean is for onnx_file.py. Everything that is not on the list is refused by
its name: functions, subgraphs, training, sparse tensors, weights in other files, unknown fields. So is a field that stands twice where one
is meant, for readers differ in which of the two they take. Field numbers are those of onnx.proto
(https://github.com/onnx/onnx/blob/main/onnx/onnx.proto).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

FIELDS_MAX = 100_000  # of all messages together: 1000 nodes have about 15 each
LIST_MAX = 64  # inputs, outputs, attributes and numbers of a node, dimensions of a tensor, numbers that hold a shape
NAME_MAX_BYTES = 1000
SKIPPED_MAX_BYTES = 1 << 20  # comments and metadata, all together
PACKED_MAX_BYTES = 1 << 20  # integers of varying length: large constants are stored raw

# message -> {field number: (name, kind of its value)}; a kind that ends in * may stand several times, `skip` is read over
_FIELDS: dict[str, dict[int, tuple[str, str]]] = {
    "model": {
        **{1: ("ir_version", "int"), 7: ("graph", "graph"), 8: ("opsets", "opset*"), 5: ("model_version", "int")},
        **{2: ("producer", "skip"), 3: ("producer_version", "skip"), 4: ("domain", "skip"), 6: ("doc", "skip")},
        14: ("metadata", "skip"),
    },
    "opset": {1: ("domain", "text"), 2: ("version", "int")},
    "graph": {
        **{1: ("nodes", "node*"), 2: ("name", "skip"), 5: ("tensors", "tensor*"), 10: ("doc", "skip")},
        **{11: ("inputs", "value*"), 12: ("outputs", "value*"), 13: ("hints", "value*"), 16: ("metadata", "skip")},
    },
    "node": {
        **{1: ("inputs", "text*"), 2: ("outputs", "text*"), 3: ("name", "skip"), 4: ("op", "text")},
        **{5: ("attributes", "attribute*"), 6: ("doc", "skip"), 7: ("domain", "text"), 9: ("metadata", "skip")},
    },
    "attribute": {
        **{1: ("name", "text"), 2: ("f", "float"), 3: ("i", "int"), 4: ("s", "text"), 5: ("t", "tensor")},
        **{7: ("floats", "float*"), 8: ("ints", "int*"), 13: ("doc", "skip"), 20: ("type", "int")},
    },
    "tensor": {
        **{1: ("dims", "int*"), 2: ("dtype", "int"), 4: ("floats", "bytes"), 5: ("int32s", "bytes")},
        **{7: ("int64s", "bytes"), 8: ("name", "text"), 9: ("raw", "bytes"), 12: ("doc", "skip")},
        **{14: ("location", "int"), 16: ("metadata", "skip")},
    },
    "value": {1: ("name", "text"), 2: ("type", "type"), 3: ("doc", "skip"), 4: ("metadata", "skip")},
    "type": {1: ("tensor", "tensor_type"), 6: ("denotation", "skip")},
    "tensor_type": {1: ("dtype", "int"), 2: ("shape", "shape")},
    "shape": {1: ("dims", "dim*")},
    "dim": {1: ("size", "int"), 2: ("symbol", "text"), 3: ("denotation", "skip")},
}
REFUSED = {
    **{("model", 20): "a training graph", ("model", 25): "functions of its own", ("graph", 15): "sparse weights"},
    **{("attribute", number): "a subgraph" for number in (6, 11)},
    **{("attribute", number): "sparse weights" for number in (22, 23)},
    ("tensor", 13): "weights that lie in another file (external data)",
}
_WIRE_OF = {"int": (0,), "float": (5,), "int*": (0, 2), "float*": (5, 2)}  # all others: 2, length and bytes


class Reader:
    """Messages as dicts of their fields; counts fields over the whole model."""

    def __init__(self) -> None:
        self._fields = 0
        self._skipped_bytes = 0

    def message(self, kind: str, data: memoryview, depth: int) -> dict[str, Any]:
        known = _FIELDS[kind]
        found: dict[str, Any] = {name: [] for name, value_kind in known.values() if value_kind.endswith("*")}
        for number, wire, value in _fields(data):
            self._fields += 1
            if self._fields > FIELDS_MAX:
                raise ValueError(f"more than {FIELDS_MAX} fields, allowed: that many")
            if number not in known:
                raise ValueError(
                    f"{REFUSED.get((kind, number), f'field {number} in a {kind}')}, which no head may have"
                )
            name, value_kind = known[number]
            if wire not in _WIRE_OF.get(value_kind, (2,)):
                raise ValueError(f"not an ONNX model (field {number} in a {kind} is of protobuf wire type {wire})")
            if value_kind == "skip":
                self._skipped_bytes += len(value) if wire == 2 else 8
                if self._skipped_bytes > SKIPPED_MAX_BYTES:
                    raise ValueError(f"more than {SKIPPED_MAX_BYTES} bytes of comments and metadata")
                continue
            if value_kind.endswith("*"):
                found[name] += self._repeated(value_kind[:-1], wire, value, depth)
            elif name in found:
                raise ValueError(f"a {kind} has the field {name} twice")
            else:
                found[name] = self._one(value_kind, value, depth)
        return found

    def _repeated(self, kind: str, wire: int, value: Any, depth: int) -> list[Any]:
        if kind in ("int", "float") and wire == 2:  # packed
            if len(value) > 10 * LIST_MAX:
                raise ValueError(f"a list of numbers in {len(value)} bytes, allowed: {LIST_MAX} numbers")
            return list((packed_integers if kind == "int" else packed_floats)(value).tolist())
        return [self._one(kind, value, depth)]

    def _one(self, kind: str, value: Any, depth: int) -> Any:
        if kind == "int":
            return value - (1 << 64) if value >> 63 else value
        if kind == "float":
            return float(packed_floats(value)[0])
        if kind == "text":
            return _text(value)
        return value if kind == "bytes" else self.message(kind, value, depth + 1)


def _fields(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Yield (field number, wire type, value) of one message; all but numbers of wire type 0 come as their bytes."""
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        wire, number = key & 7, key >> 3
        if wire == 0:
            value, position = _varint(data, position)
            yield number, wire, value
            continue
        if wire not in (1, 2, 5):
            raise ValueError(f"not an ONNX model (protobuf wire type {wire})")
        length = 8 if wire == 1 else 4
        if wire == 2:
            length, position = _varint(data, position)
        if length > len(data) - position:
            raise ValueError("not an ONNX model (a field reaches past its end)")
        yield number, wire, data[position : position + length]
        position += length


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(data):
            break
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & ((1 << 64) - 1), position
    raise ValueError("not an ONNX model (a number never ends)")


def packed_integers(data: memoryview) -> NDArray[np.int64]:
    """Return packed numbers, int64."""
    if len(data) > PACKED_MAX_BYTES:
        raise ValueError(f"{len(data)} bytes of packed integers, allowed at most {PACKED_MAX_BYTES}: store them raw")
    numbers = np.frombuffer(data, np.uint8)
    if not (numbers & 0x80).any():
        return numbers.astype(np.int64)
    found, position = [], 0
    while position < len(data):
        value, position = _varint(data, position)
        found.append(value - (1 << 64) if value >> 63 else value)
    return np.array(found, np.int64)


def packed_floats(data: memoryview) -> NDArray[np.float32]:
    if len(data) % 4:
        raise ValueError("not an ONNX model (a list of floats is cut)")
    return np.frombuffer(data, "<f4")


def _text(value: memoryview) -> str:
    if len(value) > NAME_MAX_BYTES:
        raise ValueError(f"a name of {len(value)} bytes, allowed at most {NAME_MAX_BYTES}")
    try:
        return bytes(value).decode()
    except UnicodeDecodeError:
        raise ValueError("a name in it is not UTF-8") from None
