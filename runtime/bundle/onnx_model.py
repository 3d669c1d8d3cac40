"""The bytes of an ONNX model in, its graph out: known fields in bounded number; everything else is refused by name.

Read without `onnx`. Field numbers: onnx.proto (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto). A field that stands twice where one
is meant is refused, because readers differ in which of the two they use.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

MODEL_MAX_BYTES = 32 << 20  # onnxruntime holds up to three copies while it opens one
ELEMENTS_MAX = 1 << 26  # of one constant
FIELDS_MAX = 100_000  # of all messages together: 1000 nodes have about 15 each
LIST_MAX = 64  # inputs and attributes of a node, dimensions of a tensor, numbers that hold a shape
_MOST = {"nodes": 1000, "tensors": 2000, "sources": 2000}  # longer lists
_PACKED_MAX_BYTES = 1 << 20  # integers of varying length: large constants are stored raw

FLOAT, INT64 = 1, 7  # TensorProto.DataType
DTYPES = {FLOAT: "<f4", 2: "|u1", 3: "|i1", 6: "<i4", INT64: "<i8"}
_STANDARD = ("", "ai.onnx")  # two names of the domain of the standard operators
_CONTENT: dict[int, tuple[str, Any]] = {  # AttributeProto.AttributeType -> field, and what it is where it is left out
    **{1: ("f", 0.0), 2: ("i", 0), 3: ("s", ""), 4: ("t", {"dims": []}), 6: ("floats", []), 7: ("ints", [])}
}
# message, then number:name:kind of its fields; * marks a list. Numbers alone are comments and metadata, which are read over.
_FIELDS = {
    words[0]: {int(field.split(":")[0]): field.partition(":")[2] for field in words[1:]}
    for words in map(
        str.split,
        """model 7:graph:graph 8:opsets:opset* 1 2 3 4 5 6 14
        opset 1:domain:text 2:version:int
        graph 1:nodes:node* 5:tensors:tensor* 11:sources:value* 12:results:value* 2 10 13 16
        node 1:inputs:text* 2:outputs:text* 4:op:text 5:attributes:attribute* 7:domain:text 3 6 9
        attribute 1:name:text 2:f:float 3:i:int 4:s:text 5:t:tensor 7:floats:float* 8:ints:int* 20:type:int 13
        tensor 1:dims:int* 2:dtype:int 4:floats:bytes 5:int32s:bytes 7:int64s:bytes 8:name:text 9:raw:bytes 12 14 16
        value 1:name:text 2:type:type 3 4
        type 1:tensor:tensor_type 6
        tensor_type 1:dtype:int 2:shape:shape
        shape 1:dims:dim*
        dim 1:size:int 2:symbol:text 3""".splitlines(),
    )
}
_REFUSED = {
    **{("model", 20): "a training graph", ("model", 25): "functions of its own", ("graph", 15): "sparse weights"},
    **{("attribute", 6): "a subgraph", ("attribute", 11): "a subgraph", ("tensor", 13): "weights in another file"},
}
_WIRES = {"": (0, 1, 2, 5), "int": (0,), "float": (5,), "int*": (0, 2), "float*": (5, 2)}  # others: 2, length and bytes


class Node(NamedTuple):
    """One operator of the standard domain; attributes are int, float, str, arrays, or tuples of int or float."""

    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]


class Value(NamedTuple):
    """A declared input or output: its TensorProto.DataType and shape, None for a free size."""

    name: str
    dtype: int
    shape: tuple[int | None, ...]


class Model(NamedTuple):
    """A feed-forward graph; `inputs` are those without a constant of the same name."""

    opset: int
    nodes: tuple[Node, ...]
    tensors: Mapping[str, NDArray[Any]]
    inputs: tuple[Value, ...]
    outputs: tuple[Value, ...]


def read_model(data: bytes) -> Model:
    """Return the graph in `data`; ValueError, in words for the user, for everything that is not on the list of fields."""
    if not 0 < len(data) <= MODEL_MAX_BYTES:
        raise ValueError(f"{len(data)} bytes, allowed: 1 to {MODEL_MAX_BYTES}")
    model = _message("model", memoryview(data), [FIELDS_MAX])
    versions = [int(row.get("version", 0)) for row in model["opsets"] if row.get("domain", "") in _STANDARD]
    if "graph" not in model or len(versions) != 1:
        raise ValueError(f"not an ONNX model (no graph, or {len(versions)} versions of the standard operators)")
    graph = model["graph"]
    tensors = {row.get("name", ""): _array(row) for row in graph["tensors"]}
    if len(tensors) != len(graph["tensors"]):
        raise ValueError("two constants have the same name")
    inputs = tuple(value for value in map(_value, graph["sources"]) if value.name not in tensors)
    return Model(versions[0], tuple(map(_node, graph["nodes"])), tensors, inputs, tuple(map(_value, graph["results"])))


def _node(row: Mapping[str, Any]) -> Node:
    op = row.get("op", "")
    if row.get("domain", "") not in _STANDARD:
        raise ValueError(f"the operator {op!a:.60} of the domain {row['domain']!a:.60}, allowed: the standard one")
    attributes = {}
    for one in row["attributes"]:
        name, (field, empty) = one.get("name", ""), _CONTENT.get(one.get("type", 0), ("", None))
        if not field or name in attributes:
            raise ValueError(f"the operator {op!a:.60} has the attribute {name!a:.60} twice, or of no allowed type")
        content = one.get(field) or empty
        attributes[name] = _array(content) if field == "t" else tuple(content) if field[1:] else content
    return Node(op, tuple(row["inputs"]), tuple(row["outputs"]), attributes)


def _value(row: Mapping[str, Any]) -> Value:
    kind = row.get("type", {}).get("tensor", {})
    shape = tuple(dim.get("size") for dim in kind.get("shape", {"dims": []})["dims"])
    return Value(row.get("name", ""), kind.get("dtype", 0), shape)


def _array(row: Mapping[str, Any]) -> NDArray[Any]:
    """A constant, as a view of the file where its bytes are stored raw; finite if they are floats."""
    what, dims, dtype = f"the constant {row.get('name', '')!a:.60}", row["dims"], row.get("dtype", 0)
    if dtype not in DTYPES:
        raise ValueError(f"{what} is of data type {dtype}, allowed: float, (u)int8, int32, int64")
    elements, stored = math.prod(dims), {FLOAT: "floats", INT64: "int64s"}.get(dtype, "int32s")
    if min(dims, default=1) < 1 or elements > ELEMENTS_MAX:
        raise ValueError(f"{what} has the shape {dims!s:.80}, allowed: at most {ELEMENTS_MAX} values")
    given = [key for key in ("raw", "floats", "int32s", "int64s") if key in row]
    if given not in (["raw"], [stored]):
        raise ValueError(f"{what} has its values in {given}, allowed: raw, or {stored}")
    plain = given == ["raw"] or stored == "floats"
    values = np.frombuffer(row[given[0]], DTYPES[dtype]) if plain else _integers(row[given[0]])
    if values.size != elements or (dtype == FLOAT and not np.isfinite(values).all()):
        raise ValueError(f"{what} has {values.size} values for {elements}, or one that is not finite")
    return values.reshape(dims)


def _message(kind: str, data: memoryview, left: list[int]) -> dict[str, Any]:
    """One message as a dict of its fields; `left[0]` is how many fields may still come."""
    known, position = _FIELDS[kind], 0
    found: dict[str, Any] = {text.split(":")[0]: [] for text in known.values() if text.endswith("*")}
    while position < len(data):
        key, position = _varint(data, position)
        number, wire = key >> 3, key & 7
        value: Any
        if wire == 0:
            value, position = _varint(data, position)
        else:
            length, position = _varint(data, position) if wire == 2 else (4 if wire == 5 else 8, position)
            value, position = data[position : position + length], position + length
        left[0] -= 1
        if left[0] < 0 or number not in known:
            more = _REFUSED.get((kind, number), f"field {number} in a {kind}")
            raise ValueError(f"{more if left[0] >= 0 else f'more than {FIELDS_MAX} fields'}, which no head may have")
        name, _, what = known[number].partition(":")
        if position > len(data) or wire not in _WIRES.get(what, (2,)):
            raise ValueError(f"not an ONNX model (field {number} in a {kind} is cut, or of protobuf wire type {wire})")
        if what.endswith("*"):
            packed = wire == 2 and what in ("int*", "float*")
            found[name] += _numbers(what, value) if packed else [_one(what[:-1], value, left)]
            if len(found[name]) > (most := _MOST.get(name, LIST_MAX)):
                raise ValueError(f"more than {most} {name} in a {kind}, allowed: that many")
        elif name in found:
            raise ValueError(f"a {kind} has the field {name} twice")
        elif name:
            found[name] = _one(what, value, left)
    return found


def _one(kind: str, value: Any, left: list[int]) -> Any:
    if kind == "int":
        return value - (1 << 64) if value >> 63 else value
    if kind == "float":
        return float(np.frombuffer(value, "<f4")[0])
    if kind == "text":
        return bytes(value).decode()
    return value if kind == "bytes" else _message(kind, value, left)


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for place, byte in enumerate(data[position : position + 10]):
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value & ((1 << 64) - 1), position + place + 1
    raise ValueError("not an ONNX model (a number never ends)")


def protobuf(*fields: tuple[int, int | bytes | str]) -> bytes:
    """Return a protobuf message of these fields, each its number and its value."""
    out = b""
    for number, value in fields:
        if isinstance(value, int):
            out += _varint_bytes(number << 3) + _varint_bytes(value)
        else:
            data = value.encode() if isinstance(value, str) else value
            out += _varint_bytes(number << 3 | 2) + _varint_bytes(len(data)) + data
    return out


def _varint_bytes(value: int) -> bytes:
    return bytes([value]) if value < 0x80 else bytes([value & 0x7F | 0x80]) + _varint_bytes(value >> 7)


def _numbers(kind: str, data: memoryview) -> list[Any]:
    return list((np.frombuffer(data, "<f4") if kind == "float*" else _integers(data)).tolist())


def _integers(data: memoryview) -> NDArray[np.int64]:
    found, position = [], 0
    if len(data) > _PACKED_MAX_BYTES:
        raise ValueError(f"{len(data)} bytes of packed integers, allowed at most {_PACKED_MAX_BYTES}: store them raw")
    while position < len(data):
        value, position = _varint(data, position)
        found.append(value - (1 << 64) if value >> 63 else value)
    return np.array(found, np.int64)
