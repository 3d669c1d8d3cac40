"""A run's figures in words: closing lines for a terminal, rows for pages, sentences for faults.

Owns wording alone; never measures. Each call returns text.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def closing_words(summary: dict[str, Any]) -> str:
    """The lines that the command ends with."""
    banner = "SIMULATED · " if summary["simulated"] else ""
    accuracy = "unknown" if summary["accuracy"] is None else f"{summary['accuracy']:.2%}"
    clicks = summary["clicks_mean"] or 0.0
    photons = "unknown" if summary["photons_mean"] is None else f"{summary['photons_mean']:.2f}"
    latency = summary["latency_us"]
    lines = [
        f"{banner}{summary['verdict']}: {summary['decisions']} decisions ({summary['objects']} objects × {summary['trials']} trials)",
        f"  accuracy      {accuracy} at {clicks:.2f} clicks, {photons} photons, illumination {summary['illumination']:.1f} each",
        f"  latency       p50 {latency['p50']:.0f} us, p99 {latency['p99']:.0f} us, p99.9 {latency['p999']:.0f} us, "
        f"max {latency['max']:.0f} us; late {summary['late']}, lost {summary['lost']}",
        *(flow_words(summary) if "flow" in summary else ()),
        *(f"  fault         {fault}" for fault in summary["faults"]),
        f"  recording     {summary['recording']}",
        f"  report        {summary['report']}",
    ]
    return "\n".join(lines)


def flow_faults(summary: Mapping[str, Any]) -> list[str]:
    """Return one sentence for each broken promise of the gates."""
    gates = summary["gates"]
    lost = gates.get("refused", 0) + gates.get("expired", 0)
    return (
        [f"{lost} of {gates['asked']} pulses were not made: {gates['refused']} refused, {gates['expired']} expired"]
        if lost
        else []
    )


def flow_rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return name and text of the figures that only a flow has."""
    counts, gates = summary["passages"], summary["gates"]
    aborted = ", ".join(f"{name} {n}" for name, n in summary["aborted"].items()) or "none"
    rows = [
        (
            "passages (alone, in coincidence, in gaps)",
            f"{counts['alone']}, {counts['coincident']}, {counts['in_gaps']}",
        ),
        ("accuracy per passage alone, 95 % interval", _share(summary, "accuracy")),
        ("accuracy where a label was given", _share(summary, "accuracy_labelled")),
        ("missed, of those alone", _share(summary, "missed")),
        ("doubled, of those alone", _share(summary, "doubled")),
        ("decisions without a passage", str(counts["without_mark"])),
        ("coincidences aborted / labelled", f"{counts['coincident_aborted']} / {counts['coincident_labelled']}"),
        ("aborted", aborted),
        ("yield (targets pulsed)", _share(summary, "yield")),
        ("purity (pulses on a target alone)", _share(summary, "purity")),
        ("pulses asked, done, refused, expired", ", ".join(str(n) for n in gates.values())),
        ("clicks of the whole passage", _mean(summary["passage_clicks_mean"])),
        ("photons of the whole passage, at least (scaled by clicks)", _mean(summary["passage_photons_mean"])),
    ]
    return rows


def flow_words(summary: Mapping[str, Any]) -> list[str]:
    """Return the lines of a flow's closing words."""
    gates = summary["gates"]
    pulses = f"asked {gates['asked']}, done {gates['done']}, refused {gates['refused']}, expired {gates['expired']}"
    return [*passage_words(summary), f"  gates         {pulses}"]


def passage_words(summary: Mapping[str, Any]) -> list[str]:
    """Return what the decisions about passing objects were worth, in lines; all of it is known in a replay, too."""
    counts = summary["passages"]
    return [
        f"  passages      {counts['marks']}: {counts['alone']} alone, {counts['coincident']} in coincidence, {counts['in_gaps']} in gaps; "
        f"missed {_share(summary, 'missed')}, doubled {_share(summary, 'doubled')}",
        f"  accuracy      {_share(summary, 'accuracy')} of those alone",
        f"  aborted       {', '.join(f'{name} {n}' for name, n in summary['aborted'].items()) or 'none'}",
        f"  light         {_mean(summary['clicks_mean'])} clicks of the window, {_mean(summary['passage_clicks_mean'])} of the passage",
        f"  pulses        {counts['pulses']} made; yield {_share(summary, 'yield')}, purity {_share(summary, 'purity')}",
    ]


def _share(summary: Mapping[str, Any], name: str) -> str:
    value, interval = summary[name], summary[f"{name}_ci"]
    return "unknown" if value is None else f"{value:.3%} ({interval[0]:.3%} to {interval[1]:.3%})"


def _mean(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"
