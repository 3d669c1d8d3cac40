"""Why work was late: every cause from evidence made by hand, and evidence from real collections, waits and threads."""

import gc
import os
import re
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import made_bundle
from hypothesis import given
from hypothesis import strategies as st

from pans.bundle.backends.choose import make_decider
from pans.decide.plan.plan import build_plan
from pans.decide.still.core import Core
from pans.instrument.profile import load_profile
from pans.live.loop import Job, run_live
from pans.live.options import RunOptions
from pans.live.timing.causes import (
    CAUSES,
    DISK,
    GC,
    IDLE,
    INFERENCE,
    OVERSLEPT,
    QUIET_NS,
    READ_EVERY_S,
    Counters,
    Evidence,
    Facts,
    Incidents,
    LateWork,
    Span,
    Stamped,
    judge,
    judge_gap,
    longest_pause_ns,
)
from pans.protocol.tracker import Gap
from pans.record.reading import read_recording
from pans.record.recorder import Recorder
from pans_sim.ports.serve import open_sim
from pans_sim.testing import small_setup

MS = 1_000_000


def facts(
    arrival: float = 40,
    end: float = 40.2,
    spans: tuple[Span, ...] = (),
    run_delay: float = 0,
    stamped: tuple[Stamped, ...] = (),
    cpu: float = 2,
    arrivals: tuple[float, ...] = (),
) -> Facts:
    """Late work whose exposure ended at 0; times in ms; a block every millisecond."""
    stamps = tuple(int(one * MS) for one in arrivals)
    came, decided, computed, delay = (int(one * MS) for one in (arrival, end, cpu, run_delay))
    return Facts(0, came, decided, spans, stamps, MS, computed, delay, 0, stamped)


def span(kind: str, begin: float, end: float) -> Span:
    return Span(kind, int(begin * MS), int(end * MS))


def pong(sent: float, reached: float, left: float, arrival: float) -> Stamped:
    return Stamped(*(int(value * MS) for value in (sent, reached, left, arrival)))


IDLE_ALL = span(IDLE, 0, 40)
CASES = {
    "a collection while bytes wait": (facts(0.2, 40, (span(GC, 0.1, 39),)), "gc", True),
    "a collection holds up the reader, so the bytes seem late": (facts(39, 40, (span(GC, 0.1, 39),)), "gc", True),
    "a write before the bytes could be taken": (facts(0.2, 40, (span(DISK, 0.1, 39),)), "disk", True),
    "this decision's own computation": (facts(0.2, 40, (span(INFERENCE, 0.3, 40),), cpu=39), "inference", True),
    "the computation of the decision before": (facts(0.2, 40, (span(INFERENCE, 0, 39.8),), cpu=39), "inference", True),
    "a back end that waits for other hardware while bytes come": (
        facts(0.2, 40, (span(INFERENCE, 0.3, 40),), arrivals=(10, 20, 30)), "inference", True
    ),
    "stopped within the decision": (facts(0.2, 40, (span(INFERENCE, 0.3, 40),)), "host", True),
    "stopped between two waits": (facts(39.9, 40, (span(IDLE, -5, 0.5),)), "host", True),
    "a collection within the computation": (
        facts(0.2, 40, (span(INFERENCE, 0.3, 40), span(GC, 1, 39))), "gc", True
    ),
    "a processor taken away within the computation": (
        facts(0.2, 40, (span(INFERENCE, 0.3, 40),), run_delay=38), "host", True
    ),
    "a processor taken away while bytes come": (facts(39, 40, (span(IDLE, 0, 39),), run_delay=38), "host", True),
    "stopped in the middle of a wait": (facts(39, 40, (span(IDLE, 0, 5), span(OVERSLEPT, 5, 39))), "host", True),
    "its own work": (facts(0.2, 40, cpu=39), "decode", True),
    "silence without a witness": (facts(spans=(IDLE_ALL,)), "link", False),
    "a probe stuck on its way there": (facts(spans=(IDLE_ALL,), stamped=(pong(5, 39.8, 39.8, 40),)), "link", True),
    "an answer stuck on its way back": (facts(spans=(IDLE_ALL,), stamped=(pong(1, 1.1, 1.1, 40),)), "link", True),
    "a status stuck on its way": (
        facts(spans=(IDLE_ALL,), stamped=(Stamped(None, None, 3 * MS, 40 * MS),)), "link", True
    ),
    "a probe there and back in the silence": (
        facts(spans=(IDLE_ALL,), stamped=(pong(5, 5.1, 5.1, 5.2),)), "device", True
    ),
    "a probe that the device kept": (facts(spans=(IDLE_ALL,), stamped=(pong(5, 5.1, 39.9, 40),)), "device", True),
    "a round trip before the silence proves nothing": (
        facts(spans=(IDLE_ALL,), stamped=(pong(-5, -4.9, -4.9, -4.8),)), "link", False
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_each_cause_is_named(name: str) -> None:
    known, cause, sure = CASES[name]
    verdict = judge(known)
    assert (verdict.cause, verdict.sure) == (cause, sure), verdict
    assert verdict.share_ns > 0.8 * (known.end_ns - known.begin_ns)
    assert "ms" in verdict.why


@given(
    st.integers(1, 10**9),
    st.floats(0, 1),
    st.lists(st.tuples(st.sampled_from([GC, DISK, INFERENCE, IDLE, OVERSLEPT]), st.floats(-0.5, 1), st.floats(0, 1)), max_size=6),
    st.floats(0, 2),
)  # fmt: skip
def test_no_cause_explains_more_than_the_delay(
    total: int, arrival: float, spans: list[tuple[str, float, float]], delay: float
) -> None:
    pieces, reached = [], -total // 2
    for kind, gap, length in spans:  # a loop does one thing after the other
        begin = reached + int(abs(gap) * total / 4)
        reached = begin + int(length * total / 2)
        pieces.append(Span(kind, begin, reached))
    verdict = judge(Facts(0, int(arrival * total), total, tuple(pieces), (), 1, total // 3, int(delay * total), 0, ()))
    assert verdict.cause in CAUSES
    assert all(0 <= share <= total for share in verdict.shares_ns.values())
    assert verdict.share_ns == max(verdict.shares_ns.values())
    assert sum(verdict.shares_ns.values()) <= 2 * total + 5  # the scheduler's counters may overlap what was seen


def test_no_time_in_the_words_is_longer_than_the_delay() -> None:
    """The system's counters are read around the delay."""
    why = judge(facts(arrival=1, end=41, run_delay=160, cpu=90)).why
    assert max(float(one) for one in re.findall(r"([\d.]+) ms", why)) == 41.0


def test_what_never_came_is_the_links_fault_unless_the_device_dropped_it() -> None:
    lost, dropped = Gap(5, 10, 2, 0), Gap(5, 10, 2, 10)
    verdict = judge_gap(lost, facts(), 3)
    assert (verdict.cause, verdict.sure, "3 damaged frames" in verdict.why) == ("link", True, True)
    verdict = judge_gap(dropped, facts(0.2, 400, (span(DISK, 0.1, 399),)), 0)
    assert (verdict.cause, "dropped 10 exposures" in verdict.why) == ("disk", True)
    assert judge_gap(dropped, facts(0.1, 0.2), 0)[:3:2] == ("device", False)


def verdict_of(incidents: Incidents, now_ns: int) -> dict[str, Any] | None:
    """What is known is gathered in one call and judged in the next."""
    found = incidents.verdict(now_ns) or incidents.verdict(now_ns)
    return None if found is None else found.event()


def test_an_incident_is_judged_once_from_its_worst_decision() -> None:
    evidence = Evidence(lambda: 0, 10 * MS, virtual=True)
    evidence.worked(DISK, 100 * MS, 150 * MS)
    incidents = Incidents(evidence)
    assert incidents.verdict(0) is None
    for number, begin in enumerate(range(101, 131, 10)):
        incidents.late(LateWork(number, begin * MS, begin * MS + 1000, 151 * MS))
    assert incidents.verdict(152 * MS) is None  # not quiet yet
    event = verdict_of(incidents, 151 * MS + QUIET_NS)
    assert (event["cause"], event["decisions"], event["first_decision"], event["last_decision"]) == ("disk", 3, 0, 2)
    assert event["worst_us"] == 50_000
    assert incidents.causes == {"disk": 3}
    assert incidents.verdict(10**12) is None


def test_late_work_that_does_not_overlap_is_judged_apart() -> None:
    evidence = Evidence(lambda: 0, 10 * MS, virtual=True)
    incidents = Incidents(evidence)
    for number, (kind, begin, end) in enumerate(((DISK, 100, 120), (INFERENCE, 121, 161))):
        evidence.worked(kind, begin * MS, end * MS)
        incidents.late(LateWork(number, (begin + 1) * MS, (begin + 1) * MS, end * MS))
    assert [verdict_of(incidents, 10**12)["cause"] for _ in range(2)] == ["disk", "inference"]  # type: ignore[index]


def test_a_run_that_is_always_late_gets_a_verdict_per_second() -> None:
    incidents = Incidents(Evidence(lambda: 0, MS, virtual=True))
    verdicts = []
    for number in range(5000):
        incidents.late(LateWork(number, number * MS, number * MS + 1, (number + 20) * MS))
        verdicts.append(incidents.verdict((number + 20) * MS))
    found = [one for one in verdicts if one is not None]
    assert len(found) == 4
    assert sum(incidents.causes.values()) == sum(one.what["decisions"] for one in found)


def test_a_real_collection_is_seen_with_its_length() -> None:
    evidence = Evidence(time.perf_counter_ns, MS)
    heap = [[[]] for _ in range(400_000)]
    evidence.watch()
    begin = time.perf_counter_ns()
    gc.collect()
    end = time.perf_counter_ns()
    evidence.close()
    assert evidence._on_gc not in gc.callbacks
    assert len(heap) == 400_000
    known = evidence.facts(begin, begin, end)
    assert {one.kind for one in known.spans} == {GC}
    assert judge(known).cause == "gc"


def test_waits_that_end_on_time_are_idle_and_others_overslept() -> None:
    evidence = Evidence(lambda: 0, MS, virtual=True)
    evidence.waited(0, 20 * MS, 20 * MS)
    evidence.waited(20 * MS, 20 * MS + 20 * MS, 90 * MS)
    evidence.waited(90 * MS, 90 * MS + 20 * MS, 90 * MS + 10)
    assert evidence.facts(0, 0, 100 * MS).spans == (
        Span(IDLE, 0, 40 * MS),  # two waits with nothing of note between them
        Span(OVERSLEPT, 40 * MS, 90 * MS),
        Span(IDLE, 90 * MS, 90 * MS + 10),
    )


def test_memory_is_bounded() -> None:
    evidence = Evidence(lambda: 0, MS, virtual=True)
    for number in range(10_000):
        evidence.worked(DISK, number * MS, number * MS + MS)
        evidence.stamped(Stamped(None, None, number * MS, number * MS))
    known = evidence.facts(0, 0, 10**13)
    assert len(known.spans) == 1024
    assert len(known.stamped) == 64


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3)), min_size=1, max_size=8),
    st.integers(-5, 60),
    st.integers(0, 20),
)
def test_the_readings_around_a_stretch_are_the_nearest_that_enclose_it(
    steps: list[tuple[int, int]], begin_ns: int, length_ns: int
) -> None:
    counters, now, samples = Counters(time.perf_counter_ns, []), 0, []
    for number, (gap, length) in enumerate(steps):
        samples.append((now + gap, now + gap + length, [0, number, 0]))
        now += gap + length
    counters._samples.clear()
    counters._samples.extend(samples)
    before = [one for one in samples if one[1] <= begin_ns] or samples[:1]
    after = [one for one in samples if one[0] >= begin_ns + length_ns] or samples[-1:]
    assert counters.grown(begin_ns, begin_ns + length_ns) == [0, after[0][2][1] - before[-1][2][1], 0]


@pytest.mark.parametrize("threads", [[], [threading.get_native_id()]])
def test_the_processor_time_of_a_stretch_is_read_and_the_thread_ends(threads: list[int]) -> None:
    before = len(os.listdir("/proc/self/fd")) if sys.platform == "linux" else 0
    counters = Counters(time.perf_counter_ns, threads)
    began = time.perf_counter_ns()
    until = time.thread_time_ns() + 30 * MS
    while time.thread_time_ns() < until:
        pass
    ended, give_up = time.perf_counter_ns(), time.monotonic() + 100 * READ_EVERY_S
    if not threads:
        counters.read()
    while counters.read_ns < ended and time.monotonic() < give_up:
        time.sleep(READ_EVERY_S / 5)
    _, cpu_ns, *_ = counters.grown(began, ended)
    counters.close()
    counters.close()
    assert cpu_ns >= 20 * MS  # the kernel counts in steps of some ms while a thread goes on
    assert counters._thread is None or not counters._thread.is_alive()
    assert sys.platform != "linux" or len(os.listdir("/proc/self/fd")) == before
    heard = counters.read_ns
    counters.read()
    assert counters.read_ns == heard  # closed


def test_a_verdict_waits_for_a_reading_and_not_for_ever() -> None:
    now = [0]
    evidence = Evidence(lambda: now[0], MS)  # nobody reads: it is not watched
    incidents = Incidents(evidence)
    now[0] = 100 * MS
    incidents.late(LateWork(1, 90 * MS, 91 * MS, 92 * MS))
    assert incidents.verdict(150 * MS) is None
    now[0] = 300 * MS
    assert incidents.verdict(now[0]) is None  # gathered: the loop has read for itself
    assert incidents.verdict(now[0]) is not None  # judged
    assert evidence.read_since(300 * MS)


def test_a_starved_thread_is_stood_in_for() -> None:
    now = [0]
    evidence = Evidence(lambda: now[0], MS)
    for at, heard in ((200 * MS, False), (251 * MS, True)):
        now[0] = at
        evidence.read_if_stale(at)
        assert evidence.read_since(at) == heard


@pytest.mark.parametrize(
    ("faults", "causes"),
    [
        ("", set()),
        ("stall:60ms/300ms", {"link"}),
        ("late:60ms/300ms", {"device"}),
        ("pause:60ms/300ms", {"host"}),
        ("loss:0.02", {"link"}),
    ],
)
def test_whole_runs_in_virtual_time_blame_what_was_done_to_them(faults: str, causes: set[str], tmp_path: Path) -> None:
    profile, bundle, plan = small_setup("sequential")
    config = RunOptions(n_cycles=3000, deadline_us=10_000.0, realtime=False)
    core = Core(plan, make_decider(bundle, backend="table"), 1, config.n_cycles)
    path = tmp_path / "run.pansrec"
    with Recorder(path, {}) as recorder:
        link = open_sim(f"sim:ideal?scene=uniform&pace=fast&seed=2&faults={faults}")
        result = run_live(link, Job(profile, bundle, plan, config), core, recorder)
        recorder.close({})
    assert result.ended == "completed"
    assert set(result.late_cause) | set(result.lost_cause) == causes
    assert sum(result.late_cause.values()) == result.timing.late
    assert sum(result.lost_cause.values()) == result.stream["lost_exposures"]
    verdicts = [event for event in read_recording(path).events() if event["kind"] == "blame"]
    assert sum(event.get("decisions", 0) for event in verdicts) == result.timing.late
    if faults and "loss" not in faults:
        assert len(verdicts) > 1
        assert all(event["sure"] for event in verdicts), [event["why"] for event in verdicts]


@pytest.mark.parametrize(("shots", "dark"), [(1, 0), (3, 1), (5, 2)])
@pytest.mark.parametrize("order", ["pattern-major", "shot-major"])
def test_the_longest_pause_between_blocks(shots: int, dark: int, order: str) -> None:
    levels = np.zeros((4, 9), np.uint16)
    levels[:, 0] = 123
    bundle = made_bundle(
        image_shape=(3, 3), levels=124, pattern_levels=levels, photons_per_level=8.0 / 123, table=np.zeros((16, 2), np.float32)
    )  # fmt: skip
    plan = build_plan(
        load_profile("oled-qcmos"), bundle, shots_per_object=shots, dark_slots_per_cycle=dark, order=order
    )
    ends, length = [], 0
    for slot in range(2 * plan.slots_per_cycle):  # two cycles
        length += 1
        here, following = (
            at // plan.slots_per_cycle * plan.cycle_ticks + int(plan.slot_offset_ticks[at % plan.slots_per_cycle])
            for at in (slot, slot + 1)
        )
        is_last = (slot + 1) % plan.slots_per_cycle == 0
        if is_last or length == plan.block_exposures or following - here != plan.slot_period_ticks:
            ends.append(here)
            length = 0
    naive = max(after - before for before, after in pairwise(ends))
    assert longest_pause_ns(plan) == pytest.approx(naive * plan.tick_us * 1000, abs=1)
