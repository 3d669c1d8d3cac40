"""Rows of scores in, labels and probabilities out; and what the back ends share: their protocol, their checks, the golden vectors.

Scores that are not finite give probability 0.0, which no finite scores can give: the caller must not use their label.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.errors import DamagedFileError
from pans.bundle.automaton import Automaton, DoseCap
from pans.bundle.sensor.facts import Bundle, golden_violation

NO_LABEL = 0xFFFF  # the label of a decision that abstained
_CHUNK_ROWS = 65536


class Verdict(NamedTuple):
    """A label and the probability of its class; probability 0.0 says that the scores were not finite.

    The label `NO_LABEL` says that no class was as sure as was asked for; the probability is that of the surest.
    """

    label: int
    probability: float


class Verdicts(NamedTuple):
    """Labels uint16 (n,) and probabilities float32 (n,), 0.0 where the scores were not finite."""

    labels: NDArray[np.uint16]
    probabilities: NDArray[np.float32]


class LookUp(NamedTuple):
    """Every answer of a back end: the label and the probability of each row.

    The row is the sum of counts * `radix`, int64 (d_f,); of an automaton it is the leaf, and `radix` is 0.
    """

    labels: NDArray[Any]
    probabilities: NDArray[np.float32]
    radix: NDArray[np.int64]


class Decider(Protocol):
    """One back end, ready to answer; ties go to the lowest label. A back end inherits what it does not have of its own."""

    name: str  # by which it is asked for (backends.backend_names, without `auto`)
    n_features: int  # patterns, d_f
    n_classes: int
    largest: int = 1  # photon number of one exposure
    choice: Mapping[str, Any] = MappingProxyType(
        {}
    )  # how it was chosen, for the record; empty where it was asked for by name
    automaton: Automaton | None = None  # that chooses the patterns, stopped early where that was asked for
    dose: DoseCap | None = None  # at which its walks end
    look_up: LookUp | None = None  # by which kernels decide without a call

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide one object from its clicks per pattern, int64 (d_f,), 0..shots, over `shots` shots."""

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the scores, float32 (n, classes), of click counts, integers (n, d_f)."""

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), of click counts, integers (n, d_f)."""

    def verdicts(self, counts: NDArray[Any], shots: int) -> Verdicts:
        """Decide many objects, integers (n, d_f), each as `decide` would decide it alone where the back end can."""
        return softmax_winners(self.scores_batch(counts, shots))


def softmax_winner(scores: NDArray[np.floating[Any]]) -> Verdict:
    """Return label and probability of one row of scores (classes,) by a stable log-sum-exp in float64."""
    wide = scores.astype(np.float64)
    label = int(wide.argmax())
    best = float(wide[label])
    if not math.isfinite(best):  # argmax finds a NaN first
        return Verdict(label, 0.0)
    return Verdict(label, 1.0 / float(np.exp(wide - best).sum()))  # the winner itself adds 1


def softmax_winners(scores: NDArray[np.floating[Any]]) -> Verdicts:
    """Return labels and probabilities of rows of scores (n, classes), in pieces so that float64 copies stay small."""
    labels = np.empty(len(scores), np.uint16)
    probabilities = np.empty(len(scores), np.float32)
    for start in range(0, len(scores), _CHUNK_ROWS):
        wide = scores[start : start + _CHUNK_ROWS].astype(np.float64)
        labels[start : start + _CHUNK_ROWS] = wide.argmax(axis=1)
        best = wide.max(axis=1, keepdims=True)
        finite = np.isfinite(best[:, 0])
        wide -= np.where(np.isfinite(best), best, 0.0)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            probabilities[start : start + _CHUNK_ROWS] = np.where(finite, 1.0 / np.exp(wide).sum(axis=1), 0.0)
    return Verdicts(labels, probabilities)


def log_evidence(scores: NDArray[np.floating[Any]], floor: float = 1e-6) -> NDArray[np.float64]:
    """Return log posteriors of scores (rows, classes) by a stable log-sum-exp in float64, saturated at log(floor)."""
    wide = scores.astype(np.float64)
    wide -= wide.max(axis=1, keepdims=True)
    logs = wide - np.log(np.exp(wide).sum(axis=1, keepdims=True))
    return np.maximum(logs, math.log(floor))


def checked_counts(counts: ArrayLike, most: int, n_features: int) -> NDArray[np.int64]:
    """Return click counts as int64 (n, d_f); ValueError for another shape or type, or a count beyond 0..`most`."""
    values = np.asarray(counts)
    if values.ndim != 2 or values.shape[1] != n_features or not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"counts are {values.dtype} {values.shape}, allowed: integers (n, {n_features})")
    if most < 1:
        raise ValueError(f"shots is {most}, allowed: 1 or more")
    if values.size and (int(values.min()) < 0 or int(values.max()) > most):
        raise ValueError(f"counts run from {values.min()} to {values.max()}, allowed: 0 to {most}")
    return values.astype(np.int64)


class ScoredDecider(Decider):
    """What back ends share that score many objects at once; a subclass has `_scores`, and perhaps a faster `decide`.

    Where the detector counts photons up to `largest`, one exposure of a number up to L is L exposures that can click.
    """

    name = ""

    def __init__(self, bundle: Bundle) -> None:
        self.n_features, self.n_classes, self.largest = bundle.n_features, bundle.n_classes, bundle.largest

    def _scores(self, counts: NDArray[np.int64], exposures: int) -> NDArray[np.floating[Any]]:
        """Scores (n, classes) of counts (n, d_f), each of 0 to `exposures`."""
        raise NotImplementedError

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); the caller answers for 0 <= counts <= shots * largest and shots >= 1."""
        return softmax_winner(self._scores(counts[None], shots * self.largest)[0])

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the scores, float32 (n, classes), of click counts, integers (n, d_f)."""
        checked = checked_counts(counts, shots * self.largest, self.n_features)
        return self._scores(checked, shots * self.largest).astype(np.float32, copy=False)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), of click counts, integers (n, d_f)."""
        checked = checked_counts(counts, shots * self.largest, self.n_features)
        return self._scores(checked, shots * self.largest).argmax(axis=1)

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Return labels and probabilities of click counts, int64 (n, d_f), that are known to be 0..shots * largest."""
        return softmax_winners(self._scores(counts, shots * self.largest))


def demand_golden(name: str, found: NDArray[np.float32], golden: NDArray[np.float32], bundle: Bundle) -> None:
    """Raise DamagedFileError when a back end's scores differ from the golden ones of the bundle."""
    difference = golden_violation(found, golden, decides=bundle.picture_shape is None)
    if difference:
        what = f"{bundle.name}: the back end {name} contradicts the golden vectors of the bundle: {difference}"
        remedy = "export the bundle again, or check the onnxruntime installation of this machine"
        raise DamagedFileError(what, remedy=remedy)
