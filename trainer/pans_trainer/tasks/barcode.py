"""OUR sampling of the task `barcode`: does a window of ten bars contain the sequence 1010?

Only 1024 strings exist: `all_strings` returns every string with its label, `weights` the probability of each by one of three priors
(docs/reference/tasks.md; the paper, appendix "Barcode 1010 identification", does not say how its strings were drawn), `draw` a sample as
uint8 images (1, 10): bright bars are 255, dark bars 0. The number of bright bars tells nothing beyond the prior where all strings are
equally likely (best decision on it: 65.1 %, as without any light), and 57.5 % where the classes are. With `balanced`, three patterns were
not found to reach the paper's 69.4 % (exact_search.py: 68.4 %), with the other two they were.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draw import Labels, random_stream

N_BARS = 10
CLASSES = ("without 1010", "with 1010")
TARGET = (1, 0, 1, 0)
PRIORS = ("uniform", "balanced", "inserted")


def all_strings() -> tuple[NDArray[np.uint8], Labels]:
    """Return every string, uint8 (1024, 10) of 0 and 1, and its label int64 (1024,); bar 0 is the highest bit of the row index."""
    bars = (np.arange(1 << N_BARS)[:, None] >> np.arange(N_BARS - 1, -1, -1) & 1).astype(np.uint8)
    return bars, (occurrences(bars) > 0).astype(np.int64)


def occurrences(bars: NDArray[np.uint8]) -> Labels:
    """Return how often 1010 stands in each row of `bars` (n, 10), int64 (n,)."""
    windows = np.lib.stride_tricks.sliding_window_view(bars, len(TARGET), axis=1)
    return (windows == np.array(TARGET)).all(axis=2).sum(axis=1).astype(np.int64)


def weights(prior: str = "uniform") -> NDArray[np.float64]:
    """Return the probability of each of the 1024 strings, float64, sum 1; ValueError for an unknown prior."""
    if prior not in PRIORS:
        raise ValueError(f"barcode prior {prior!r}, allowed: {', '.join(PRIORS)}")
    bars, labels = all_strings()
    if prior == "uniform":
        return np.full(len(bars), 1 / len(bars))
    share = np.where(labels == 1, occurrences(bars) if prior == "inserted" else 1, 0).astype(np.float64)
    return 0.5 * share / share.sum() + 0.5 * (labels == 0) / (labels == 0).sum()


def draw(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` strings drawn with replacement, uint8 (n, 1, 10) of 0 and 255, and int64 (n,) (OUR sampling)."""
    bars, labels = all_strings()
    chosen = np.searchsorted(np.cumsum(weights()), random_stream(seed, "barcode-uniform", part, 0).random(n))
    chosen = np.minimum(chosen, len(bars) - 1)
    return (bars[chosen] * np.uint8(255))[:, None, :], labels[chosen]
