"""ONNX operators that move, join, cut or sum values, and the list of all allowed operators.

Owns the rules of these operators and `outcome_of`; the rules of operators that compute stand in onnx_shapes.py. Rows stay first: no
operator here may move, cut or sum along them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from .onnx_file import Node, Tensor
from .onnx_protobuf import LIST_MAX
from .onnx_shapes import ROWS, VALUE_OPERATIONS, VALUE_RULES, Call, Known, Outcome, Rule, per_row, shape_text, values_of


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
    return values_of(Known(output))


def _flatten(call: Call) -> Outcome:
    dims, axis = call.given(0).dims, call.attribute("axis", 1)
    axis += len(dims) if axis < 0 else 0
    if not 0 <= axis <= len(dims) or (ROWS in dims and axis != 1):
        raise ValueError("mixes the rows, allowed: axis 1")
    return values_of(Known((ROWS if ROWS in dims else math.prod(dims[:axis]), math.prod(dims[axis:]))))


def _unsqueeze(call: Call) -> Outcome:
    known, axes = call.given(0), call.integers("axes", 1) or ()
    rank = len(known.dims) + len(axes)
    places = {call.axis(axis, rank) for axis in axes}
    if len(places) != len(axes):
        raise ValueError("names an axis twice")
    left = iter(known.dims)
    return values_of(Known(tuple(1 if axis in places else next(left) for axis in range(rank)), known.ints))


def _squeeze(call: Call) -> Outcome:
    known, axes = call.given(0), call.integers("axes", 1)
    if not axes:
        raise ValueError("names no axes")
    gone = {call.axis(axis, len(known.dims)) for axis in axes}
    if any(known.dims[axis] != 1 for axis in gone):
        raise ValueError(f"takes axes {axes} from {shape_text(known.dims)}, allowed: those of size 1")
    return values_of(Known(tuple(size for axis, size in enumerate(known.dims) if axis not in gone), known.ints))


def _transpose(call: Call) -> Outcome:
    dims = call.given(0).dims
    order = call.attribute("perm", tuple(reversed(range(len(dims)))))
    if sorted(order) != list(range(len(dims))) or (ROWS in dims and order[0] != 0):
        raise ValueError(f"has the order {order!s:.60}, allowed: rows stay first")
    return values_of(Known(tuple(dims[axis] for axis in order)))


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
    return values_of(Known((*first[:axis], size, *first[axis + 1 :]), ints))


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
    return values_of(Known(tuple(dims), ints))


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
        return values_of(Known(where, tuple(values[place] for place in index.ints)))
    return values_of(Known(known.dims[:axis] + where + known.dims[axis + 1 :]))


def _shape(call: Call) -> Outcome:
    if call.node.attributes:
        raise ValueError("has start or end, allowed: the whole shape")
    dims = call.given(0).dims
    return values_of(Known((len(dims),), dims))


def _constant(call: Call) -> Outcome:
    values = list(call.node.attributes.values())
    if len(values) != 1 or isinstance(values[0], str):
        raise ValueError("has no value, or several")
    if isinstance(values[0], Tensor):
        return values_of(known_constant(values[0].values))
    numbers = values[0] if isinstance(values[0], tuple) else (values[0],)
    ints = numbers if all(isinstance(number, int) for number in numbers) else None
    return values_of(Known((len(numbers),) if isinstance(values[0], tuple) else (), ints))


def known_constant(values: Any) -> Known:
    """Return what is known of a constant array: its integers too, where they are few enough to be a shape."""
    small = values.dtype.kind == "i" and values.size <= LIST_MAX and values.ndim < 2
    return Known(values.shape, tuple(values.reshape(-1).tolist()) if small else None)


RULES: Mapping[str, Rule] = {
    **VALUE_RULES,
    **dict.fromkeys(("ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum"), _reduce),
    **{"Reshape": _reshape, "Flatten": _flatten, "Unsqueeze": _unsqueeze, "Squeeze": _squeeze, "Transpose": _transpose},
    **{"Concat": _concat, "Slice": _slice, "Gather": _gather, "Shape": _shape, "Constant": _constant},
}
