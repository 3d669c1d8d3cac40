"""Latencies of decisions: histograms per stage, deadlines, and the stage that made a decision late.

Latencies count from the device's tick, not from when the host got around to looking, so a stalled host cannot hide its own delay
(coordinated omission).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import QUANTILES, has_quantile

I64 = NDArray[np.int64]

SUB_BITS = 5  # 32 steps per octave: a quantile is at most 3.2 % above the true value
N_BUCKETS = 64 << SUB_BITS


class LatencyHistogram:
    """Log-linear counts of durations in ns: `counts` int64 (N_BUCKETS,), their `total`, and the exact maximum."""

    def __init__(self) -> None:
        self.counts = np.zeros(N_BUCKETS, np.int64)
        self.total = 0
        self.max_ns = 0

    def add_many(self, durations_ns: I64, counts: I64 | int = 1) -> None:
        """Count durations below 2^53 ns, int64 (n,), each `counts` times; negative ones (clock uncertainty) count as 0."""
        count_each([self], durations_ns[None], np.broadcast_to(counts, durations_ns.shape))

    def quantile_ns(self, q: float) -> int:
        """Return the upper edge of the bucket that holds quantile `q` (never above the exact maximum); 0 without data."""
        if not self.total:
            return 0
        bucket = int(np.searchsorted(np.cumsum(self.counts), max(1, -int(-q * self.total // 1))))
        return min(upper_edge(bucket), self.max_ns)

    def summary(self) -> dict[str, float | None]:
        """Return {p50, p99, p999, max} in microseconds; None where there are fewer durations than `has_quantile` asks for."""
        found = {
            name: self.quantile_ns(q) / 1000 if has_quantile(self.total, q) else None for name, q in QUANTILES.items()
        }
        return found | {"max": self.max_ns / 1000 if self.total else None}


def quantiles_us(durations_ns: I64) -> dict[str, float | None]:
    """Return {p50_us, p99_us, p999_us} of single durations in ns, int64 (n,); None where n is too small."""
    n = len(durations_ns)
    return {
        f"{name}_us": float(np.quantile(durations_ns, q)) / 1000 if has_quantile(n, q) else None
        for name, q in QUANTILES.items()
    }


def count_each(histograms: Sequence[LatencyHistogram], durations_ns: I64, counts: I64) -> None:
    """Count durations int64 (histograms, n) in a histogram each, `counts` int64 (n,) times: see `LatencyHistogram.add_many`."""
    if not len(counts):
        return
    values = np.maximum(durations_ns, 0)
    shift = np.maximum(np.frexp(values)[1] - (SUB_BITS + 1), 0)
    buckets, total = (shift << SUB_BITS) + (values >> shift), int(counts.sum())
    for histogram, places, largest in zip(histograms, buckets, values.max(axis=1).tolist()):
        np.add.at(histogram.counts, places, counts)
        histogram.total += total
        histogram.max_ns = max(histogram.max_ns, largest)


def upper_edge(bucket: int) -> int:
    """Return the longest duration in ns that a bucket of LatencyHistogram counts."""
    if bucket < 2 << SUB_BITS:
        return bucket
    shift = (bucket >> SUB_BITS) - 1
    return ((bucket - (shift << SUB_BITS) + 1) << shift) - 1


STAGES = ("link", "decode", "decide", "record")


@dataclass(slots=True)
class TimingLedger:
    """Latencies per stage and in total, late decisions and the stage that took longest in each (JSON: `blame`).

    link: end of the last exposure (device tick, converted) -> bytes read; decode: -> message ready; decide: -> decision made;
    record: -> handed to the recorder. A decision is late when its total, less the clock's uncertainty, exceeds the deadline.
    """

    deadline_ns: int
    total: LatencyHistogram = field(default_factory=LatencyHistogram)
    stages: dict[str, LatencyHistogram] = field(default_factory=lambda: {name: LatencyHistogram() for name in STAGES})
    late: int = 0
    blame: dict[str, int] = field(default_factory=dict)
    worst_uncertainty_ns: int = 0

    def judge(self, marks_ns: I64, uncertainty_ns: I64, counts: I64) -> NDArray[np.bool_]:
        """Count decisions and return which are late, bool (n,); `counts` of them share each row.

        marks_ns (n, 5): device end, arrival, decoded, decided, recorded; uncertainty_ns (n,): of the device end.
        """
        steps = np.diff(marks_ns, axis=1)
        latency = marks_ns[:, 3] - marks_ns[:, 0]
        count_each([*self.stages.values(), self.total], np.vstack((steps.T, latency)), counts)
        self.worst_uncertainty_ns = max(self.worst_uncertainty_ns, int(uncertainty_ns.max(initial=0)))
        late: NDArray[np.bool_] = latency - uncertainty_ns > self.deadline_ns
        self.late += int(counts[late].sum())
        for slowest, count in zip(steps[late, :3].argmax(axis=1).tolist(), counts[late].tolist()):
            self.blame[STAGES[slowest]] = self.blame.get(STAGES[slowest], 0) + count
        return late
