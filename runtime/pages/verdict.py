"""The top of a run's page: the verdict with its reasons and what to do about each, what was run, the main figures.

Verdict, faults and figures are those that the run recorded. A recording that was cut has no summary: then the top says so, and only what
the header knows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.intervals import Z_95
from pans.runtime.record import Recording
from pans.runtime.report.words import exposure_words, repeat_words
from pans.runtime.safe_text import one_line

from .page import Page
from .timing import NO_TIME_US

# words of a fault (report/summary.py) -> what to do about it; the first that fits
ADVICE = (
    ("decisions later than", "“Late and missing work” names the cause; `pans doctor` checks the machine (docs/how-to/real-time.md)."),
    ("exposures lost", "Check the cable, the hub and the device's buffer; “Late and missing work” names the cause."),
    ("messages lost", "Check the cable: only marks of objects were lost, no clicks."),
    ("lost and found again", "Check cable, power and hub. Decisions during an outage are missing."),
    ("was lost", "Check cable, power and hub; `pans devices` shows whether the device is there."),
    ("contradict the evidence", "Messages do not fit the plan or each other: check the device's firmware (pans conform) and the link."),
    ("another pattern than planned", "Check the trigger between projector and detector: a pattern was skipped or shown twice."),
    ("named their state too late", "Let the device choose the pattern (`--drive device`), or give the loop a core of its own (`--core`)."),
    ("exposure_tolerance_us", "Begin and end exposures by a timer, not in the main loop (docs/how-to/reference-instrument.md)."),
    ("decisions abstained", "The flags in the decision log say why; “Events” below has the moments."),
    ("decisions were made", "The run ended early; run it again for the rest."),
    ("the calibration contradicts", "Calibrate again with `pans calibrate`: the dark counts are not those of the calibration."),
    ("dark", "Look for stray light, check the detector's temperature, then calibrate again (docs/how-to/dark-counts.md)."),
    ("channel", "A channel is dead or disconnected: check its supply and cable; docs/how-to/dark-counts.md."),
    ("pulses were not made", "The pulse was asked for too late: raise `--gate-delay-us`, or check the actuator."),
)  # fmt: skip


def advice_on(fault: str) -> str:
    """Return what to do about a fault, "" where nothing is known."""
    return next((advice for words, advice in ADVICE if words in fault), "")


def add_verdict(page: Page, recording: Recording, bundle: Bundle | None) -> None:
    """Add verdict, reasons, what was run, and the main figures."""
    summary = recording.summary
    if not recording.complete:
        reason = (
            f"The recording was cut. The page shows {recording.n_decisions} decisions in the first {recording.end_offset} of "
            f"{recording.size} bytes. {recording.damage}"
        )
        page.verdict("INCOMPLETE", "fail", [(reason, "What was recorded before is whole; run again for the rest.")])
    if "verdict" in summary:
        passed = summary["verdict"] == "PASS"
        faults = [(str(fault), advice_on(str(fault))) for fault in summary.get("faults", [])]
        page.verdict(str(summary["verdict"]), "pass" if passed else "fail", faults or [(_why_passed(summary), "")])
    page.table(_facts(recording, bundle), kind="facts")
    if summary:
        page.tiles(_tiles(summary))


def _why_passed(summary: Mapping[str, Any]) -> str:
    dark = summary.get("dark")
    counted = dark if isinstance(dark, Mapping) and dark.get("exposures") else {}
    agree = counted.get("low", 1) <= counted.get("expected", 0) <= counted.get("high", 0)
    return (
        f"All {summary.get('decisions', 0):,} decisions were made within {float(summary.get('deadline_us', 0)) / 1000:g} ms, no exposure "
        f"was lost{', and the dark counts are as expected' if agree else ''}."
    )


def _facts(recording: Recording, bundle: Bundle | None) -> list[tuple[str, str]]:
    header, summary = recording.header, recording.summary
    device, profile = summary.get("device", {}), header.get("profile") or {}
    firmware = f", firmware {device['firmware']}" if "firmware" in device else ""
    name = bundle.name if bundle is not None else "not in the recording"
    seconds = summary.get("seconds")
    lasted = "" if seconds is None else f", {float(seconds):,.1f} s"
    rows = [
        ("date", f"{str(header.get('created_utc', 'unknown'))[:19].replace('T', ' ')} UTC{lasted}"),
        ("device", f"{header.get('device_url', 'unknown')}{firmware}"),
        ("bundle", f"{name} (SHA-256 {str(header.get('bundle_sha256', ''))[:16]}…)"),
        ("profile", f"{profile.get('name', 'unknown')} (SHA-256 {str(profile.get('sha256', ''))[:16]}…)"),
        ("recording", str(recording.path)),
    ]
    if summary.get("ended"):
        rows.append(("ended", str(summary["ended"])))
    return [(key, one_line(text)) for key, text in rows]


def accuracy_interval(summary: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the 95 % interval of the accuracy by its spread over objects; None where it is not known."""
    accuracy, error = summary.get("accuracy"), summary.get("accuracy_stderr_objects")
    if accuracy is None or error is None:
        return None
    return max(0.0, accuracy - Z_95 * error), min(1.0, accuracy + Z_95 * error)


def _tiles(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    found: list[tuple[str, str, str]] = []
    accuracy, between = summary.get("accuracy"), accuracy_interval(summary)
    if accuracy is not None:
        more = f"of {summary.get('objects', 0):,} objects"
        if between is not None:
            more = f"95 % interval {100 * between[0]:.2f} to {100 * between[1]:.2f} %, {more}"
        found.append(("accuracy", f"{100 * accuracy:.2f} %", more))
    abstained = summary.get("abstained", 0)
    found.append(("decisions", f"{summary.get('decisions', 0):,}", f"{abstained:,} of them abstained"))
    light = [f"{_number(summary.get('photons_mean'))} photons (expected photoelectrons)"]
    shown = summary.get("illumination_mean", summary.get("illumination"))
    light.append(f"illumination {_number(shown)} (sum of pattern intensities)")
    found.append(("clicks per decision", _number(summary.get("clicks_mean")), ", ".join(light)))
    latency = summary.get("latency_us")
    if latency:
        deadline = float(summary.get("deadline_us", 0.0))
        more = f"99 % of decisions were faster; budget {deadline / 1000:g} ms"
        p99 = f"{latency['p99'] / 1000:.3g} ms"
        if latency["p99"] < NO_TIME_US:
            p99, more = "not measured", "virtual time: the host took no time"
        found.append(("latency p99", p99, more))
    late, lost = summary.get("late", 0), summary.get("lost", 0)
    found.append(("late", f"{late:,}", f"decisions; {lost:,} exposures lost{repeat_words(summary.get('stream', {}))}"))
    if timing := summary.get("exposure_timing"):  # not of older recordings
        start = f"{timing['worst_start_us']:+.3g} us" if timing["exposures"] else "unknown"
        found.append(("exposures off the plan", start, exposure_words(timing)))
    dark = summary.get("dark")
    if isinstance(dark, Mapping) and dark.get("exposures"):
        more = f"95 % interval {dark['low']:.3g} to {dark['high']:.3g}, expected {dark['expected']:.3g}"
        found.append(("dark clicks per exposure", f"{dark['clicks'] / dark['exposures']:.3g}", more))
    return found


def _number(value: Any) -> str:
    return "unknown" if value is None else f"{float(value):.3f}"
