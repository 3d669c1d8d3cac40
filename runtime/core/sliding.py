"""Sliding windows over a continuous stream: after every frame, a decision on the last K.

Owns what lies between pieces of a stream and what a gap does: no window overlaps one, the K - 1 frames after it give NO_LABEL. Never counts
losses (ingest.py) and never decides by itself: tables and scores come from a back end. `push` takes packed frames and returns labels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.decide.table import CountTableDecider, TableDecider
from pans.runtime.errors import UsageError

from . import sliding_kernels as kernels
from .decision import NO_LABEL

WORD_FEATURES_MAX = 16  # of windows that look words up
LANE_SHOTS_MAX = 255  # a byte counts the clicks of a channel
SCORE_COLUMNS = 16
PIECE_FRAMES = 1 << 15  # frames in one call of a kernel: they stay in the cache
SUM_MAX = 1 << 30  # of a window's score, in steps: half of int32

U16 = NDArray[np.uint16]


class _Pieces:
    """Cuts a stream into pieces behind the K frames before them; subclasses label one piece."""

    def __init__(self, shots: int, frame_shape: tuple[int, ...], dtype: Any) -> None:
        if shots < 1:
            raise UsageError(f"shots is {shots}, allowed: 1 or more")
        self.shots = shots
        self._buffer = np.zeros((shots + PIECE_FRAMES, *frame_shape), dtype)
        self._seen = 0  # frames since the start or the last gap, up to `shots`

    def restart(self) -> None:
        """Forget the window: a gap came, or another object."""
        self._buffer[: self.shots] = 0
        self._seen = 0

    def _piece(self, frames: NDArray[Any]) -> NDArray[Any]:
        stop = self.shots + len(frames)
        self._buffer[self.shots : stop] = frames
        return self._buffer[:stop]

    def _keep(self, n: int) -> None:
        self._buffer[: self.shots] = self._buffer[n : n + self.shots].copy()
        self._seen = min(self.shots, self._seen + n)


class _Labels(_Pieces):
    """Windows that give one label per frame."""

    def push(self, words: U16, out: U16 | None = None) -> U16:
        """Take packed frames, uint16 (n,); return the label of the window that ends with each, uint16 (n,), NO_LABEL while it fills."""
        if words.dtype != np.uint16 or words.ndim != 1:
            raise UsageError(f"frames are {words.dtype} {words.shape}, allowed: uint16 (n,)")
        labels = np.empty(len(words), np.uint16) if out is None else out
        for start in range(0, len(words), PIECE_FRAMES):
            part = words[start : start + PIECE_FRAMES]
            result = labels[start : start + PIECE_FRAMES]
            self._label(self._piece(part), result)
            result[: max(0, self.shots - 1 - self._seen)] = NO_LABEL
            self._keep(len(part))
        return labels

    def _label(self, piece: NDArray[Any], out: U16) -> None:
        raise NotImplementedError


class SlidingTable(_Labels):
    """Windows of K frames decided by a table of counts (or of words, K = 1); words must be below 2**d_f."""

    def __init__(self, decider: CountTableDecider | TableDecider, shots: int) -> None:
        super().__init__(shots, (), np.uint16)
        self.labels = np.ascontiguousarray(decider.labels, np.uint16)
        self.parts = byte_parts(decider.radix)
        if len(self.labels) != (shots + 1) ** decider.n_features:
            raise UsageError(f"a table of {len(self.labels)} rows does not answer {shots} shots")
        self._index = 0

    def restart(self) -> None:
        """Forget the window: a gap came, or another object."""
        super().restart()
        self._index = 0

    def _label(self, piece: NDArray[Any], out: U16) -> None:
        self._index = kernels.slide_index(piece, self.shots, self.parts, self._index, self.labels, out)


class SlidingScores(_Labels):
    """Windows of K frames decided by the sum of their frames' class scores, in fixed point."""

    def __init__(self, scores: NDArray[np.floating[Any]], shots: int) -> None:
        """`scores` (2**d_f, classes): evidence of one frame for each class, for example log posteriors (`log_evidence`)."""
        super().__init__(shots, (), np.uint16)
        self.n_classes = scores.shape[1]
        self.table, self.step = fixed_point(scores, shots)
        self._first = np.zeros(self.table.shape[1], np.int32)  # a window of K frames without a click
        self._sums = self._first.copy()
        self.restart()

    def restart(self) -> None:
        """Forget the window: a gap came, or another object."""
        super().restart()
        self._sums[:] = self.table[0] * np.int32(self.shots)

    def _label(self, piece: NDArray[Any], out: U16) -> None:
        kernels.slide_scores(piece, self.shots, self.table, self._sums, self.n_classes, out)


class SlidingCounts(_Pieces):
    """Clicks per channel over the last K <= 255 frames, for any number of channels, given out every `stride` frames."""

    def __init__(self, n_channels: int, shots: int, stride: int = 1) -> None:
        if not 1 <= shots <= LANE_SHOTS_MAX or stride < 1:
            raise UsageError(f"{shots} shots every {stride}, allowed: 1 to {LANE_SHOTS_MAX}, every 1 or more")
        super().__init__(shots, (-(-n_channels // 8),), np.uint8)
        self.n_channels, self.stride = n_channels, stride
        self._lanes = np.zeros(-(-n_channels // 8), np.uint64)
        self._phase = 0

    def restart(self) -> None:
        """Forget the window and the phase: a gap came, or another object."""
        super().restart()
        self._lanes[:] = 0
        self._phase = 0

    def push(self, words: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Take packed frames, uint8 (n, bytes or more); return counts uint8 (m, channels) and which of them are of whole windows."""
        width = self._buffer.shape[1]
        if words.dtype != np.uint8 or words.ndim != 2 or words.shape[1] < width:
            raise UsageError(f"frames are {words.dtype} {words.shape}, allowed: uint8 (n, {width} or more)")
        total = (self._phase + len(words)) // self.stride
        counts = np.empty((total, self.n_channels), np.uint8)
        frames_before = self._seen + self.stride - self._phase  # of the first output, if all were kept
        whole = frames_before + self.stride * np.arange(total) >= self.shots
        row = 0
        for start in range(0, len(words), PIECE_FRAMES):
            piece = self._piece(words[start : start + PIECE_FRAMES, :width])
            n = len(piece) - self.shots
            rows = (self._phase + n) // self.stride
            out = counts[row : row + rows]
            self._phase = kernels.slide_counts(piece, self.shots, self._lanes, self.stride, self._phase, out)
            row += rows
            self._keep(n)
        return counts, whole


class SlidingObjects:
    """Windows of K frames for several objects whose frames come interleaved, decided by a table of counts."""

    def __init__(self, decider: CountTableDecider | TableDecider, shots: int, n_objects: int) -> None:
        self._labels = np.ascontiguousarray(decider.labels, np.uint16)
        self._parts = byte_parts(decider.radix)
        self._rings = np.zeros((n_objects, shots), np.uint16)
        self._state = np.zeros((n_objects, 3), np.int64)

    def restart(self, which: int) -> None:
        """Forget the window of one object: its next K - 1 frames give NO_LABEL."""
        self._state[which] = 0

    def push(self, words: U16, objects: NDArray[np.int32]) -> U16:
        """Take packed frames uint16 (n,) and whose they are, int32 (n,); return the labels, uint16 (n,)."""
        if words.shape != objects.shape or (
            len(objects) and not 0 <= objects.min() <= objects.max() < len(self._state)
        ):
            raise UsageError(
                f"{len(words)} frames of objects beyond 0..{len(self._state) - 1}, or not one object for each"
            )
        out = np.empty(len(words), np.uint16)
        kernels.slide_objects(
            words, objects, self._parts, self._rings, self._state, self._labels, np.uint16(NO_LABEL), out
        )
        return out


def byte_parts(radix: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return what the low and the high byte of a word add to the row of a table, int64 (2, 256); d_f <= 16."""
    if len(radix) > WORD_FEATURES_MAX:
        raise UsageError(f"{len(radix)} patterns, allowed at most {WORD_FEATURES_MAX}", remedy="use SlidingCounts")
    bits = (np.arange(256)[:, None] >> np.arange(8)) & 1
    wide = np.zeros(16, np.int64)
    wide[: len(radix)] = radix
    return np.stack([bits @ wide[:8], bits @ wide[8:]])


def log_evidence(scores: NDArray[np.floating[Any]], floor: float = 1e-6) -> NDArray[np.float64]:
    """Return log posteriors of scores (rows, classes) by a stable log-sum-exp in float64, saturated at log(floor)."""
    wide = scores.astype(np.float64)
    wide -= wide.max(axis=1, keepdims=True)
    logs = wide - np.log(np.exp(wide).sum(axis=1, keepdims=True))
    return np.maximum(logs, math.log(floor))


def fixed_point(scores: NDArray[np.floating[Any]], shots: int) -> tuple[NDArray[np.int32], float]:
    """Return scores as whole steps, int32 (rows, columns padded to 16), and the step; a window's sum is off by at most shots * step / 2."""
    wide = scores.astype(np.float64)
    if not np.isfinite(wide).all():
        raise UsageError("scores are not finite: saturate them first (log_evidence)")
    largest = float(np.abs(wide).max()) or 1.0
    step = 2.0 ** math.ceil(math.log2(largest * shots / SUM_MAX))
    table = np.zeros((len(wide), -(-wide.shape[1] // SCORE_COLUMNS) * SCORE_COLUMNS), np.int32)
    table[:, : wide.shape[1]] = np.rint(wide / step)
    return table, step
