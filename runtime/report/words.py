"""A run's figures in words, from the facts of its summary: rows for terminal, Markdown and pages, closing lines, and the Markdown page.

The Markdown page is written beside the recording without any extra; `pans report` makes the full page of the recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.intervals import wilson_interval
from pans.runtime.outputs import write_file
from pans.runtime.safe_text import markdown, one_line
from pans.runtime.timing.realtime import fault_words

if TYPE_CHECKING:
    from .summary import Summary

UNRESOLVED_US = 1000.0  # a clock that is known no better hides what a host takes
QUANTILES = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
Facts = Mapping[str, Any]
Rows = list[tuple[str, str, str]]  # name, figure, what else there is to say


def closing_words(summary: Summary, recording: str, report: str) -> str:
    """The lines that the command ends with."""
    facts = summary.as_json()
    accuracy = "unknown" if facts["accuracy"] is None else f"{facts['accuracy']:.2%}"
    photons = "unknown" if facts["photons_mean"] is None else f"{facts['photons_mean']:.2f}"
    light = f"{facts['clicks_mean'] or 0.0:.2f} clicks, {photons} photons, illumination {facts['illumination']:.1f}"
    rows: Rows = [
        ("accuracy", f"{accuracy} at {light} each", ""),
        ("latency", f"{latency_words(facts)}; late {facts['late']}, lost {facts['lost']}", ""),
        ("exposures", exposure_words(facts["exposure_timing"]), ""),
        *more_rows(facts),
        *(("fault", fault, "") for fault in facts["faults"]),
        *(("recording", recording, ""), ("report", report, "")),
    ]
    simulated = "SIMULATED · " * facts["simulated"]
    head = f"{simulated}{facts['verdict']}: {facts['decisions']} decisions ({objects_words(facts)})"
    return "\n".join([head, *lines_of(rows)])


def lines_of(rows: Rows) -> list[str]:
    """Return rows as lines for a terminal."""
    return [f"  {name:<13} {one_line('; '.join(filter(None, texts)))}" for name, *texts in rows]


def objects_words(facts: Facts) -> str:
    """Return on how many objects how often was decided; objects that come again and again are no trials.

    >>> objects_words({"objects": 200, "trials": 1, "decisions": 500})
    '200 objects, 2.5 decisions on each on average'
    """
    objects, trials, decisions = facts["objects"], facts["trials"], facts["decisions"]
    if objects * trials == decisions:
        return f"{objects} objects × {trials} trials"
    many = f"{objects} objects, {decisions / max(objects, 1):.1f} decisions on each on average"
    return many if objects else "true classes unknown"


def latency_words(facts: Facts) -> str:
    """Return the quantiles of the time from exposure to decision; what the clock cannot resolve is said, not shown as 0."""
    values = {name: facts["latency_us"][key] for name, key in QUANTILES.items()}
    uncertainty_us = facts["clock"]["worst_uncertainty_us"]
    seen = [f"{name} {value:.0f} us" for name, value in values.items() if not is_unresolved(value, uncertainty_us)]
    if not is_unresolved(values["p50"], uncertainty_us):
        return ", ".join(seen)
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


def accuracy_interval(facts: Facts) -> tuple[float, float] | None:
    """Return the 95 % interval of the accuracy, None where it is not known: as a flow states it, else Wilson's by independent objects.

    Several decisions about an object count as many objects as the spread over objects amounts to.
    """
    accuracy, objects, error = (facts.get(name) for name in ("accuracy", "objects", "accuracy_stderr_objects"))
    if facts.get("accuracy_ci"):
        low, high = facts["accuracy_ci"]
        return low, high
    if accuracy is None or not objects:
        return None
    n = max(objects, round(accuracy * (1 - accuracy) / error**2)) if error else objects
    return wilson_interval(accuracy * n, n)


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.2f} %"


def _mean(value: float | None) -> str:
    return "unknown" if value is None or value != value else f"{value:.3f}"


def _share(facts: Facts, name: str) -> str:
    value, ends = facts[name], facts[f"{name}_ci"]
    return "unknown" if value is None or ends is None else f"{value:.3%} ({ends[0]:.3%} to {ends[1]:.3%})"


def figure_rows(facts: Facts, *, timed: bool = False) -> Rows:
    """Return the figures that every run has; with `timed` how long decisions took."""
    rows: Rows = []
    if "passages" not in facts:
        ends, spread = accuracy_interval(facts), facts.get("accuracy_std_trials")
        more = "" if ends is None else f"95 % interval {100 * ends[0]:.2f} to {100 * ends[1]:.2f} %; "
        more += "" if spread is None else f"standard deviation over trials {_percent(spread)}; "
        rows.append(("accuracy", _percent(facts.get("accuracy")), more + objects_words(facts)))
    clicks, photons = (_mean(facts.get(name)) for name in ("clicks_mean", "photons_mean"))
    light = _mean(facts.get("illumination_mean", facts.get("illumination")))
    sent = f"{photons} photons (expected photoelectrons), illumination {light} (sum of pattern intensities)"
    rows += [
        ("decisions", f"{facts['decisions']:,}", f"{facts['abstained']:,} of them abstained"),
        ("clicks per decision", clicks, sent),
        ("late decisions", f"{facts['late']:,}", f"{facts['lost']:,} exposures lost{_repeats(facts['stream'])}"),
    ]
    if timed:
        budget = f"99 % of decisions were faster; budget {facts['deadline_us'] / 1000:g} ms"
        rows.append(("latency p99", f"{facts['latency_us']['p99'] / 1000:.3g} ms", budget))
    if timing := facts.get("exposure_timing"):
        start = f"{timing['worst_start_us']:+.3g} us" if timing["exposures"] else "unknown"
        rows.append(("exposures off the plan", start, exposure_words(timing)))
    if (dark := facts.get("dark") or {}).get("exposures"):
        between = f"95 % interval {dark['low']:.2g} to {dark['high']:.2g}, expected {dark['expected']:.2g}"
        counts = f"{dark['clicks']} clicks in {dark['exposures']} dark exposures of the whole run, {between}"
        rows.append(("dark clicks per exposure", f"{dark['clicks'] / dark['exposures']:.3g}", counts))
    return rows


def more_rows(facts: Facts) -> Rows:
    """Return the figures that only passing objects, and those that only an automaton has."""
    return (flow_rows(facts) if "passages" in facts else []) + (walk_rows(facts) if "drive" in facts else [])


def _repeats(stream: Facts) -> str:
    """How many messages came twice; what differs is a contradiction, and a fault."""
    more = {what: stream.get(f"repeats_{what}", 0) for what in ("differing", "unchecked")}
    words = ", ".join(f"{count} {what}" for what, count in more.items() if count)
    repeated = stream.get("repeated", 0)
    return f"; {repeated} messages repeated or overtaken{f' ({words})' if words else ''}" if repeated else ""


def walk_rows(facts: Facts) -> Rows:
    """Return the figures of an automaton's walks."""
    rows: Rows = [("walks", f"{_mean(facts['exposures_mean'])} exposures each, driven by the {facts['drive']}", "")]
    if facts["confidence"]:
        below = f"{facts['abstained_below_confidence']} decisions abstained below it"
        rows.append(("confidence", f"{facts['confidence']:g}", below))
    if (turn := facts["turn_us"]) is not None:
        words = ", ".join(f"{name} {turn[key]:.0f} us" for name, key in QUANTILES.items())
        rows.append(
            ("host's turn", f"{words} of {facts['turn_budget_us']:.0f} us", f"late slots {facts['late_slots']}")
        )
    if (one := facts["expected"]) is not None:
        off = facts["expected_off_stderr"]
        light = f"{one['clicks']:.2f} clicks, {one['photons']:.2f} photons"
        words = f"{one['accuracy']:.2%} at {light} ({one['profile']}, {one['split']})"
        rows.append(("expected", words, "" if off is None else f"measured {off:+.2f} standard errors from it"))
    return rows


def flow_rows(facts: Facts) -> Rows:
    """Return the figures of passing objects; those of the gates are not known in a replay. Intervals are 95 %."""
    n, gates = facts["passages"], facts.get("gates")
    means = [_mean(facts[name]) for name in ("clicks_mean", "passage_clicks_mean", "passage_photons_mean")]
    aborted = ", ".join(f"{name} {count}" for name, count in facts["aborted"].items()) or "none"
    coincident = (
        f"{n['coincident']} in coincidence ({n['coincident_aborted']} aborted, {n['coincident_labelled']} labelled)"
    )
    passed = f"{n['alone']} alone, {coincident}, {n['in_gaps']} in gaps"
    made = (
        "" if gates is None else ", ".join(f"{what} {gates[what]}" for what in ("asked", "done", "refused", "expired"))
    )
    return [
        ("passages", f"{n['marks']}: {passed}", f"{n['without_mark']} decisions without a passage"),
        (
            "accuracy",
            f"{_share(facts, 'accuracy')} of those alone",
            f"{_share(facts, 'accuracy_labelled')} where labelled",
        ),
        ("missed", f"{_share(facts, 'missed')} of those alone", f"doubled {_share(facts, 'doubled')}"),
        ("aborted", aborted, ""),
        ("light", "{} clicks of the window, {} of the passage".format(*means), f"{means[2]} photons of it, at least"),
        (
            "pulses",
            f"{n['pulses']} made{f' ({made})' if made else ''}",
            f"yield {_share(facts, 'yield')}, purity {_share(facts, 'purity')}",
        ),
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
    clock, granted = facts["clock"], ", ".join(f"{what}: {answer}" for what, answer in facts["realtime"].items())
    timing = [
        f"deadline {facts['deadline_us']:.0f} us",
        f"clock: uncertainty at most {clock['worst_uncertainty_us']:.0f} us, drift {clock.get('drift_ppm', 0.0):.1f} ppm; "
        f"slot jitter at most {facts['slot_jitter_us']:.1f} us",
        f"armed {facts['armed_after_s']:.2f} s after the start; measured for {facts['seconds']:.1f} s; ended: {facts['ended']}",
        f"real-time set-up: {granted or 'virtual time: nothing asked for'}",
        f"page faults of the loop while armed: {fault_words(facts['page_faults'])}",
    ]
    lines = [
        f"# Run of {markdown(run.get('bundle', 'a bundle'))}{' (SIMULATED)' if simulated else ''}",
        simulated,
        f"**{facts['verdict']}**",
        *(f"- {markdown(fault)}" for fault in facts["faults"]),
        *_table("Results", ("figure", "value", ""), [*figure_rows(facts), *more_rows(facts)]),
        *_table("Timing", ("microseconds", *QUANTILES), stage_rows(facts)),
        *(f"- {markdown(line)}" for line in timing),
        *(
            _table("Late and missing work", ("what", "cause", "sure", "why"), causes)
            if (causes := _causes(facts))
            else ()
        ),
    ]
    if confusion.any():
        cells = [(name, *(str(n) if n else "·" for n in row)) for name, row in zip(classes, confusion.tolist())]
        lines += _table("Decisions by class (truth in rows)", ("", *classes), cells)
    lines += ["", "## What was run", "", *(f"- {name}: {markdown(text)}" for name, text in run.items())]
    write_file(path, ("\n".join(lines) + "\n").encode(), force=force)


def _table(heading: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(map(markdown, row))} |" for row in (head, *rows)]
    return ["", f"## {heading}", "", lines[0], "|" + " --- |" * len(head), *lines[1:], ""]


def _causes(facts: Facts) -> list[tuple[str, ...]]:
    """What was late or missing, from which decision or exposure on, its cause, whether the evidence is conclusive, and why."""
    late, missing = (
        "{decisions} late from decision {first_decision} on",
        "{exposures} exposures missing from {first_exposure} on",
    )
    rows = ((late if one["what"] == "late" else missing, one) for one in facts["blame"])
    return [(words.format(**one), one["cause"], "yes" if one["sure"] else "no", one["why"]) for words, one in rows]


def stage_rows(facts: Facts) -> list[tuple[str, ...]]:
    """Return the quantiles of the whole latency and by stage, microseconds; the host's own stages are of its clock alone."""
    uncertainty_us, rows = facts["clock"]["worst_uncertainty_us"], []
    for name, row in {"exposure end to decision": facts["latency_us"], **facts["stage_latency_us"]}.items():
        doubt_us = uncertainty_us if name in ("exposure end to decision", "link") else 0.0
        cells = (row[key] for key in QUANTILES.values())
        rows.append((name, *("not resolved" if is_unresolved(us, doubt_us) else f"{us:.0f}" for us in cells)))
    return rows
