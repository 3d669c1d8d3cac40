"""What is tried for real time: every condition is put back, and cores are chosen by what was measured."""

import os
import sys
from pathlib import Path

import pytest

from pans.app.doctor.command import settings_of, table_text
from pans.app.doctor.rehearsal import ROUNDS, core_siblings, pair_of, rehearse
from pans.base.machine.realtime import usable_cores


@pytest.mark.skipif(sys.platform != "linux", reason="conditions of Linux")
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


def core(number: int, away: float, p99: float = 50.0) -> dict[str, object]:
    return {"core": number, "sleep": {"p99_us": p99}, "away_ms_per_s": away}


def test_the_quietest_core_is_the_hosts_and_the_devices_is_no_sibling_of_it() -> None:
    cores = [core(0, 9.0), core(1, 1.0), core(2, 2.0), core(3, 3.0)]
    assert pair_of(cores, (), []) == (1, 2)
    assert pair_of(cores, (), [frozenset({0, 3}), frozenset({1, 2})]) == (1, 3)
    assert pair_of(cores, (0,), []) == (0, 1)
    assert pair_of(cores[:1], (), []) == (0, None)
    assert pair_of([], (), []) == (None, None)


def test_cores_that_share_a_physical_core_are_read(tmp_path: Path) -> None:
    for number, text in enumerate(("0,2", "1,3", "0,2")):
        folder = tmp_path / f"sys/devices/system/cpu/cpu{number}/topology"
        folder.mkdir(parents=True)
        (folder / "thread_siblings_list").write_text(text + "\n")
    assert core_siblings(tmp_path) == [frozenset({0, 2}), frozenset({1, 3})]
