"""ONNX models as bytes: a checked reader of the protobuf fields that a feed-forward head consists of.

Owns the list of allowed fields and the limits on their number; never runs a model and never imports onnx. `read_model` goes through the
bytes once. Everything that is not on the list is refused by its name: functions, subgraphs, training, sparse tensors, weights in other
files, unknown fields. So is a field that stands twice where one is meant, for readers differ in which of the two they take. Field numbers
are those of onnx.proto (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MODEL_MAX_BYTES = 64 << 20
FIELDS_MAX = 100_000  # of all messages together: 1000 nodes have about 15 each
NODES_MAX = 1000
TENSORS_MAX = 2000
LIST_MAX = 64  # inputs, outputs, attributes and numbers of a node, dimensions of a tensor, numbers that hold a shape
NAME_MAX_BYTES = 1000
SKIPPED_MAX_BYTES = 1 << 20  # comments and metadata, all together
PACKED_MAX_BYTES = 1 << 20  # integers of varying length: large constants are stored raw
ELEMENTS_MAX = 1 << 26

FLOAT, UINT8, INT8, INT32, INT64 = 1, 2, 3, 6, 7  # TensorProto.DataType
_DTYPES = {FLOAT: "<f4", UINT8: "|u1", INT8: "|i1", INT32: "<i4", INT64: "<i8"}
_STANDARD = ("", "ai.onnx")  # two names of the domain of the standard operators
_CONTENT = {1: "f", 2: "i", 3: "s", 4: "t", 6: "floats", 7: "ints"}  # AttributeProto.AttributeType -> field

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
_REFUSED = {
    **{("model", 20): "a training graph", ("model", 25): "functions of its own", ("graph", 15): "sparse weights"},
    **{("attribute", number): "a subgraph" for number in (6, 11)},
    **{("attribute", number): "sparse weights" for number in (22, 23)},
    ("tensor", 13): "weights that lie in another file (external data)",
}
_WIRE_OF = {"int": (0,), "float": (5,), "int*": (0, 2), "float*": (5, 2)}  # all others: 2, length and bytes


@dataclass(frozen=True, slots=True, eq=False)
class Tensor:
    """A constant: `values` is a view of the file where its bytes are stored raw; finite if they are floats."""

    name: str
    values: NDArray[Any]


@dataclass(frozen=True, slots=True)
class Node:
    """One operator of the standard domain; attributes are int, float, str, Tensor, or tuples of int or float."""

    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Value:
    """A declared input or output: its dtype (1: float32) and shape, None for a free size; `shape` None if it is not declared."""

    name: str
    dtype: int
    shape: tuple[int | None, ...] | None


@dataclass(frozen=True, slots=True)
class Model:
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
    model = _Reader().message("model", memoryview(data), 0)
    if "graph" not in model or not model["opsets"]:
        raise ValueError("not an ONNX model (no graph, or no operator set)")
    versions = [int(row.get("version", 0)) for row in model["opsets"] if row.get("domain", "") in _STANDARD]
    if len(versions) != 1:
        raise ValueError(f"{len(versions)} versions of the standard operator set, allowed: one")
    graph = model["graph"]
    for what, most in (("nodes", NODES_MAX), ("tensors", TENSORS_MAX), ("inputs", TENSORS_MAX), ("outputs", LIST_MAX)):
        if len(graph[what]) > most:
            raise ValueError(f"{len(graph[what])} {what}, allowed at most {most}")
    tensors: dict[str, NDArray[Any]] = {}
    for row in graph["tensors"]:
        tensor = _tensor(row)
        if tensor.name in tensors:
            raise ValueError(f"two constants have the name {tensor.name!a:.60}")
        tensors[tensor.name] = tensor.values
    return Model(
        opset=versions[0],
        nodes=tuple(_node(row) for row in graph["nodes"]),
        tensors=tensors,
        inputs=tuple(value for value in map(_value, graph["inputs"]) if value.name not in tensors),
        outputs=tuple(_value(row) for row in graph["outputs"]),
    )


class _Reader:
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
                    f"{_REFUSED.get((kind, number), f'field {number} in a {kind}')}, which no head may have"
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
            return list((_varints if kind == "int" else _floats)(value).tolist())
        return [self._one(kind, value, depth)]

    def _one(self, kind: str, value: Any, depth: int) -> Any:
        if kind == "int":
            return value - (1 << 64) if value >> 63 else value
        if kind == "float":
            return float(_floats(value)[0])
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


def _varints(data: memoryview) -> NDArray[np.int64]:
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


def _floats(data: memoryview) -> NDArray[np.float32]:
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


def _demand_short(what: str, values: Any) -> None:
    if len(values) > LIST_MAX:
        raise ValueError(f"{what}: {len(values)}, allowed at most {LIST_MAX}")


def _tensor(row: Mapping[str, Any]) -> Tensor:
    name, dims, dtype = row.get("name", ""), row["dims"], row.get("dtype", 0)
    if row.get("location", 0):
        raise ValueError(f"{_REFUSED['tensor', 13]}, which no head may have")
    if dtype not in _DTYPES:
        raise ValueError(f"the constant {name!a:.60} is of data type {dtype}, allowed: float, (u)int8, int32, int64")
    _demand_short(f"dimensions of the constant {name!a:.60}", dims)
    elements = math.prod(dims)
    if any(size < 1 for size in dims) or elements > ELEMENTS_MAX:
        raise ValueError(
            f"the constant {name!a:.60} has the shape {dims!s:.80}, allowed: at most {ELEMENTS_MAX} values"
        )
    given = [key for key in ("raw", "floats", "int32s", "int64s") if key in row]
    stored = {FLOAT: "floats", INT64: "int64s"}.get(dtype, "int32s")
    if len(given) != 1 or given[0] not in ("raw", stored):
        raise ValueError(f"the constant {name!a:.60} has its values in {given}, allowed: raw, or {stored}")
    if given[0] == "raw" or stored == "floats":
        item = np.dtype(_DTYPES[dtype]).itemsize
        if len(row[given[0]]) != elements * item:
            raise ValueError(
                f"the constant {name!a:.60} has {len(row[given[0]])} bytes, its shape needs {elements * item}"
            )
        values = np.frombuffer(row[given[0]], _DTYPES[dtype])
    else:
        values = _varints(row[given[0]])
    if values.size != elements or (dtype == FLOAT and not np.isfinite(values).all()):
        raise ValueError(
            f"the constant {name!a:.60} has {values.size} values for {elements}, or one that is not finite"
        )
    return Tensor(name, values.reshape(dims))


def _node(row: Mapping[str, Any]) -> Node:
    op = row.get("op", "")
    if row.get("domain", "") not in _STANDARD:
        raise ValueError(f"the operator {op!a:.60} of the domain {row['domain']!a:.60}, allowed: the standard one")
    for what in ("inputs", "outputs", "attributes"):
        _demand_short(f"{what} of the operator {op!a:.60}", row[what])
    attributes: dict[str, Any] = {}
    for attribute in row["attributes"]:
        name, content = _attribute(attribute)
        if name in attributes:
            raise ValueError(f"the operator {op!a:.60} has the attribute {name!a:.60} twice")
        attributes[name] = content
    return Node(op, tuple(row["inputs"]), tuple(row["outputs"]), attributes)


def _attribute(row: Mapping[str, Any]) -> tuple[str, Any]:
    name, wanted = row.get("name", ""), _CONTENT.get(row.get("type", 0))
    given = {key for key in _CONTENT.values() if row.get(key) not in (None, [])}
    if wanted is None or not given <= {wanted}:
        raise ValueError(f"the attribute {name!a:.60} is of no allowed type: a number, a text, a tensor or a list")
    if wanted in ("floats", "ints"):
        _demand_short(f"numbers of the attribute {name!a:.60}", row[wanted])
        content: Any = tuple(row[wanted])
    else:
        content = row.get(wanted, {"f": 0.0, "i": 0, "s": ""}.get(wanted))
    if wanted == "t":
        content = _tensor(content or {"dims": []})
    if wanted in ("f", "floats") and not np.isfinite(content).all():
        raise ValueError(f"the attribute {name!a:.60} is not finite")
    return name, content


def _value(row: Mapping[str, Any]) -> Value:
    name, kind = row.get("name", ""), row.get("type", {}).get("tensor", {})
    if "shape" not in kind:
        return Value(name, kind.get("dtype", 0), None)
    dims = kind["shape"]["dims"]
    _demand_short(f"dimensions of {name!a:.60}", dims)
    if any("size" in dim and "symbol" in dim for dim in dims):
        raise ValueError(f"a size of {name!a:.60} is both a number and a name")
    return Value(name, kind.get("dtype", 0), tuple(dim.get("size") for dim in dims))
