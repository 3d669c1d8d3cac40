"""The system's counters: readings taken apart, the right two around a stretch of time, and the thread that makes them."""

from __future__ import annotations

import os
import sys
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pans.runtime.timing.attribution import Incidents, LateWork
from pans.runtime.timing.counters import READ_EVERY_S, Counters, Reading
from pans.runtime.timing.evidence import Evidence

MS = 1_000_000
linux_only = pytest.mark.skipif(sys.platform != "linux", reason="the counters are those of Linux")


def reading(began_ns: int, ended_ns: int, cpu_ns: int) -> Reading:
    status = b"Name:\tx\nvoluntary_ctxt_switches:\t900\nnonvoluntary_ctxt_switches:\t%d\n" % (cpu_ns // 10)
    stat = b"cpu  1 2 3 4 5 6 7 %d 9 10\ncpu0 1 2 3 4 5 6 7 99 9 10\n" % cpu_ns
    return Reading(began_ns, ended_ns, -1, (status, stat, b"%d 77 12\n" % cpu_ns, b"5 %d 3\n" % (2 * cpu_ns)))


@linux_only
def test_a_reading_is_taken_apart() -> None:
    counters = Counters(time.perf_counter_ns, [threading.get_native_id()])
    counters.close()
    tick_ns = 10**9 // os.sysconf("SC_CLK_TCK")
    found = counters.sample(reading(0, 1, 120))
    assert found == (0, 120, (77, 240), 120 * tick_ns, 12)
    assert counters.sample(Reading(0, 1, -1, (b"", b"", b"", b"damaged"))) == (0, 0, (0, 0), 0, 0)


@linux_only
@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3)), min_size=1, max_size=8),
    st.integers(-5, 60),
    st.integers(0, 20),
)
def test_the_readings_around_a_stretch_are_the_nearest_that_enclose_it(
    steps: list[tuple[int, int]], begin_ns: int, length_ns: int
) -> None:
    counters = Counters(time.perf_counter_ns, [])
    counters._readings.clear()
    counters._thread = threading.current_thread()  # so that files are looked at
    readings, now = [], 0
    for gap, length in steps:
        readings.append(reading(now + gap, now + gap + length, now + gap))
        now += gap + length
    counters._readings.extend(readings)
    first, last = counters.around(begin_ns, begin_ns + length_ns)
    before = [one for one in readings if one.ended_ns <= begin_ns]
    after = [one for one in readings if one.began_ns >= begin_ns + length_ns]
    assert first == counters.sample(before[-1] if before else readings[0])
    assert last == counters.sample(after[0] if after else readings[-1])
    assert last.cpu_ns >= first.cpu_ns


@linux_only
@given(st.integers(0, 60), st.integers(0, 7), st.integers(0, 10**6))
def test_the_usual_waiting_is_not_moved_by_one_bad_stretch(per_mille: int, bad: int, extra: int) -> None:
    counters = Counters(time.perf_counter_ns, [])
    counters._thread = threading.current_thread()
    for step in range(160):
        waited = per_mille * 20 * step + (extra * 1000 if step >= 20 * bad + 5 else 0)
        counters._readings.append(Reading(20_000 * step, 20_000 * step, 0, (b"", b"", b"1 %d 1" % waited)))
    assert counters.look_back() == pytest.approx((min(per_mille / 1000, 0.05),))
    for _ in range(150):
        counters._readings.popleft()
    assert counters.look_back() == ()  # too few to say


@linux_only
def test_the_thread_reads_by_itself_and_ends() -> None:
    before = len(os.listdir("/proc/self/fd"))
    counters = Counters(time.perf_counter_ns, [threading.get_native_id()])
    thread = counters._thread
    assert thread is not None
    assert len(os.listdir("/proc/self/fd")) == before + 3
    began = time.perf_counter_ns()
    until = time.thread_time_ns() + 3 * MS
    while time.thread_time_ns() < until:
        pass
    ended = time.perf_counter_ns()
    give_up = time.monotonic() + 100 * READ_EVERY_S
    while counters.heard_ns < ended and time.monotonic() < give_up:
        time.sleep(READ_EVERY_S / 5)
    first, last = counters.around(began, ended)
    counters.close()
    counters.close()
    assert last.cpu_ns - first.cpu_ns >= 2 * MS  # of this thread, read by the other one
    assert not thread.is_alive()
    assert len(os.listdir("/proc/self/fd")) == before
    heard = counters.heard_ns
    counters.read()
    assert counters.heard_ns == heard  # closed


def test_without_the_systems_counters_the_caller_reads_its_own_time() -> None:
    counters = Counters(time.perf_counter_ns, [])
    began = time.perf_counter_ns()
    until = time.thread_time_ns() + 2 * MS
    while time.thread_time_ns() < until:
        pass
    counters.read()
    first, last = counters.around(began, began + MS)
    assert last.cpu_ns - first.cpu_ns >= 2 * MS
    assert (last.run_delays_ns, last.steal_ns, last.switches) == ((), 0, 0)


def test_a_verdict_waits_for_a_reading_and_not_for_ever() -> None:
    now = [0]
    evidence = Evidence(lambda: now[0], MS)  # nobody reads: it is not watched
    incidents = Incidents(evidence)
    now[0] = 100 * MS
    incidents.late(LateWork(1, 90 * MS, 91 * MS, 92 * MS, 0))
    assert incidents.verdict(150 * MS) is None
    now[0] = 300 * MS
    assert incidents.verdict(now[0]) is None  # gathered: the loop has read for itself
    assert incidents.verdict(now[0]) is not None  # judged
    assert evidence.heard_since(300 * MS)
    incidents.late(LateWork(2, 290 * MS, 291 * MS, 299 * MS, 0))
    assert incidents.verdict(348 * MS) is None  # not over
    assert incidents.verdict(349 * MS) is None  # gathered, since it was read in time
    assert incidents.verdict(350 * MS) is not None


def test_a_starved_thread_is_stood_in_for() -> None:
    now = [0]
    evidence = Evidence(lambda: now[0], MS)
    now[0] = 200 * MS
    evidence.read_if_stale(now[0])
    assert not evidence.heard_since(MS)
    now[0] = 251 * MS
    evidence.read_if_stale(now[0])
    assert evidence.heard_since(251 * MS)
