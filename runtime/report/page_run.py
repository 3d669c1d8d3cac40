"""The report page of a recording or of a bundle: which figures stand on it, and where they come from.

Owns the order of the sections and the sums behind the drawings; never draws (page_figures.py) and never judges: the verdict is the
recorded one. Every figure is computed from the recorded messages, decisions and times, except where it says "as the run summed it up".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.core.plan import Plan
from pans.runtime.intervals import wilson_interval
from pans.runtime.record import Recording
from pans.runtime.record.exposures import Exposures, is_dark, iter_exposures
from pans.runtime.record.sent_plan import recorded_plan

from . import figures as draw
from .page import Page
from .page_flow import add_late, add_passages, is_flow

BINS = 120
EXPOSURES_PER_BIN = 25  # of each pattern: a rate from fewer is noise
EVENTS_SHOWN = 200
EVENTS_OF_A_KIND = 30
F64 = NDArray[np.float64]
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


class Rates(NamedTuple):
    """Clicks and exposures per time bin and pattern or channel, and of the dark slots, (bins, channels) and (bins,)."""

    edges_s: F64
    clicks: F64
    exposures: F64
    dark_clicks: F64
    dark_exposures: F64


def recording_page(recording: Recording) -> bytes:
    """Return the page of `recording`; a cut one is shown as far as it goes, and says so."""
    summary = recording.summary
    bundle = recording.bundle() if recording.bundle_data() else None
    name = bundle.name if bundle is not None else "a bundle that is not in the recording"
    page = Page(f"Run of {name}", simulated=bool(recording.header.get("simulated")))
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
    _rates(page, plan, rates, summary)
    _clock(page, recording)
    _events(page, recording)
    if bundle is not None:
        page.heading("The bundle")
        _optics(page, bundle)
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


def bundle_page(bundle: Bundle, sha256: str, path: Path) -> bytes:
    """Return the page of a bundle: what it is, its patterns or optics, where it comes from."""
    from .file_facts import file_facts

    page = Page(f"Bundle {bundle.name}", simulated=False)
    page.text(
        "A trained sensor: what is shown or stands before the detectors, and how clicks become a decision.", "note"
    )
    facts = file_facts(path)
    provenance = facts.pop("provenance", {})
    page.facts(facts)
    page.heading("Patterns" if bundle.analyser is None else "Optics")
    _optics(page, bundle)
    page.heading("Provenance")
    page.facts({"SHA-256": sha256, **provenance})
    return page.html()


def count_rates(recording: Recording, plan: Plan) -> Rates:
    """Sum clicks and exposures over at most `BINS` equal stretches of device time; a clock that went back starts no new bin."""
    n = plan.n_patterns
    sums: list[tuple[int, F64, F64, int, int]] = []
    for item in iter_exposures(recording, plan):
        if isinstance(item, Exposures):
            sums.append((int(item.start_tick[0]), *_sums(item, plan, n)))
    if not sums:
        empty = np.zeros((1, n))
        return Rates(np.array([0.0, 1.0]), empty, empty, np.zeros(1), np.zeros(1))
    ticks = np.array([row[0] for row in sums], np.int64)
    seconds = np.maximum(ticks - ticks[0], 0) * plan.tick_us * 1e-6
    per_pattern = sum(float(row[2].sum()) for row in sums) / n
    bins = int(np.clip(per_pattern / EXPOSURES_PER_BIN, 1, BINS))
    edges = np.linspace(0.0, float(seconds.max()) + plan.cycle_us * 1e-6, bins + 1)
    which = np.clip(np.searchsorted(edges, seconds, "right") - 1, 0, len(edges) - 2)
    totals = [np.zeros((len(edges) - 1, n)) for _ in range(2)] + [np.zeros(len(edges) - 1) for _ in range(2)]
    for total, column in zip(totals, range(1, 5)):
        np.add.at(total, which, np.array([row[column] for row in sums], np.float64))
    return Rates(edges, *totals)


def _sums(item: Exposures, plan: Plan, n: int) -> tuple[F64, F64, int, int]:
    """Clicks and exposures of one message per pattern or channel; clicks and exposures in the dark."""
    dark = is_dark(item.pattern)
    lit = item.clicks[~dark]
    if plan.mode == "parallel":
        clicks, exposures = lit.sum(axis=0).astype(np.float64), np.full(n, float(len(lit)))
        return clicks, exposures, int(item.clicks[dark].sum()), int(dark.sum()) * n
    shown = np.minimum(item.pattern[~dark], n - 1)
    clicks = np.bincount(shown, weights=lit[:, 0], minlength=n).astype(np.float64)
    return clicks, np.bincount(shown, minlength=n).astype(np.float64), int(item.clicks[dark].sum()), int(dark.sum())


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


def _rates(page: Page, plan: Plan, rates: Rates, summary: Mapping[str, Any]) -> None:
    page.heading("Clicks over time")
    what = "channel" if plan.mode == "parallel" else "pattern"
    page.figure(
        draw.click_rates(rates.edges_s, rates.clicks, rates.exposures, what),
        f"Clicks per exposure of each {what}, {len(rates.clicks)} bins over the run; right: the mean with its standard error.",
    )
    if not rates.dark_exposures.sum():
        _empty_fields(page, summary)
        return
    page.heading("Dark counts")
    clicks, exposures = int(rates.dark_clicks.sum()), int(rates.dark_exposures.sum())
    low, high = wilson_interval(clicks, exposures)
    expected = summary.get("dark", {}).get("expected") if isinstance(summary.get("dark"), Mapping) else None
    expected = float(np.mean(expected)) if expected is not None else None
    page.text(
        f"{clicks} clicks in {exposures} dark exposures: {clicks / exposures:.3g} per exposure, 95 % interval {low:.3g} to {high:.3g}"
        + ("." if expected is None else f"; expected {expected:.3g}.")
    )
    some = rates.dark_exposures > 0
    counted = zip(rates.dark_clicks[some].astype(int).tolist(), rates.dark_exposures[some].astype(int).tolist())
    intervals = np.array([wilson_interval(c, n) for c, n in counted])
    centres = (rates.edges_s[:-1] + rates.edges_s[1:])[some] / 2
    page.figure(
        draw.dark_rates(centres, rates.dark_clicks[some], rates.dark_exposures[some], intervals, expected),
        "Dark clicks per dark exposure in each stretch of the run.",
    )


def _empty_fields(page: Page, summary: Mapping[str, Any]) -> None:
    """Without dark slots: what a flow's frames without an object told, channel by channel."""
    channels = summary.get("dark", {}).get("channels") or []
    if not channels or not channels[0]["exposures"]:
        page.text("The run had no dark slots: nothing is known about dark counts.", "note")
        return
    page.heading("Dark counts")
    page.text("The run had no dark slots; frames in which no object was found tell, as the run summed it up.", "note")
    rows = [
        (number, row["clicks"], row["exposures"], f"{row['low']:.3g} to {row['high']:.3g}", f"{row['expected']:.3g}")
        for number, row in enumerate(channels)
    ]
    page.table(rows, ("channel", "clicks", "frames", "per frame, 95 %", "expected"))


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


def _optics(page: Page, bundle: Bundle) -> None:
    if bundle.analyser is None:
        pictures = bundle.patterns().reshape(-1, *bundle.image_shape)
        more = (
            ""
            if len(pictures) <= draw.PATTERNS_MAX
            else f" The first {draw.PATTERNS_MAX} of {len(pictures)} are drawn."
        )
        page.figure(
            draw.patterns(pictures, "photoelectrons per exposure\nand unit transmission"),
            f"The patterns as they are shown, in {bundle.levels} whole levels.{more}",
        )
        page.figure(
            draw.per_pattern(pictures.sum(axis=(1, 2)), "photoelectrons at\ntransmission 1"),
            f"Light of each pattern; together {bundle.illumination():.4g}, the illumination of one shot.",
        )
        return
    matrix = bundle.analyser.matrix.reshape(-1, *bundle.image_shape)
    values, unit = (np.abs(matrix), "modulus of W") if np.iscomplexobj(matrix) else (matrix, "W")
    page.figure(draw.patterns(values.astype(np.float64), unit), f"The rows of W, {bundle.encoder}: one per detector.")
