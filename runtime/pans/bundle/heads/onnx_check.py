"""A head's bytes in; what one decision of it costs out, or ValueError in words: checked before any onnxruntime session is made.

Shapes are followed through the operators (https://onnx.ai/onnx/operators/). No loop, no branch, no size that depends on a click and no
mixing of rows is let through, so that time and memory are those stated here, whatever the weights are. A rule may let through what
onnxruntime refuses; for all else its shape is onnxruntime's. docs/reference/formats.md states the same bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

OPSETS = (7, 30)  # operators before 7 broadcast by attributes; what onnxruntime does not know it refuses itself
OPERATIONS_MAX = 1 << 27  # multiply-adds per decision, about 0.05 s on one core
VALUES_MAX = 1 << 22  # of all intermediate results and workspace per decision: 16 MiB of float32
VALUE_OPERATIONS = 8  # multiply-adds that take as long as one value of an element-wise operator, such as an exponential
ROWS = 2_147_483_629  # stands for the number of decisions at once: a prime that no constant has room for
Dims = tuple[int, ...]
Tensor = NDArray[Any]  # int64: few integers with known values; else only the shape counts, and nothing is allocated


class HeadCost(NamedTuple):
    """What a checked head is: names of its ends, whether its batch is fixed to one row, and what one row costs."""

    input_name: str
    output_name: str
    row_by_row: bool
    operations: int
    values: int


def check_head(head_onnx: bytes, n_features: int, n_outputs: int) -> HeadCost:
    """Return the cost of a head for means (n, n_features) and scores (n, n_outputs); ValueError, in words, if it may not run."""
    model = read_model(head_onnx)
    if not OPSETS[0] <= model.opset <= OPSETS[1]:
        raise ValueError(f"operator set {model.opset}, allowed: {OPSETS[0]} to {OPSETS[1]}")
    ends = model.inputs + model.outputs[:1]
    if len(model.inputs) != 1 or len(ends) != 2 or {value.dtype for value in ends} != {FLOAT}:
        found = ", ".join(f"{value.name!a:.40} of data type {value.dtype}" for value in ends[:5])
        raise ValueError(f"the ends are {found}; allowed: one input and an output, tensor(float)")
    source, result = ends
    if len(source.shape) != 2 or source.shape[0] not in (None, 1) or source.shape[1] not in (None, n_features):
        raise ValueError(f"the input has the shape {source.shape!s:.80}, allowed: (n or 1, {n_features})")
    known, operations, values = shapes_of(model, n_features)
    if result.name not in known or known[result.name].shape != (ROWS, n_outputs):
        found = shape_text(known[result.name].shape) if result.name in known else "of nothing: no operator makes it"
        raise ValueError(f"the output {result.name!a:.60} has the shape {found}, allowed: (n, {n_outputs})")
    return HeadCost(source.name, result.name, source.shape[0] == 1, operations, values)


def shapes_of(model: Model, n_features: int) -> tuple[dict[str, Tensor], int, int]:
    """Return every tensor's shape, the multiply-adds and the values of one row; ValueError where they pass what is allowed."""
    known = {name: _constant_of(values) for name, values in model.tensors.items()}
    known[model.inputs[0].name] = _shaped((ROWS, n_features))
    operations, values = 0, n_features
    for node in model.nodes:
        missing = [name for name in node.inputs if name and name not in known]
        if missing or len(node.outputs) != 1 or node.outputs[0] in known:
            ends = f"makes {node.outputs!s:.80} of {node.inputs!s:.80}"
            raise ValueError(f"the operator {node.op!a:.60} {ends}, allowed: one new output, of what was made before")
        call = _Call(node, [known.get(name) for name in node.inputs], model.opset)
        known[node.outputs[0]] = output = _outcome(call)
        operations += call.operations + VALUE_OPERATIONS * per_row(output.shape)
        values += call.workspace + per_row(output.shape)
        if operations > OPERATIONS_MAX or values > VALUES_MAX:
            found = f"{operations} multiply-adds and {values} intermediate values per decision"
            raise ValueError(f"{found} at {node.op}, allowed: {OPERATIONS_MAX} and {VALUES_MAX}")
    return known, operations, values


@dataclass(slots=True)
class _Call:
    """One operator, what is known of its inputs (None: left out), and what it costs per row beside one pass over its output."""

    node: Node
    inputs: list[Tensor | None]
    opset: int
    operations: int = 0
    workspace: int = 0

    def given(self, number: int) -> Tensor:
        if number >= len(self.inputs) or (known := self.inputs[number]) is None:
            raise ValueError(f"has no input {number}")
        return known

    def dims(self, number: int = 0) -> Dims:
        return self.given(number).shape

    def constant(self, number: int) -> Dims:
        """The sizes of an input that must not depend on the clicks."""
        if ROWS in self.dims(number):
            raise ValueError(f"has an input {number} that depends on the clicks, allowed: a constant")
        return self.dims(number)

    def attribute(self, name: str, otherwise: Any) -> Any:
        """An attribute of the type of `otherwise`, or that."""
        value = self.node.attributes.get(name, otherwise)
        if type(value) is not type(otherwise):
            raise ValueError(f"has {name} {value!s:.60}, allowed: {type(otherwise).__name__}")
        return value

    def integers(self, name: str, number: int) -> Dims:
        """Integers given as attribute `name` or, in later operator sets, as input `number`; () if in neither."""
        if name in self.node.attributes or number >= len(self.inputs) or self.inputs[number] is None:
            return tuple(self.attribute(name, ()))
        values = self.given(number).reshape(-1)
        if values.dtype != np.int64 or (ROWS in values and name != "shape"):
            raise ValueError(f"has {name} that are not a short constant")
        return tuple(values.tolist())


def per_row(dims: Dims) -> int:
    """Return the number of values of one row."""
    return math.prod(size for size in dims if size != ROWS)


def shape_text(dims: Dims) -> str:
    """Return sizes for a message, the rows as n."""
    return f"({', '.join('n' if size == ROWS else str(size) for size in dims)})"[:80]


def _shaped(dims: Dims) -> Tensor:
    return np.ndarray(dims, np.int8, b"\0", strides=(0,) * len(dims))


def _constant_of(values: Tensor) -> Tensor:
    few = values.dtype.kind == "i" and values.size <= LIST_MAX and values.ndim < 2
    return values.astype(np.int64) if few else _shaped(values.shape)


def _outcome(call: _Call) -> Tensor:
    """What the operator gives; ValueError, naming it, for one that is not allowed or does not fit."""
    op, rows = call.node.op, any(known is not None and ROWS in known.shape for known in call.inputs)
    if op not in _RULES:
        raise ValueError(f"the operator {op!a:.60}, allowed: {', '.join(sorted(_RULES))}")
    try:
        found = _RULES[op](call)
        dims = found if isinstance(found, tuple) else found.shape
        if len(dims) > LIST_MAX or min(dims, default=1) < 1 or math.prod(dims) > 1 << 62:
            raise ValueError(f"gives the shape {shape_text(dims)}, allowed: sizes of 1 and more, {VALUES_MAX} in all")
        if ROWS in dims[1:] or (rows and op != "Shape" and dims[:1] != (ROWS,)):
            raise ValueError(f"gives the shape {shape_text(dims)}, allowed: rows stay first, and apart")
        return _shaped(found) if isinstance(found, tuple) else found
    except (ValueError, IndexError, TypeError) as error:
        raise ValueError(f"the operator {op} {error}") from None


def _same(call: _Call) -> Tensor | Dims:
    if call.attribute("training_mode", 0) or (call.node.op == "Dropout" and len(call.inputs) > 2):
        raise ValueError("has training_mode, allowed: inference")
    return call.given(0) if call.node.op == "Identity" else call.dims()


def _along_axis(call: _Call) -> Dims:
    dims, last = call.dims(), call.node.op == "LayerNormalization" or call.opset >= 13
    if call.attribute("axis", -1 if last else 1) % len(dims) == 0 and ROWS in dims:
        raise ValueError("works along the rows, allowed: within each")
    return dims


def _broadcast(call: _Call) -> Dims:
    return np.broadcast_shapes(*(call.dims(number) for number in range(len(call.inputs))))


def _cast(call: _Call) -> Tensor | Dims:
    wanted = call.attribute("to", 0)
    if wanted not in DTYPES:
        raise ValueError(f"gives data type {wanted}, allowed: float, (u)int8, int32, int64")
    return call.given(0) if wanted > 5 else call.dims()


def _product(call: _Call) -> Dims:
    left, right = call.dims(), call.constant(1)
    if call.node.op == "Gemm":
        left = left[::-1] if call.attribute("transA", 0) else left
        right = right[::-1] if call.attribute("transB", 0) else right
    if not left or len(right) not in (1, 2) or left[-1] != right[0]:
        raise ValueError(f"multiplies {shape_text(left)} by {shape_text(right)}, which do not fit")
    output = left[:-1] + right[1:]
    call.operations = per_row(output) * right[0]
    return output


def _windows(call: _Call, sizes: Dims, kernel: Dims) -> Dims:
    """How many windows of a convolution or pool fit, per axis; of a transposed convolution the size of its output."""
    rank, how, up = len(kernel), call.attribute("auto_pad", "NOTSET"), call.attribute("ceil_mode", 0)
    strides, dilations = call.attribute("strides", (1,) * rank), call.attribute("dilations", (1,) * rank)
    pads, further = call.attribute("pads", (0,) * 2 * rank), call.attribute("output_padding", (0,) * rank)
    if min(kernel + strides + dilations) < 1 or min(pads + further) < 0 or len(pads) != 2 * rank:
        raise ValueError("has a kernel, strides or dilations below 1, or pads below 0")
    if how not in ("NOTSET", "VALID", "SAME_UPPER", "SAME_LOWER", ""):
        raise ValueError(f"has auto_pad {how!a:.60}")
    if how == "VALID":
        pads = (0,) * 2 * rank
    found = []
    axes = zip(sizes, pads[:rank], pads[rank:], kernel, strides, dilations, further, strict=True)
    for size, before, behind, k, stride, dilation, more in axes:
        reach = (k - 1) * dilation + 1
        if before + behind > 2 * reach:
            raise ValueError("has pads wider than its kernel")
        count = (size + before + behind - reach + (stride - 1) * bool(up)) // stride + 1
        if how.startswith("SAME"):
            count = -(-size // stride)
        elif up and (count - 1) * stride >= size + before:
            count -= 1  # it would begin in the pad behind
        transposed = (size - 1) * stride + reach + more - before - behind
        found.append(transposed if call.node.op == "ConvTranspose" else count)
    return tuple(found)


def _conv(call: _Call) -> Dims:
    dims, weights, groups = call.dims(), call.constant(1), call.attribute("group", 1)
    turned, window = call.node.op == "ConvTranspose", math.prod(weights[2:])
    outer, inner = weights[1::-1] if turned else weights[:2]  # channels; the second axis has those of a group
    if turned and (call.attribute("auto_pad", "NOTSET") != "NOTSET" or "output_shape" in call.node.attributes):
        raise ValueError("has auto_pad or output_shape, allowed: pads alone")
    fits = groups >= 1 and inner * (1 if turned else groups) == dims[1]
    if not fits or call.attribute("kernel_shape", weights[2:]) != weights[2:]:
        raise ValueError(f"has weights {shape_text(weights)} for {shape_text(dims)}, which do not fit")
    channels = outer * groups if turned else outer
    output = (dims[0], channels, *_windows(call, dims[2:], weights[2:]))
    call.operations = per_row(dims if turned else output) * (outer if turned else inner) * window
    places = math.prod(dims[2:]) * channels if turned else math.prod(output[2:]) * dims[1]
    call.workspace = max(0, places) * window
    return output


def _pool(call: _Call) -> Dims:
    dims, kernel = call.dims(), call.attribute("kernel_shape", ())
    if call.node.op.startswith("Global"):
        kernel, output = dims[2:], dims[:2] + (1,) * (len(dims) - 2)
    else:
        output = (*dims[:2], *_windows(call, dims[2:], kernel))
    call.operations = per_row(output) * math.prod(kernel)
    return output


def _reduce(call: _Call) -> Dims:
    dims, kept = call.dims(), call.attribute("keepdims", 1)
    if call.attribute("noop_with_empty_axes", 0):
        raise ValueError("has noop_with_empty_axes")
    gone = {range(len(dims))[axis] for axis in call.integers("axes", 1) or range(len(dims))}
    call.operations = VALUE_OPERATIONS * per_row(dims)
    return tuple(1 if axis in gone else size for axis, size in enumerate(dims) if kept or axis not in gone)


def _reshape(call: _Call) -> Dims:
    dims, wanted = call.dims(), call.integers("shape", 1)
    sizes = [dims[axis] if size == 0 and axis < len(dims) else size for axis, size in enumerate(wanted)]
    if ROWS in dims and sizes[:1] in ([-1], [1]):  # 1 is right where a head has a fixed batch of one
        sizes[0] = ROWS
    total, rest = math.prod(dims), math.prod(size for size in sizes if size != -1)
    fits = rest >= 1 and total % rest == 0 and (total == rest or sizes.count(-1) == 1)
    if not fits or sizes.count(-1) > 1 or call.attribute("allowzero", 0):
        raise ValueError(f"gives the shape {shape_text(wanted)} to {shape_text(dims)}, which does not fit")
    return tuple(total // rest if size == -1 else size for size in sizes)


def _flatten(call: _Call) -> Dims:
    dims, axis = call.dims(), call.attribute("axis", 1)
    return math.prod(dims[:axis]), math.prod(dims[axis:])


def _concat(call: _Call) -> Tensor | Dims:
    parts = [call.given(number) for number in range(len(call.inputs))]
    dims = list(parts[0].shape)
    axis = range(len(dims))[call.attribute("axis", 0)]
    if any(part.shape[:axis] + part.shape[axis + 1 :] != (*dims[:axis], *dims[axis + 1 :]) for part in parts):
        raise ValueError("joins shapes that do not fit")
    dims[axis] = sum(part.shape[axis] for part in parts)
    return np.concatenate(parts) if all(part.dtype == np.int64 for part in parts) else tuple(dims)


def _slice(call: _Call) -> Tensor:
    values, starts, ends = call.given(0), call.integers("starts", 1), call.integers("ends", 2)
    axes, steps = call.integers("axes", 3) or range(len(starts)), call.integers("steps", 4) or (1,) * len(starts)
    for start, end, place, step in zip(starts, ends, axes, steps, strict=True):
        axis = range(values.ndim)[place]
        if values.shape[axis] == ROWS and step != 1:  # one of all rows in reverse has the same shape
            raise ValueError(f"takes the rows in steps of {step}, allowed: rows stay in their order")
        past = step < 0 and end < -values.shape[axis]
        values = values[(slice(None),) * axis + (slice(start, None if past else end, step),)]
    return values


def _gather(call: _Call) -> Tensor | Dims:
    values, index, axis = call.given(0), call.given(1), call.attribute("axis", 0)
    if values.dtype == index.dtype == np.int64 and values.ndim == 1:
        return np.take(values, index)
    axis = range(values.ndim)[axis]
    return values.shape[:axis] + call.constant(1) + values.shape[axis + 1 :]


def _shape(call: _Call) -> Tensor:
    return np.array(call.dims()[call.attribute("start", 0) : call.node.attributes.get("end")], np.int64)


def _constant(call: _Call) -> Tensor:
    (value,) = call.node.attributes.values()
    return _constant_of(np.asarray(value))


_RULES: Mapping[str, Callable[[_Call], Tensor | Dims]] = {
    name: rule
    for names, rule in (
        ("Abs Ceil Celu Clip Elu Erf Exp Floor Gelu HardSigmoid HardSwish Identity LeakyRelu Log Mish Neg", _same),
        ("Reciprocal Relu Round Selu Sigmoid Softplus Softsign Sqrt Tanh ThresholdedRelu", _same),
        ("QuantizeLinear DequantizeLinear BatchNormalization Dropout", _same),
        ("Add Sub Mul Div Max Min Pow PRelu Sum", _broadcast),
        ("Gemm MatMul MatMulInteger", _product),
        ("Conv ConvTranspose", _conv),
        ("AveragePool MaxPool GlobalAveragePool GlobalMaxPool", _pool),
        ("Softmax LogSoftmax LayerNormalization", _along_axis),
        ("ReduceMax ReduceMean ReduceMin ReduceSum", _reduce),
        *(("Cast", _cast), ("Reshape", _reshape), ("Flatten", _flatten), ("Concat", _concat), ("Slice", _slice)),
        *(("Gather", _gather), ("Constant", _constant), ("Shape", _shape)),
        ("Unsqueeze", lambda call: np.expand_dims(call.given(0), call.integers("axes", 1))),
        ("Squeeze", lambda call: np.squeeze(call.given(0), call.integers("axes", 1) or None)),
        ("Transpose", lambda call: np.transpose(call.given(0), call.node.attributes.get("perm"))),
    )
    for name in names.split()
}


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
