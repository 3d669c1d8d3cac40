"""The back ends that any reader can recompute bit for bit, from docs/reference/formats.md ("The back ends", "The quantised head").

Owns the way from clicks (or sums of photon numbers) per pattern to scores, label and probability. Imports nothing of the package.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from lab_bundle import Bundle
from numpy.typing import NDArray

NO_LABEL = 0xFFFF
ABSTAINED, NOT_FINITE = 8, 64

Counts = NDArray[np.int64]
Scores = Callable[[Counts, int], NDArray[Any]]


def table_scores(bundle: Bundle) -> Scores:
    """Return the back end `table`."""
    table, base = bundle.parts["table"], bundle.largest + 1
    return lambda counts, shots: table[sum(int(count) * base**i for i, count in enumerate(counts))]


def float64_scores(bundle: Bundle) -> Scores:
    """Return the back end `float64`."""
    layers = bundle.layers()

    def scores(counts: Counts, shots: int) -> NDArray[Any]:
        x = counts / np.float64(shots * bundle.largest)
        for weights, bias, relu in layers:
            x = x @ weights.astype(np.float64) + bias.astype(np.float64)
            x = np.maximum(x, 0.0) if relu else x
        return x

    return scores


def int8_scores(bundle: Bundle) -> Scores:
    """Return the back end `int8`."""
    sizes = bundle.parts["int8_sizes"].tolist()
    scale, bias = bundle.parts["int8_affine"]

    def scores(counts: Counts, shots: int) -> NDArray[Any]:
        x, unit, weight_at, at = counts, np.float32(1) / np.float32(shots * bundle.largest), 0, 0
        for n_in, n_out in pairwise(sizes):
            flat = bundle.parts["int8_weights"][weight_at : weight_at + n_in * n_out]
            sums = (x @ flat.reshape(n_in, n_out).astype(np.int64)).astype(np.float32)
            y = sums * (scale[at : at + n_out] * unit) + bias[at : at + n_out]
            x = (np.clip(y, np.float32(0), np.float32(255)) + np.float32(0.5)).astype(np.int64)
            weight_at, at, unit = weight_at + n_in * n_out, at + n_out, np.float32(1)
        return y

    return scores


BACKENDS = {"table": table_scores, "float64": float64_scores, "int8": int8_scores}


def verdict(scores: NDArray[Any]) -> tuple[int, np.float32, int]:
    """Return label, probability and flags of one row of scores."""
    wide = scores.astype(np.float64)
    if np.isnan(wide).any() or np.isinf(wide.max()):
        return NO_LABEL, np.float32(0), NOT_FINITE | ABSTAINED
    label = int(wide.argmax())
    return label, np.float32(1 / np.exp(wide - wide[label]).sum()), 0
