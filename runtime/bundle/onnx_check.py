"""May this ONNX head run at all? Answered from its bytes, before any session is made.

Owns the bounds on what a head costs; never runs one. `check_head` reads the graph, follows the shapes through its operators and adds up
what one decision costs. A head that passes has no loop, no branch and no size that depends on a value: its time and memory are those
stated here, whatever its weights are. docs/reference/formats.md states the same bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

from .onnx_file import FLOAT, Model, Value, read_model
from .onnx_layout import known_constant, outcome_of
from .onnx_shapes import ROWS, Known, per_row, shape_text

OPSETS = (7, 30)  # operators before 7 broadcast by attributes; what onnxruntime does not know it refuses itself
OPERATIONS_MAX = 1 << 27  # multiply-adds per decision, about 0.05 s on one core
VALUES_MAX = 1 << 22  # of all intermediate results and workspace per decision: 16 MiB of float32


@dataclass(frozen=True, slots=True)
class HeadCost:
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
    source = _source(model, n_features)
    known = {name: known_constant(values) for name, values in model.tensors.items()}
    known[source.name] = Known((ROWS, n_features))
    operations, values = 0, n_features
    for node in model.nodes:
        for name in node.inputs:
            if name and name not in known:
                raise ValueError(f"the operator {node.op} reads {name!a:.60} before it is made")
        outcome = outcome_of(node, [known[name] if name else None for name in node.inputs], model.opset)
        if node.outputs[0] in known:
            raise ValueError(f"two values have the name {node.outputs[0]!a:.60}")
        known[node.outputs[0]] = outcome.output
        operations += outcome.operations
        values += per_row(outcome.output.dims) + outcome.workspace
        if operations > OPERATIONS_MAX or values > VALUES_MAX:
            found = f"{operations} multiply-adds and {values} intermediate values per decision"
            raise ValueError(f"{found} at {node.op}, allowed: {OPERATIONS_MAX} and {VALUES_MAX}")
    _demand_output(model.outputs[0], known, n_outputs)
    fixed = source.shape is not None and source.shape[0] == 1
    return HeadCost(source.name, model.outputs[0].name, fixed, operations, values)


def _source(model: Model, n_features: int) -> Value:
    """Return the one input, after checking what the model declares of its ends."""
    if len(model.inputs) != 1 or not model.outputs:
        names = ", ".join(f"{value.name!a:.40}" for value in model.inputs[:5])
        found = f"{len(model.inputs)} inputs ({names}) and {len(model.outputs)} outputs"
        raise ValueError(f"{found}, allowed: one input, an output")
    source = model.inputs[0]
    for value in (source, model.outputs[0]):
        if value.dtype != FLOAT:
            raise ValueError(f"{value.name!a:.60} is of data type {value.dtype}, allowed: tensor(float)")
    shape = source.shape or ()
    if len(shape) != 2 or shape[0] not in (None, 1) or shape[1] not in (None, n_features):
        found = ", ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"the input has the shape ({found:.80}), allowed: (n or 1, {n_features})")
    return source


def _demand_output(result: Value, known: dict[str, Known], n_outputs: int) -> None:
    found = known.get(result.name)
    if found is None:
        raise ValueError(f"the output {result.name!a:.60} is made by no operator")
    if found.dims != (ROWS, n_outputs):
        raise ValueError(f"the output has the shape {shape_text(found.dims)}, allowed: (n, {n_outputs})")
