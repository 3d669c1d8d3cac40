"""Latency and clock, from TIMINGS and CLOCK rows as they come; the table is the summary's where there is one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.timing.clock import CLOCK_DTYPE
from pans.runtime.timing.ledger import LatencyHistogram, upper_edge

from .charts import Axis, Curve, Mark, chart, percent, seconds, span

LEAST_US = 1.0
NO_TIME_US = 0.05  # p99 of the host's own time
CLOCK_MAX = 1 << 15  # probes that the line is laid through
IN_HOST = "in the host, to the decision"
_CURVES = {  # name of a stage -> where it begins and ends
    "end of exposure to decision": ("device_end_ns", "decided_ns"),
    "on the link": ("device_end_ns", "arrival_ns"),
    IN_HOST: ("arrival_ns", "decided_ns"),
    "to the recorder": ("decided_ns", "recorded_ns"),
}
_STAGES = {
    "link": "link: end of exposure to bytes read",
    "decode": "decode: to message ready",
    "decide": "decide: to decision made",
    "record": "record: to handed to the recorder",
}
F64 = NDArray[np.float64]


class Durations:
    """Histograms of the latencies of all decisions, whole and by stage; at most 3.2 % too long, their maximum exact."""

    def __init__(self) -> None:
        self.stages = {name: LatencyHistogram() for name in _CURVES}

    @property
    def n(self) -> int:
        """Decisions."""
        return self.stages[IN_HOST].total

    def take(self, rows: NDArray[np.void]) -> None:
        """Take the next rows, TIMING_DTYPE (n,)."""
        for name, (start, end) in _CURVES.items():
            self.stages[name].add_many(rows[end].astype(np.int64) - rows[start].astype(np.int64))

    def quantiles(self, name: str) -> list[float]:
        """Return p50, p99, p99.9 and the maximum of a stage in microseconds."""
        return list(self.stages[name].summary().values())

    def is_virtual(self) -> bool:
        """Whether the host took no time at all, as in virtual time: then latencies say nothing."""
        return self.stages[IN_HOST].summary()["p99"] < NO_TIME_US

    def rows(self, summary: Mapping[str, Any]) -> list[tuple[str, list[float]]]:
        """Return name and quantiles of the whole and of each stage, as the run summed them up where it did."""
        told = summary.get("stage_latency_us")
        if not told or not summary.get("latency_us"):
            return [(name, self.quantiles(name)) for name in self.stages]
        known = {"whole: end of exposure to decision": summary["latency_us"]}
        known |= {words: told[name] for name, words in _STAGES.items() if name in told}
        return [(name, [row[key] for key in ("p50", "p99", "p999", "max")]) for name, row in known.items()]


def survival(histogram: LatencyHistogram) -> tuple[F64, F64]:
    """Return times in microseconds and the share of durations that are at least about as long."""
    counts, n = histogram.counts, max(histogram.total, 1)
    buckets = np.flatnonzero(counts)
    beyond = np.cumsum(counts[::-1])[::-1][buckets] / n
    edges = np.minimum([upper_edge(bucket) for bucket in buckets.tolist()], histogram.max_ns)
    return np.maximum(edges / 1000, LEAST_US), np.asarray(beyond, np.float64)


def latency_chart(durations: Durations, deadline_us: float | None, label: str = "Latency") -> Any:
    """Return the shares of decisions above each time, with the deadline."""
    curves = [Curve(*survival(one), name, kind) for (name, one), kind in zip(durations.stages.items(), "abcd")]
    top = max([one.max_ns / 1000 for one in durations.stages.values()] + [deadline_us or 0.0, 10.0]) * 1.3
    return chart(
        f"{label}: share of decisions that took longer than a time",
        Axis("longer than", LEAST_US, top, log=True, text=span),
        Axis("share of decisions", 0.7 / durations.n, 1.0, log=True, text=percent),
        curves=curves,
        marks=[Mark(deadline_us, f"budget {span(deadline_us)}", upright=True)] if deadline_us else [],
        height=320,
    )


class Clock:
    """The device's clock against a straight line through all probes; of very many probes the extremes of each stretch stand for it."""

    def __init__(self, tick_hz: int) -> None:
        self._nominal_ns = 1e9 / tick_hz
        self.samples: NDArray[np.void] = np.zeros(0, CLOCK_DTYPE)
        self.n = 0

    def take(self, rows: NDArray[np.void]) -> None:
        """Take the next rows, CLOCK_DTYPE (n,)."""
        self.n += len(rows)
        some = self.samples = np.append(self.samples, rows)
        if len(some) > 2 * CLOCK_MAX:
            ticks = (some["tick"] - some["tick"][0]).astype(np.int64)
            off_ns = (some["host_ns"] - some["host_ns"][0]) - ticks * self._nominal_ns
            # by time, not by number: what was thinned before must not be thinned more than what came since
            stretch = (ticks - ticks.min()) * (CLOCK_MAX // 2) // max(int(np.ptp(ticks)), 1)
            order = np.lexsort((off_ns, stretch))
            ends = np.flatnonzero(np.diff(stretch[order], append=CLOCK_MAX))
            self.samples = some[np.unique(order[np.concatenate([ends, [0], ends[:-1] + 1])])]

    def facts(self, summary: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return the drift in words, that of the line, the probes that lie outside, and a chart; None of a run too short for it."""
        some = self.samples
        if len(some) < 3 or some["tick"].min() == some["tick"].max():
            return None
        host = (some["host_ns"] - some["host_ns"][0]).astype(np.float64)
        ticks = (some["tick"] - some["tick"][0]).astype(np.int64).astype(np.float64)
        half_us = some["round_trip_ns"].astype(np.float64) / 2000
        slope, start = np.polyfit(ticks, host, 1, w=1 / np.maximum(half_us, 1e-3))
        off_us = (host - slope * ticks - start) / 1000
        reach = 3 * float(np.quantile(np.abs(off_us) + half_us, 0.9)) + 1e-3
        line_ppm, known = (self._nominal_ns / slope - 1) * 1e6, summary.get("clock", {}).get("drift_ppm")
        drift = f"{line_ppm:+.2f} ppm over the run" if known is None else f"{known:+.2f} ppm at the end of the run"
        x = Axis("time since the first probe", 0.0, max(float(host[-1]) / 1e9, 1e-9), text=seconds)
        y = Axis("offset from the line, us", -reach, reach)
        seen = np.clip(off_us, -reach, reach)
        dots = Curve(host / 1e9, seen, low=seen - half_us, high=seen + half_us, dots=True)
        drawn = chart(f"Clock probes against a straight line, drift {drift}", x, y, curves=[dots], height=200)
        outside = int((np.abs(off_us) > reach).sum())
        return {
            "drift": drift,
            "line_ppm": line_ppm,
            "n": self.n,
            "kept": len(some),
            "outside": outside,
            "chart": drawn,
        }
