"""Histograms against sorted samples; lateness and blame."""

import numpy as np
import pytest

from pans.live.timing.ledger import LatencyHistogram, TimingLedger, quantiles_us, upper_edge


def counted(*durations_ns: int) -> LatencyHistogram:
    histogram = LatencyHistogram()
    histogram.add_many(np.array(durations_ns, np.int64))
    return histogram


def test_buckets_tile_the_integers() -> None:
    edges = [upper_edge(bucket) for bucket in range(1600)]  # below 2^53
    assert counted(*edges).counts[:1600].tolist() == [1] * 1600
    assert counted(*(edge + 1 for edge in edges)).counts[1:1601].tolist() == [1] * 1600


@pytest.mark.parametrize("low_high", [(0, 1), (0, 3), (2, 9)])
def test_quantiles_are_at_most_3_2_percent_high(low_high: tuple[int, int]) -> None:
    samples = (10 ** np.random.default_rng(1).uniform(*low_high, 5000)).astype(int)
    histogram, ranked = counted(*samples.tolist()), np.sort(samples)
    for q in (0.001, 0.5, 0.99, 0.999, 1.0):
        exact = int(ranked[max(1, int(np.ceil(q * len(ranked)))) - 1])
        assert exact <= histogram.quantile_ns(q) <= exact * (1 + 1 / 31) + 1
    assert histogram.max_ns == histogram.quantile_ns(1.0) == ranked[-1]


def test_extreme_durations() -> None:
    assert counted().summary() == {"p50": None, "p99": None, "p999": None, "max": None}
    histogram = counted(-5, 2**62)  # an arrival before its own exposure ended: clock uncertainty
    assert (histogram.quantile_ns(0.5), histogram.max_ns, histogram.total) == (0, 2**62, 2)


def test_a_quantile_needs_a_sample_beyond_it() -> None:
    for n, known in ((1, ()), (2, ("p50",)), (99, ("p50",)), (100, ("p50", "p99")), (1000, ("p50", "p99", "p999"))):
        found = counted(*range(1, n + 1)).summary()
        assert tuple(name for name, us in found.items() if us is not None) == (*known, "max")
        single = quantiles_us(np.arange(n))
        assert tuple(name for name, us in single.items() if us is not None) == tuple(f"{name}_us" for name in known)


def judge(ledger: TimingLedger, marks: tuple[int, int, int, int, int], uncertainty_ns: int = 0, count: int = 1) -> bool:
    return bool(ledger.judge(np.array([marks]), np.array([uncertainty_ns]), np.array([count]))[0])


def test_a_decision_is_late_only_beyond_the_clocks_uncertainty() -> None:
    ledger = TimingLedger(deadline_ns=1000)
    assert not judge(ledger, (0, 100, 200, 1000, 1100), 0)
    assert not judge(ledger, (0, 100, 200, 1050, 1100), 50)
    assert judge(ledger, (0, 100, 200, 1051, 1100), 50)
    assert ledger.late == 1


@pytest.mark.parametrize(
    ("marks", "stage"),
    [
        ((0, 5000, 5001, 5002, 5003), "link"),
        ((0, 1, 5000, 5001, 5002), "decode"),
        ((0, 1, 2, 5000, 5001), "decide"),
        ((0, 1, 2, 2000, 90_000), "decide"),  # the recording took longer, and comes after
        ((0, 1, 2, 3, 10_000), None),
    ],
)
def test_blame_goes_to_the_slowest_stage_before_the_decision(
    marks: tuple[int, int, int, int, int], stage: str | None
) -> None:
    ledger = TimingLedger(deadline_ns=1000)
    assert judge(ledger, marks) == (stage is not None)
    assert ledger.blame == ({} if stage is None else {stage: 1})
    assert ledger.stages["record"].max_ns == marks[4] - marks[3]


def test_many_blocks_are_judged_as_one_by_one() -> None:
    rng = np.random.default_rng(1)
    marks = np.cumsum(10 ** rng.uniform(-1, 6, (300, 5)), axis=1).astype(np.int64) - 50
    unsure, counts = rng.integers(0, 1000, 300), rng.integers(1, 9, 300)
    one, many = TimingLedger(100_000), TimingLedger(100_000)
    late = [judge(one, tuple(row), int(off), int(n)) for row, off, n in zip(marks.tolist(), unsure, counts)]
    assert many.judge(marks, unsure, counts).tolist() == late
    assert (many.late, many.blame, many.worst_uncertainty_ns) == (one.late, one.blame, one.worst_uncertainty_ns)
    assert many.late == int(counts[late].sum())
    assert many.total.counts.tolist() == one.total.counts.tolist()
    assert many.total.total == int(counts.sum())
