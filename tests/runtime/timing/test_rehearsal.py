"""What is tried for real time: every condition is put back, refusals are told, cores are chosen by what was measured."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from pans.runtime.commands.doctor import settings_of, table_text
from pans.runtime.timing.cpu import (
    GRANTED,
    bound,
    fifo,
    isolated_cores,
    shallow_idle,
    steal_ms,
    usable_cores,
)
from pans.runtime.timing.rehearsal import ROUNDS, core_siblings, pair_of, rehearse

linux = pytest.mark.skipif(sys.platform != "linux", reason="conditions of Linux")


@linux
def test_a_rehearsal_measures_every_arm_in_every_round_and_leaves_nothing_changed() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    shares: list[float] = []
    found = rehearse(0.6, shares.append)
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    for name, turns in found.arms.items():
        refused = any(str(answer).startswith("refused") for answer in turns.asked.values())
        assert refused or len(turns.rounds_ns) == ROUNDS, name
    assert found.host in usable_cores()
    assert found.device != found.host or len(usable_cores()) == 1
    rows = settings_of(found)
    assert {"SCHED_FIFO", "affinity", "core kept awake", "C-states", "isolcpus"} <= {row["setting"] for row in rows}
    assert all(row["do"] and {"without", "with"} <= set(row) for row in rows)
    assert all(row["setting"] in table_text(rows, found) for row in rows)


@linux
def test_conditions_hold_inside_and_are_undone() -> None:
    core = max(os.sched_getaffinity(0))
    before = os.sched_getaffinity(0)
    with bound(core) as answer:
        assert answer == GRANTED
        assert os.sched_getaffinity(0) == {core}
    assert (os.sched_getaffinity(0)) == before
    with bound(4095) as answer:
        assert answer.startswith("refused: ")
    with fifo(10) as answer:
        assert (answer == GRANTED) == (os.sched_getscheduler(0) == os.SCHED_FIFO)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@linux
def test_idle_states_are_asked_for_by_a_file_that_stays_open(tmp_path: Path) -> None:
    with shallow_idle(tmp_path / "missing") as answer:
        assert answer.startswith("refused: ")
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    with shallow_idle(device) as answer:
        assert answer == GRANTED
        held = [os.readlink(path) for path in Path("/proc/self/fd").iterdir() if path.exists()]
        assert str(device) in held
    assert device.read_bytes() == bytes(4)


def core(number: int, away: float, p99: float = 50.0) -> dict[str, object]:
    return {"core": number, "sleep": {"p99_us": p99}, "away_ms_per_s": away}


def test_the_quietest_core_is_the_hosts_and_the_devices_is_no_sibling_of_it() -> None:
    cores = [core(0, 9.0), core(1, 1.0), core(2, 2.0), core(3, 3.0)]
    assert pair_of(cores, (), []) == (1, 2)
    assert pair_of(cores, (), [frozenset({0, 3}), frozenset({1, 2})]) == (1, 3)
    assert pair_of(cores, (0,), []) == (0, 1)
    assert pair_of(cores[:1], (), []) == (0, None)
    assert pair_of([], (), []) == (None, None)


def test_the_facts_of_a_machine_are_read(tmp_path: Path) -> None:
    cpu = tmp_path / "sys/devices/system/cpu"
    for number, text in enumerate(("0,2", "1,3", "0,2")):
        (cpu / f"cpu{number}/topology").mkdir(parents=True)
        (cpu / f"cpu{number}/topology/thread_siblings_list").write_text(text + "\n")
    (cpu / "isolated").write_text("2-3\n")
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/stat").write_text("cpu  1 2 3 4 5 6 7 200 9 10\n")
    assert core_siblings(tmp_path) == [frozenset({0, 2}), frozenset({1, 3})]
    assert isolated_cores(tmp_path) == {2, 3}
    assert steal_ms(tmp_path) == 200_000 / os.sysconf("SC_CLK_TCK")
    assert isolated_cores(tmp_path / "nothing") == frozenset()
    assert steal_ms(tmp_path / "nothing") is None
