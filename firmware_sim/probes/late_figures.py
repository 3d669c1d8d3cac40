"""A watched run -> its late decisions, each attributed: what trials of real time report.

Owns the figures; which gap explains which decision is attribution.py's.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from pans.runtime.record import read_recording

from .attribution import (
    MACHINE,
    OURS,
    PARTLY,
    WHOSE,
    LateDecision,
    attribute,
    gap_figures,
    late_entry,
    late_table,
    link_figures,
    verdict_of,
    worked_off,
)
from .watched import Outcome


class LateFigures(NamedTuple):
    """Figures for the JSON object, and an entry for each late decision."""

    figures: dict[str, Any]
    entries: list[dict[str, Any]]


def late_figures(outcome: Outcome, deadline_us: float) -> LateFigures:
    """Return how many decisions were late, whose they were, what the run named, and what the probes saw meanwhile."""
    recording = read_recording(outcome.recording)
    timings, events = recording.timings(), list(recording.events())
    late_numbers = [int(event["decision"]) for event in events if event["kind"] == "late"]
    verdicts = [event for event in events if event["kind"] == "blame" and event["what"] == "late"]
    gaps = [gap for log in outcome.logs for gap in log.gaps]
    delays = () if outcome.link is None else outcome.link.delays
    found = attribute(timings, late_numbers, gaps, round(deadline_us * 1000), delays)
    whose = Counter(late.whose for late in found)
    begin_ns = int(timings["device_end_ns"][0]) if len(timings) else 0
    end_ns = int(timings["decided_ns"][-1]) if len(timings) else 1
    figures = {
        "deadline_us": deadline_us,
        "seconds": (end_ns - begin_ns) / 1e9,
        "decisions": len(timings),
        "late": len(late_numbers),
        "late_share": len(late_numbers) / max(len(timings), 1),
        "whose": {name: whose[name] for name in WHOSE},
        "partly_worked_off": sum(worked_off(late, outcome.busy["host"]) for late in found),
        "machine_by_core": _by_core(found),
        "machine_queued": sum(late.queued for late in found if late.whose == MACHINE),
        "named": late_table(found, verdicts),
        "gaps": [
            gap_figures(log, begin_ns, end_ns) | {"stolen_ms": 1000 * outcome.stolen_s[log.core]}
            for log in outcome.logs
        ],
        "link_probe": None if outcome.link is None else link_figures(outcome.link, begin_ns, end_ns),
        "busy": outcome.busy,
        "other_real_time_programs": list(outcome.others),
    }
    return LateFigures(figures, [late_entry(late, verdict_of(late.number, verdicts)) for late in found])


def unexplained(figures: dict[str, Any]) -> int:
    """Return how many late decisions no gap of the machine, no delay of the pair beside and no working off explains."""
    whose = figures["whose"]
    return int(whose[PARTLY] - figures["partly_worked_off"] + whose[OURS])


def _by_core(found: list[LateDecision]) -> dict[str, int]:
    return dict(Counter("+".join(map(str, late.cores)) for late in found if late.whose == MACHINE))
