"""A comparison in words: the lines for a terminal, and the page."""

from __future__ import annotations

import math
from typing import Any

from pans.runtime.pages.page import render, words
from pans.runtime.pages.run import Decisions, Durations
from pans.runtime.safe_text import one_line

from .comparison import ALPHA, Change, Comparison, Finding, Side

SAME = "Bundle, profile, options and device are the same."
CUT = "cut, no summary"


def value_of(finding: Finding, value: float | None) -> str:
    """Return one side's figure with its unit."""
    if value is None:
        return "unknown"
    if finding.unit == "share":
        return f"{100 * value:.2f} %"
    return f"{value:.1f} us" if finding.unit == "us" else f"{value:.4g}"


def difference_of(finding: Finding) -> str:
    """Return how far the sides are apart, with the 95 % interval where it is known."""
    if finding.difference is None:
        return ""
    if finding.is_ratio:
        return _ratio(finding.difference, finding.low, finding.high)
    scale, form, unit = (100, "+.2f", " points") if finding.unit == "share" else (1, "+.3g", "")
    head = f"A − B = {scale * finding.difference:{form}}{unit}"
    if finding.low is None or finding.high is None:
        return head
    return f"{head} ({scale * finding.low:{form}} to {scale * finding.high:{form}})"


def _ratio(ratio: float, low: float | None, high: float | None) -> str:
    if math.isnan(ratio):
        return "none in either run"
    head = "B has none" if math.isinf(ratio) else f"A is {ratio:.3g} times B"
    if low is None or high is None:
        return head
    return f"{head} ({f'at least {low:.3g} times' if math.isinf(high) else f'{low:.3g} to {high:.3g}'})"


def verdict_of(finding: Finding) -> str:
    """Return whether it is significant, with the corrected p-value."""
    if finding.significant is None:
        return "not tested"
    word = "significant" if finding.significant else "within chance"
    return word if finding.p_corrected is None else f"{word}, p = {finding.p_corrected:.2g}"


def conclusion(comparison: Comparison) -> str:
    """Return one sentence on what differs by more than chance."""
    if not any(one.significant is not None for one in comparison.findings):
        return "Nothing could be tested."
    differing = ", ".join(_title(one) for one in comparison.findings if one.significant)
    how = f"(p-values below {ALPHA:g} after a correction for their number, or 95 % intervals)"
    return f"Larger than chance {how}: {differing}." if differing else f"No difference is larger than chance {how}."


def _title(finding: Finding) -> str:
    return str(words()["figures"].get(finding.name, finding.name))


def _row(one: Finding) -> tuple[str, str, str, str, str]:
    """Name, both sides, their difference and whether it is beyond chance."""
    return _title(one), value_of(one, one.first), value_of(one, one.second), difference_of(one), verdict_of(one)


def comparison_words(comparison: Comparison) -> str:
    """Return all of it as lines for a terminal: results first, then what was different about the runs."""
    sides = {"A": comparison.first, "B": comparison.second}
    lines = [
        *(["SIMULATED"] if any(side.simulated for side in sides.values()) else []),
        *(f"{a}  {one_line(side.path)}: {one_line(side.summary.get('verdict', CUT))}" for a, side in sides.items()),
        *("", conclusion(comparison)),
        *(f"Objects: {'paired' if comparison.paired else 'two samples'}; {one_line(comparison.why)}", ""),
        *("  {:<26}A {}, B {}; {}; {}".format(*_row(one)) for one in comparison.findings),
        *("", "What changed:" if comparison.changes else SAME),
    ]
    for change in sorted(comparison.changes, key=_is_hash):
        texts = (one_line(text or "-", 60) for text in (change.first, change.second))
        lines.append(f"  {one_line(change.name)}: {' -> '.join(texts)}")
    return "\n".join(lines)


def _is_hash(change: Change) -> bool:
    return "sha256" in change.name


def comparison_page(comparison: Comparison) -> bytes:
    """Return the page: results and their differences, curves of both sides, what was different about the runs, hashes at the end."""
    sides = {"A": comparison.first, "B": comparison.second}
    return render(
        "compare.html",
        simulated=any(side.simulated for side in sides.values()),
        sides=sides,
        comparison=comparison,
        conclusion=conclusion(comparison),
        rows=[_row(one) for one in comparison.findings],
        methods=[f"{_title(one)}: {one.method}." for one in comparison.findings],
        curves={name: _curves(side) for name, side in sides.items()},
        changes=[(one.name, one.first or "-", one.second or "-") for one in sorted(comparison.changes, key=_is_hash)],
        same=SAME,
        cut=CUT,
    )


def _curves(side: Side) -> dict[str, Any]:
    """What is drawn of one side: accuracy over time, latency unless time was virtual."""
    if side.decisions is None or side.timings is None or not len(side.decisions):
        return {}
    numbers, durations = (
        Decisions(side.header["config"], len(side.decisions), first=int(side.decisions["index"][0])),
        Durations(),
    )
    numbers.take(side.decisions)
    durations.take(side.timings)
    deadline_us = side.summary.get("deadline_us")
    latency = None if durations.is_virtual() else durations.chart(float(deadline_us) if deadline_us else None)
    classes = max(int(side.decisions["truth"].max()) + 1, 2)
    return {"accuracy": numbers.accuracy(), "classes": classes, "latency": latency}
