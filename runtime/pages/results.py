"""The page's part on decisions about still objects: accuracy over time, and truth against decision.

Owns the sums per stretch of time, from the decision log; the figures of the whole run are the summary's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.intervals import wilson_interval

from .charts import Axis, Chart, Curve, Mark, percent, seconds
from .page import CONFUSION_MAX, Page

BINS = 60
OBJECTS_PER_BIN = 20
F64 = NDArray[np.float64]


class AccuracyBins(NamedTuple):
    """Middle of each stretch (seconds since the first decision), accuracy, the ends of its 95 % interval, distinct objects."""

    seconds: F64
    accuracy: F64
    low: F64
    high: F64
    objects: NDArray[np.int64]


def accuracy_bins(decisions: NDArray[np.void], tick_hz: float) -> AccuracyBins:
    """Cut the decisions with a known truth into stretches of equal number; the interval (Wilson) counts distinct objects."""
    known = decisions[decisions["truth"] >= 0]
    n_objects = len(np.unique(known["object"]))
    bins = int(np.clip(n_objects // OBJECTS_PER_BIN, 1, BINS))
    rows = []
    for part in np.array_split(known, bins):
        if not len(part):
            continue
        share = float((part["label"] == part["truth"]).mean())
        objects = len(np.unique(part["object"]))
        low, high = wilson_interval(round(share * objects), objects)
        middle = (int(part["tick"][0]) + int(part["tick"][-1])) / 2 - int(decisions["tick"][0])
        rows.append((max(middle, 0.0) / tick_hz, share, min(low, share), max(high, share), objects))
    columns = np.array(rows, np.float64).reshape(-1, 5).T
    return AccuracyBins(columns[0], columns[1], columns[2], columns[3], columns[4].astype(np.int64))


def add_results(page: Page, decisions: NDArray[np.void], bundle: Bundle | None, header: Mapping[str, Any]) -> None:
    """Add accuracy over time, and truth against decision."""
    if bundle is None or bundle.n_classes < 2:
        return
    if not (decisions["truth"] >= 0).any():
        page.text("The true classes are not in the decision log: accuracy is not known.", "note")
        return
    bins = accuracy_bins(decisions, float(header["config"]["tick_hz"]))
    if len(bins.seconds) > 1:
        page.heading("Accuracy over time")
        known = decisions[decisions["truth"] >= 0]
        mean = float((known["label"] == known["truth"]).mean())
        page.figure(
            accuracy_chart(bins, mean, bundle.n_classes),
            f"Share of right decisions in {len(bins.seconds)} stretches of the run with their 95 % intervals (Wilson, by distinct objects: "
            f"{int(bins.objects.min())} to {int(bins.objects.max())} in a stretch).",
        )
    _add_confusion(page, decisions, bundle)


def accuracy_chart(bins: AccuracyBins, mean: float, n_classes: int) -> Chart:
    """Return accuracy over time with its interval, the mean, and what a guess would give."""
    marks = [Mark(mean, f"whole run {100 * mean:.1f} %")]
    if abs(mean - 1 / n_classes) > 0.08:
        marks.append(Mark(1 / n_classes, "a guess"))
    return Chart(
        label=f"Accuracy over the run, {100 * mean:.1f} % on average",
        x=Axis("time since the first decision", 0.0, max(float(bins.seconds[-1]), 1e-9), text=seconds),
        y=Axis("accuracy", 0.0, 1.0, text=percent),
        curves=[Curve(bins.seconds, bins.accuracy, low=bins.low, high=bins.high)],
        marks=marks,
    )


def _add_confusion(page: Page, decisions: NDArray[np.void], bundle: Bundle) -> None:
    if bundle.n_classes > CONFUSION_MAX:
        page.text(f"{bundle.n_classes} classes are too many for a table of truth against decision.", "note")
        return
    decided = decisions[(decisions["flags"] & int(DecisionFlag.ABSTAINED)) == 0]
    known = decided[(decided["truth"] >= 0) & (decided["truth"] < bundle.n_classes) & (decided["label"] != NO_LABEL)]
    counts = np.zeros((bundle.n_classes, bundle.n_classes), np.int64)
    np.add.at(counts, (known["truth"], known["label"]), 1)
    page.heading("Decisions by class")
    caption = f"{len(known)} decisions with a known truth, without those that abstained; shades are shares of a row."
    page.confusion(counts, bundle.classes, caption)
    worst = counts.copy()
    np.fill_diagonal(worst, 0)
    if worst.any():
        pairs = np.argsort(worst, axis=None)[::-1][:3]
        words = []
        for truth, label in (divmod(int(pair), bundle.n_classes) for pair in pairs):
            if worst[truth, label]:
                share = worst[truth, label] / max(counts[truth].sum(), 1)
                words.append(
                    f"{bundle.classes[truth]} taken for {bundle.classes[label]} ({share:.0%} of {bundle.classes[truth]})"
                )
        page.text(f"Most frequent mistakes: {'; '.join(words)}.")
