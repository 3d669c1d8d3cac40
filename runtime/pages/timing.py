"""The section on time: latency as curves, and the clock, from TIMINGS and CLOCK blocks; the table is the summary's where there is one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.record import Recording
from pans.runtime.record.recording import together
from pans.runtime.timing.clock import CLOCK_DTYPE
from pans.runtime.timing.ledger import LatencyHistogram, upper_edge

from .charts import Axis, Chart, Curve, Mark, extremes, percent, seconds, span
from .page import Page

LEAST_US = 1.0
CURVE_POINTS = 300
NO_TIME_US = 0.05  # p99 of the host's own time below this: virtual time
EXACT_MAX = 1 << 17  # durations that are kept one by one
LONGEST_KEPT = 1 << 10  # of more than that: exact where the curve's points are dense
CLOCK_MAX = 1 << 15  # probes that the line is laid through
F64 = NDArray[np.float64]
_WHOLE, _IN_HOST = "end of exposure to decision", "in the host, to the decision"
_CURVES = {  # name of a stage -> where it begins and ends
    _WHOLE: ("device_end_ns", "decided_ns"),
    "on the link": ("device_end_ns", "arrival_ns"),
    _IN_HOST: ("arrival_ns", "decided_ns"),
    "to the recorder": ("decided_ns", "recorded_ns"),
}
_STAGES = {
    "link": "link: end of exposure to bytes read",
    "decode": "decode: to message ready",
    "decide": "decide: to decision made",
    "record": "record: to handed to the recorder",
}


class Durations:
    """Durations in microseconds, one by one as long as they are few; of more, their histogram and the longest ones."""

    def __init__(self) -> None:
        self.n = 0
        self._kept: list[F64] = []
        self._kept_n = 0
        self._histogram: LatencyHistogram | None = None  # of all, once they are many

    def add(self, values: F64) -> None:
        """Take more of them, float64 (n,)."""
        self.n += len(values)
        self._kept.append(values)
        self._kept_n += len(values)
        if self._histogram is not None:
            self._histogram.add_many(np.rint(values * 1000).astype(np.int64))
        if self._kept_n > EXACT_MAX:
            self._reduce()

    def _reduce(self) -> None:
        kept = np.concatenate(self._kept)
        if self._histogram is None:
            self._histogram = LatencyHistogram()
            self._histogram.add_many(np.rint(kept * 1000).astype(np.int64))
        longest = np.partition(kept, -LONGEST_KEPT)[-LONGEST_KEPT:]
        self._kept, self._kept_n = [longest], len(longest)

    def longest(self, ranks: NDArray[np.int64]) -> F64:
        """Return the durations of these ranks, 1 for the longest; at most 3.2 % too long where the histogram tells them."""
        kept = np.sort(np.concatenate(self._kept))[::-1]
        if self._histogram is None:
            return np.asarray(kept[ranks - 1], np.float64)
        beyond = np.cumsum(self._histogram.counts[::-1])  # as long as a bucket, or longer
        buckets = len(beyond) - 1 - np.searchsorted(beyond, ranks)
        edges = np.array([upper_edge(bucket) / 1000 for bucket in buckets.tolist()])
        known = ranks <= LONGEST_KEPT  # of each part that came, as many are kept
        edges[known] = kept[ranks[known] - 1]
        return np.minimum(edges, kept[0])

    def quantiles(self, *wanted: float) -> list[float]:
        """Return quantiles; of many durations, those of the histogram."""
        if self._histogram is None:
            return [float(value) for value in np.quantile(np.concatenate(self._kept), wanted)]
        return [self._histogram.quantile_ns(q) / 1000 for q in wanted]

    @property
    def max(self) -> float:
        """The longest one."""
        return max(float(one.max()) for one in self._kept if len(one))

    def survival(self) -> tuple[F64, F64]:
        """Return times and the share of the durations that is at least as long, at most CURVE_POINTS of them, dense in the tail."""
        ranks = np.unique(np.round(np.geomspace(1, self.n, min(CURVE_POINTS, self.n))).astype(np.int64))
        return np.maximum(self.longest(ranks)[::-1], LEAST_US), ranks[::-1] / self.n


def stages_of(timings: Iterable[NDArray[np.void]]) -> dict[str, Durations]:
    """Return the latencies of all decisions, whole and by stage."""
    stages = {name: Durations() for name in _CURVES}
    for rows in timings:
        us = {name: rows[name].astype(np.float64) / 1000 for name in rows.dtype.names or ()}
        for name, (start, end) in _CURVES.items():
            stages[name].add(us[end] - us[start])
    return stages


def add_timing(page: Page, recording: Recording) -> None:
    """Add the table of latencies and the curve."""
    stages, summary = stages_of(together(recording.iter_timings())), recording.summary
    if not stages[_WHOLE].n:
        return
    page.heading("Latency")
    page.table(_rows(stages, summary), ("microseconds", "p50", "p99", "p99.9", "max"))
    if stages[_IN_HOST].quantiles(0.99)[0] < NO_TIME_US:
        page.text("Virtual time: the host took no time at all, so these figures say nothing about speed.", "warn")
        return
    deadline = summary.get("deadline_us") or recording.header.get("config", {}).get("deadline_us")
    page.figure(
        latency_chart(stages, float(deadline) if deadline else None),
        "Share of decisions that took longer than the time on the horizontal axis; both axes are logarithmic. Time begins at the end of "
        f"the last exposure, by the device's clock; what is below {LEAST_US:g} us stands at the left edge.",
    )


def _rows(stages: Mapping[str, Durations], summary: Mapping[str, Any]) -> list[tuple[str, ...]]:
    if summary.get("latency_us") and summary.get("stage_latency_us"):
        told = summary["stage_latency_us"]
        named = {words: told[name] for name, words in _STAGES.items() if name in told}
        rows = {"whole: end of exposure to decision": summary["latency_us"], **named}
        return [(name, *(f"{row[key]:.1f}" for key in ("p50", "p99", "p999", "max"))) for name, row in rows.items()]
    return [
        (name, *(f"{value:.1f}" for value in (*values.quantiles(0.5, 0.99, 0.999), values.max)))
        for name, values in stages.items()
    ]


def latency_chart(stages: Mapping[str, Durations], deadline_us: float | None) -> Chart:
    """Return the shares of decisions above each time, with the deadline."""
    curves = [Curve(*values.survival(), name, kind) for (name, values), kind in zip(stages.items(), "abcd")]
    top = max([values.max for values in stages.values()] + [deadline_us or 0.0, 10.0]) * 1.3
    n = next(iter(stages.values())).n
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
    samples, n_probes = _probes(recording)
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
        f"{n_probes} probes of the device's clock, each with half its round trip."
        + (f" {len(samples)} of them are looked at: the extremes of each stretch." if n_probes > len(samples) else "")
        + (f" {outside} lie outside and are drawn at the edge." if outside else "")
        + " The run itself followed the clock as it went.",
    )


def _probes(recording: Recording) -> tuple[NDArray[np.void], int]:
    """Return the clock samples, and how many there were: of very many, the extremes of each stretch stand for it."""
    nominal_ns = 1e9 / int(recording.header["config"]["tick_hz"])
    kept, count, held = [np.zeros(0, CLOCK_DTYPE)], 0, 0
    for samples in together(recording.iter_clock_samples()):
        kept.append(samples)
        count, held = count + len(samples), held + len(samples)
        if held > 2 * CLOCK_MAX:
            some = np.concatenate(kept)
            offset_ns = (some["host_ns"] - some["host_ns"][0]) - (some["tick"] - some["tick"][0]).astype(
                np.int64
            ) * nominal_ns
            kept = [some[extremes(offset_ns, CLOCK_MAX // 2)]]
            held = len(kept[0])
    return np.concatenate(kept), count
