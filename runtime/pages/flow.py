"""The sections on objects that passed by: what they were worth, what became of pulses, what was late and why.

Figures come from a replay of the recorded messages, so that a recording that was cut, or one part of a longer one, has them too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.flow.matching import abort_reason
from pans.runtime.record import Recording
from pans.runtime.record.recording import together
from pans.runtime.report.words import flow_rows

from .charts import Axis, Bars, Chart, seconds
from .page import CONFUSION_MAX, Page

BINS = 60
EVENTS_AT_ONCE = 1 << 16  # late decisions and verdicts that are held
I64 = NDArray[np.int64]


def is_flow(recording: Recording) -> bool:
    """Whether objects passed by in this run."""
    return "flow" in recording.header.get("config", {})


def add_passages(page: Page, recording: Recording, bundle: Bundle | None) -> None:
    """Add what the decisions about passing objects were worth, and what became of them and of their pulses over time."""
    page.heading("Objects that passed by")
    if bundle is None:
        page.text("The bundle is not in the recording: its decisions cannot be matched with what passed.", "note")
        return
    from pans.runtime.record.replaying import replayed_flow

    figures, confusion = replayed_flow(recording, bundle)
    pulses = _pulses(recording, bundle)
    page.table(flow_rows(figures, {name: len(numbers) for name, numbers in pulses.items()}))
    if "part" in recording.header:
        page.text(
            "This is one part of a run: objects whose truth came in the part before count as without one.", "note"
        )
    if confusion.any() and len(bundle.classes) <= CONFUSION_MAX:
        caption = (
            f"{int(confusion.sum())} decisions about objects alone, without those that abstained; true class in rows."
        )
        page.confusion(confusion, bundle.classes, caption)
    if recording.n_decisions:
        span = _span_of(recording)
        edges_s = span.edges_s(int(recording.header["config"]["tick_hz"]))
        page.figure(
            _stacked(edges_s, "decisions", _outcomes(recording, span)),
            "Decisions by what became of them, over the run.",
        )
        made = {name: _counted(span.bins(numbers)) for name, numbers in pulses.items() if name != "asked"}
        if made := {name: counts for name, counts in made.items() if counts.any()}:
            caption = "Pulses over the run. A pulse without a refusal counts as made."
            page.figure(_stacked(edges_s, "pulses", made), caption)


def _stacked(edges_s: NDArray[np.float64], what: str, rows: Mapping[str, I64]) -> Chart:
    """Counts per bin over time, one kind upon the other."""
    base, bars = np.zeros(len(edges_s) - 1), []
    for (name, counts), kind in zip(sorted(rows.items(), key=lambda row: -int(row[1].sum()))[:4], "abcd"):
        bars.append(Bars(edges_s, counts, base.copy(), f"{name} ({int(counts.sum())})", kind))
        base += counts
    return Chart(
        label=f"{what} over the run: " + ", ".join(f"{name} {int(counts.sum())}" for name, counts in rows.items()),
        x=Axis("time since the first decision", float(edges_s[0]), float(edges_s[-1]), text=seconds),
        y=Axis(f"{what} per {edges_s[1] - edges_s[0]:.3g} s", 0.0, 1.05 * max(float(base.max()), 1.0)),
        bars=bars,
    )


def add_late(page: Page, recording: Recording) -> None:
    """Add who is to blame for late decisions and lost exposures, with the evidence in words; nothing where all was on time."""
    late, lost, first_case = Counter[str](), Counter[str](), dict[str, str]()
    for event in recording.events():
        if event.get("kind") != "blame":
            continue
        cause = str(event.get("cause", "?"))
        if event.get("what") == "late":
            late[cause] += int(event.get("decisions", 1))
        else:
            lost[cause] += int(event.get("exposures", 1))
        first_case.setdefault(cause, str(event.get("why", "")))
    if not late and not lost:
        return
    page.heading("Late and missing work, by cause")
    rows = [(cause, late[cause], lost[cause]) for cause, _ in (late + lost).most_common()]
    page.table(rows, ("cause", "late decisions", "lost exposures"))
    if late and recording.n_decisions:
        span = _span_of(recording)
        edges_s = span.edges_s(int(recording.header["config"]["tick_hz"]))
        page.figure(
            _stacked(edges_s, "late decisions", _late_rows(recording, span)),
            "Late decisions over the run, by the cause that the evidence names.",
        )
    page.table(
        [(cause, first_case[cause]) for cause, _ in (late + lost).most_common() if first_case.get(cause)],
        ("cause", "its first case"),
    )


def _pulses(recording: Recording, bundle: Bundle) -> dict[str, I64]:
    """Numbers of the decisions whose pulses were asked for, made, refused and expired."""
    gated = [
        bundle.classes.index(name)
        for name in recording.header["config"]["flow"]["settings"].get("gate_classes", ())
        if name in bundle.classes
    ]
    rows = (rows["index"][np.isin(rows["label"], gated)] for rows in together(recording.iter_decisions()))
    asked = np.concatenate([np.zeros(0, np.int64), *rows]).astype(np.int64)
    failed: dict[str, list[int]] = {"gate_refused": [], "gate_expired": []}
    for event in recording.events():
        if event.get("kind") in failed and "decision" in event:
            failed[str(event["kind"])].append(int(event["decision"]))
    refused, expired = (np.intersect1d(asked, numbers) for numbers in failed.values())
    made = np.setdiff1d(asked, np.concatenate([refused, expired]))
    return {"asked": asked, "done": made, "refused": refused, "expired": expired}


def _outcomes(recording: Recording, span: Span) -> dict[str, I64]:
    """Decisions by bin and outcome: with a label, or why not."""
    found: dict[str, I64] = {}
    for rows in together(recording.iter_decisions()):
        bins = span.bins(rows["index"].astype(np.int64))
        for flag in np.unique(rows["flags"]).tolist():
            name = abort_reason(flag) or "with a label"
            found[name] = found.get(name, 0) + _counted(bins[rows["flags"] == flag])
    return dict(sorted(found.items(), reverse=True))


def _late_rows(recording: Recording, span: Span) -> dict[str, I64]:
    """Late decisions by bin and cause: those between the first and the last of each verdict, which comes behind them."""
    rows: dict[str, I64] = {}
    late = np.zeros(0, np.int64)
    more, verdicts, n_verdicts = list[int](), dict[str, list[tuple[int, int]]](), 0
    for event in recording.events():
        if event.get("kind") == "late":
            more.append(int(event["decision"]))
        elif event.get("kind") == "blame" and event.get("what") == "late":
            ends = int(event.get("first_decision", 0)), int(event.get("last_decision", -1)) + 1
            verdicts.setdefault(str(event["cause"]), []).append(ends)
            n_verdicts += 1
        if len(more) + n_verdicts >= EVENTS_AT_ONCE:
            late = _count_late(np.append(late, more), verdicts, span, rows)[-EVENTS_AT_ONCE:]
            more, verdicts, n_verdicts = [], {}, 0
    _count_late(np.append(late, more), verdicts, span, rows)
    return dict(sorted(rows.items()))


def _count_late(late: I64, verdicts: Mapping[str, list[tuple[int, int]]], span: Span, rows: dict[str, I64]) -> I64:
    """Add the decisions of `late` that `verdicts` are about to `rows`; return those of which nothing has been said yet."""
    late = np.sort(late.astype(np.int64))
    bins, open_ones = span.bins(late), np.ones(len(late), np.bool_)
    for cause, ends in verdicts.items():
        begins, stops = np.searchsorted(late, np.array(ends, np.int64)).T
        change = np.zeros(len(late) + 1, np.int64)
        np.add.at(change, begins, 1)
        np.add.at(change, np.maximum(begins, stops), -1)
        times = np.cumsum(change)[:-1]
        rows[cause] = rows.get(cause, 0) + _counted(bins, times)
        open_ones &= times == 0
    return late[open_ones]


class Span(NamedTuple):
    """The device time of a run's decisions in BINS stretches: the numbers of decisions at which another stretch begins."""

    first_tick: int
    last_tick: int
    numbers: I64  # the last one is behind all decisions
    stretch: I64  # -1 behind all decisions

    def bins(self, numbers: I64) -> I64:
        """Return the stretch of each decision, -1 of one that there is not."""
        at = np.searchsorted(self.numbers, numbers, "right") - 1
        return np.where(at < 0, -1, self.stretch[at])

    def edges_s(self, tick_hz: int) -> NDArray[np.float64]:
        """Return the ends of the stretches."""
        return np.linspace(0.0, max((self.last_tick - self.first_tick) / tick_hz, 1e-6), BINS + 1)


def _span_of(recording: Recording) -> Span:
    """Return the stretches of `recording`, which has decisions."""
    first, last = 1 << 64, 0
    for rows in together(recording.iter_decisions()):
        first, last = min(first, int(rows["tick"].min())), max(last, int(rows["tick"].max()))
    numbers, stretch, number, before = list[I64](), list[I64](), 0, -1
    for rows in together(recording.iter_decisions()):
        places = (rows["tick"] - np.uint64(first)).astype(np.float64) * BINS / max(last - first, 1)
        bins = np.minimum(places.astype(np.int64), BINS - 1)
        changes = np.flatnonzero(np.diff(bins, prepend=before))
        number = int(rows["index"][0])
        numbers.append(number + changes)
        stretch.append(bins[changes])
        number, before = number + len(rows), int(bins[-1])
    return Span(first, last, np.append(np.concatenate(numbers), number), np.append(np.concatenate(stretch), -1))


def _counted(bins: I64, times: I64 | None = None) -> I64:
    """How many decisions are in each stretch, each counted so many times."""
    known = bins >= 0
    return np.bincount(bins[known], None if times is None else times[known], BINS).astype(np.int64)
