"""What the decisions about passing objects were worth: they are matched with the MARKs that tell the truth, afterwards.

`PassageMatcher.figures` returns the figures with 95 % Wilson intervals. Memory is bounded: a mark is settled when no
decision can reach it any more.

A mark's object is in the field from `half_exposures` before its centre to as many after it. Two marks whose times in the field overlap
are in coincidence: they are counted apart, since no instrument could tell them from one.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pans.base.numbers import wilson_interval
from pans.bundle.backends import NO_LABEL
from pans.decide.decision import Decision, DecisionFlag, Passage
from pans.protocol.wire import Mark

MAX_REMEMBERED_PULSES = 1 << 16  # whose fate may still change
MAX_GAPS = 4096
_ABSTAINED, _COINCIDENCE = int(DecisionFlag.ABSTAINED), int(DecisionFlag.COINCIDENCE)
COUNTED = (
    *("decisions", "marks", "alone", "missed", "doubled", "coincident", "coincident_aborted", "coincident_labelled"),
    *("in_gaps", "cut_off", "without_mark", "targets", "pulses", "pulses_on_target", "pulses_pure"),
)
REASONS = (  # the first that applies names an abort
    (int(DecisionFlag.GAP), "gap"),
    (int(DecisionFlag.INCOMPLETE), "incomplete"),
    (int(DecisionFlag.COINCIDENCE), "coincidence"),
    (int(DecisionFlag.AMBIGUOUS), "ambiguous"),
    (int(DecisionFlag.NOT_FINITE), "not finite"),
    (int(DecisionFlag.DARK_ALARM), "dark counts"),
)


def abort_reason(flags: int) -> str:
    """Return why a decision abstained, "" if it did not."""
    if not flags & _ABSTAINED:
        return ""
    return next((name for flag, name in REASONS if flags & flag), "other")


class _Row(NamedTuple):
    """A decision that waits for its mark."""

    decision: Decision
    passage: Passage
    gated: bool


class Share(NamedTuple):
    """A share with its 95 % Wilson interval; None where there is nothing to take it of."""

    value: float | None
    interval: list[float] | None


def share(n: int, of: int) -> Share:
    """Return `n` of `of`."""
    return Share(n / of, list(wilson_interval(n, of))) if of else Share(None, None)


@dataclass(frozen=True, slots=True)
class PassageFigures:
    """What the decisions about passing objects were worth; means are per decision, None where there is nothing."""

    accuracy: Share
    accuracy_labelled: Share
    missed: Share
    doubled: Share
    yield_: Share
    purity: Share
    aborted: dict[str, int]
    passages: dict[str, int]
    clicks_mean: float | None
    photons_mean: float | None
    passage_clicks_mean: float | None
    passage_photons_mean: float | None
    centre_offset_exposures: dict[str, float | None]
    judged: int  # decisions with a label about objects alone
    photons_known: int  # decisions of which `photons_mean` is
    figures_of: dict[str, str]  # key -> "alone": decisions about objects alone, aborted ones too; "decisions": all

    def as_json(self) -> dict[str, Any]:
        """Return the figures under the contract's keys; a share is two of them."""
        facts: dict[str, Any] = {}
        for field in fields(self):
            key, value = field.name.rstrip("_"), getattr(self, field.name)
            facts |= {key: value.value, f"{key}_ci": value.interval} if isinstance(value, Share) else {key: value}
        return facts


class PassageMatcher:
    """Matches decisions with marks while both come; `lag` exposures after leaving the field, nothing more can come."""

    def __init__(self, n_classes: int, gated: frozenset[int], lag: int, *, touching: bool = False) -> None:
        """`touching`: objects follow each other without a space, as bars do, and that is no coincidence."""
        self.confusion: npt.NDArray[np.int64] = np.zeros((n_classes, n_classes), np.int64)  # truth x decision
        self.counts: Counter[str] = Counter()
        self.aborted: Counter[str] = Counter()  # all decisions
        self._gated = gated
        self._lag, self._touching = lag, touching
        self._seen = 0  # exposures of the stream so far
        self._marks: deque[Mark] = deque()
        self._rows: deque[_Row] = deque()
        self._gaps: deque[tuple[int, int]] = deque(maxlen=MAX_GAPS)
        self._left_field = -1  # last exposure of the marks settled so far
        self._photons = 0.0
        # of pulses counted as done: decision -> (its truth is a target, alone)
        self._pulses: dict[int, tuple[bool, bool]] = {}
        self._undone: set[int] = set()  # decisions whose pulse did not happen, not settled yet

    # -- what comes ----------------------------------------------------------------------------------------------------

    def add_mark(self, mark: Mark) -> None:
        """Take a mark, in the order of the stream."""
        self._marks.append(mark)

    def forget_marks(self, before: int) -> None:
        """Marks centred before exposure `before` are none of this matcher's: a part of a recording begins here."""
        self._marks = deque(mark for mark in self._marks if mark.exposure_index >= before)

    def add_decision(self, decision: Decision, passage: Passage, gated: bool) -> None:
        """Take a decision, in the order of the log."""
        counts = self.counts
        counts["decisions"] += 1
        counts["clicks"] += decision.clicks
        counts["passage_clicks"] += passage.clicks
        if decision.flags & _ABSTAINED:
            self.aborted[abort_reason(decision.flags)] += 1
        self._rows.append(_Row(decision, passage, gated))

    def add_gap(self, first: int, stop: int) -> None:
        """Exposures `first`..`stop` - 1 never came."""
        self._gaps.append((first, stop))

    def undo(self, number: int) -> None:
        """The pulse that decision `number` asked for did not happen (refused, or too late to send)."""
        known = self._pulses.pop(number, None)
        if known is None:
            self._undone.add(number)
        else:
            self._count_pulse(known, -1)

    def settle(self, next_exposure: int) -> None:
        """Match what can no longer change, `next_exposure` being the next one of the stream."""
        self._seen = next_exposure
        marks = self._marks
        while marks and marks[0].exposure_index + marks[0].half_exposures + self._lag < next_exposure:
            mark = marks.popleft()
            self._settle_mark(mark, marks[0] if marks else None)
        if not marks:  # an instrument that knows no truth, or an empty field
            self._drop_rows(next_exposure - 2 * self._lag)

    def finish(self) -> None:
        """The stream has ended: match all that is left; what was still in the field is cut off, and counted as that."""
        while self._marks:
            mark = self._marks.popleft()
            if until_field(mark) < self._seen:
                self._settle_mark(mark, self._marks[0] if self._marks else None)
            else:
                self.counts["cut_off"] += 1
                self._rows = deque(
                    row for row in self._rows if row.passage.centre < mark.exposure_index - mark.half_exposures
                )
        self._drop_rows(1 << 62)
        self._gaps.clear()
        self._left_field = -1

    # -- one mark ------------------------------------------------------------------------------------------------------

    def _drop_rows(self, before: int) -> None:
        while self._rows and self._rows[0].passage.centre < before:
            row = self._rows.popleft()
            self.counts["without_mark"] += 1
            if row.gated:
                self._pulse(row, False, False)

    def _settle_mark(self, mark: Mark, following: Mark | None) -> None:
        centre, half = mark.exposure_index, mark.half_exposures
        self._drop_rows(centre - half)
        until = centre + half
        if following is not None:
            until = min(until, (centre + following.exposure_index) // 2)
        mine = []
        while self._rows and self._rows[0].passage.centre <= until:
            mine.append(self._rows.popleft())
        overlaps = following is not None and following.exposure_index - following.half_exposures < until_field(mark)
        coincident = (overlaps or centre - half < self._left_field) and not self._touching
        self._left_field = max(self._left_field, centre + half)
        in_gap = any(first <= centre + half and stop > centre - half for first, stop in self._gaps)
        counts = self.counts
        counts["marks"] += 1
        target = mark.truth in self._gated
        counts["targets"] += target
        for row in mine:
            if row.gated:
                self._pulse(row, target, not coincident)
        if in_gap:
            counts["in_gaps"] += 1
        elif coincident:
            counts["coincident"] += 1
            counts["coincident_aborted"] += any(row.decision.flags & _COINCIDENCE for row in mine)
            counts["coincident_labelled"] += any(row.decision.label != NO_LABEL for row in mine)
        else:
            self._settle_alone(mark, mine)

    def _settle_alone(self, mark: Mark, mine: list[_Row]) -> None:
        counts = self.counts
        counts["alone"] += 1
        if not mine:
            counts["missed"] += 1
            return
        counts["doubled"] += len(mine) > 1
        decision, passage, _ = mine[0]
        offset = passage.centre - mark.exposure_index
        self._photons += mark.photons
        counts["alone_clicks"] += decision.clicks
        counts["alone_passage_clicks"] += passage.clicks
        counts["offset"] += offset
        counts["offset_squared"] += offset**2
        if decision.label == NO_LABEL:
            counts["alone_aborted"] += 1
        elif 0 <= mark.truth < len(self.confusion):
            self.confusion[mark.truth, decision.label] += 1

    # -- pulses --------------------------------------------------------------------------------------------------------

    def _pulse(self, row: _Row, target: bool, alone: bool) -> None:
        number = row.decision.number
        if number in self._undone:
            self._undone.discard(number)
            return
        self._pulses[number] = (target, alone)
        if len(self._pulses) > MAX_REMEMBERED_PULSES:
            del self._pulses[next(iter(self._pulses))]
        self._count_pulse((target, alone), 1)

    def _count_pulse(self, what: tuple[bool, bool], by: int) -> None:
        self.counts["pulses"] += by
        self.counts["pulses_on_target"] += by * what[0]
        self.counts["pulses_pure"] += by * (what[0] and what[1])

    # -- what came of it -----------------------------------------------------------------------------------------------

    def figures(self, frames: int) -> PassageFigures:
        """Return the figures; `frames` exposures are a decision. Shares are None where there is nothing."""
        counts = self.counts
        decided = int(self.confusion.sum()) + counts["alone_aborted"]
        right = int(np.trace(self.confusion))
        seen = counts["alone"] - counts["missed"]
        photons = self._photons * frames / seen if seen else None
        gain = counts["alone_passage_clicks"] / counts["alone_clicks"] if counts["alone_clicks"] else None
        mean = counts["offset"] / seen if seen else 0.0
        light = ("clicks_mean", "photons_mean", "illumination")
        return PassageFigures(
            accuracy=share(right, decided),
            accuracy_labelled=share(right, int(self.confusion.sum())),
            missed=share(counts["missed"], counts["alone"]),
            doubled=share(counts["doubled"], counts["alone"]),
            # of an object that was decided twice both pulses count: never more than all
            yield_=share(min(counts["pulses_on_target"], counts["targets"]), counts["targets"]),
            purity=share(counts["pulses_pure"], counts["pulses"]),
            aborted=dict(sorted(self.aborted.items())),
            passages={name: counts[name] for name in COUNTED},
            clicks_mean=counts["alone_clicks"] / seen if seen else _ratio(counts["clicks"], counts["decisions"]),
            photons_mean=photons,
            passage_clicks_mean=_ratio(counts["passage_clicks"], counts["decisions"]),
            passage_photons_mean=None if photons is None or gain is None else photons * gain,
            centre_offset_exposures={
                "mean": mean if seen else None,
                "std": max(0.0, counts["offset_squared"] / seen - mean**2) ** 0.5 if seen else None,
            },
            judged=int(self.confusion.sum()),
            photons_known=0 if photons is None else seen,
            figures_of={"accuracy": "alone", **dict.fromkeys(light, "alone" if seen else "decisions")},
        )


def until_field(mark: Mark) -> int:
    """The exposure at which the mark's object has left the field."""
    return mark.exposure_index + mark.half_exposures


def _ratio(n: int, of: int) -> float | None:
    return n / of if of else None
