"""A run's figures in words: closing lines for a terminal, rows for pages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pans.runtime.safe_text import one_line

UNRESOLVED_US = 1000.0  # a clock that is known no better hides what a host takes


if TYPE_CHECKING:
    from pans.runtime.flow.matching import PassageFigures, Share
    from pans.runtime.live.flow_run import FlowFigures
    from pans.runtime.live.tally import TallyFigures

    from .summary import Summary, WalkFigures


def closing_words(summary: Summary, recording: str, report: str) -> str:
    """The lines that the command ends with."""
    banner = "SIMULATED · " if summary.simulated else ""
    accuracy = "unknown" if summary.accuracy is None else f"{summary.accuracy:.2%}"
    clicks = summary.clicks_mean or 0.0
    photons = "unknown" if summary.photons_mean is None else f"{summary.photons_mean:.2f}"
    tally = summary.tally
    lines = [
        f"{banner}{summary.verdict}: {tally.decisions} decisions ({objects_words(tally)})",
        f"  accuracy      {accuracy} at {clicks:.2f} clicks, {photons} photons, illumination {summary.illumination:.1f} each",
        f"  latency       {latency_words(summary)}; late {summary.late}, lost {summary.lost}",
        f"  exposures     {exposure_words(summary.exposure_timing)}",
        *([] if summary.flow is None else flow_words(summary.flow)),
        *([] if summary.walks is None else walk_words(summary.walks)),
        *(f"  fault         {one_line(fault)}" for fault in summary.faults),
        f"  recording     {one_line(recording)}",
        f"  report        {one_line(report)}",
    ]
    return "\n".join(lines)


def objects_words(tally: TallyFigures) -> str:
    """Return on how many objects how often was decided; objects that come again and again are no trials.

    >>> from pans.runtime.live.tally import TallyFigures
    >>> objects_words(TallyFigures(0.8, None, None, objects=200, trials=1, decisions=500, abstained=0, clicks_mean=5, photons_mean=8))
    '200 objects, 2.5 decisions on each on average'
    """
    if tally.objects * tally.trials == tally.decisions:
        return f"{tally.objects} objects × {tally.trials} trials"
    if not tally.objects:
        return "true classes unknown"
    return f"{tally.objects} objects, {tally.decisions / tally.objects:.1f} decisions on each on average"


def latency_words(summary: Summary) -> str:
    """Return the quantiles of the time from exposure to decision; what the clock cannot resolve is said, not shown as 0."""
    names = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
    values = {name: summary.latency_us[key] for name, key in names.items()}
    uncertainty_us = summary.clock["worst_uncertainty_us"]
    if not is_unresolved(values["p50"], uncertainty_us):
        return ", ".join(f"{name} {value:.0f} us" for name, value in values.items())
    seen = [f"{name} {value:.0f} us" for name, value in values.items() if not is_unresolved(value, uncertainty_us)]
    return f"{', '.join([*seen, 'else'] if seen else [])} not resolved (clock uncertainty {uncertainty_us / 1000:.1f} ms)".strip()


def is_unresolved(latency_us: float, uncertainty_us: float) -> bool:
    """Whether a latency of (nearly) 0 says nothing, because the device's clock was not known to a millisecond."""
    return latency_us < 0.5 and uncertainty_us >= UNRESOLVED_US


def exposure_words(timing: Mapping[str, Any]) -> str:
    """Return when exposures happened, as the device told.

    >>> exposure_words({"announced": False, "exposures": 0})
    'not told by the device'
    """
    if not timing.get("exposures"):
        return f"{'none ' if timing.get('announced') else 'not '}told by the device"
    start, length = (f"{timing[key]:+.3g} us" for key in ("worst_start_us", "worst_length_us"))
    return f"start {start}, length {length} at most, of {timing['exposures']}; allowed {timing['tolerance_us']:.3g} us"


def walk_rows(walks: WalkFigures) -> list[tuple[str, str]]:
    """Return name and text of the figures that only an automaton has."""
    rows = [
        ("driven by", f"the {walks.drive}"),
        ("exposures of a walk, dark ones left out", _mean(walks.exposures_mean)),
    ]
    if walks.confidence:
        rows.append((f"abstained below a confidence of {walks.confidence:g}", str(walks.abstained_below_confidence)))
    if walks.turn_us is not None:
        turns = ", ".join(f"{name} {value:.0f}" for name, value in walks.turn_us.items())
        rows.append(("slots that stayed dark because their state was named too late", str(walks.late_slots)))
        rows.append((f"host's turns in us, of {walks.turn_budget_us:.0f} that the plan leaves", turns))
    if walks.expected is not None:
        one, off = walks.expected, walks.expected_off_stderr
        where = f"{one['profile']}, {one['objects']} objects of {one['split']}"
        rows.append((f"expected accuracy ({where})", f"{one['accuracy']:.2%} at {one['clicks']:.2f} clicks"))
        if off is not None:
            rows.append(("measured less expected accuracy, in standard errors", f"{off:+.2f}"))
    return rows


def walk_words(walks: WalkFigures) -> list[str]:
    """Return the lines of an automaton's closing words."""
    lines = [f"  walks         {_mean(walks.exposures_mean)} exposures each, driven by the {walks.drive}"]
    if walks.confidence:
        lines.append(
            f"  confidence    {walks.confidence:g}: {walks.abstained_below_confidence} decisions abstained below it"
        )
    if walks.turn_us is not None:
        turn = walks.turn_us
        lines.append(
            f"  host's turn   p50 {turn['p50']:.0f} us, p99 {turn['p99']:.0f} us, p99.9 {turn['p999']:.0f} us, max {turn['max']:.0f} us "
            f"of {walks.turn_budget_us:.0f} us; late slots {walks.late_slots}"
        )
    if walks.expected is not None:
        one, off = walks.expected, walks.expected_off_stderr
        beside = "" if off is None else f"; measured {off:+.2f} standard errors from it"
        lines.append(
            f"  expected      {one['accuracy']:.2%} at {one['clicks']:.2f} clicks, {one['photons']:.2f} photons "
            f"({one_line(one['profile'])}, {one_line(one['split'])}){beside}"
        )
    return lines


def flow_rows(passages: PassageFigures, gates: Mapping[str, int]) -> list[tuple[str, str]]:
    """Return name and text of the figures that only a flow has."""
    counts = passages.passages
    aborted = ", ".join(f"{name} {n}" for name, n in passages.aborted.items()) or "none"
    rows = [
        (
            "passages (alone, in coincidence, in gaps)",
            f"{counts['alone']}, {counts['coincident']}, {counts['in_gaps']}",
        ),
        ("accuracy per passage alone, 95 % interval", _share(passages.accuracy)),
        ("accuracy where a label was given", _share(passages.accuracy_labelled)),
        ("missed, of those alone", _share(passages.missed)),
        ("doubled, of those alone", _share(passages.doubled)),
        ("decisions without a passage", str(counts["without_mark"])),
        ("coincidences aborted / labelled", f"{counts['coincident_aborted']} / {counts['coincident_labelled']}"),
        ("aborted", aborted),
        ("yield (targets pulsed)", _share(passages.yield_)),
        ("purity (pulses on a target alone)", _share(passages.purity)),
        ("pulses asked, done, refused, expired", ", ".join(str(n) for n in gates.values())),
        ("clicks of the whole passage", _mean(passages.passage_clicks_mean)),
        ("photons of the whole passage, at least (scaled by clicks)", _mean(passages.passage_photons_mean)),
    ]
    return rows


def flow_words(flow: FlowFigures) -> list[str]:
    """Return the lines of a flow's closing words."""
    gates = flow.gates
    pulses = f"asked {gates['asked']}, done {gates['done']}, refused {gates['refused']}, expired {gates['expired']}"
    return [*passage_words(flow.passages), f"  gates         {pulses}"]


def passage_words(passages: PassageFigures) -> list[str]:
    """Return what the decisions about passing objects were worth, in lines; all of it is known in a replay, too."""
    counts = passages.passages
    return [
        f"  passages      {counts['marks']}: {counts['alone']} alone, {counts['coincident']} in coincidence, {counts['in_gaps']} in gaps; "
        f"missed {_share(passages.missed)}, doubled {_share(passages.doubled)}",
        f"  accuracy      {_share(passages.accuracy)} of those alone",
        f"  aborted       {', '.join(f'{name} {n}' for name, n in passages.aborted.items()) or 'none'}",
        f"  light         {_mean(passages.clicks_mean)} clicks of the window, {_mean(passages.passage_clicks_mean)} of the passage",
        f"  pulses        {counts['pulses']} made; yield {_share(passages.yield_)}, purity {_share(passages.purity)}",
    ]


def repeat_words(stream: Mapping[str, int]) -> str:
    """Return how many messages came twice, behind a semicolon, "" without any; what differs is a contradiction, and a fault."""
    more = {what: stream.get(f"repeats_{what}", 0) for what in ("differing", "unchecked")}
    words = ", ".join(f"{count} {what}" for what, count in more.items() if count)
    repeated = stream.get("repeated", 0)
    return f"; {repeated} messages repeated or overtaken{f' ({words})' if words else ''}" if repeated else ""


def _share(share: Share) -> str:
    value, interval = share
    return "unknown" if value is None or interval is None else f"{value:.3%} ({interval[0]:.3%} to {interval[1]:.3%})"


def _mean(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"
