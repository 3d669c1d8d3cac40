"""The ONNX head: from the bytes in a bundle to a checked, quiet, single-threaded onnxruntime session.

Owns every check that a stranger's model must pass before it runs; never decides (decide.py) and never reads a file:
models that point at files of their own are refused. `open_head` returns an `OnnxHead`; onnxruntime is imported there and
nowhere earlier.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import DamagedFileError

HEAD_MAX_BYTES = 64 << 20
_BATCH_ROWS = 65536
_NESTING_MAX = 128  # protobuf messages within messages
_REMEDY = (
    "export the head again: one float32 input (n, patterns), first output float32 (n, classes), weights inside the file"
)

# field number -> message kind, for the parts of onnx.proto in which a tensor can stand
_CHILDREN = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "function": {7: "node", 11: "attribute"},
    "tensor": {},
}
_TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION = 13, 14


@dataclass(frozen=True, slots=True, eq=False)
class OnnxHead:
    """A checked session; `row_by_row` when the model has a fixed batch of one."""

    session: Any
    input_name: str
    output_name: str
    n_features: int
    n_classes: int
    row_by_row: bool

    def scores(self, means: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the scores (n, classes), float32, of click means (n, d_f), float32 in [0, 1]."""
        rows = np.ascontiguousarray(means, dtype=np.float32)
        step = 1 if self.row_by_row else _BATCH_ROWS
        out = np.empty((len(rows), self.n_classes), dtype=np.float32)
        for start in range(0, len(rows), step):
            part = rows[start : start + step]
            out[start : start + step] = self.session.run([self.output_name], {self.input_name: part})[0]
        return out


def open_head(head_onnx: bytes, n_features: int, n_classes: int, where: str) -> OnnxHead:
    """Return a session that maps float32 (n, n_features) to float32 (n, n_classes); DamagedFileError if it does not."""
    _refuse_external_data(head_onnx, where)
    session = _session(head_onnx, where)
    try:
        head = _describe(session, n_features, n_classes, where)
    except UnicodeDecodeError as error:
        raise _damaged(where, "a name in it is not UTF-8") from error
    _try_out(head, where)
    return head


def _describe(session: Any, n_features: int, n_classes: int, where: str) -> OnnxHead:
    """Check what the model declares of its inputs and outputs."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1 or not outputs:
        names = ", ".join(_plain(item.name) for item in inputs)
        raise _damaged(
            where, f"{len(inputs)} inputs ({names}) and {len(outputs)} outputs, allowed: one input, an output"
        )
    source, result = inputs[0], outputs[0]
    for item in (source, result):
        if item.type != "tensor(float)":
            raise _damaged(where, f"{_plain(item.name)} is a {item.type}, allowed: tensor(float)")
    shape = list(source.shape)  # an int is fixed; a name or None is free
    fixed = [n if isinstance(n, int) else None for n in shape]
    if len(fixed) != 2 or fixed[0] not in (None, 1) or fixed[1] not in (None, n_features):
        raise _damaged(where, f"the input has the shape {_plain(shape)}, allowed: (n or 1, {n_features})")
    return OnnxHead(session, source.name, result.name, n_features, n_classes, shape[0] == 1)


def _session(head_onnx: bytes, where: str) -> Any:
    import onnxruntime

    onnxruntime.set_default_logger_severity(4)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    try:
        # its own fall-back would try the same again and print about it on stdout, where our JSON belongs
        return onnxruntime.InferenceSession(
            head_onnx, options, providers=["CPUExecutionProvider"], enable_fallback=False
        )
    except Exception as error:  # onnxruntime raises a dozen unrelated classes
        raise _damaged(where, f"onnxruntime refuses it: {_plain(error)}") from error


def _try_out(head: OnnxHead, where: str) -> None:
    """Run one row and, where the batch is free, three: a shape that only shows when it runs must show here."""
    for rows in (1,) if head.row_by_row else (1, 3):
        means = np.zeros((rows, head.n_features), dtype=np.float32)
        try:
            found = np.asarray(head.session.run([head.output_name], {head.input_name: means})[0])
        except Exception as error:
            raise _damaged(where, f"onnxruntime cannot run it on {rows} rows: {_plain(error)}") from error
        if found.shape != (rows, head.n_classes) or found.dtype != np.float32:
            allowed = f"({rows}, {head.n_classes}) float32"
            raise _damaged(where, f"the output for {rows} rows is {found.shape} {found.dtype}, allowed: {allowed}")


def _damaged(where: str, reason: str) -> DamagedFileError:
    return DamagedFileError(f"{where}: the ONNX head cannot be used: {reason}", remedy=_REMEDY)


def _plain(value: Any) -> str:
    """The first line of a foreign text, without control characters: it goes to a terminal."""
    text = str(value).strip().split("\n")[0][:300]
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _refuse_external_data(model: bytes, where: str) -> None:
    """A tensor may name a file that holds its data; a bundle is one file, and a stranger's must not open others."""
    pending: list[tuple[str, memoryview, int]] = [("model", memoryview(model), 0)]
    while pending:
        kind, data, depth = pending.pop()
        if depth > _NESTING_MAX:
            raise _damaged(where, f"messages nested more than {_NESTING_MAX} deep")
        for number, value in protobuf_fields(data, where):
            external = number == _TENSOR_EXTERNAL_DATA or (number == _TENSOR_DATA_LOCATION and value != 0)
            if kind == "tensor" and external:
                raise _damaged(where, "its weights lie in another file (external data)")
            child = _CHILDREN[kind].get(number)
            if child is not None and isinstance(value, memoryview):
                pending.append((child, value, depth + 1))


def protobuf_fields(data: memoryview, where: str) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (field number, value) of one protobuf message; fixed-width values come as their bytes."""
    position = 0
    while position < len(data):
        key, position = _varint(data, position, where)
        wire, number = key & 7, key >> 3
        if wire == 0:
            value, position = _varint(data, position, where)
            yield number, value
            continue
        if wire not in (1, 2, 5):
            raise _damaged(where, f"not an ONNX model (protobuf wire type {wire})")
        length = 8 if wire == 1 else 4
        if wire == 2:
            length, position = _varint(data, position, where)
        if length > len(data) - position:
            raise _damaged(where, "not an ONNX model (a field reaches past its end)")
        yield number, data[position : position + length]
        position += length


def _varint(data: memoryview, position: int, where: str) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(data):
            break
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise _damaged(where, "not an ONNX model (a number never ends)")
