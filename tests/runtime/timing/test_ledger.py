"""Histograms against sorted samples, lateness and blame, and the real-time set-up's way back."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from pans.runtime.timing.ledger import N_BUCKETS, LatencyHistogram, TimingLedger, arm_realtime, frozen_heap, upper_edge


def test_buckets_tile_the_integers() -> None:
    for bucket in range(2000):
        histogram = LatencyHistogram()
        edge = upper_edge(bucket)
        histogram.add(edge)
        assert histogram.counts[bucket] == 1
        histogram.add(edge + 1)
        assert histogram.counts[bucket + 1] == 1


@pytest.mark.parametrize("low_high", [(0, 1), (0, 3), (2, 9)])
def test_quantiles_are_at_most_3_2_percent_high(low_high: tuple[int, int]) -> None:
    samples = (10 ** np.random.default_rng(1).uniform(*low_high, 5000)).astype(int)
    histogram = LatencyHistogram()
    for value in samples.tolist():
        histogram.add(value)
    ranked = np.sort(samples)
    for q in (0.001, 0.5, 0.99, 0.999, 1.0):
        exact = int(ranked[max(1, int(np.ceil(q * len(ranked)))) - 1])
        assert exact <= histogram.quantile_ns(q) <= exact * (1 + 1 / 31) + 1
    assert histogram.max_ns == ranked[-1]
    assert histogram.quantile_ns(1.0) == ranked[-1]


def test_extreme_durations() -> None:
    histogram = LatencyHistogram()
    assert histogram.summary() == {"p50": 0.0, "p99": 0.0, "p999": 0.0, "max": 0.0}
    histogram.add(-5)  # an arrival before its own exposure ended: clock uncertainty
    histogram.add(2**62)
    assert histogram.quantile_ns(0.5) == 0
    assert histogram.max_ns == 2**62
    assert len(histogram.counts) == N_BUCKETS


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
    [((0, 5000, 5001, 5002, 5003), "link"), ((0, 1, 5000, 5001, 5002), "decode"), ((0, 1, 2, 5000, 5001), "decide")],
)
def test_blame_goes_to_the_slowest_stage(marks: tuple[int, int, int, int, int], stage: str) -> None:
    ledger = TimingLedger(deadline_ns=1000)
    assert judge(ledger, marks)
    assert ledger.blame == {stage: 1}


def test_recording_is_not_part_of_the_deadline() -> None:
    ledger = TimingLedger(deadline_ns=1000)
    slow = TimingLedger(deadline_ns=1000)
    assert judge(slow, (0, 1, 2, 2000, 90_000), 0)
    assert slow.blame == {"decide": 1}
    assert not judge(ledger, (0, 1, 2, 3, 10_000), 0)
    assert ledger.stages["record"].max_ns == 9997


def test_many_blocks_are_judged_as_one_by_one() -> None:
    rng = np.random.default_rng(1)
    marks = np.cumsum(10 ** rng.uniform(-1, 6, (300, 5)), axis=1).astype(np.int64) - 50
    unsure, counts = rng.integers(0, 1000, 300), rng.integers(1, 9, 300)
    one, many = TimingLedger(100_000), TimingLedger(100_000)
    late = [judge(one, tuple(row), int(off), int(n)) for row, off, n in zip(marks.tolist(), unsure, counts)]
    assert many.judge(marks, unsure, counts).tolist() == late
    assert (many.late, many.blame, many.worst_uncertainty_ns) == (one.late, one.blame, one.worst_uncertainty_ns)
    assert many.late == int(counts[late].sum())
    assert many.total.counts == one.total.counts
    assert many.total.total == int(counts.sum())


def test_a_heap_that_the_caller_has_frozen_stays_frozen() -> None:
    with frozen_heap():
        with arm_realtime(False):
            assert gc.get_freeze_count() > 0
        assert gc.get_freeze_count() > 0
    assert gc.get_freeze_count() == 0
    with arm_realtime(False):
        assert gc.get_freeze_count() > 0
    assert gc.get_freeze_count() == 0


LOCKED = """
import ctypes, mmap
from pans.runtime.timing import arm_realtime
here = mmap.mmap(-1, 256 << 20)  # as large a library as nobody calls
with arm_realtime(True) as granted:
    held = {line.split(":")[0]: int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("Vm")}
    print(granted["mlockall"], held["VmLck"], held["VmRSS"])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux")
def test_locked_memory_is_what_was_touched() -> None:
    said = subprocess.run([sys.executable, "-c", LOCKED], capture_output=True, text=True, check=True).stdout.rsplit(
        maxsplit=2
    )
    if said[0] != "granted":
        pytest.skip(f"mlockall: {said[0]}")
    locked_kb, resident_kb = map(int, said[1:])
    assert locked_kb > 256 << 10
    assert resident_kb < 200 << 10


def test_the_realtime_set_up_is_undone() -> None:
    interval = sys.getswitchinterval()
    with arm_realtime(True) as granted:
        assert not gc.isenabled()
        assert granted["gc_off"] == "granted"
        assert (
            granted["sched_fifo"] == "granted"
            or "refused" in granted["sched_fifo"]
            or "no SCHED_FIFO" in granted["sched_fifo"]
        )
        assert granted["mlockall"]
    assert gc.isenabled()
    assert sys.getswitchinterval() == interval
    if sys.platform == "linux":
        import os

        assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_without_asking_nothing_is_asked_for() -> None:
    with arm_realtime(False) as granted:
        assert set(granted) == {"gc_off", "switch_interval_s"}


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux")
def test_other_threads_of_the_interpreter_go_one_step_below_the_loop_and_come_back() -> None:
    ended, started = threading.Event(), threading.Event()

    def wait() -> None:
        started.set()
        ended.wait()

    thread = threading.Thread(target=wait)
    thread.start()
    started.wait()
    number = thread.native_id
    assert number is not None
    try:
        with arm_realtime(True) as granted:
            if granted["sched_fifo"] != "granted":
                pytest.skip(granted["sched_fifo"])
            assert os.sched_getscheduler(number) == os.SCHED_FIFO
            assert os.sched_getparam(number).sched_priority == os.sched_getparam(0).sched_priority - 1
        assert os.sched_getscheduler(number) == os.SCHED_OTHER
    finally:
        ended.set()
        thread.join()
