"""What the decisions of a run add up to: accuracy with both spreads, clicks, photons, confusion.

Owns integer sums, updated per decision; never touches single photons. `RunTally.summary` returns the figures of the contract.
Spread over trials: how much the mean accuracy of one pass over the objects varies. Spread over objects: the standard error from
having measured only these objects.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from .core import NO_LABEL, Decision
from .record import DecisionFlag

MAX_OBJECTS = 1 << 20


class RunTally:
    """Sums over decisions; memory is bounded by classes^2 and MAX_OBJECTS."""

    def __init__(self, n_classes: int, shots: int) -> None:
        self.confusion: npt.NDArray[np.int64] = np.zeros((n_classes, n_classes), np.int64)  # truth x decision
        self.shots = shots
        self.decisions = 0
        self.abstained = 0
        self.clicks = 0
        self.photons = 0.0
        self.photons_known = 0
        self._trials: dict[int, list[int]] = {}  # window within the visit -> [decided, right]
        self._objects: dict[int, list[int]] = {}  # object -> [decided, right]

    def add(self, decision: Decision, photons_per_shot: float) -> None:
        """Count one decision; `photons_per_shot` is NaN where the instrument does not know it."""
        self.decisions += 1
        self.clicks += decision.clicks
        if not math.isnan(photons_per_shot):
            self.photons += photons_per_shot * self.shots
            self.photons_known += 1
        if decision.flags & DecisionFlag.ABSTAINED or decision.label == NO_LABEL:
            self.abstained += 1
        if decision.truth < 0 or decision.truth >= len(self.confusion):
            return
        right = int(decision.label == decision.truth)
        if decision.label != NO_LABEL:
            self.confusion[decision.truth, decision.label] += 1
        trial = decision.shot // self.shots
        for sums in (self._trials.setdefault(trial, [0, 0]), self._object_sums(decision.object)):
            sums[0] += 1
            sums[1] += right

    def _object_sums(self, index: int) -> list[int]:
        if index not in self._objects and len(self._objects) >= MAX_OBJECTS:
            return [0, 0]
        return self._objects.setdefault(index, [0, 0])

    @property
    def objects(self) -> int:
        """Distinct objects with a known truth."""
        return len(self._objects)

    @property
    def accuracy(self) -> float | None:
        """Right decisions over decisions with a known truth (an abstention is not right); None without any."""
        total = sum(n for n, _ in self._trials.values())
        return sum(right for _, right in self._trials.values()) / total if total else None

    def summary(self) -> dict[str, Any]:
        """Return accuracy, its spread over trials and over objects, clicks and photons per decision."""
        per_trial = [right / n for n, right in self._trials.values() if n]
        per_object = [right / n for n, right in self._objects.values() if n]
        return {
            "accuracy": self.accuracy,
            "accuracy_std_trials": float(np.std(per_trial, ddof=1)) if len(per_trial) > 1 else None,
            "accuracy_stderr_objects": (
                float(np.std(per_object, ddof=1) / math.sqrt(len(per_object))) if len(per_object) > 1 else None
            ),
            "objects": self.objects,
            "trials": len(self._trials),
            "decisions": self.decisions,
            "abstained": self.abstained,
            "clicks_mean": self.clicks / self.decisions if self.decisions else None,
            "photons_mean": self.photons / self.photons_known if self.photons_known else None,
        }
