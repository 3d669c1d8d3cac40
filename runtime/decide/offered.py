"""A back end of another package: checked before a run, and given the calls that it need not have.

Owns the checks of its facts and answers; never holds it against the golden vectors, for it may decide by other means than the head.
"""

from __future__ import annotations

import math
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError
from pans.runtime.guests import load_guest, package_of

from .verdict import Verdict, Verdicts, checked_counts

TRIED = 64  # clicks tried before a run: enough to meet a wrong shape or range, few enough to cost nothing
CLICKS_SEED = 20250103
_LEAST = 1e-12  # of a probability, so that a score is finite


class OfferedDecider:
    """What `point` makes for `bundle`, as a `Decider`; every answer of it is checked."""

    def __init__(self, point: EntryPoint, bundle: Bundle, shots: int) -> None:
        self.name, self.n_features, self.n_classes = point.name, bundle.n_features, len(bundle.classes)
        self._whose = f"back end {point.name!r} of {package_of(point)}"
        make = load_guest(point)
        try:
            self._guest = make(bundle)
        except Exception as error:
            raise UsageError(f"{self._whose} cannot be made: {type(error).__name__}: {error}") from error
        wanted = {"name": self.name, "n_features": self.n_features, "n_classes": self.n_classes}
        for member, value in wanted.items():
            found = getattr(self._guest, member, None)
            if found != value:
                raise UsageError(
                    f"{self._whose}: its {member} is {found!r}, must be {value!r}",
                    remedy="take the name of the entry point, and the numbers of patterns and classes of the bundle",
                )
        for row in np.random.default_rng(CLICKS_SEED).integers(0, shots + 1, size=(TRIED, self.n_features)):
            self.decide(row, shots)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide one object; UsageError for an answer that is none, and for an error of the back end."""
        try:
            label, probability = self._guest.decide(counts, shots)
        except Exception as error:
            raise UsageError(
                f"{self._whose} fails on the clicks {counts.tolist()}: {type(error).__name__}: {error}",
                remedy="test it on these clicks, or run with another --backend",
            ) from error
        if not (0 <= label < self.n_classes and 0.0 <= probability <= 1.0):
            raise UsageError(
                f"{self._whose} answers {(label, probability)} to the clicks {counts.tolist()}",
                remedy=f"allowed: a label in 0..{self.n_classes - 1} and a probability in 0..1",
            )
        return Verdict(int(label), float(probability))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return scores, float32 (n, classes), whose softmax gives the label its probability and the others equal shares."""
        verdicts = [self.decide(row, shots) for row in checked_counts(counts, shots, self.n_features)]
        scores = np.empty((len(verdicts), self.n_classes), np.float32)
        for row, (label, probability) in zip(scores, verdicts):
            row[:] = math.log(max((1.0 - probability) / max(self.n_classes - 1, 1), _LEAST))
            row[label] = math.log(max(probability, _LEAST))
        return scores

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), of click counts, integers (n, d_f)."""
        rows = checked_counts(counts, shots, self.n_features)
        return np.array([self.decide(row, shots).label for row in rows], np.int64)

    def verdicts(self, counts: NDArray[Any], shots: int) -> Verdicts:
        """Return labels and probabilities of many objects, each decided alone."""
        found = [self.decide(row, shots) for row in checked_counts(counts, shots, self.n_features)]
        return Verdicts(
            np.array([v.label for v in found], np.uint16), np.array([v.probability for v in found], np.float32)
        )
