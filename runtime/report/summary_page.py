"""The summary of a run as a Markdown page for people, written beside the recording. A simulated run says SIMULATED."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.outputs import write_file
from pans.runtime.safe_text import markdown
from pans.runtime.timing.realtime import fault_words

from .summary import Summary
from .words import exposure_words, flow_rows, is_unresolved, objects_words, repeat_words, walk_rows


def write_markdown(
    path: Path,
    summary: Summary,
    facts: Mapping[str, Any],
    confusion: NDArray[np.int64],
    classes: Sequence[str],
    *,
    force: bool = False,
) -> None:
    """Write the summary page; UsageError if it exists, unless `force`.

    `facts` are name -> text lines about what was run (bundle, profile, device, command).
    """
    simulated = " (SIMULATED)" if summary.simulated else ""
    lines = [f"# Run of {markdown(facts.get('bundle', 'a bundle'))}{simulated}", ""]
    if summary.simulated:
        lines += ["> **SIMULATED**: the clicks come from a simulated instrument, not from light.", ""]
    lines += [f"**{summary.verdict}**" + "".join(f"\n- {markdown(fault)}" for fault in summary.faults), ""]
    lines += [
        *_figures(summary),
        "",
        *_timing(summary),
        "",
        *_causes(summary),
        *_confusion(confusion, classes),
        "",
        "## What was run",
        "",
    ]
    lines += [f"- {name}: {markdown(text)}" for name, text in facts.items()]
    write_file(path, ("\n".join(lines) + "\n").encode(), force=force)


def _figures(summary: Summary) -> list[str]:
    rows = [
        ("accuracy", _percent(summary.accuracy)),
        ("spread over trials (standard deviation)", _percent(summary.tally.accuracy_std_trials)),
        ("spread over objects (standard error)", _percent(summary.tally.accuracy_stderr_objects)),
        ("objects", objects_words(summary.tally)),
        ("decisions (abstained)", f"{summary.tally.decisions} ({summary.tally.abstained})"),
        ("clicks per decision", _number(summary.clicks_mean)),
        ("photons per decision (expected photoelectrons)", _number(summary.photons_mean)),
        ("illumination per decision (sum of pattern intensities)", _number(summary.illumination)),
        (
            "dark clicks per dark exposure",
            f"{summary.dark.clicks} in {summary.dark.exposures}, 95 % interval "
            f"{summary.dark.low:.2g} to {summary.dark.high:.2g}, profile {summary.dark.expected:.2g}",
        ),
    ]
    if summary.flow is not None:
        rows += flow_rows(summary.flow.passages, summary.flow.gates)
    if summary.walks is not None:
        rows += walk_rows(summary.walks)
    return [
        "## Results",
        "",
        "| figure | value |",
        "| --- | --- |",
        *(f"| {markdown(name)} | {markdown(text)} |" for name, text in rows),
    ]


def _timing(summary: Summary) -> list[str]:
    head = [
        "## Timing",
        "",
        "Microseconds; from the end of the last exposure (device clock) to the decision, and by stage.",
        "",
    ]
    table = ["| stage | p50 | p99 | p99.9 | max |", "| --- | --- | --- | --- | --- |"]
    whole = "**exposure end to decision**"
    stages = {whole: summary.latency_us, **summary.stage_latency_us}
    uncertainty_us = summary.clock["worst_uncertainty_us"]
    for name, row in stages.items():
        # the host's own stages are of its clock alone
        doubt_us = uncertainty_us if name in (whole, "link") else 0.0
        cells = (row[key] for key in ("p50", "p99", "p999", "max"))
        table.append(
            f"| {name} | {' | '.join('not resolved' if is_unresolved(us, doubt_us) else f'{us:.0f}' for us in cells)} |"
        )
    granted = (
        ", ".join(f"{what}: {markdown(answer)}" for what, answer in summary.realtime.items())
        or "virtual time: nothing asked for"
    )
    tail = [
        "",
        f"- deadline {summary.deadline_us:.0f} us: {summary.late} late; {summary.lost} exposures lost{repeat_words(summary.stream)}",
        f"- clock: uncertainty at most {summary.clock['worst_uncertainty_us']:.0f} us, "
        f"drift {summary.clock.get('drift_ppm', 0.0):.1f} ppm; slot jitter at most {summary.slot_jitter_us:.1f} us",
        f"- exposures: {exposure_words(summary.exposure_timing)}",
        f"- armed {summary.armed_after_s:.2f} s after the start; measured for {summary.seconds:.1f} s; ended: {markdown(summary.ended)}",
        f"- real-time set-up: {granted}",
        f"- page faults of the loop while armed: {fault_words(summary.page_faults)}",
    ]
    return head + table + tail


def _causes(summary: Summary) -> list[str]:
    """What made work late or lost it, with the first verdicts in words."""
    if not summary.blame:
        return []
    sums = (("late decisions", summary.late_cause), ("lost exposures", summary.lost_cause))
    lines = ["## Late and missing work", ""]
    for what, causes in sums:
        if causes:
            named = ", ".join(f"{cause} {count}" for cause, count in sorted(causes.items(), key=lambda item: -item[1]))
            lines.append(f"- {what} by cause: {named}")
    lines += ["", "| what | cause | sure | why |", "| --- | --- | --- | --- |"]
    for event in summary.blame:
        late = event["what"] == "late"
        what = f"{event['decisions']} late" if late else f"{event['exposures']} exposures missing"
        lines.append(
            f"| {what} | {markdown(event['cause'])} | {'yes' if event['sure'] else 'no'} | {markdown(event['why'])} |"
        )
    return [*lines, ""]


def _confusion(confusion: NDArray[np.int64], classes: Sequence[str]) -> list[str]:
    if not confusion.any():
        return []
    classes = [markdown(name) for name in classes]
    head = ["## Decisions by class", "", "Rows: truth; columns: decision.", "", "| | " + " | ".join(classes) + " |"]
    rule = "| --- |" + " --- |" * len(classes)
    body = [
        f"| **{name}** | " + " | ".join(str(n) if n else "·" for n in row) + " |"
        for name, row in zip(classes, confusion)
    ]
    return [*head, rule, *body]


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.2f} %"


def _number(value: float | None) -> str:
    return "unknown (the instrument does not know)" if value is None or math.isnan(value) else f"{value:.3f}"
