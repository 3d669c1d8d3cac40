"""What an ONNX operator gives that computes: the shape of its output and what it costs, from the shapes of its inputs.

Owns what is known of a tensor, and the rules; those that only move values stand in onnx_layout.py. Never runs an operator and never
sees weights, except integers that stand for shapes. The first size of a tensor that depends on the clicks is ROWS: how many there are is
not known here, and no operator may mix rows, so that every cost is one per row. What a rule lets through may still be refused by
onnxruntime; no rule may give less than onnxruntime takes. Rules: the operator list of ONNX (https://onnx.ai/onnx/operators/), operator
sets 7 and later.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any, NamedTuple

from .onnx_file import FLOAT, INT8, INT32, INT64, UINT8, Node

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


def values_of(known: Known) -> Outcome:
    """Return the outcome of an operator that computes each value of its output by itself."""
    return Outcome(known, VALUE_OPERATIONS * per_row(known.dims))


def _same(call: Call) -> Outcome:
    return values_of(Known(call.given(0).dims))


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
    return values_of(Known(tuple(reversed(sizes))))


def _cast(call: Call) -> Outcome:
    wanted, known = call.attribute("to", 0), call.given(0)
    if wanted not in (FLOAT, UINT8, INT8, INT32, INT64):
        raise ValueError(f"gives data type {wanted}, allowed: float, (u)int8, int32, int64")
    return values_of(Known(known.dims, known.ints if wanted in (INT32, INT64) else None))


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
        return values_of(Known(dims))

    return rule


VALUE_RULES: Mapping[str, Rule] = {
    "Cast": _cast,
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
}
