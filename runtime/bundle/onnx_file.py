"""ONNX models as bytes: a checked reader of what a feed-forward head consists of.

Owns the meaning of the fields and the limits on a graph; never runs a model and never imports onnx. `read_model` goes through the bytes
once; the fields themselves are read by onnx_protobuf.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .onnx_protobuf import LIST_MAX, REFUSED, Reader, packed_integers

MODEL_MAX_BYTES = 32 << 20  # onnxruntime holds up to three copies while it opens one
NODES_MAX = 1000
TENSORS_MAX = 2000
ELEMENTS_MAX = 1 << 26

FLOAT, UINT8, INT8, INT32, INT64 = 1, 2, 3, 6, 7  # TensorProto.DataType
_DTYPES = {FLOAT: "<f4", UINT8: "|u1", INT8: "|i1", INT32: "<i4", INT64: "<i8"}
_STANDARD = ("", "ai.onnx")  # two names of the domain of the standard operators
_CONTENT = {1: "f", 2: "i", 3: "s", 4: "t", 6: "floats", 7: "ints"}  # AttributeProto.AttributeType -> field


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
    model = Reader().message("model", memoryview(data), 0)
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


def _demand_short(what: str, values: Any) -> None:
    if len(values) > LIST_MAX:
        raise ValueError(f"{what}: {len(values)}, allowed at most {LIST_MAX}")


def _tensor(row: Mapping[str, Any]) -> Tensor:
    name, dims, dtype = row.get("name", ""), row["dims"], row.get("dtype", 0)
    if row.get("location", 0):
        raise ValueError(f"{REFUSED['tensor', 13]}, which no head may have")
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
        values = packed_integers(row[given[0]])
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
