"""The section on decisions about still objects, from the decision log: accuracy over time, and truth against decision.

The figures of the whole run are the summary's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.intervals import wilson_interval

from .charts import Axis, Chart, Curve, Mark, percent, seconds
from .page import CONFUSION_MAX, Page

BINS = 60
OBJECTS_PER_BIN = 20
F64 = NDArray[np.float64]
Blocks = Callable[[], Iterable[NDArray[np.void]]]  # gives the decisions of a run from the first on, block by block


class AccuracyBins(NamedTuple):
    """Middle of each stretch (seconds since the first decision), accuracy, the ends of its 95 % interval, distinct objects."""

    seconds: F64
    accuracy: F64
    low: F64
    high: F64
    objects: NDArray[np.int64]


class DecisionSums(NamedTuple):
    """What one pass over the decisions adds up to."""

    first_tick: int
    known: int  # with a known truth
    right: int
    objects: int  # distinct ones with a known truth, or as many as matter
    confusion: NDArray[np.int64]  # (classes, classes), truth in rows: those that have a label

    @property
    def accuracy(self) -> float:
        """Share of right ones among those with a known truth."""
        return self.right / self.known


def sum_decisions(decisions: Blocks, n_classes: int) -> DecisionSums:
    """Add up `decisions`, block by block."""
    first_tick, known, right, objects = None, 0, 0, np.zeros(0, np.uint32)
    confusion = np.zeros((n_classes, n_classes), np.int64)
    for rows in decisions():
        first_tick = int(rows["tick"][0]) if first_tick is None else first_tick
        told = rows[rows["truth"] >= 0]
        known, right = known + len(told), right + int((told["label"] == told["truth"]).sum())
        if len(objects) < BINS * OBJECTS_PER_BIN:
            objects = np.union1d(objects, told["object"])
        fits = (told["flags"] & int(DecisionFlag.ABSTAINED)) == 0
        fits &= (told["truth"] < n_classes) & (told["label"] < n_classes)
        np.add.at(confusion, (told["truth"][fits], told["label"][fits]), 1)
    return DecisionSums(first_tick or 0, known, right, len(objects), confusion)


def accuracy_bins(decisions: Blocks, sums: DecisionSums, tick_hz: float) -> AccuracyBins:
    """Cut the decisions with a known truth into stretches of equal number; the interval (Wilson) counts distinct objects.

    Memory holds the objects of one stretch.
    """
    bins = int(np.clip(sums.objects // OBJECTS_PER_BIN, 1, BINS))
    sizes = (sums.known // bins + (np.arange(bins) < sums.known % bins)).tolist()
    rows: list[tuple[float, float, float, float, int]] = []
    left, right, ticks, seen = sizes[0], 0, [0, 0], list[NDArray[np.uint32]]()
    for block in decisions():
        told = block[block["truth"] >= 0]
        while len(told):
            part, told = told[:left], told[left:]
            ticks = [ticks[0] if seen else int(part["tick"][0]), int(part["tick"][-1])]
            seen.append(np.unique(part["object"]))
            right, left = right + int((part["label"] == part["truth"]).sum()), left - len(part)
            if not left:
                share, objects = right / sizes[len(rows)], len(np.unique(np.concatenate(seen)))
                low, high = wilson_interval(round(share * objects), objects)
                middle = max(sum(ticks) / 2 - sums.first_tick, 0.0)
                rows.append((middle / tick_hz, share, min(low, share), max(high, share), objects))
                left, right, seen = sizes[min(len(rows), bins - 1)], 0, []
    columns = np.array(rows, np.float64).reshape(-1, 5).T
    return AccuracyBins(columns[0], columns[1], columns[2], columns[3], columns[4].astype(np.int64))


def add_results(page: Page, decisions: Blocks, bundle: Bundle | None, header: Mapping[str, Any]) -> None:
    """Add accuracy over time, and truth against decision."""
    if bundle is None or bundle.n_classes < 2:
        return
    sums = sum_decisions(decisions, bundle.n_classes if bundle.n_classes <= CONFUSION_MAX else 0)
    if not sums.known:
        page.text("The true classes are not in the decision log: accuracy is not known.", "note")
        return
    bins = accuracy_bins(decisions, sums, float(header["config"]["tick_hz"]))
    if len(bins.seconds) > 1:
        page.heading("Accuracy over time")
        page.figure(
            accuracy_chart(bins, sums.accuracy, bundle.n_classes),
            f"Share of right decisions in {len(bins.seconds)} stretches of the run with their 95 % intervals (Wilson, by distinct objects: "
            f"{int(bins.objects.min())} to {int(bins.objects.max())} in a stretch).",
        )
    _add_confusion(page, sums.confusion, bundle)


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


def _add_confusion(page: Page, counts: NDArray[np.int64], bundle: Bundle) -> None:
    if bundle.n_classes > CONFUSION_MAX:
        page.text(f"{bundle.n_classes} classes are too many for a table of truth against decision.", "note")
        return
    page.heading("Decisions by class")
    caption = (
        f"{int(counts.sum())} decisions with a known truth, without those that abstained; shades are shares of a row."
    )
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
