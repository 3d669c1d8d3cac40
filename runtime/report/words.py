"""A run's figures in words, from the facts of its summary: closing lines for a terminal, rows for pages, and the summary as Markdown.

The Markdown page is written beside the recording without any extra; `pans report` makes the full page of the recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.outputs import write_file
from pans.runtime.safe_text import markdown, one_line
from pans.runtime.timing.realtime import fault_words

if TYPE_CHECKING:
    from .summary import Summary

UNRESOLVED_US = 1000.0  # a clock that is known no better hides what a host takes
QUANTILES = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
Facts = Mapping[str, Any]
Rows = list[tuple[str, str]]


def closing_words(summary: Summary, recording: str, report: str) -> str:
    """The lines that the command ends with."""
    facts = summary.as_json()
    accuracy = "unknown" if facts["accuracy"] is None else f"{facts['accuracy']:.2%}"
    photons = "unknown" if facts["photons_mean"] is None else f"{facts['photons_mean']:.2f}"
    light = (
        f"{facts['clicks_mean'] or 0.0:.2f} clicks, {photons} photons, illumination {facts['illumination']:.1f} each"
    )
    lines = [
        f"{'SIMULATED · ' if facts['simulated'] else ''}{facts['verdict']}: {facts['decisions']} decisions ({objects_words(facts)})",
        f"  accuracy      {accuracy} at {light}",
        f"  latency       {latency_words(facts)}; late {facts['late']}, lost {facts['lost']}",
        f"  exposures     {exposure_words(facts['exposure_timing'])}",
    ]
    if "passages" in facts:
        gates = ", ".join(f"{what} {facts['gates'][what]}" for what in ("asked", "done", "refused", "expired"))
        lines += [*passage_words(facts), f"  gates         pulses asked {gates.removeprefix('asked ')}"]
    if "drive" in facts:
        lines += [f"  {name:<13} {one_line(text)}" for name, text in _walk_words(facts)]
    lines += [f"  fault         {one_line(fault)}" for fault in facts["faults"]]
    return "\n".join([*lines, f"  recording     {one_line(recording)}", f"  report        {one_line(report)}"])


def objects_words(facts: Facts) -> str:
    """Return on how many objects how often was decided; objects that come again and again are no trials.

    >>> objects_words({"objects": 200, "trials": 1, "decisions": 500})
    '200 objects, 2.5 decisions on each on average'
    """
    objects, trials, decisions = facts["objects"], facts["trials"], facts["decisions"]
    if objects * trials == decisions:
        return f"{objects} objects × {trials} trials"
    return (
        f"{objects} objects, {decisions / objects:.1f} decisions on each on average"
        if objects
        else "true classes unknown"
    )


def latency_words(facts: Facts) -> str:
    """Return the quantiles of the time from exposure to decision; what the clock cannot resolve is said, not shown as 0."""
    values = {name: facts["latency_us"][key] for name, key in QUANTILES.items()}
    uncertainty_us = facts["clock"]["worst_uncertainty_us"]
    if not is_unresolved(values["p50"], uncertainty_us):
        return ", ".join(f"{name} {value:.0f} us" for name, value in values.items())
    seen = [f"{name} {value:.0f} us" for name, value in values.items() if not is_unresolved(value, uncertainty_us)]
    return f"{', '.join([*seen, 'else'] if seen else [])} not resolved (clock uncertainty {uncertainty_us / 1000:.1f} ms)".strip()


def is_unresolved(latency_us: float, uncertainty_us: float) -> bool:
    """Whether a latency of (nearly) 0 says nothing, because the device's clock was not known to a millisecond."""
    return latency_us < 0.5 and uncertainty_us >= UNRESOLVED_US


def exposure_words(timing: Facts) -> str:
    """Return when exposures happened, as the device told.

    >>> exposure_words({"announced": False, "exposures": 0})
    'not told by the device'
    """
    if not timing.get("exposures"):
        return f"{'none ' if timing.get('announced') else 'not '}told by the device"
    start, length = (f"{timing[key]:+.3g} us" for key in ("worst_start_us", "worst_length_us"))
    return f"start {start}, length {length} at most, of {timing['exposures']}; allowed {timing['tolerance_us']:.3g} us"


def repeat_words(stream: Facts) -> str:
    """Return how many messages came twice, behind a semicolon, "" without any; what differs is a contradiction, and a fault."""
    more = {what: stream.get(f"repeats_{what}", 0) for what in ("differing", "unchecked")}
    words = ", ".join(f"{count} {what}" for what, count in more.items() if count)
    repeated = stream.get("repeated", 0)
    return f"; {repeated} messages repeated or overtaken{f' ({words})' if words else ''}" if repeated else ""


def mean_words(value: float | None) -> str:
    """Return a mean with three digits behind the point."""
    return "unknown" if value is None or value != value else f"{value:.3f}"


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.2f} %"


def _share(facts: Facts, name: str) -> str:
    value, ends = facts[name], facts[f"{name}_ci"]
    return "unknown" if value is None or ends is None else f"{value:.3%} ({ends[0]:.3%} to {ends[1]:.3%})"


def figure_rows(facts: Facts) -> Rows:
    """Return name and text of a run's figures, of passing objects and of an automaton too."""
    dark, rows = facts.get("dark") or {}, [("accuracy", _percent(facts.get("accuracy")))]
    if "passages" not in facts:
        rows += [
            ("spread over trials (standard deviation)", _percent(facts.get("accuracy_std_trials"))),
            ("spread over objects (standard error)", _percent(facts.get("accuracy_stderr_objects"))),
            ("objects", objects_words(facts)),
        ]
    rows += [
        ("decisions (abstained)", f"{facts['decisions']} ({facts['abstained']})"),
        ("clicks per decision", mean_words(facts["clicks_mean"])),
        ("photons per decision (expected photoelectrons)", mean_words(facts["photons_mean"])),
        ("illumination per decision (sum of pattern intensities)", mean_words(facts["illumination"])),
        ("late decisions", str(facts["late"])),
        ("lost exposures", str(facts["lost"])),
    ]
    if dark.get("exposures"):
        ends = f"95 % interval {dark['low']:.2g} to {dark['high']:.2g}, profile {dark['expected']:.2g}"
        rows.append(("dark clicks per dark exposure", f"{dark['clicks']} in {dark['exposures']}, {ends}"))
    rows += flow_rows(facts) if "passages" in facts else []
    return [*rows, *_walk_words(facts)] if "drive" in facts else rows


def _walk_words(facts: Facts) -> Rows:
    """Return name and text of the figures that only an automaton has."""
    rows = [("walks", f"{mean_words(facts['exposures_mean'])} exposures each, driven by the {facts['drive']}")]
    if facts["confidence"]:
        below = f"{facts['abstained_below_confidence']} decisions abstained below it"
        rows.append(("confidence", f"{facts['confidence']:g}: {below}"))
    if (turn := facts["turn_us"]) is not None:
        words = ", ".join(f"{name} {turn[key]:.0f} us" for name, key in QUANTILES.items())
        rows.append(("host's turn", f"{words} of {facts['turn_budget_us']:.0f} us; late slots {facts['late_slots']}"))
    if (one := facts["expected"]) is not None:
        off = facts["expected_off_stderr"]
        beside = "" if off is None else f"; measured {off:+.2f} standard errors from it"
        light = f"{one['clicks']:.2f} clicks, {one['photons']:.2f} photons"
        rows.append(("expected", f"{one['accuracy']:.2%} at {light} ({one['profile']}, {one['split']}){beside}"))
    return rows


def flow_rows(facts: Facts) -> Rows:
    """Return name and text of the figures that only a flow has."""
    counts = facts["passages"]
    return [
        (
            "passages (alone, in coincidence, in gaps)",
            f"{counts['alone']}, {counts['coincident']}, {counts['in_gaps']}",
        ),
        ("accuracy per passage alone, 95 % interval", _share(facts, "accuracy")),
        ("accuracy where a label was given", _share(facts, "accuracy_labelled")),
        ("missed, of those alone", _share(facts, "missed")),
        ("doubled, of those alone", _share(facts, "doubled")),
        ("decisions without a passage", str(counts["without_mark"])),
        ("coincidences aborted / labelled", f"{counts['coincident_aborted']} / {counts['coincident_labelled']}"),
        ("aborted", _counts(facts["aborted"])),
        ("yield (targets pulsed)", _share(facts, "yield")),
        ("purity (pulses on a target alone)", _share(facts, "purity")),
        ("pulses asked, done, refused, expired", ", ".join(str(n) for n in facts["gates"].values())),
        ("clicks of the whole passage", mean_words(facts["passage_clicks_mean"])),
        ("photons of the whole passage, at least (scaled by clicks)", mean_words(facts["passage_photons_mean"])),
    ]


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in counts.items()) or "none"


def passage_words(facts: Facts) -> list[str]:
    """Return what the decisions about passing objects were worth, in lines; all of it is known in a replay, too."""
    counts, means = facts["passages"], (mean_words(facts[f"{name}_mean"]) for name in ("clicks", "passage_clicks"))
    return [
        f"  passages      {counts['marks']}: {counts['alone']} alone, {counts['coincident']} in coincidence, {counts['in_gaps']} in gaps; "
        f"missed {_share(facts, 'missed')}, doubled {_share(facts, 'doubled')}",
        f"  accuracy      {_share(facts, 'accuracy')} of those alone",
        f"  aborted       {_counts(facts['aborted'])}",
        "  light         {} clicks of the window, {} of the passage".format(*means),
        f"  pulses        {counts['pulses']} made; yield {_share(facts, 'yield')}, purity {_share(facts, 'purity')}",
    ]


# ---- Markdown ----


def write_markdown(
    path: Path,
    summary: Summary,
    run: Facts,
    confusion: NDArray[np.int64],
    classes: Sequence[str],
    *,
    force: bool = False,
) -> None:
    """Write the summary as Markdown; UsageError if it exists, unless `force`. `run`: name -> text about what was run."""
    facts = summary.as_json()
    simulated = "\n> **SIMULATED**: the clicks come from a simulated instrument, not from light.\n" * facts["simulated"]
    causes = [(*_what(one), "yes" if one["sure"] else "no", one["why"]) for one in facts["blame"]]
    lines = [
        f"# Run of {markdown(run.get('bundle', 'a bundle'))}{' (SIMULATED)' if simulated else ''}",
        simulated,
        f"**{facts['verdict']}**",
        *(f"- {markdown(fault)}" for fault in facts["faults"]),
        *_table("Results", ("figure", "value"), figure_rows(facts)),
        *_table("Timing", ("microseconds", *QUANTILES), _stage_rows(facts)),
        *(f"- {markdown(line)}" for line in _timing(facts)),
        *(_table("Late and missing work", ("what", "cause", "sure", "why"), causes) if causes else ()),
    ]
    if confusion.any():
        cells = [(name, *(str(n) if n else "·" for n in row)) for name, row in zip(classes, confusion.tolist())]
        lines += _table("Decisions by class (truth in rows)", ("", *classes), cells)
    lines += ["", "## What was run", "", *(f"- {name}: {markdown(text)}" for name, text in run.items())]
    write_file(path, ("\n".join(lines) + "\n").encode(), force=force)


def _table(heading: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    cells = [head, *rows]
    lines = [f"| {' | '.join(map(markdown, row))} |" for row in cells]
    return ["", f"## {heading}", "", lines[0], "|" + " --- |" * len(head), *lines[1:], ""]


def _what(blame: Facts) -> tuple[str, str]:
    late = blame["what"] == "late"
    return f"{blame['decisions']} late" if late else f"{blame['exposures']} exposures missing", blame["cause"]


def _stage_rows(facts: Facts) -> list[tuple[str, ...]]:
    """The quantiles of the whole and by stage; the host's own stages are of its clock alone."""
    uncertainty_us, rows = facts["clock"]["worst_uncertainty_us"], []
    for name, row in {"exposure end to decision": facts["latency_us"], **facts["stage_latency_us"]}.items():
        doubt_us = uncertainty_us if name in ("exposure end to decision", "link") else 0.0
        cells = (row[key] for key in QUANTILES.values())
        rows.append((name, *("not resolved" if is_unresolved(us, doubt_us) else f"{us:.0f}" for us in cells)))
    return rows


def _timing(facts: Facts) -> list[str]:
    clock, granted = facts["clock"], ", ".join(f"{what}: {answer}" for what, answer in facts["realtime"].items())
    return [
        f"deadline {facts['deadline_us']:.0f} us: {facts['late']} late; {facts['lost']} exposures lost{repeat_words(facts['stream'])}",
        f"clock: uncertainty at most {clock['worst_uncertainty_us']:.0f} us, drift {clock.get('drift_ppm', 0.0):.1f} ppm; "
        f"slot jitter at most {facts['slot_jitter_us']:.1f} us",
        f"exposures: {exposure_words(facts['exposure_timing'])}",
        f"armed {facts['armed_after_s']:.2f} s after the start; measured for {facts['seconds']:.1f} s; ended: {facts['ended']}",
        f"real-time set-up: {granted or 'virtual time: nothing asked for'}",
        f"page faults of the loop while armed: {fault_words(facts['page_faults'])}",
    ]
