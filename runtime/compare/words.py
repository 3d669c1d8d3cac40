"""A comparison in words: the lines for a terminal, and the rows and sentences that the page shares."""

from __future__ import annotations

import math

from pans.runtime.safe_text import one_line

from .comparison import ALPHA, Comparison, Finding

NAMES = {
    "accuracy": "accuracy",
    "abstained": "abstained",
    "clicks_mean": "clicks per decision",
    "photons_mean": "photons per decision",
    "illumination": "illumination per decision",
    "late": "late decisions",
    "lost": "lost exposures",
    "dark_rate": "dark clicks per exposure",
    "latency_p50": "latency p50",
    "latency_p99": "latency p99",
    "latency_p99.9": "latency p99.9",
}


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
    differing = [NAMES.get(one.name, one.name) for one in comparison.findings if one.significant]
    if not any(one.significant is not None for one in comparison.findings):
        return "Nothing could be tested."
    if not differing:
        return f"No difference is larger than chance (p-values below {ALPHA:g} after a correction for their number, or 95 % intervals)."
    return f"Larger than chance (p-values below {ALPHA:g} after a correction for their number, or 95 % intervals): {', '.join(differing)}."


def comparison_words(comparison: Comparison) -> str:
    """Return all of it as lines for a terminal."""
    first, second = comparison.first, comparison.second
    lines = [
        *(["SIMULATED"] if first.simulated or second.simulated else []),
        f"A  {one_line(first.path)}: {one_line(first.summary.get('verdict', 'cut, no summary'))}",
        f"B  {one_line(second.path)}: {one_line(second.summary.get('verdict', 'cut, no summary'))}",
        "",
        "What changed:" if comparison.changes else "Bundle, profile, options and device are the same.",
        *(
            f"  {one_line(one.name)}: {one_line(one.first or '-', 60)} -> {one_line(one.second or '-', 60)}"
            for one in comparison.changes
        ),
        "",
        f"Objects: {'paired' if comparison.paired else 'two samples'}; {one_line(comparison.why)}",
        "",
    ]
    for one in comparison.findings:
        sides = f"A {value_of(one, one.first)}, B {value_of(one, one.second)}"
        lines.append(f"  {NAMES.get(one.name, one.name):<26}{sides}; {difference_of(one)}; {verdict_of(one)}")
    return "\n".join([*lines, "", conclusion(comparison)])
