"""Photon numbers as a back end takes them: an exposure that can say 0 to L is L exposures that can click.

Owns that sentence, and no other: a head, a table or a guest is told counts of 0 to K times L over K times L shots, where its caller has
numbers of K shots. Never checks a number (table.py, verdict.py) and never decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .verdict import Decider, Verdict, Verdicts, choice_of, verdicts_of


class PhotonDecider:
    """`inner` for exposures that are photon numbers of 0 to `largest`."""

    def __init__(self, inner: Decider, largest: int) -> None:
        self._inner, self.largest = inner, largest
        self.name, self.n_features, self.n_classes = inner.name, inner.n_features, inner.n_classes

    @property
    def choice(self) -> Mapping[str, Any]:
        """How the back end was chosen, as `choice_of` tells."""
        return choice_of(self._inner)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from the sums of numbers over `shots` exposures of each pattern, int64 (d_f,)."""
        return self._inner.decide(counts, shots * self.largest)

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the scores, float32 (n, classes), of such sums, integers (n, d_f)."""
        return self._inner.scores_batch(counts, shots * self.largest)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), of such sums, integers (n, d_f)."""
        return self._inner.decide_batch(counts, shots * self.largest)

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Return labels and probabilities of such sums, int64 (n, d_f)."""
        return verdicts_of(self._inner, counts, shots * self.largest)
