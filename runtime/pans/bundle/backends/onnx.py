"""ONNX Runtime as a back end: click counts in; a class out, by buffers that are bound once, or a picture."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.errors import UsageError
from pans.bundle.heads.head import open_head
from pans.bundle.sensor.facts import Bundle

from .verdict import ScoredDecider, Verdict, Verdicts, demand_golden, softmax_winner

WARM_UP_CALLS = 500  # of a few microseconds each
WARM_UP_S = 0.5  # or as many as fit into this: the slowest head that is allowed takes about 0.05 s
TABLE_WORK_MAX = 1 << 33  # multiply-adds, about a second
TABLE_SCORES_MAX = 1 << 23  # 32 MiB
PICTURE_WARM_UP_CALLS = 20  # heads of pictures are far larger


class OnnxDecider(ScoredDecider):
    """The ONNX head on one thread, the float one or the quantised one; a single decision runs through buffers that are bound once."""

    def __init__(self, bundle: Bundle, *, int8: bool = False) -> None:
        import onnxruntime

        super().__init__(bundle)
        self.name = "int8-onnx" if int8 else "onnx"
        model = bundle.int8_onnx if int8 else bundle.head_onnx
        if model is None:
            raise UsageError(f"{bundle.name} has no {'quantised ' if int8 else ''}ONNX head")
        self._head = open_head(model, bundle.n_features, bundle.n_classes, bundle.name)
        self.operations = self._head.cost.operations
        inputs, scores = np.zeros((1, self.n_features), np.float32), np.zeros((1, self.n_classes), np.float32)
        self._means, self._out = inputs[0], scores[0]
        self._run, self._binding = self._head.session.run_with_iobinding, self._head.session.io_binding()
        make = onnxruntime.OrtValue.ortvalue_from_numpy  # on the CPU a view of the array, not a copy
        self._binding.bind_ortvalue_input(self._head.cost.input_name, make(inputs))
        self._binding.bind_ortvalue_output(self._head.cost.output_name, make(scores))
        if not int8:  # golden scores are the float head's
            self._check_golden(bundle)
        until = time.perf_counter() + WARM_UP_S
        for _ in range(WARM_UP_CALLS):
            self._run(self._binding)
            if time.perf_counter() > until:
                break

    def affords(self, rows: int) -> bool:
        """Whether a table of the scores of `rows` click vectors is made within a second or so, and is small."""
        return rows * self.operations <= TABLE_WORK_MAX and rows * self.n_classes <= TABLE_SCORES_MAX

    def _check_golden(self, bundle: Bundle) -> None:
        """Hold the batch path and the bound path against the golden vectors: they are different code in onnxruntime."""
        found = self._head.scores(bundle.golden_means)
        demand_golden(self.name, found, bundle.golden_scores, bundle)
        for row, means in enumerate(bundle.golden_means):
            self._means[:] = means
            self._run(self._binding)
            found[row] = self._out
        demand_golden(f"{self.name} (single decisions)", found, bundle.golden_scores, bundle)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); the caller answers for 0 <= counts <= shots * largest and shots >= 1."""
        np.divide(counts, np.float32(shots * self.largest), out=self._means, casting="same_kind", dtype=np.float32)
        self._run(self._binding)
        return softmax_winner(self._out)

    def _scores(self, counts: NDArray[np.int64], exposures: int) -> NDArray[np.float32]:
        return self._head.scores(counts.astype(np.float32) / np.float32(exposures))


class PictureDecider(ScoredDecider):
    """The ONNX head of a picture bundle on one thread; `n_classes` is 0, for there is no class to be right about.

    To the core it is a `Decider`: its verdict is label 0, "a picture was given back", with probability 1, or 0 where pixels are not
    finite, so that the core abstains. The picture is not in the decision log: it follows from the recorded clicks (record/pictures.py).
    """

    name = "onnx"

    def __init__(self, bundle: Bundle) -> None:
        if bundle.picture_shape is None or bundle.head_onnx is None:
            raise UsageError(f"{bundle.name} decides among classes, it returns no pictures")
        super().__init__(bundle)
        self.choice = {"chosen": self.name, "why": "pictures come from the head alone"}
        self.picture_shape = bundle.picture_shape
        self._head = open_head(bundle.head_onnx, bundle.n_features, bundle.n_outputs, bundle.name)
        demand_golden(self.name, self._head.scores(bundle.golden_means), bundle.golden_scores, bundle)
        for _ in range(PICTURE_WARM_UP_CALLS):
            self.decide(np.zeros(self.n_features, np.int64), 1)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Give back the picture of clicks per pattern, int64 (d_f,), and say whether it is one; `picture` holds it until the next."""
        self.picture = self._scores(counts[None], shots)[0].reshape(self.picture_shape)
        return Verdict(0, float(np.isfinite(self.picture).all()))

    def pictures(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return pictures cut to [0, 1], float32 (n, height, width), of click counts (n, d_f)."""
        return self.scores_batch(counts, shots).clip(0.0, 1.0).reshape(-1, *self.picture_shape)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return label 0, int64 (n,), for click counts (n, d_f)."""
        return np.zeros(len(np.asarray(counts)), np.int64)

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Return label 0 and probability 1, or 0 where the pixels are not finite, for click counts, int64 (n, d_f)."""
        whole = np.asarray(np.isfinite(self._scores(counts, shots)).all(axis=1), np.float32)
        return Verdicts(np.zeros(len(counts), np.uint16), whole)

    def _scores(self, counts: NDArray[np.int64], exposures: int) -> NDArray[np.float32]:
        return self._head.scores(counts.astype(np.float32) / np.float32(exposures))
