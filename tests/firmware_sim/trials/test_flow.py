"""Late decisions against gaps of the machine: the attribution on gaps made up, a real probe, and one short run of everything."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pans.firmware_sim.probes.attribution import (
    CATCH_UP,
    LINK,
    MACHINE,
    ON_TIME_SHARE,
    OURS,
    PARTLY,
    LateDecision,
    attribute,
    gap_figures,
    late_table,
    link_figures,
    united,
    verdict_of,
    worked_off,
)
from pans.firmware_sim.probes.link_probe import Delay, LinkProbe
from pans.firmware_sim.probes.processes import real_time_programs
from pans.firmware_sim.probes.scheduling_probe import MAX_GAPS, Gap, ProbeLog, SchedulingProbe
from pans.firmware_sim.trials import figures_text
from pans.firmware_sim.trials.flow import Job, broken_bars, carry_out, report
from pans.runtime.bundle.model import write_bundle
from pans.runtime.instrument.profile import load_profile
from pans.runtime.record.format import TIMING_DTYPE
from pans.trainer.export.tape_bundle import tape_bundle

US = 1_000
DEADLINE_NS = 1000 * US


def real_time_allowed() -> bool:
    try:
        policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, policy, parameters)
    except (AttributeError, OSError):
        return False
    return len(os.sched_getaffinity(0)) >= 2


needs_real_time = pytest.mark.skipif(
    not real_time_allowed(), reason="needs Linux, two cores and the right to SCHED_FIFO"
)


def rows(*ends_and_latencies_us: tuple[int, int]) -> NDArray[np.void]:
    """Timings by (when the object left, how long the decision took); numbers from 0."""
    table = np.zeros(len(ends_and_latencies_us), TIMING_DTYPE)
    for number, (end, latency) in enumerate(ends_and_latencies_us):
        table[number] = (number, end * US, (end + latency // 2) * US, (end + latency) * US, (end + latency) * US)
    return table


def gap(begin_us: int, end_us: int, core: int = 0, queued_us: int = 0) -> Gap:
    return Gap(core, (begin_us - 100) * US, begin_us * US, end_us * US, queued_us * US)


def delay(sent_us: int, came_us: int, usual_us: int = 50) -> Delay:
    return Delay(sent_us * US, (sent_us + usual_us) * US, came_us * US)


def judged(timings: NDArray[np.void], number: int, *gaps: Gap, delays: tuple[Delay, ...] = ()) -> LateDecision:
    (found,) = attribute(timings, [number], gaps, DEADLINE_NS, delays)
    assert found.number == number
    return found


# decisions on time at 1000 and 2000 us, one that is 400 us late: it left at 3000 and was made at 4400
THREE = rows((1000, 300), (2000, 300), (3000, 1400))


def test_a_gap_as_long_as_the_decision_was_late_is_the_machines() -> None:
    found = judged(THREE, 2, gap(3100, 3500))
    assert (found.whose, found.away_ns, found.late_ns, found.cores) == (MACHINE, 400 * US, 400 * US, (0,))
    assert judged(THREE, 2, gap(3100, 3499)).whose == PARTLY
    assert judged(THREE, 2).whose == OURS


def test_a_gap_and_working_off_what_came_in_it() -> None:
    found = judged(THREE, 2, gap(3100, 3400))  # 400 us late, away for 300
    assert worked_off(found, 0.34)
    assert not worked_off(found, 0.33)
    assert not worked_off(judged(THREE, 2, gap(3100, 3280)), 5.0)  # nobody is busy for more than all of the time
    assert not worked_off(judged(THREE, 2, gap(3100, 3500)), 0.5)  # explained already
    assert not worked_off(judged(THREE, 2), 0.5)


def test_gaps_of_both_cores_count_once_where_they_overlap() -> None:
    apart = judged(THREE, 2, gap(3100, 3300), gap(3300, 3500, core=1))
    assert (apart.whose, apart.cores) == (MACHINE, (0, 1))
    together = judged(THREE, 2, gap(3100, 3350), gap(3200, 3499, core=1))
    assert (together.whose, together.away_ns) == (PARTLY, 399 * US)


def test_only_gaps_that_the_decision_could_still_feel_count() -> None:
    assert judged(THREE, 2, gap(2400, 2800)).whose == MACHINE  # being caught up when the object left
    assert judged(THREE, 2, gap(1800, 2250)).whose == OURS  # before a decision on time: nothing was waiting any more
    assert judged(THREE, 2, gap(4400, 5000)).whose == OURS  # after it
    assert judged(THREE, 2, gap(4300, 5000)).away_ns == 100 * US  # what lies after it does not count
    long_ago = rows((1000, 300), (9000, 1400))
    assert judged(long_ago, 1, gap(1400, 1900)).whose == OURS  # over for longer than it takes to catch up
    assert judged(long_ago, 1, gap(4000, 7000)).whose == MACHINE


def test_what_the_pair_beside_saw_late_counts_where_the_cores_were_there() -> None:
    assert judged(THREE, 2, delays=(delay(3050, 3500),)).whose == LINK  # 400 us beyond the usual 50
    assert judged(THREE, 2, delays=(delay(3051, 3500),)).whose == PARTLY
    assert judged(THREE, 2, delays=(delay(1800, 2250),)).whose == OURS  # before a decision on time
    both = judged(THREE, 2, gap(3100, 3300), delays=(delay(3200, 3500),))
    assert (both.whose, both.away_ns, both.held_ns) == (LINK, 200 * US, 400 * US)
    assert judged(THREE, 2, gap(3100, 3500), delays=(delay(3050, 3500),)).whose == MACHINE
    assert worked_off(judged(THREE, 2, delays=(delay(3050, 3400),)), 0.34)


def test_a_gap_in_which_the_core_ran_something_else_is_told() -> None:
    assert judged(THREE, 2, gap(3100, 3500, queued_us=390)).queued
    assert not judged(THREE, 2, gap(3100, 3500, queued_us=10)).queued


pieces = st.lists(
    st.tuples(st.integers(0, 60), st.integers(0, 12)).map(lambda pair: (pair[0], pair[0] + pair[1])), max_size=8
)


@given(pieces)
def test_the_union_of_pieces(spans: list[tuple[int, int]]) -> None:
    assert united(spans) == len({at for begin, end in spans for at in range(begin, end)})


@given(
    st.lists(st.tuples(st.integers(1, 900), st.integers(0, 3000)), min_size=1, max_size=12),
    st.lists(st.tuples(st.integers(0, 6000), st.integers(1, 2000), st.integers(0, 1)), max_size=6),
)
def test_the_attribution_is_what_its_words_say(
    steps: list[tuple[int, int]], made_up: list[tuple[int, int, int]]
) -> None:
    ends = np.cumsum([step for step, _ in steps])
    decided = np.maximum.accumulate([end + latency for end, (_, latency) in zip(ends, steps)])  # one after the other
    timings = rows(*((int(end), int(done - end)) for end, done in zip(ends, decided)))
    latencies = decided - ends
    late = [number for number, latency in enumerate(latencies) if latency > 1000]
    gaps = [gap(begin, begin + length, core) for begin, length, core in made_up]
    found = attribute(timings, late, gaps, DEADLINE_NS)
    assert [one.number for one in found] == late
    for one in found:
        punctual = [number for number in range(one.number) if latencies[number] <= 1000 * ON_TIME_SHARE]
        end, done = int(ends[one.number]), int(decided[one.number])
        since = min(end, int(decided[punctual[-1]])) if punctual else end
        away: set[int] = set()
        cores = set()
        for begin, length, core in made_up:
            stop = begin + length
            if begin < done and stop > since and end - stop <= CATCH_UP * length:
                cores.add(core)
                away |= set(range(max(begin, since), min(stop, done)))
        assert (one.away_ns, set(one.cores)) == (len(away) * US, cores)
        expected = OURS if not cores else MACHINE if len(away) >= done - end - 1000 else PARTLY
        assert one.whose == expected


def test_figures_of_the_gaps_are_those_of_the_run() -> None:
    log = ProbeLog(
        1, (gap(0, 900), gap(2000, 2400), gap(10_000, 11_200, queued_us=1100), gap(2_000_000, 2_009_000)), 7, 0.03
    )
    figures = gap_figures(log, 1000 * US, 1_001_000 * US)
    assert figures["per_s_above_ms"] == {"0.2": 2.0, "0.3": 2.0, "0.5": 1.0, "1.0": 1.0, "3.0": 0.0}
    assert (figures["largest_ms"], figures["away_ms"], figures["queued_ms"]) == (1.2, 1.6, 1.2)


def test_the_runs_own_verdicts_beside_whose_it_was() -> None:
    verdicts = [
        {"first_decision": 1, "last_decision": 2, "cause": "host", "shares_us": {}},
        {"first_decision": 2, "last_decision": 5, "cause": "link", "shares_us": {}},
    ]
    assert [verdict_of(number, verdicts)["cause"] for number in (0, 1, 2, 5, 6)] == [
        "none",
        "host",
        "link",
        "link",
        "none",
    ]
    found = attribute(rows((1000, 1300), (3000, 1400)), [0, 1], [gap(1100, 1600)], DEADLINE_NS)
    assert late_table(found, verdicts) == {
        "none": {MACHINE: 1, LINK: 0, PARTLY: 0, OURS: 0},
        "host": {MACHINE: 0, LINK: 0, PARTLY: 0, OURS: 1},
    }


def test_each_bar_that_is_missed_is_said() -> None:
    kept = {"late_share": 1e-4, "run": {"missed": 0.005, "doubled": 0.001}, "whose": {MACHINE: 9, PARTLY: 3, OURS: 0}}
    assert broken_bars(kept | {"partly_worked_off": 3}) == []
    whose = {MACHINE: 9, PARTLY: 3, OURS: 2}
    missed = {"late_share": 2e-4, "run": {"missed": 0.006, "doubled": 0.002}, "whose": whose, "partly_worked_off": 2}
    assert [text.split(":")[0] for text in broken_bars(missed)[:3]] == ["late", "missed", "doubled"]
    assert "2 late decisions without any gap of the machine, 1 with too short ones" in broken_bars(missed)


@needs_real_time
def test_a_probe_that_is_kept_from_its_core_notes_from_when_to_when() -> None:
    probe = SchedulingProbe(max(os.sched_getaffinity(0)))
    try:
        time.sleep(0.1)
        os.kill(probe.pid, signal.SIGSTOP)
        stopped_ns = time.perf_counter_ns()
        time.sleep(0.08)
        continued_ns = time.perf_counter_ns()
        os.kill(probe.pid, signal.SIGCONT)
        time.sleep(0.1)
        programs = real_time_programs({os.getpid()})
        watched = probe.end()
    finally:
        probe.kill()
    assert any(name.endswith("(30)") for name in programs)
    longest = max(watched.gaps, key=lambda one: one.length_ns)
    assert longest.seen_ns < stopped_ns
    assert longest.end_ns > continued_ns
    assert longest.length_ns >= 0.075e9
    assert 0 <= longest.queued_ns <= longest.end_ns - longest.seen_ns
    assert watched.wakes > 100
    assert 0 < watched.own_share < 1
    assert len(watched.gaps) < MAX_GAPS


@needs_real_time
@pytest.mark.parametrize("link", ["tcp", "pty"])
def test_a_pair_whose_receiver_is_held_notes_what_came_late(link: str) -> None:
    cores = sorted(os.sched_getaffinity(0))
    probe = LinkProbe(link, (cores[0], cores[1]))
    try:
        time.sleep(0.15)
        os.kill(probe.pid, signal.SIGSTOP)
        stopped_ns = time.perf_counter_ns()
        time.sleep(0.05)
        continued_ns = time.perf_counter_ns()
        os.kill(probe.pid, signal.SIGCONT)
        time.sleep(0.15)
        watched = probe.end()
    finally:
        probe.kill()
    assert any(one.sent_ns < stopped_ns + 5_000 * US and one.came_ns > continued_ns for one in watched.delays)
    assert all(one.sent_ns <= one.due_ns <= one.came_ns for one in watched.delays)
    assert watched.messages > 100
    assert 0 < watched.usual_ns < 200 * US
    figures = link_figures(watched, stopped_ns, continued_ns + 1)
    assert figures["largest_ms"] >= 45


@needs_real_time
def test_a_short_run_of_everything(tmp_path: Path) -> None:
    bundle, _ = tape_bundle(
        load_profile("flow-snspd"), photons=8.0, dark=0.0, pixels_per_bar=8, lit_px=2, exposure_us=5.0
    )
    write_bundle(bundle, tmp_path / "tape.pans")
    (tmp_path / "tape.toml").write_text('kind = "tape"\nbars = 10\npixels_per_bar = 8\nspeed_bars_per_s = 1000.0\n')
    (tmp_path / "flow.toml").write_text('kind = "tape"\nbars_per_s = 1000.0\n')
    cores = sorted(os.sched_getaffinity(0))[:2]
    job = Job(
        tmp_path / "tape.pans",
        "flow-snspd",
        str(tmp_path / "tape.toml"),
        str(tmp_path / "flow.toml"),
        seconds=1.0,
        seed=3,
        link="tcp",
        pin=(cores[0], cores[1]),
    )
    outcome = carry_out(job, tmp_path)
    result = report(job, outcome)
    assert result["decisions"] == outcome.summary["decisions"] > 800
    assert result["late"] == outcome.summary["late"]
    assert sum(result["whose"].values()) == result["late"]
    assert sum(count for row in result["named"].values() for count in row.values()) == result["late"]
    assert {figures["core"] for figures in result["gaps"]} >= set(cores)
    assert all(0 < figures["canary_share_of_core"] < 1 for figures in result["gaps"])
    assert all(figures["stolen_ms"] >= 0 for figures in result["gaps"])
    assert 0 < result["busy"]["host"] <= 2
    lines = figures_text(result).splitlines()
    assert lines[0] == "SIMULATED"
    assert f"late {result['late']}" in lines
