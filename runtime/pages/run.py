"""The report page of any file that has one, and that of a recording: its sections, from the verdict to the raw facts.

The verdict and the figures of the whole run are those of its summary; curves are computed from recorded messages, decisions and times.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pans.runtime.bundle.model import load_bundle
from pans.runtime.errors import UsageError
from pans.runtime.record import Recording
from pans.runtime.record.parts import open_recording
from pans.runtime.record.recording import together
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.report.verify import file_kind

from .bundle import add_optics, bundle_page
from .events import add_events
from .flow import add_late, add_passages, is_flow
from .page import Page
from .rates import add_dark, add_rates, count_rates
from .results import add_results
from .timing import add_clock, add_timing
from .verdict import add_verdict
from .walks import add_walks

_TITLES = {
    "accuracy": "accuracy",
    "accuracy_std_trials": "spread over trials (standard deviation)",
    "accuracy_stderr_objects": "spread over objects (standard error)",
    "objects": "objects",
    "trials": "trials each time that an object is shown",
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
        return recording_page(open_recording(path, salvage=True))
    if kind == "bundle":
        bundle, sha256 = load_bundle(path)
        return bundle_page(bundle, sha256, Path(path))
    raise UsageError(f"{path} is a {kind}", remedy="reports are made of recordings and bundles; `pans info` shows this")


def recording_page(recording: Recording) -> bytes:
    """Return the page of `recording`; a cut one is shown as far as it goes, and says so."""
    bundle = recording.bundle() if recording.bundle_place else None
    name = bundle.name if bundle is not None else "a bundle that is not in the recording"
    page = Page(f"Run of {name}", simulated=recording.simulated)
    add_verdict(page, recording, bundle)
    if is_flow(recording):
        add_passages(page, recording, bundle)
    else:
        add_results(page, lambda: together(recording.iter_decisions()), bundle, recording.header)
    plan = recorded_plan(recording)
    rates = count_rates(recording, plan, 0 if bundle is None else bundle.n_classes)
    if bundle is not None and plan.automaton is None:
        page.heading("Patterns, and what a click on each means" if bundle.analyser is None else "Optics")
        add_optics(page, bundle, rates)
    if plan.automaton is not None and bundle is not None:
        add_walks(page, recording, bundle, plan.automaton, rates)
    add_dark(page, rates, recording.summary)
    add_timing(page, recording)
    add_late(page, recording)
    add_rates(page, plan, rates)
    add_clock(page, recording)
    add_events(page, recording)
    _add_all_figures(page, recording)
    _add_what_was_run(page, recording)
    return page.html()


def _add_all_figures(page: Page, recording: Recording) -> None:
    summary = recording.summary
    if not summary:
        return
    hidden = _STILL if is_flow(recording) else set()
    page.heading("All figures")
    page.table(
        [(text, _figure(key, summary[key])) for key, text in _TITLES.items() if key in summary and key not in hidden]
    )
    rest = {key: value for key, value in summary.items() if key not in _SHOWN_ELSEWHERE and key not in recording.header}
    told = {key: summary.get(key, {}) for key in ("device", "dark", "clock")}
    with page.folded("Further figures, as the run summed them up"):
        page.facts(rest | told)


def _add_what_was_run(page: Page, recording: Recording) -> None:
    page.heading("What was run")
    header = {key: value for key, value in recording.header.items() if key != "profile"}
    profile = recording.header.get("profile") or {}
    page.facts({"command": header.pop("command", ""), "decision log SHA-256": recording.decisions_sha256})
    with page.folded("Configuration and versions"):
        page.facts({"profile": {key: profile[key] for key in ("name", "sha256") if key in profile}} | header)


def _figure(key: str, value: Any) -> str:
    if value is None:
        return "unknown"
    if key.startswith("accuracy"):
        return f"{100 * value:.2f} %"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
