"""A comparison as an HTML page: what changed, the figures with their intervals, curves side by side."""

from __future__ import annotations

from functools import partial

from pans.runtime.pages.page import Page
from pans.runtime.pages.results import Blocks, accuracy_bins, accuracy_chart, sum_decisions
from pans.runtime.pages.timing import NO_TIME_US, latency_chart, stages_of
from pans.runtime.record.recording import together

from .comparison import Comparison
from .side import Side
from .words import NAMES, conclusion, difference_of, value_of, verdict_of


def comparison_page(comparison: Comparison) -> bytes:
    """Return the page of a comparison."""
    first, second = comparison.first, comparison.second
    page = Page("Two runs side by side", simulated=first.simulated or second.simulated)
    reasons = [(conclusion(comparison), "")]
    for name, side in (("A", first), ("B", second)):
        if not side.complete:
            reasons.append((f"Side {name} was cut: it is compared as far as it goes.", ""))
    page.verdict("Result", "", reasons)
    page.table(_sides(first, second), ("", "A", "B"))
    page.heading("What changed")
    if comparison.changes:
        page.table(
            [(one.name, one.first or "-", one.second or "-") for one in comparison.changes], ("", "A", "B"), "long"
        )
    else:
        page.text("Bundle, profile, options and device are the same.")
    page.heading("What came of it")
    page.text(f"Objects are {'compared in pairs' if comparison.paired else 'two samples'}: {comparison.why}.", "note")
    rows = [
        (
            NAMES.get(one.name, one.name),
            value_of(one, one.first),
            value_of(one, one.second),
            difference_of(one),
            verdict_of(one),
        )
        for one in comparison.findings
    ]
    page.table(rows, ("", "A", "B", "difference, 95 % interval", "beyond chance?"))
    with page.folded("How it was tested"):
        page.sentences(f"{NAMES.get(one.name, one.name)}: {one.method}." for one in comparison.findings)
    _add_accuracy(page, comparison)
    _add_latency(page, comparison)
    return page.html()


def _sides(first: Side, second: Side) -> list[tuple[str, str, str]]:
    columns = [_facts(first), _facts(second)]
    return [(name, columns[0][name], columns[1][name]) for name in columns[0]]


def _facts(side: Side) -> dict[str, str]:
    made = side.summary.get("decisions", 0 if side.decisions is None else len(side.decisions))
    return {
        "run": str(side.path),
        "date": str(side.header.get("created_utc", "unknown"))[:19].replace("T", " "),
        "verdict": str(side.summary.get("verdict", "cut, no summary")),
        "decisions": f"{made:,}",
    }


def _add_accuracy(page: Page, comparison: Comparison) -> None:
    sides = [("A", comparison.first), ("B", comparison.second)]
    if any(side.decisions is None or not (side.decisions["truth"] >= 0).any() for _, side in sides):
        return
    page.heading("Accuracy over time")
    with page.sides():
        for number, (name, side) in enumerate(sides):
            if number:
                page.side()
            assert side.decisions is not None
            rows = side.decisions
            blocks: Blocks = partial(list, [rows])
            sums = sum_decisions(blocks, 0)
            bins = accuracy_bins(blocks, sums, float(side.header["config"]["tick_hz"]))
            classes = int(max(rows["truth"].max() + 1, 2))
            page.figure(
                accuracy_chart(bins, sums.accuracy, classes),
                f"{name}: {len(bins.seconds)} stretches with their 95 % intervals.",
                half=True,
            )


def _add_latency(page: Page, comparison: Comparison) -> None:
    sides = [("A", comparison.first), ("B", comparison.second)]
    if any(
        side.latency_us is None or not len(side.latency_us) or side.latency_us.max() < NO_TIME_US for _, side in sides
    ):
        return
    page.heading("Latency")
    with page.sides():
        for number, (name, side) in enumerate(sides):
            if number:
                page.side()
            deadline = side.summary.get("deadline_us")
            stages = stages_of(together(rows for one in side.recordings for rows in one.iter_timings()))
            chart = latency_chart(stages, float(deadline) if deadline else None)
            page.figure(chart, f"{name}: share of decisions that took longer, whole and by stage.", half=True)
