"""The summary of a run: the JSON of the contract, the verdict, and a Markdown page for people.

Owns how results are worded; never measures. `summarise` returns the JSON object, `write_markdown` writes the page beside and
renames it. A simulated run says SIMULATED in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pans.runtime.container import replace_file
from pans.runtime.live.config import RunResult
from pans.runtime.live.tally import RunTally

from .words import flow_faults, flow_rows

MAX_VERDICTS = 20  # of a summary; the recording has them all


def summarise(
    result: RunResult, *, illumination: float, expected_decisions: int, flow: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the run's figures under the contract's keys; `illumination` is per decision, in photoelectrons per unit transmission.

    `flow` is what FlowRun says of passing objects; its figures replace those of still ones.
    """
    tally, timing = result.tally, result.timing
    faults = find_faults(result, expected_decisions, aborts_are_faults=flow is None)
    faults += [] if flow is None else flow_faults(flow)
    return {
        **tally.summary(),
        **(flow or {}),
        "illumination": illumination,
        "late": timing.late,
        "late_blame": timing.blame,
        "late_cause": result.late_cause,
        "lost_cause": result.lost_cause,
        "blame": [event for event in result.events if event["kind"] == "blame"][:MAX_VERDICTS],
        "lost": result.stream["lost_exposures"],
        "latency_us": timing.total.summary(),
        "stage_latency_us": {name: histogram.summary() for name, histogram in timing.stages.items()},
        "deadline_us": timing.deadline_ns / 1000,
        "clock": result.clock | {"worst_uncertainty_us": timing.worst_uncertainty_ns / 1000},
        "slot_jitter_us": result.slot_jitter_us,
        "wrong_patterns": result.wrong_patterns,
        "dark": asdict(result.dark),
        "stream": result.stream,
        "link": result.decoder,
        "realtime": result.realtime,
        "device": _plain_device(result.device),
        "armed_after_s": result.armed_after_s,
        "seconds": result.seconds,
        "ended": result.ended,
        "link_lost": result.link_lost,
        "reconnects": result.reconnects,
        "decisions_sha256": result.decisions_sha256,
        "simulated": bool(result.device.get("simulated")),
        "verdict": "FAIL" if faults else "PASS",
        "faults": faults,
    }


def find_faults(result: RunResult, expected_decisions: int, aborts_are_faults: bool = True) -> list[str]:
    """Return one sentence for each way in which the run broke its promise; empty means PASS."""
    tally, timing, stream = result.tally, result.timing, result.stream
    faults = []
    if result.link_lost:
        faults.append(result.ended)
    if result.reconnects:
        faults.append(f"the device was lost and found again {result.reconnects} times")
    if timing.late:
        blame = ", ".join(f"{cause} {count}" for cause, count in sorted(result.late_cause.items()))
        faults.append(f"{timing.late} decisions later than {timing.deadline_ns / 1e6:g} ms (cause: {blame})")
    if stream["lost_exposures"]:
        faults.append(
            f"{stream['lost_exposures']} exposures lost in {stream['gaps']} gaps, "
            f"{stream['device_drops']} of them dropped by the device"
        )
    if result.wrong_patterns:
        faults.append(f"{result.wrong_patterns} exposures showed another pattern than planned")
    if tally.abstained and aborts_are_faults:
        faults.append(f"{tally.abstained} decisions abstained")
    if expected_decisions and tally.decisions != expected_decisions:
        faults.append(f"{tally.decisions} of {expected_decisions} decisions were made; the run ended: {result.ended}")
    if result.dark.alarm:
        faults.append(result.dark.alarm)
    faults += [event["words"] for event in result.dark.findings if event["level"] == "alarm"]
    return faults


def write_markdown(
    path: Path, summary: Mapping[str, Any], facts: Mapping[str, Any], tally: RunTally, classes: Sequence[str]
) -> None:
    """Write the summary page; `facts` are name -> text lines about what was run (bundle, profile, device, command)."""
    simulated = " (SIMULATED)" if summary["simulated"] else ""
    lines = [f"# Run of {facts.get('bundle', 'a bundle')}{simulated}", ""]
    if summary["simulated"]:
        lines += ["> **SIMULATED**: the clicks come from a simulated instrument, not from light.", ""]
    lines += [f"**{summary['verdict']}**" + "".join(f"\n- {fault}" for fault in summary["faults"]), ""]
    lines += [
        *_figures(summary),
        "",
        *_timing(summary),
        "",
        *_blame(summary),
        *_confusion(tally, classes),
        "",
        "## What was run",
        "",
    ]
    lines += [f"- {name}: {text}" for name, text in facts.items()]
    replace_file(path, ("\n".join(lines) + "\n").encode())


def _figures(summary: Mapping[str, Any]) -> list[str]:
    rows = [
        ("accuracy", _percent(summary["accuracy"])),
        ("spread over trials (standard deviation)", _percent(summary["accuracy_std_trials"])),
        ("spread over objects (standard error)", _percent(summary["accuracy_stderr_objects"])),
        ("objects × trials", f"{summary['objects']} × {summary['trials']}"),
        ("decisions (abstained)", f"{summary['decisions']} ({summary['abstained']})"),
        ("clicks per decision", _number(summary["clicks_mean"])),
        ("photons per decision (expected photoelectrons)", _number(summary["photons_mean"])),
        ("illumination per decision (sum of pattern intensities)", _number(summary["illumination"])),
        (
            "dark clicks per dark exposure",
            f"{summary['dark']['clicks']} in {summary['dark']['exposures']}, 95 % interval "
            f"{summary['dark']['low']:.2g} to {summary['dark']['high']:.2g}, profile {summary['dark']['expected']:.2g}",
        ),
    ]
    if "flow" in summary:
        rows += flow_rows(summary)
    return ["## Results", "", "| figure | value |", "| --- | --- |", *(f"| {name} | {text} |" for name, text in rows)]


def _timing(summary: Mapping[str, Any]) -> list[str]:
    head = [
        "## Timing",
        "",
        "Microseconds; from the end of the last exposure (device clock) to the decision, and by stage.",
        "",
    ]
    table = ["| stage | p50 | p99 | p99.9 | max |", "| --- | --- | --- | --- | --- |"]
    stages = {"**exposure end to decision**": summary["latency_us"], **summary["stage_latency_us"]}
    for name, row in stages.items():
        table.append(f"| {name} | {row['p50']:.0f} | {row['p99']:.0f} | {row['p999']:.0f} | {row['max']:.0f} |")
    granted = (
        ", ".join(f"{what}: {answer}" for what, answer in summary["realtime"].items())
        or "virtual time: nothing asked for"
    )
    tail = [
        "",
        f"- deadline {summary['deadline_us']:.0f} us: {summary['late']} late; {summary['lost']} exposures lost",
        f"- clock: uncertainty at most {summary['clock']['worst_uncertainty_us']:.0f} us, "
        f"drift {summary['clock'].get('drift_ppm', 0.0):.1f} ppm; slot jitter at most {summary['slot_jitter_us']:.1f} us",
        f"- armed {summary['armed_after_s']:.2f} s after the start; measured for {summary['seconds']:.1f} s; ended: {summary['ended']}",
        f"- real-time set-up: {granted}",
    ]
    return head + table + tail


def _blame(summary: Mapping[str, Any]) -> list[str]:
    """Who is to blame for late and missing work, with the first verdicts in words."""
    if not summary["blame"]:
        return []
    sums = [(what, summary[key]) for what, key in (("late decisions", "late_cause"), ("lost exposures", "lost_cause"))]
    lines = ["## Late and missing work", ""]
    for what, causes in sums:
        if causes:
            named = ", ".join(f"{cause} {count}" for cause, count in sorted(causes.items(), key=lambda item: -item[1]))
            lines.append(f"- {what} by cause: {named}")
    lines += ["", "| what | cause | sure | why |", "| --- | --- | --- | --- |"]
    for event in summary["blame"]:
        late = event["what"] == "late"
        what = f"{event['decisions']} late" if late else f"{event['exposures']} exposures missing"
        lines.append(f"| {what} | {event['cause']} | {'yes' if event['sure'] else 'no'} | {event['why']} |")
    return [*lines, ""]


def _confusion(tally: RunTally, classes: Sequence[str]) -> list[str]:
    if not tally.confusion.any():
        return []
    head = ["## Decisions by class", "", "Rows: truth; columns: decision.", "", "| | " + " | ".join(classes) + " |"]
    rule = "| --- |" + " --- |" * len(classes)
    body = [
        f"| **{name}** | " + " | ".join(str(n) if n else "·" for n in row) + " |"
        for name, row in zip(classes, tally.confusion)
    ]
    return [*head, rule, *body]


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.2f} %"


def _number(value: float | None) -> str:
    return "unknown (the instrument does not know)" if value is None or math.isnan(value) else f"{value:.3f}"


def _plain_device(device: Mapping[str, Any]) -> dict[str, Any]:
    return {str(key): value for key, value in device.items() if isinstance(value, (str, int, float, bool))}
