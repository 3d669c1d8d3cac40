"""ONNX Runtime as a back end: one thread, buffers bound once.

Owns the single decision through onnxruntime, for the float head and for the quantised one; never looks into a model (head.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.bundle.head import open_head
from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError

from .verdict import Verdict, checked_counts, demand_golden, softmax_winner

WARM_UP_CALLS = 500


class OnnxDecider:
    """The ONNX head on one thread; a single decision runs through buffers that are bound once."""

    name = "onnx"

    def __init__(self, bundle: Bundle, *, int8: bool = False) -> None:
        import onnxruntime

        self.name = "int8-onnx" if int8 else "onnx"
        model = bundle.int8_onnx if int8 else bundle.head_onnx
        if model is None:
            raise UsageError(f"{bundle.name} has no {'quantised ' if int8 else ''}ONNX head")
        self.choice: Mapping[str, Any] = {}
        self.n_features = bundle.n_features
        self.n_classes = bundle.n_classes
        self._head = open_head(model, bundle.n_features, bundle.n_classes, bundle.name)
        self._input = np.zeros((1, bundle.n_features), dtype=np.float32)
        self._output = np.zeros((1, bundle.n_classes), dtype=np.float32)
        self._means, self._scores = self._input[0], self._output[0]
        self._run = self._head.session.run_with_iobinding
        self._binding = self._head.session.io_binding()
        make = onnxruntime.OrtValue.ortvalue_from_numpy  # on the CPU a view of the array, not a copy
        self._binding.bind_ortvalue_input(self._head.input_name, make(self._input))
        self._binding.bind_ortvalue_output(self._head.output_name, make(self._output))
        if not int8:  # golden scores are the float head's
            self._check_golden(bundle)
        for _ in range(WARM_UP_CALLS):
            self._run(self._binding)

    def _check_golden(self, bundle: Bundle) -> None:
        """Hold the batch path and the bound path against the golden vectors: they are different code in onnxruntime."""
        found = self._head.scores(bundle.golden_means)
        demand_golden(self.name, found, bundle.golden_scores, bundle)
        for row, means in enumerate(bundle.golden_means):
            self._means[:] = means
            self._run(self._binding)
            found[row] = self._scores
        demand_golden(f"{self.name} (single decisions)", found, bundle.golden_scores, bundle)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); the caller answers for 0 <= counts <= shots and shots >= 1."""
        np.divide(counts, np.float32(shots), out=self._means, casting="same_kind", dtype=np.float32)
        self._run(self._binding)
        return softmax_winner(self._scores)

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the head's scores, float32 (n, classes), for click counts (n, d_f)."""
        means = checked_counts(counts, shots, self.n_features).astype(np.float32) / np.float32(shots)
        return self._head.scores(means)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), for click counts (n, d_f)."""
        return self.scores_batch(counts, shots).argmax(axis=1).astype(np.int64)
