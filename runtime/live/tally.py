"""What the decisions of a run add up to: accuracy with both spreads, clicks, photons, confusion.

Owns integer sums, updated per decision; never touches single photons. `RunTally.figures` returns the figures of the contract.
Spread over trials: how much the mean accuracy of one pass over the objects varies. Spread over objects: the standard error from
having measured only these objects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pans.runtime.core.decision import (
    DECISION_DTYPE,
    NO_LABEL,
    Decision,
    DecisionFlag,
    NumberedDecisions,
    RowDecisions,
)

if TYPE_CHECKING:
    from pans.runtime.core.stream_arrays import MarkArrays

_ABSTAINED, _AMBIGUOUS = int(DecisionFlag.ABSTAINED), int(DecisionFlag.AMBIGUOUS)
MAX_OBJECTS = 1 << 14  # that may still come back; a run for days sees any number
RUNS_AT_ONCE = 1 << 13  # decisions in a row on one object
NO_DECISIONS = RowDecisions(np.zeros(0, DECISION_DTYPE))


@dataclass(frozen=True, slots=True)
class TallyFigures:
    """What decisions add up to; None where it is not known. Clicks and photons are per decision."""

    accuracy: float | None
    accuracy_std_trials: float | None
    accuracy_stderr_objects: float | None
    objects: int
    trials: int
    decisions: int
    abstained: int
    clicks_mean: float | None
    photons_mean: float | None


class RunTally:
    """Sums over decisions; memory is bounded by classes^2 and MAX_OBJECTS.

    `distinct` is after how many objects the first one is shown again, 0: never, or unknown. A standard error counts each object once.
    """

    def __init__(self, n_classes: int, shots: int, distinct: int = 0) -> None:
        self.confusion: npt.NDArray[np.int64] = np.zeros((n_classes, n_classes), np.int64)  # truth x decision
        self.shots = shots
        self.distinct = distinct
        self.decisions = 0
        self.abstained = 0
        self.unsure = 0  # of them because no class was as sure as was asked for
        self.known = self.right = 0  # decisions with a known truth, and those of them that are right
        self.clicks = self.exposures = 0  # exposures: of walks
        self.photons = 0.0
        self.photons_known = 0
        self._trials: npt.NDArray[np.int64] = np.zeros((64, 2), np.int64)  # by window within the visit: decided, right
        self._objects: dict[int, list[int]] = {}  # object -> [decided, right]
        self._past = [0.0, 0.0, 0.0]  # objects that are summed up: how many, accuracies, their squares
        self._runs: npt.NDArray[np.int64] = np.zeros((RUNS_AT_ONCE, 3), np.int64)

    def add(self, decision: Decision, photons_per_shot: float) -> None:
        """Count one decision; `photons_per_shot` is NaN where the instrument does not know it."""
        self.decisions += 1
        self.clicks += decision.clicks
        self.exposures += decision.exposures
        if not math.isnan(photons_per_shot):
            self.photons += photons_per_shot * self.shots
            self.photons_known += 1
        if decision.flags & _ABSTAINED or decision.label == NO_LABEL:
            self.abstained += 1
            self.unsure += bool(decision.flags & _AMBIGUOUS)
        if decision.truth < 0 or decision.truth >= len(self.confusion):
            return
        right = int(decision.label == decision.truth)
        self.known += 1
        self.right += right
        if decision.label != NO_LABEL:
            self.confusion[decision.truth, decision.label] += 1
        trial = decision.shot // self.shots
        self._make_room(trial)
        self._trials[trial, 0] += 1
        self._trials[trial, 1] += right
        sums = self._object_sums(self._which(decision))
        sums[0] += 1
        sums[1] += right

    def warm_up(self, marks: MarkArrays, trials: int, like: RowDecisions = NO_DECISIONS) -> None:
        """Compile or load what `add_many` needs for decisions of this kind, and make room for `trials` of an object, before arming."""
        self._make_room(trials - 1)
        self._runs[:] = 0  # touched
        self._add_from(like, 0, marks)

    def add_many(self, decisions: RowDecisions, marks: MarkArrays) -> None:
        """Count many decisions on objects of which `marks` tell; as `add` does for each."""
        first = 0
        while first < len(decisions):
            if isinstance(decisions, NumberedDecisions):
                count, shot, step = (int(decisions.runs[name][first]) for name in ("count", "shot", "shot_step"))
                self._make_room((shot + (count - 1) * step) // self.shots)
            else:
                self._make_room(int(decisions.rows["shot"][first]) // self.shots)
            first = self._add_from(decisions, first, marks)

    def _add_from(self, decisions: RowDecisions, first: int, marks: MarkArrays) -> int:
        """Count decisions from `first` on; return up to where there was room."""
        from pans.runtime.turn import settling as kernels  # numba is loaded only by who counts many at once

        plan, sums, photons = np.array([self.shots, self.distinct]), np.zeros(kernels.N_SUMS, np.int64), np.zeros(1)
        photons[0] = self.photons
        tables = (self.confusion, self._trials, self._runs)
        rest = (first, marks.objects, marks.photons, plan, sums, photons, tables)
        if isinstance(decisions, NumberedDecisions):
            stop, n_runs = kernels.add_numbered((decisions.verdicts, decisions.numbers, decisions.runs), *rest)
        else:
            stop, n_runs = kernels.add_rows(decisions.rows, *rest)
        self._take_sums(stop - first, sums.tolist(), float(photons[0]))
        for number, decided, right in self._runs[:n_runs].tolist():
            mine = self._object_sums(number)
            mine[0] += decided
            mine[1] += right
        return int(stop)

    def _take_sums(self, decisions: int, sums: list[int], photons: float) -> None:
        clicks, exposures, photons_known, abstained, unsure, known, right = sums
        self.decisions += decisions
        self.clicks += clicks
        self.exposures += exposures
        self.photons, self.photons_known = photons, self.photons_known + photons_known
        self.abstained += abstained
        self.unsure += unsure
        self.known += known
        self.right += right

    def _make_room(self, trial: int) -> None:
        """Make the sums of trials long enough for one more, twice as long each time; a visit has at most 2^24 exposures."""
        while trial >= len(self._trials):
            self._trials = np.concatenate([self._trials, np.zeros_like(self._trials)])

    def _which(self, decision: Decision) -> int:
        """Return which object a decision is about: one that is shown again keeps its number."""
        return decision.object % self.distinct if self.distinct else decision.object

    def _object_sums(self, index: int) -> list[int]:
        sums = self._objects.get(index)
        if sums is None:
            if len(self._objects) >= MAX_OBJECTS:
                self._sum_up(next(iter(self._objects)))
            sums = self._objects[index] = [0, 0]
        return sums

    def _sum_up(self, index: int) -> None:
        """Keep of an object only what it adds to the sums; should it come back, it counts as another one."""
        decided, right = self._objects.pop(index)
        for place, value in enumerate((1, right / decided, (right / decided) ** 2)):
            self._past[place] += value

    def _spread_over_objects(self) -> float | None:
        """Standard error of the mean accuracy from having measured only these objects; None below two."""
        here = np.array([right / decided for decided, right in self._objects.values()])
        if not self._past[0]:
            return float(np.std(here, ddof=1) / math.sqrt(len(here))) if len(here) > 1 else None
        n = self._past[0] + len(here)
        mean = (self._past[1] + float(here.sum())) / n
        squares = self._past[2] + float((here**2).sum())
        return math.sqrt(max(squares - n * mean**2, 0.0) / (n - 1) / n)

    @property
    def objects(self) -> int:
        """Distinct objects with a known truth."""
        return int(self._past[0]) + len(self._objects)

    @property
    def accuracy(self) -> float | None:
        """Right decisions over decisions with a known truth (an abstention is not right); None without any."""
        return self.right / self.known if self.known else None

    def figures(self) -> TallyFigures:
        """Return accuracy, its spread over trials and over objects, clicks and photons per decision."""
        per_trial = [right / n for n, right in self._trials.tolist() if n]
        return TallyFigures(
            accuracy=self.accuracy,
            accuracy_std_trials=float(np.std(per_trial, ddof=1)) if len(per_trial) > 1 else None,
            accuracy_stderr_objects=self._spread_over_objects(),
            objects=self.objects,
            trials=len(per_trial),
            decisions=self.decisions,
            abstained=self.abstained,
            clicks_mean=self.clicks / self.decisions if self.decisions else None,
            photons_mean=self.photons / self.photons_known if self.photons_known else None,
        )
