"""The bytes of an ONNX head in, a checked, quiet, single-threaded onnxruntime session out; onnxruntime is imported only here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import one_line
from pans.base.errors import DamagedFileError

from .onnx_check import MODEL_MAX_BYTES, HeadCost, check_head

HEAD_MAX_BYTES = MODEL_MAX_BYTES
_BATCH_ROWS = 65536
_TRIED_ROWS = 3
# Of the largest score. A quantised head may round another way in another batch; one that mixes rows is off by whole scores.
_MIXING = 0.02
_BATCH_VALUES = 1 << 22  # of intermediate results at once: 16 MiB
_REMEDY = (
    "export the head again: one float32 input (n, patterns), first output float32 (n, classes), weights inside the file, "
    "operators and sizes as docs/reference/formats.md allows them"
)


@dataclass(frozen=True, slots=True, eq=False)
class OnnxHead:
    """A checked session and what one decision costs it."""

    session: Any
    cost: HeadCost
    n_features: int
    n_classes: int

    def scores(self, means: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the scores (n, classes), float32, of click means (n, d_f), float32 in [0, 1]."""
        rows = np.ascontiguousarray(means, dtype=np.float32)
        step = 1 if self.cost.row_by_row else max(1, min(_BATCH_ROWS, _BATCH_VALUES // self.cost.values))
        out = np.empty((len(rows), self.n_classes), dtype=np.float32)
        for start in range(0, len(rows), step):
            out[start : start + step] = self._run(rows[start : start + step])
        return out

    def _run(self, means: NDArray[np.float32]) -> Any:
        return self.session.run([self.cost.output_name], {self.cost.input_name: means})[0]


def open_head(head_onnx: bytes, n_features: int, n_classes: int, where: str) -> OnnxHead:
    """Return a session that maps float32 (n, n_features) to float32 (n, n_classes); DamagedFileError if it does not."""
    try:
        cost = check_head(head_onnx, n_features, n_classes)
    except ValueError as error:
        raise _damaged(where, str(error)) from error
    head = OnnxHead(_session(head_onnx, where), cost, n_features, n_classes)
    _try_out(head, where)
    return head


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
        words = {"providers": ["CPUExecutionProvider"], "enable_fallback": False}
        return onnxruntime.InferenceSession(head_onnx, options, **words)
    except Exception as error:  # onnxruntime raises a dozen unrelated classes
        raise _damaged(where, f"onnxruntime refuses it: {_first_line(error)}") from error


def _try_out(head: OnnxHead, where: str) -> None:
    """Run single rows and, where the batch is free, all together: what only shows when it runs must show here."""
    means = np.random.default_rng(20250104).random((_TRIED_ROWS, head.n_features)).astype(np.float32)
    alone = np.concatenate([_tried(head, row[None], where) for row in means])
    if head.cost.row_by_row:
        return
    together = _tried(head, means, where)
    off, allowed = np.abs(together - alone), _MIXING * np.abs(alone).max()
    if (off > allowed).any():
        row, label = np.unravel_index(int(off.argmax()), off.shape)
        found = (
            f"score {label} of row {row} is {alone[row, label]:.6g} alone and {together[row, label]:.6g} among others"
        )
        raise _damaged(where, f"it mixes rows: {found}, allowed: each row is decided by itself")


def _tried(head: OnnxHead, means: NDArray[np.float32], where: str) -> NDArray[np.float32]:
    """Return the scores of the rows `means`, of the right shape."""
    rows = len(means)
    try:
        found = np.asarray(head._run(means))
    except Exception as error:
        raise _damaged(where, f"onnxruntime cannot run it on {rows} rows: {_first_line(error)}") from error
    if found.shape != (rows, head.n_classes) or found.dtype != np.float32:
        allowed = f"({rows}, {head.n_classes}) float32"
        raise _damaged(where, f"the output for {rows} rows is {found.shape} {found.dtype}, allowed: {allowed}")
    return found


def _first_line(error: Exception) -> str:
    return one_line(str(error).strip().split("\n")[0], 300)


def _damaged(where: str, reason: str) -> DamagedFileError:
    return DamagedFileError(f"{where}: the ONNX head cannot be used: {reason}", remedy=_REMEDY)
