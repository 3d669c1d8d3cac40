"""The page's part on time: latency as curves, the clock.

Owns the curves, from TIMINGS and CLOCK blocks; the table's figures are the summary's where the run wrote one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.record import Recording

from .charts import Axis, Chart, Curve, Mark, percent, seconds, span
from .page import Page

LEAST_US = 1.0
CURVE_POINTS = 300
NO_TIME_US = 0.05  # p99 of the host's own time below this: virtual time
F64 = NDArray[np.float64]
_STAGES = {
    "link": "link: end of exposure to bytes read",
    "decode": "decode: to message ready",
    "decide": "decide: to decision made",
    "record": "record: to handed to the recorder",
}


def stages_of(timings: NDArray[np.void]) -> dict[str, F64]:
    """Return the latencies of all decisions, whole and by stage, microseconds."""
    end, arrival, decided, recorded = (
        timings[name].astype(np.float64) / 1000 for name in ("device_end_ns", "arrival_ns", "decided_ns", "recorded_ns")
    )
    return {
        "end of exposure to decision": decided - end,
        "on the link": arrival - end,
        "in the host, to the decision": decided - arrival,
        "to the recorder": recorded - decided,
    }


def add_timing(page: Page, recording: Recording) -> None:
    """Add the table of latencies and the curve."""
    timings = recording.timings()
    if not len(timings):
        return
    stages, summary = stages_of(timings), recording.summary
    page.heading("Latency")
    page.table(_rows(stages, summary), ("microseconds", "p50", "p99", "p99.9", "max"))
    if float(np.quantile(stages["in the host, to the decision"], 0.99)) < NO_TIME_US:
        page.text("Virtual time: the host took no time at all, so these figures say nothing about speed.", "warn")
        return
    deadline = summary.get("deadline_us") or recording.header.get("config", {}).get("deadline_us")
    page.figure(
        latency_chart(stages, float(deadline) if deadline else None),
        "Share of decisions that took longer than the time on the horizontal axis; both axes are logarithmic. Time begins at the end of "
        f"the last exposure, by the device's clock; what is below {LEAST_US:g} us stands at the left edge.",
    )


def _rows(stages: Mapping[str, F64], summary: Mapping[str, Any]) -> list[tuple[str, ...]]:
    if summary.get("latency_us") and summary.get("stage_latency_us"):
        told = summary["stage_latency_us"]
        named = {words: told[name] for name, words in _STAGES.items() if name in told}
        rows = {"whole: end of exposure to decision": summary["latency_us"], **named}
        return [(name, *(f"{row[key]:.1f}" for key in ("p50", "p99", "p999", "max"))) for name, row in rows.items()]
    return [
        (name, *(f"{value:.1f}" for value in (*np.quantile(values, (0.5, 0.99, 0.999)), values.max())))
        for name, values in stages.items()
    ]


def survival(values: F64) -> tuple[F64, F64]:
    """Return times and the share of `values` that is at least as long, at most CURVE_POINTS of them, dense in the tail."""
    n = len(values)
    ranks = np.unique(np.round(np.geomspace(1, n, min(CURVE_POINTS, n))).astype(np.int64))  # from the longest on
    times = np.sort(values)[::-1][ranks - 1][::-1]
    return np.maximum(times, LEAST_US), ranks[::-1] / n


def latency_chart(stages: Mapping[str, F64], deadline_us: float | None) -> Chart:
    """Return the shares of decisions above each time, with the deadline."""
    curves = [Curve(*survival(values), name, kind) for (name, values), kind in zip(stages.items(), "abcd")]
    top = max([float(values.max()) for values in stages.values()] + [deadline_us or 0.0, 10.0]) * 1.3
    n = len(next(iter(stages.values())))
    marks = [Mark(deadline_us, f"budget {span(deadline_us)}", upright=True)] if deadline_us else []
    return Chart(
        label="Latency: share of decisions that took longer than a time",
        x=Axis("longer than", LEAST_US, top, log=True, text=span),
        y=Axis("share of decisions", 0.7 / n, 1.0, log=True, text=percent),
        curves=curves,
        marks=marks,
        height=280,
    )


def add_clock(page: Page, recording: Recording) -> None:
    """Add the device's clock against a straight line through all probes."""
    samples = recording.clock_samples()
    if len(samples) < 3 or samples["tick"].min() == samples["tick"].max():
        return  # a run so short that nothing passed on the clock
    host = (samples["host_ns"] - samples["host_ns"][0]).astype(np.float64)
    ticks = (samples["tick"] - samples["tick"][0]).astype(np.int64).astype(np.float64)
    half_trip_us = samples["round_trip_ns"].astype(np.float64) / 2000
    slope, start = np.polyfit(ticks, host, 1, w=1 / np.maximum(half_trip_us, 1e-3))
    residual_us = (host - slope * ticks - start) / 1000
    nominal_ns = 1e9 / int(recording.header["config"]["tick_hz"])
    reach = 3 * float(np.quantile(np.abs(residual_us) + half_trip_us, 0.9)) + 1e-3
    outside = int((np.abs(residual_us) > reach).sum())
    line_ppm, known = (nominal_ns / slope - 1) * 1e6, recording.summary.get("clock", {}).get("drift_ppm")
    page.heading("Clock")
    drift = f"{known:+.2f} ppm at the end of the run" if known is not None else f"{line_ppm:+.2f} ppm over the run"
    page.text(
        f"The device's clock differs from this computer's by {drift}; one straight line through all probes has {line_ppm:+.2f} ppm."
    )
    page.figure(
        Chart(
            label=f"Clock probes against a straight line, drift {drift}",
            x=Axis("time since the first probe", 0.0, max(float(host[-1]) / 1e9, 1e-9), text=seconds),
            y=Axis("offset from the line, us", -reach, reach),
            curves=[
                Curve(
                    host / 1e9, residual_us, low=residual_us - half_trip_us, high=residual_us + half_trip_us, dots=True
                )
            ],
            height=180,
        ),
        f"{len(samples)} probes of the device's clock, each with half its round trip."
        + (f" {outside} lie outside and are drawn at the edge." if outside else "")
        + " The run itself followed the clock as it went.",
    )
