"""What came of a run: `RunResult`, and what its decisions add up to: accuracy with both spreads, clicks, photons, confusion.

Spread over trials: how much the mean accuracy of one pass over the objects varies. Spread over objects: the standard error from
having measured only these objects. `RunTally.figures` returns the figures of the contract.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.base.numbers import GROUPS, LIGHT, DecisionFigures, decision_figures
from pans.decide import DecisionFlag, is_decided
from pans.decide.dark import DarkReport
from pans.decide.kernel import PhotonsOf
from pans.live.timing.ledger import TimingLedger

I64 = npt.NDArray[np.int64]
_AMBIGUOUS = int(DecisionFlag.AMBIGUOUS)
MAX_OBJECTS = 1 << 14  # that may still come back; a run for days sees any number


def _some(values: I64, where: npt.NDArray[np.bool_]) -> I64:
    """Return `values` (n,) where `where` holds; no copy where that is everywhere."""
    return values if where.all() else values[where]


@dataclass(frozen=True, slots=True, kw_only=True)
class TallyFigures(DecisionFigures):
    """What the decisions of a run add up to, with the spread of the accuracy."""

    accuracy_std_trials: float | None
    accuracy_stderr_objects: float | None
    objects: int
    trials: int


@dataclass(slots=True)
class LightSums:
    """Sums over the decisions of a group; photons of those where they are known."""

    n: int = 0
    clicks: int = 0
    photons: float = 0.0
    photons_known: int = 0

    def add(self, more: LightSums) -> None:
        """Add the sums of further decisions."""
        self.n, self.clicks = self.n + more.n, self.clicks + more.clicks
        self.photons, self.photons_known = self.photons + more.photons, self.photons_known + more.photons_known


class RunTally:
    """Sums over decisions; memory is bounded by classes^2 and MAX_OBJECTS.

    `distinct` is after how many objects the first one is shown again, 0: never, or unknown. A standard error counts each object once.
    """

    def __init__(self, n_classes: int, shots: int, distinct: int = 0) -> None:
        self.confusion: npt.NDArray[np.int64] = np.zeros((n_classes, n_classes), np.int64)  # truth x decision
        self.shots = shots
        self.distinct = distinct
        self.of = {name: LightSums() for name in GROUPS}
        self.unsure = 0  # abstained because no class was as sure as was asked for
        self.right = 0  # of those that are judged
        self.exposures = 0  # of walks
        self._trials: npt.NDArray[np.int64] = np.zeros((64, 2), np.int64)  # by window within the visit: decided, right
        self._objects: dict[int, list[int]] = {}  # object -> [decided, right]
        self._past = [0.0, 0.0, 0.0]  # objects that are summed up: how many, accuracies, their squares

    def add_rows(self, rows: npt.NDArray[np.void], photons_of: PhotonsOf) -> None:
        """Count decisions, rows of DECISION_DTYPE (n,), n > 0; `photons_of` gives the photons of one shot on each of some objects."""
        labels, truths, flags = rows["label"].astype(np.int64), rows["truth"].astype(np.int64), rows["flags"]
        numbers, n_classes = rows["object"], len(self.confusion)
        begins = np.append(0, np.flatnonzero(numbers[1:] != numbers[:-1]) + 1)  # of each object
        numbers = numbers[begins].astype(np.int64)
        decided = is_decided(rows)
        judged = decided & (truths.view(np.uint64) < n_classes)  # -1 is a large number, too
        self.unsure += int(np.count_nonzero(~decided & (flags & _AMBIGUOUS != 0)))
        self.exposures += int(rows["exposures"].sum(dtype=np.int64))
        groups = {"decisions": np.ones(len(rows), np.bool_), "decided": decided, "judged": judged}
        self._add_light(rows["clicks"], photons_of(numbers), begins, groups)
        if not judged.any():
            return
        right = judged & (labels == truths)
        seen, well = np.add.reduceat(judged, begins, dtype=np.int64), np.add.reduceat(right, begins, dtype=np.int64)
        self.right += int(well.sum())
        self._add_objects(numbers[seen > 0], seen[seen > 0], well[seen > 0])
        cells, trials = truths * n_classes + labels, rows["shot"].astype(np.int64)
        if self.shots > 1:
            trials //= self.shots
        self.confusion += np.bincount(_some(cells, judged), minlength=n_classes**2).reshape(n_classes, n_classes)
        while trials.max() >= len(self._trials):  # twice as long each time; a visit has at most 2^24 exposures
            self._trials = np.concatenate([self._trials, np.zeros_like(self._trials)])
        self._trials[:, 0] += np.bincount(_some(trials, judged), minlength=len(self._trials))
        self._trials[:, 1] += np.bincount(trials[right], minlength=len(self._trials))

    def _add_light(
        self,
        clicks: npt.NDArray[np.uint32],
        photons: npt.NDArray[np.float32],
        begins: I64,
        groups: dict[str, npt.NDArray[np.bool_]],
    ) -> None:
        """Add clicks (n,) and the photons of the objects that begin at `begins` to each of the groups, bool (n,), the largest first."""
        more, lit = LightSums(), ~np.isnan(photons)
        for name, some in groups.items():
            # mostly all decisions are in every group: then the sums are made once
            if (n := int(np.count_nonzero(some))) != more.n:
                counts = np.add.reduceat(some, begins, dtype=np.int64)[lit]
                light = float((photons[lit] * counts).sum(dtype=np.float64)) * self.shots
                more = LightSums(n, int(clicks[some].sum(dtype=np.int64)), light, int(counts.sum()))
            self.of[name].add(more)

    def _add_objects(self, numbers: I64, decided: I64, right: I64) -> None:
        """Count decisions on objects, and how many of them are right; one that is shown again keeps its number."""
        which = numbers % self.distinct if self.distinct else numbers
        begins = np.append(0, np.flatnonzero(which[1:] != which[:-1]) + 1)
        decided, right = np.add.reduceat(decided, begins), np.add.reduceat(right, begins)
        for index, n_decided, n_right in zip(which[begins].tolist(), decided.tolist(), right.tolist()):
            if index not in self._objects and len(self._objects) >= MAX_OBJECTS:
                self._sum_up(next(iter(self._objects)))
            sums = self._objects.setdefault(index, [0, 0])
            sums[0] += n_decided
            sums[1] += n_right

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
    def decisions(self) -> int:
        """All decisions."""
        return self.of["decisions"].n

    @property
    def abstained(self) -> int:
        """Decisions without a label."""
        return self.decisions - self.of["decided"].n

    @property
    def judged(self) -> int:
        """Decisions with a label and a known true class."""
        return self.of["judged"].n

    def sums(self) -> dict[str, Any]:
        """Return what `decision_figures` needs; cheap enough for each look at a run in progress."""
        found: dict[str, Any] = {"right": self.right} | {name: sums.n for name, sums in self.of.items()}
        return found | {f"{name}_{what}": getattr(sums, what) for name, sums in self.of.items() for what in LIGHT}

    def figures(self) -> TallyFigures:
        """Return accuracy, its spread over trials and over objects, clicks and photons per decision."""
        per_trial = [right / n for n, right in self._trials.tolist() if n]
        return TallyFigures(
            **asdict(decision_figures(self.sums())),
            accuracy_std_trials=float(np.std(per_trial, ddof=1)) if len(per_trial) > 1 else None,
            accuracy_stderr_objects=self._spread_over_objects(),
            objects=self.objects,
            trials=len(per_trial),
        )


@dataclass(slots=True)
class RunResult:
    """Everything a report needs; figures are measured, none is inferred from the configuration."""

    tally: RunTally
    timing: TimingLedger
    dark: DarkReport
    stream: dict[str, int]
    decoder: dict[str, int]
    clock: dict[str, Any]
    realtime: dict[str, Any]
    device: dict[str, Any]
    slot_jitter_us: float
    wrong_patterns: int  # late slots among them
    armed_after_s: float
    seconds: float
    ended: str
    link_lost: bool
    reconnects: int = 0
    late_cause: dict[str, int] = field(default_factory=dict)  # late decisions by who is to blame (causes.CAUSES)
    lost_cause: dict[str, int] = field(default_factory=dict)  # lost exposures
    contradictions: dict[str, int] = field(default_factory=dict)  # messages that are excluded, by what is wrong
    late_slots: int = 0  # that stayed dark because the host named no state in time
    turn_us: dict[str, float | None] = field(default_factory=dict)  # of the host's turns, where it drives
    # exposures of each state
    states_shown: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    decisions_sha256: str = ""
    events: list[dict[str, Any]] = field(default_factory=list)
    page_faults: dict[str, int] = field(default_factory=dict)  # of the loop's thread while armed; its switches too
    exposure_timing: dict[str, Any] = field(default_factory=dict)  # decide.exposure_timing
