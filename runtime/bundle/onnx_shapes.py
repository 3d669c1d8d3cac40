"""What each allowed ONNX operator gives: the shape of its output and what it costs, from the shapes of its inputs.

Owns the list of allowed operators; never runs one and never sees weights, except integers that stand for shapes. The first size of a
tensor that depends on the clicks is ROWS: how many there are is not known here, and no operator may mix rows, so that every cost is one
per row. What a rule lets through may still be refused by onnxruntime; no rule may give less than onnxruntime takes. Rules: the operator
list of ONNX (https://onnx.ai/onnx/operators/), operator sets 7 and later.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any, NamedTuple

from .onnx_file import FLOAT, INT8, INT32, INT64, LIST_MAX, UINT8, Node, Tensor

ROWS = -(1 << 64)  # the size of the first axis, one entry per decision; no 64-bit integer of a file equals it
VALUE_OPERATIONS = 8  # what one value of an element-wise operator counts: an exponential takes about as long as that many multiply-adds
Dims = tuple[int, ...]


class Known(NamedTuple):
    """What is known of a tensor before anything runs: its sizes, and its values where it is a list of integers."""

    dims: Dims
    ints: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Output of an operator, its multiply-adds (or what takes as long) and values of workspace, per row."""

    output: Known
    operations: int
    workspace: int = 0


@dataclass(slots=True)
class Call:
    """One operator with what is known of its inputs; an input that is left out is None."""

    node: Node
    inputs: list[Known | None]
    opset: int
    used: set[str] = field(default_factory=set)

    def given(self, number: int) -> Known:
        """Return input `number`; ValueError if it is left out."""
        if number >= len(self.inputs) or (known := self.inputs[number]) is None:
            raise ValueError(f"has no input {number}")
        return known

    def constant(self, number: int) -> Dims:
        """Return the sizes of input `number`, which must not depend on the clicks."""
        dims = self.given(number).dims
        if ROWS in dims:
            raise ValueError(f"has an input {number} that depends on the clicks, allowed: a constant")
        return dims

    def attribute(self, name: str, otherwise: Any) -> Any:
        """Return an attribute of the type of `otherwise`, or that."""
        value = self.node.attributes.get(name, otherwise)
        if type(value) is not type(otherwise):
            raise ValueError(f"has {name} {value!s:.60}, allowed: {type(otherwise).__name__}")
        return value

    def axis(self, value: int, rank: int) -> int:
        """Return an axis counted from the front, never that of the rows."""
        if not -rank <= value < rank:
            raise ValueError(f"names axis {value} of {rank}")
        if value % rank == 0 and self.mixes_rows():
            raise ValueError("works along the rows, allowed: within each")
        return value % rank

    def mixes_rows(self) -> bool:
        """Whether an input depends on the clicks."""
        return any(known is not None and ROWS in known.dims for known in self.inputs)

    def integers(self, name: str, number: int) -> tuple[int, ...] | None:
        """Return integers given as attribute `name` or, in later operator sets, as input `number`; None if in neither."""
        if name in self.node.attributes:
            return tuple(self.attribute(name, ()))
        if number >= len(self.inputs) or self.inputs[number] is None:
            return None
        ints = self.given(number).ints
        if ints is None or (ROWS in ints and name != "shape"):
            raise ValueError(f"has {name} that are not a short constant")
        return ints


Rule = Callable[[Call], Outcome]


def per_row(dims: Sequence[int]) -> int:
    """Return the number of values of one row."""
    return math.prod(size for size in dims if size != ROWS)


def shape_text(dims: Sequence[int]) -> str:
    """Return sizes for a message, the rows as n."""
    return f"({', '.join('n' if size == ROWS else str(size) for size in dims)})"[:80]


def outcome_of(node: Node, inputs: list[Known | None], opset: int) -> Outcome:
    """Return what `node` gives for `inputs`; ValueError, naming the operator, for one that is not allowed or does not fit."""
    rule = RULES.get(node.op)
    if rule is None:
        raise ValueError(f"the operator {node.op!a:.60}, allowed: {', '.join(sorted(RULES))}")
    if len([name for name in node.outputs if name]) != 1 or not node.outputs[0]:
        raise ValueError(f"the operator {node.op} has {len(node.outputs)} outputs, allowed: its first alone")
    try:
        outcome = rule(Call(node, inputs, opset))
    except ValueError as error:
        raise ValueError(f"the operator {node.op} {error}") from None
    dims = outcome.output.dims
    if len(dims) > LIST_MAX or any(size < 1 for size in dims if size != ROWS) or ROWS in dims[1:]:
        raise ValueError(f"the operator {node.op} gives the shape {shape_text(dims)}, allowed: sizes of 1 and more")
    return outcome


def _values(known: Known) -> Outcome:
    return Outcome(known, VALUE_OPERATIONS * per_row(known.dims))


def _same(call: Call) -> Outcome:
    return _values(Known(call.given(0).dims))


def _dropout(call: Call) -> Outcome:
    if len(call.inputs) > 2:
        raise ValueError("has training_mode, allowed: inference")
    return _same(call)


def _batch_norm(call: Call) -> Outcome:
    if call.attribute("training_mode", 0):
        raise ValueError("has training_mode, allowed: inference")
    return _same(call)


def _broadcast(call: Call) -> Outcome:
    shapes = [call.given(number).dims for number in range(len(call.inputs))]
    sizes = []
    for column in zip_longest(*(reversed(dims) for dims in shapes), fillvalue=1):
        wide = {size for size in column if size != 1}
        if len(wide) > 1:
            raise ValueError(f"joins {', '.join(map(shape_text, shapes)):.120}, which do not fit")
        sizes.append(wide.pop() if wide else 1)
    return _values(Known(tuple(reversed(sizes))))


def _cast(call: Call) -> Outcome:
    wanted, known = call.attribute("to", 0), call.given(0)
    if wanted not in (FLOAT, UINT8, INT8, INT32, INT64):
        raise ValueError(f"gives data type {wanted}, allowed: float, (u)int8, int32, int64")
    return _values(Known(known.dims, known.ints if wanted in (INT32, INT64) else None))


def _gemm(call: Call) -> Outcome:
    left, right = call.given(0).dims, call.constant(1)
    if len(left) != 2 or len(right) != 2:
        raise ValueError(f"multiplies {shape_text(left)} by {shape_text(right)}, allowed: matrices")
    if call.attribute("transA", 0):
        left = left[::-1]
    if call.attribute("transB", 0):
        right = right[::-1]
    return _product(left, right)


def _matmul(call: Call) -> Outcome:
    left, right = call.given(0).dims, call.constant(1)
    if len(right) not in (1, 2) or not left or (left[-1] == ROWS):
        raise ValueError(f"multiplies {shape_text(left)} by {shape_text(right)}, allowed: rows by a constant matrix")
    return _product(left, right)


def _product(left: Dims, right: Dims) -> Outcome:
    if left[-1] != right[0]:
        raise ValueError(f"multiplies {shape_text(left)} by {shape_text(right)}, which do not fit")
    output = left[:-1] + right[1:]
    return Outcome(Known(output), per_row(output) * right[0] + VALUE_OPERATIONS * per_row(output))


def _spatial(call: Call, kernel: Dims) -> tuple[Dims, Dims, Dims, Dims]:
    """Return strides, dilations and the pads before and behind, for a kernel of these sizes."""
    rank = len(kernel)
    one = (1,) * rank
    strides, dilations = call.attribute("strides", one), call.attribute("dilations", one)
    pads = call.attribute("pads", (0,) * 2 * rank)
    if (len(strides), len(dilations), len(pads)) != (rank, rank, 2 * rank):
        raise ValueError(f"has strides, dilations or pads for another number of axes than {rank}")
    if min(strides) < 1 or min(dilations) < 1 or min(pads) < 0:
        raise ValueError("has strides or dilations below 1, or pads below 0")
    return strides, dilations, pads[:rank], pads[rank:]


def _windows(call: Call, sizes: Dims, kernel: Dims) -> Dims:
    """Return how many windows of a convolution or pool fit, per axis."""
    strides, dilations, before, behind = _spatial(call, kernel)
    how = call.attribute("auto_pad", "NOTSET")
    reach = [(k - 1) * dilation + 1 for k, dilation in zip(kernel, dilations)]
    if how in ("SAME_UPPER", "SAME_LOWER"):
        return tuple(-(-size // stride) for size, stride in zip(sizes, strides))
    if how not in ("NOTSET", "VALID", ""):
        raise ValueError(f"has auto_pad {how!a:.60}")
    if how == "VALID":
        before = behind = (0,) * len(sizes)
    up, found = call.attribute("ceil_mode", 0), []
    for size, a, b, window, stride in zip(sizes, before, behind, reach, strides):
        if a + b > 2 * window:
            raise ValueError("has pads wider than its kernel")
        count = (size + a + b - window + (stride - 1 if up else 0)) // stride + 1
        if up and (count - 1) * stride >= size + a:
            count -= 1  # it would begin in the pad behind
        found.append(count)
    return tuple(found)


def _maps(call: Call) -> Dims:
    dims = call.given(0).dims
    if not 3 <= len(dims) <= 5:
        raise ValueError(f"works on {shape_text(dims)}, allowed: rows, channels and one to three axes")
    return dims


def _conv(call: Call) -> Outcome:
    dims, weights = _maps(call), call.constant(1)
    groups, kernel = call.attribute("group", 1), weights[2:]
    if len(weights) != len(dims) or groups < 1 or weights[1] * groups != dims[1] or weights[0] % groups:
        raise ValueError(
            f"has weights {shape_text(weights)} in {groups} groups for {shape_text(dims)}, which do not fit"
        )
    if call.attribute("kernel_shape", kernel) != kernel:
        raise ValueError("has a kernel_shape that is not that of its weights")
    output = (dims[0], weights[0], *_windows(call, dims[2:], kernel))
    window = math.prod(kernel)
    operations = per_row(output) * (weights[1] * window + VALUE_OPERATIONS)
    return Outcome(Known(output), operations, max(0, per_row(output) // weights[0]) * dims[1] * window)


def _conv_transpose(call: Call) -> Outcome:
    dims, weights = _maps(call), call.constant(1)
    groups, kernel = call.attribute("group", 1), weights[2:]
    if len(weights) != len(dims) or groups < 1 or weights[0] != dims[1] or dims[1] % groups:
        raise ValueError(
            f"has weights {shape_text(weights)} in {groups} groups for {shape_text(dims)}, which do not fit"
        )
    if call.attribute("auto_pad", "NOTSET") not in ("NOTSET", "") or "output_shape" in call.node.attributes:
        raise ValueError("has auto_pad or output_shape, allowed: pads alone")
    strides, dilations, before, behind = _spatial(call, kernel)
    further = call.attribute("output_padding", (0,) * len(kernel))
    if len(further) != len(kernel) or min(further) < 0:
        raise ValueError("has an output_padding that does not fit")
    output = (
        *(dims[0], weights[1] * groups),
        *(
            (size - 1) * stride + (k - 1) * dilation + 1 + more - a - b
            for size, stride, k, dilation, more, a, b in zip(
                dims[2:], strides, kernel, dilations, further, before, behind
            )
        ),
    )
    taps = per_row(dims) * weights[1] * math.prod(kernel)
    workspace = weights[1] * groups * math.prod(kernel) * math.prod(dims[2:])
    return Outcome(Known(output), taps + VALUE_OPERATIONS * max(0, per_row(output)), workspace)


def _pool(call: Call) -> Outcome:
    dims, kernel = _maps(call), call.attribute("kernel_shape", ())
    if len(kernel) != len(dims) - 2 or min(kernel) < 1:
        raise ValueError(f"has the kernel_shape {kernel!s:.60} for {shape_text(dims)}, which do not fit")
    output = (*dims[:2], *_windows(call, dims[2:], kernel))
    return Outcome(Known(output), per_row(output) * (math.prod(kernel) + VALUE_OPERATIONS))


def _global_pool(call: Call) -> Outcome:
    dims = _maps(call)
    return Outcome(Known(dims[:2] + (1,) * (len(dims) - 2)), VALUE_OPERATIONS * per_row(dims))


def _along_axis(default: int, later: int | None = None) -> Rule:
    """A rule for operators that keep the shape and work along one axis; `later`: the default from operator set 13."""

    def rule(call: Call) -> Outcome:
        dims = call.given(0).dims
        otherwise = default if later is None or call.opset < 13 else later
        call.axis(call.attribute("axis", otherwise), len(dims))
        return _values(Known(dims))

    return rule


def _reduce(call: Call) -> Outcome:
    dims, axes = call.given(0).dims, call.integers("axes", 1)
    if call.attribute("noop_with_empty_axes", 0):
        raise ValueError("has noop_with_empty_axes")
    if not axes:
        axes = tuple(range(len(dims)))
    gone = {call.axis(axis, len(dims)) for axis in axes}
    kept = [1 if axis in gone else size for axis, size in enumerate(dims)]
    if not call.attribute("keepdims", 1):
        kept = [size for axis, size in enumerate(dims) if axis not in gone]
    return Outcome(Known(tuple(kept)), VALUE_OPERATIONS * per_row(dims))


def _reshape(call: Call) -> Outcome:
    dims, wanted = call.given(0).dims, call.integers("shape", 1)
    if wanted is None:
        raise ValueError("has no shape")
    if call.attribute("allowzero", 0):
        raise ValueError("has allowzero")
    sizes = [dims[axis] if size == 0 and axis < len(dims) else size for axis, size in enumerate(wanted)]
    if ROWS in dims:
        if not sizes or sizes[0] not in (ROWS, -1, 1):  # 1 is right where a head has a fixed batch of one
            raise ValueError(f"gives the shape {shape_text(wanted)}, allowed: rows first (-1, or 0)")
        free = sizes[1:]
        total, lead = per_row(dims), [ROWS]
    else:
        free, total, lead = sizes, math.prod(dims), []
    if free.count(-1) > 1 or any(size < 1 for size in free if size != -1):
        raise ValueError(f"gives the shape {shape_text(wanted)}, allowed: sizes of 1 and more, and one -1")
    given = math.prod(size for size in free if size != -1)
    if total % given:
        raise ValueError(f"gives the shape {shape_text(wanted)} to {total} values, which does not fit")
    output = (*lead, *(total // given if size == -1 else size for size in free))
    if per_row(output) != total:
        raise ValueError(f"gives the shape {shape_text(wanted)} to {total} values, which does not fit")
    return _values(Known(output))


def _flatten(call: Call) -> Outcome:
    dims, axis = call.given(0).dims, call.attribute("axis", 1)
    axis += len(dims) if axis < 0 else 0
    if not 0 <= axis <= len(dims) or (ROWS in dims and axis != 1):
        raise ValueError("mixes the rows, allowed: axis 1")
    return _values(Known((ROWS if ROWS in dims else math.prod(dims[:axis]), math.prod(dims[axis:]))))


def _unsqueeze(call: Call) -> Outcome:
    known, axes = call.given(0), call.integers("axes", 1) or ()
    rank = len(known.dims) + len(axes)
    places = {call.axis(axis, rank) for axis in axes}
    if len(places) != len(axes):
        raise ValueError("names an axis twice")
    left = iter(known.dims)
    return _values(Known(tuple(1 if axis in places else next(left) for axis in range(rank)), known.ints))


def _squeeze(call: Call) -> Outcome:
    known, axes = call.given(0), call.integers("axes", 1)
    if not axes:
        raise ValueError("names no axes")
    gone = {call.axis(axis, len(known.dims)) for axis in axes}
    if any(known.dims[axis] != 1 for axis in gone):
        raise ValueError(f"takes axes {axes} from {shape_text(known.dims)}, allowed: those of size 1")
    return _values(Known(tuple(size for axis, size in enumerate(known.dims) if axis not in gone), known.ints))


def _transpose(call: Call) -> Outcome:
    dims = call.given(0).dims
    order = call.attribute("perm", tuple(reversed(range(len(dims)))))
    if sorted(order) != list(range(len(dims))) or (ROWS in dims and order[0] != 0):
        raise ValueError(f"has the order {order!s:.60}, allowed: rows stay first")
    return _values(Known(tuple(dims[axis] for axis in order)))


def _concat(call: Call) -> Outcome:
    parts = [call.given(number) for number in range(len(call.inputs))]
    first = parts[0].dims if parts else ()
    axis = call.axis(call.attribute("axis", 0), len(first)) if first else 0
    rest = {part.dims[:axis] + part.dims[axis + 1 :] for part in parts}
    if not first or len(rest) != 1 or len({len(part.dims) for part in parts}) != 1:
        raise ValueError("joins shapes that do not fit")
    size = sum(part.dims[axis] for part in parts)
    lists = [part.ints for part in parts if part.ints is not None]
    ints = (
        tuple(value for values in lists for value in values) if len(lists) == len(parts) and len(first) == 1 else None
    )
    return _values(Known((*first[:axis], size, *first[axis + 1 :]), ints))


def _slice(call: Call) -> Outcome:
    known = call.given(0)
    dims, starts, ends = list(known.dims), call.integers("starts", 1), call.integers("ends", 2)
    if starts is None or ends is None:
        raise ValueError("has no starts and ends")
    axes = call.integers("axes", 3) or tuple(range(len(starts)))
    steps = call.integers("steps", 4) or (1,) * len(starts)
    if not len(starts) == len(ends) == len(axes) == len(steps) or 0 in steps:
        raise ValueError("has starts, ends, axes and steps that do not fit")
    ints = known.ints
    for start, end, place, step in zip(starts, ends, axes, steps):
        axis = call.axis(place, len(dims))
        part = slice(start, None if step < 0 and end < -dims[axis] else end, step)
        dims[axis] = len(range(dims[axis])[part])
        ints = ints[part] if ints is not None and len(dims) == 1 else None
    return _values(Known(tuple(dims), ints))


def _gather(call: Call) -> Outcome:
    known, index = call.given(0), call.given(1)
    axis = call.axis(call.attribute("axis", 0), len(known.dims))
    where = call.constant(1)
    if known.ints is not None and index.ints is not None and len(known.dims) == 1 and len(where) < 2:
        values = dict(enumerate(known.ints)) | {
            place - len(known.ints): value for place, value in enumerate(known.ints)
        }
        if not set(index.ints) <= set(values):
            raise ValueError("takes values that are not there")
        return _values(Known(where, tuple(values[place] for place in index.ints)))
    return _values(Known(known.dims[:axis] + where + known.dims[axis + 1 :]))


def _shape(call: Call) -> Outcome:
    if call.node.attributes:
        raise ValueError("has start or end, allowed: the whole shape")
    dims = call.given(0).dims
    return _values(Known((len(dims),), dims))


def _constant(call: Call) -> Outcome:
    values = list(call.node.attributes.values())
    if len(values) != 1 or isinstance(values[0], str):
        raise ValueError("has no value, or several")
    if isinstance(values[0], Tensor):
        return _values(known_constant(values[0].values))
    numbers = values[0] if isinstance(values[0], tuple) else (values[0],)
    ints = numbers if all(isinstance(number, int) for number in numbers) else None
    return _values(Known((len(numbers),) if isinstance(values[0], tuple) else (), ints))


def known_constant(values: Any) -> Known:
    """Return what is known of a constant array: its integers too, where they are few enough to be a shape."""
    small = values.dtype.kind == "i" and values.size <= LIST_MAX and values.ndim < 2
    return Known(values.shape, tuple(values.reshape(-1).tolist()) if small else None)


RULES: Mapping[str, Rule] = {
    **dict.fromkeys(
        (
            *("Abs", "Ceil", "Celu", "Clip", "Elu", "Erf", "Exp", "Floor", "Gelu", "HardSigmoid", "HardSwish"),
            *(
                "Identity",
                "LeakyRelu",
                "Log",
                "Mish",
                "Neg",
                "Reciprocal",
                "Relu",
                "Round",
                "Selu",
                "Sigmoid",
                "Softplus",
            ),
            *("Softsign", "Sqrt", "Tanh", "ThresholdedRelu"),
            *("QuantizeLinear", "DequantizeLinear"),
        ),
        _same,
    ),
    **{"BatchNormalization": _batch_norm, "Dropout": _dropout},
    **dict.fromkeys(("Add", "Sub", "Mul", "Div", "Max", "Min", "Pow", "PRelu", "Sum"), _broadcast),
    **{"Gemm": _gemm, "MatMul": _matmul, "MatMulInteger": _matmul, "Conv": _conv, "ConvTranspose": _conv_transpose},
    **dict.fromkeys(("AveragePool", "MaxPool"), _pool),
    **dict.fromkeys(("GlobalAveragePool", "GlobalMaxPool"), _global_pool),
    **{"Softmax": _along_axis(1, -1), "LogSoftmax": _along_axis(1, -1), "LayerNormalization": _along_axis(-1)},
    **dict.fromkeys(("ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum"), _reduce),
    **{"Reshape": _reshape, "Flatten": _flatten, "Unsqueeze": _unsqueeze, "Squeeze": _squeeze, "Transpose": _transpose},
    **{"Concat": _concat, "Slice": _slice, "Gather": _gather, "Shape": _shape, "Constant": _constant, "Cast": _cast},
}
