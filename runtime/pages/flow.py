"""The report page's part on objects that passed by: what they were worth, what became of pulses, what was late and why.

Owns the sums behind these sections; the order of the page is run.py's. Figures come from a replay of
the recorded messages, so that a recording that was cut, or one part of a longer one, has them too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.flow.matching import abort_reason
from pans.runtime.record import Recording
from pans.runtime.report.words import flow_rows

from .charts import Axis, Bars, Chart, seconds
from .page import CONFUSION_MAX, Page

BINS = 60
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
    decisions = recording.decisions()
    if len(decisions):
        edges_s = _edges_s(decisions, int(recording.header["config"]["tick_hz"]))
        page.figure(
            _stacked(edges_s, "decisions", _outcomes(decisions)), "Decisions by what became of them, over the run."
        )
        made = _spread(decisions, {name: numbers for name, numbers in pulses.items() if name != "asked"})
        if made:
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
    late, lost, words = Counter[str](), Counter[str](), []
    for event in recording.events():
        if event.get("kind") != "blame":
            continue
        cause = str(event.get("cause", "?"))
        if event.get("what") == "late":
            late[cause] += int(event.get("decisions", 1))
        else:
            lost[cause] += int(event.get("exposures", 1))
        words.append((cause, str(event.get("why", ""))))
    if not late and not lost:
        return
    page.heading("Late and missing work, by cause")
    rows = [(cause, late[cause], lost[cause]) for cause, _ in (late + lost).most_common()]
    page.table(rows, ("cause", "late decisions", "lost exposures"))
    if late:
        decisions = recording.decisions()
        by_cause = _late_numbers(recording)
        if len(decisions):
            edges_s = _edges_s(decisions, int(recording.header["config"]["tick_hz"]))
            page.figure(
                _stacked(edges_s, "late decisions", _spread(decisions, by_cause)),
                "Late decisions over the run, by the cause that the evidence names.",
            )
    shown = dict(reversed(words))  # the first of each cause
    page.table(
        [(cause, shown[cause]) for cause, _ in (late + lost).most_common() if shown.get(cause)],
        ("cause", "its first case"),
    )


def _pulses(recording: Recording, bundle: Bundle) -> dict[str, I64]:
    """Numbers of the decisions whose pulses were asked for, made, refused and expired."""
    gated = [
        bundle.classes.index(name)
        for name in recording.header["config"]["flow"]["settings"].get("gate_classes", ())
        if name in bundle.classes
    ]
    decisions = recording.decisions()
    asked = decisions["index"][np.isin(decisions["label"], gated)].astype(np.int64)
    failed: dict[str, list[int]] = {"gate_refused": [], "gate_expired": []}
    for event in recording.events():
        if event.get("kind") in failed and "decision" in event:
            failed[str(event["kind"])].append(int(event["decision"]))
    refused, expired = (np.intersect1d(asked, numbers) for numbers in failed.values())
    made = np.setdiff1d(asked, np.concatenate([refused, expired]))
    return {"asked": asked, "done": made, "refused": refused, "expired": expired}


def _outcomes(decisions: NDArray[np.void]) -> dict[str, I64]:
    """Decisions by bin and outcome: with a label, or why not."""
    flags, which = np.unique(decisions["flags"], return_inverse=True)
    names = np.array([abort_reason(int(flag)) or "with a label" for flag in flags])[which]
    return _spread(
        decisions, {str(name): decisions["index"][names == name] for name in sorted(set(names.tolist()), reverse=True)}
    )


def _late_numbers(recording: Recording) -> dict[str, I64]:
    """Numbers of the late decisions by cause: those between the first and the last of each verdict."""
    late = np.array([int(event["decision"]) for event in recording.events() if event.get("kind") == "late"], np.int64)
    numbers: dict[str, list[I64]] = {}
    for event in recording.events():
        if event.get("kind") == "blame" and event.get("what") == "late":
            first, last = int(event.get("first_decision", 0)), int(event.get("last_decision", -1))
            numbers.setdefault(str(event["cause"]), []).append(late[(late >= first) & (late <= last)])
    return {cause: np.concatenate(found) for cause, found in sorted(numbers.items())}


def _edges_s(decisions: NDArray[np.void], tick_hz: int) -> NDArray[np.float64]:
    seconds = (decisions["tick"] - decisions["tick"].min()).astype(np.float64) / tick_hz
    return np.linspace(0.0, max(float(seconds.max()), 1e-6), BINS + 1)


def _spread(decisions: NDArray[np.void], numbers: Mapping[str, Any]) -> dict[str, I64]:
    """Count decisions, given by their numbers, in BINS equal stretches of device time."""
    first = int(decisions["index"][0])
    ticks = (decisions["tick"] - decisions["tick"].min()).astype(np.float64)
    bins = np.minimum((ticks * BINS / max(float(ticks.max()), 1.0)).astype(np.int64), BINS - 1)
    rows = {}
    for name, found in numbers.items():
        places = np.asarray(found, np.int64) - first
        places = places[(places >= 0) & (places < len(bins))]
        if len(places):
            rows[name] = np.bincount(bins[places], minlength=BINS)
    return rows
