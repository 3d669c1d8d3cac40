"""The report page of any file that has one, and that of a recording: which figures stand on it, and where they come from.

Owns the order of the sections and the sums behind the drawings; never draws (figures.py) and never judges: the verdict is the
recorded one. Every figure is computed from the recorded messages, decisions and times, except where it says "as the run summed it up".
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.errors import UsageError
from pans.runtime.record import Recording, read_recording
from pans.runtime.record.sent_plan import recorded_plan

from . import figures as draw
from .page import Page
from .page_bundle import add_optics, bundle_page
from .page_flow import add_late, add_passages, is_flow
from .page_rates import add_rates, count_rates
from .page_walks import add_walks
from .verify import file_kind

EVENTS_SHOWN = 200
EVENTS_OF_A_KIND = 30
_TITLES = {
    "accuracy": "accuracy",
    "accuracy_std_trials": "spread over trials (standard deviation)",
    "accuracy_stderr_objects": "spread over objects (standard error)",
    "objects": "objects",
    "trials": "trials per object",
    "decisions": "decisions",
    "abstained": "of them abstained",
    "clicks_mean": "clicks per decision",
    "photons_mean": "photons per decision (expected photoelectrons)",
    "illumination": "illumination per decision (sum of pattern intensities)",
    "drive": "the automaton was driven by the",
    "exposures_mean": "exposures per walk",
    "abstained_below_confidence": "abstained below the confidence that was asked for",
    "late_slots": "slots that stayed dark because their state was named too late",
    "late": "late decisions",
    "lost": "lost exposures",
}
_STILL = {"accuracy_std_trials", "accuracy_stderr_objects", "objects", "trials"}  # of objects that stand still
_SHOWN_ELSEWHERE = {
    *_TITLES,
    "simulated",
    "verdict",
    "faults",
    "latency_us",
    "stage_latency_us",
    "device",
    "dark",
    "clock",
}


def page_of(path: str | Path) -> bytes:
    """Return one self-contained HTML page of a recording or a bundle; UsageError for another kind of file or a missing one."""
    kind = file_kind(path)
    if kind == "recording":
        return recording_page(read_recording(path, salvage=True))
    if kind == "bundle":
        bundle, sha256 = load_bundle(path)
        return bundle_page(bundle, sha256, Path(path))
    raise UsageError(f"{path} is a {kind}", remedy="reports are made of recordings and bundles; `pans info` shows this")


def recording_page(recording: Recording) -> bytes:
    """Return the page of `recording`; a cut one is shown as far as it goes, and says so."""
    summary = recording.summary
    bundle = recording.bundle() if recording.bundle_place else None
    name = bundle.name if bundle is not None else "a bundle that is not in the recording"
    page = Page(f"Run of {name}", simulated=recording.simulated)
    _verdict(page, recording)
    page.heading("Results")
    if summary:
        hidden = _STILL if is_flow(recording) else set()
        page.table(
            [
                (text, _figure(key, summary[key]))
                for key, text in _TITLES.items()
                if key in summary and key not in hidden
            ]
        )
    if is_flow(recording):
        add_passages(page, recording, bundle)
    else:
        _confusion(page, recording.decisions(), bundle)
    _timing(page, recording)
    add_late(page, recording)
    plan = recorded_plan(recording)
    rates = count_rates(recording, plan)
    if plan.automaton is not None and bundle is not None:
        add_walks(page, recording, bundle, plan.automaton, rates)
    add_rates(page, plan, rates, summary)
    _clock(page, recording)
    _events(page, recording)
    if bundle is not None:
        page.heading("The bundle")
        add_optics(page, bundle)
    page.heading("What was run")
    header = {key: value for key, value in recording.header.items() if key != "profile"}
    profile = recording.header.get("profile") or {}
    facts = {
        "recording": str(recording.path),
        "decision log SHA-256": recording.decisions_sha256,
        "profile": {key: profile[key] for key in ("name", "sha256") if key in profile},
    }
    page.facts(facts | header)
    rest = {key: value for key, value in summary.items() if key not in _SHOWN_ELSEWHERE and key not in header}
    if rest:
        page.heading("Further figures, as the run summed them up")
        page.facts(
            rest
            | {"device": summary.get("device", {}), "dark": summary.get("dark", {}), "clock": summary.get("clock", {})}
        )
    return page.html()


def _verdict(page: Page, recording: Recording) -> None:
    summary = recording.summary
    if not recording.complete:
        page.text(
            f"INCOMPLETE: the recording was cut; {recording.n_decisions} decisions in the first {recording.end_offset} of "
            f"{recording.size} bytes are shown. {recording.damage}",
            "fail",
        )
    if "verdict" in summary:
        passed = summary["verdict"] == "PASS"
        page.text(str(summary["verdict"]), "pass" if passed else "fail")
        for fault in summary.get("faults", []):
            page.text(str(fault), "fail")


def _figure(key: str, value: Any) -> str:
    if value is None:
        return "unknown"
    if key.startswith("accuracy"):
        return f"{100 * value:.2f} %"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _confusion(page: Page, decisions: NDArray[np.void], bundle: Bundle | None) -> None:
    if bundle is None or not 2 <= bundle.n_classes <= draw.CLASSES_MAX:
        return
    decided = decisions[(decisions["flags"] & int(DecisionFlag.ABSTAINED)) == 0]
    known = decided[(decided["truth"] >= 0) & (decided["truth"] < bundle.n_classes)]
    if not len(known):
        page.text("The true classes are not in the decision log: no confusion matrix.", "note")
        return
    counts = np.zeros((bundle.n_classes, bundle.n_classes), np.int64)
    np.add.at(counts, (known["truth"], known["label"]), 1)
    page.heading("Decisions by class")
    page.figure(
        draw.confusion(counts, bundle.classes),
        f"{len(known)} decisions with a known truth, without those that abstained.",
    )


def _timing(page: Page, recording: Recording) -> None:
    timings = recording.timings()
    if not len(timings):
        return
    end, arrival, decided, recorded = (
        timings[name].astype(np.float64) / 1000 for name in ("device_end_ns", "arrival_ns", "decided_ns", "recorded_ns")
    )
    stages = {
        "exposure end to decision": decided - end,
        "link: exposure end to arrival": arrival - end,
        "arrival to decision": decided - arrival,
        "decision to record": recorded - decided,
    }
    deadline = recording.summary.get("deadline_us") or recording.header.get("config", {}).get("deadline_us")
    page.heading("Timing")
    page.table(
        [
            (name, *(f"{value:.1f}" for value in (*np.quantile(values, (0.5, 0.99, 0.999)), values.max())))
            for name, values in stages.items()
        ],
        ("microseconds", "p50", "p99", "p99.9", "max"),
    )
    if float(np.quantile(decided - arrival, 0.99)) < 0.05:
        page.text("Virtual time: the host took no time at all, so that these figures say nothing about speed.", "note")
    page.figure(
        draw.latencies(stages, float(deadline) if deadline else None),
        "Time between the end of the last exposure (device clock, converted) and the decision, whole and by stage. Both axes are "
        f"logarithmic; what is below {draw.LEAST_US:g} us, or below 0 within the clock's uncertainty, stands in the first bin.",
    )


def _clock(page: Page, recording: Recording) -> None:
    samples = recording.clock_samples()
    if len(samples) < 3 or samples["tick"].min() == samples["tick"].max():
        return  # a run so short that nothing passed on the clock
    host = (samples["host_ns"] - samples["host_ns"][0]).astype(np.float64)
    ticks = (samples["tick"] - samples["tick"][0]).astype(np.int64).astype(np.float64)
    half_trip_us = samples["round_trip_ns"].astype(np.float64) / 2000
    weight = 1 / np.maximum(half_trip_us, 1e-3)
    slope, start = np.polyfit(ticks, host, 1, w=weight)
    nominal_ns = 1e9 / int(recording.header["config"]["tick_hz"])
    page.heading("Clock")
    page.figure(
        draw.clock(host / 1e9, (host - slope * ticks - start) / 1000, half_trip_us, (nominal_ns / slope - 1) * 1e6),
        f"{len(samples)} probes of the device's clock. A straight line through them all is a summary; the run itself followed "
        "the clock as it went.",
    )


def _events(page: Page, recording: Recording) -> None:
    kinds: Counter[str] = Counter()
    shown: list[tuple[str, str]] = []
    for event in recording.events():
        kind = str(event.get("kind", "?"))
        kinds[kind] += 1
        if len(shown) < EVENTS_SHOWN and kinds[kind] <= EVENTS_OF_A_KIND and kind != "session":
            shown.append((kind, ", ".join(f"{key} {value}" for key, value in event.items() if key != "kind")))
    page.heading("Events")
    page.table([(kind, count) for kind, count in kinds.most_common()], ("kind", "how often"))
    if shown:
        page.table(shown, ("event", "what was noted"))
    if sum(kinds.values()) - kinds["session"] > len(shown):
        page.text(
            f"{len(shown)} are shown, the first {EVENTS_OF_A_KIND} of a kind at most; `pans export` writes them all.",
            "note",
        )
