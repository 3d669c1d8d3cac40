"""Heads that give back a picture: the back end whose answer is no class.

Owns the picture of one object or of many, by onnxruntime; never measures how good it is (picture.py). To the core it is a `Decider`: its
verdict is label 0, "a picture was given back", with probability 1, or 0 where pixels are not finite, so that the core abstains. The picture
itself is not in the decision log: it follows from the recorded clicks (`picture.pictures_of`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.bundle.head import open_head
from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError

from .verdict import Verdict, Verdicts, checked_counts, demand_golden

WARM_UP_CALLS = 20


class PictureDecider:
    """The ONNX head of a picture bundle on one thread; `n_classes` is 0, for there is no class to be right about."""

    name = "onnx"
    n_classes = 0

    def __init__(self, bundle: Bundle) -> None:
        if bundle.picture_shape is None or bundle.head_onnx is None:
            raise UsageError(f"{bundle.name} decides among classes, it gives back no pictures")
        self.choice: Mapping[str, Any] = {"chosen": self.name, "why": "pictures come from the head alone"}
        self.n_features = bundle.n_features
        self.picture_shape = bundle.picture_shape
        self._head = open_head(bundle.head_onnx, bundle.n_features, bundle.n_outputs, bundle.name)
        demand_golden(self.name, self._head.scores(bundle.golden_means), bundle.golden_scores, bundle)
        for _ in range(WARM_UP_CALLS):
            self.decide(np.zeros(self.n_features, np.int64), 1)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Give back the picture of clicks per pattern, int64 (d_f,), and say whether it is one; `picture` holds it until the next."""
        self.picture = self._pixels(counts[None], shots)[0].reshape(self.picture_shape)
        return Verdict(0, float(np.isfinite(self.picture).all()))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the pixels as the head gives them, float32 (n, height * width), of click counts (n, d_f)."""
        return self._pixels(checked_counts(counts, shots, self.n_features), shots)

    def pictures(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return pictures cut to [0, 1], float32 (n, height, width), of click counts (n, d_f)."""
        return self.scores_batch(counts, shots).clip(0.0, 1.0).reshape(-1, *self.picture_shape)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return label 0 for each of click counts (n, d_f)."""
        return self.verdicts(checked_counts(counts, shots, self.n_features), shots).labels.astype(np.int64)

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Return label 0 and probability 1, or 0 where the pixels are not finite, for click counts, int64 (n, d_f)."""
        whole = np.asarray(np.isfinite(self._pixels(counts, shots)).all(axis=1), np.float32)
        return Verdicts(np.zeros(len(counts), np.uint16), whole)

    def _pixels(self, counts: NDArray[np.int64], shots: int) -> NDArray[np.float32]:
        return self._head.scores(counts.astype(np.float32) / np.float32(shots))
