"""What is tried for real time: every condition is put back, refusals are told, cores are chosen by what was measured."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from pans.runtime.commands.doctor_realtime import payload_of, settings_of, table_text
from pans.runtime.timing.conditions import GRANTED, bound, fifo, shallow_idle, timer_slack
from pans.runtime.timing.cpu import usable_cores
from pans.runtime.timing.first_touch import first_touch
from pans.runtime.timing.machine import IdleState, Machine, SerialTimer, read_machine
from pans.runtime.timing.rehearsal import ROUNDS, pair_of, rehearse

linux = pytest.mark.skipif(sys.platform != "linux", reason="conditions of Linux")


def slack_ns() -> int:
    return int(Path(f"/proc/{os.getpid()}/timerslack_ns").read_text())


@linux
def test_a_rehearsal_measures_every_arm_in_every_round_and_leaves_nothing_changed() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0), slack_ns()
    told: list[float] = []
    machine = read_machine()
    found = rehearse(machine, 0.6, told.append)
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0), slack_ns()) == before
    assert told == sorted(told)
    assert told[-1] == 1.0
    for name, turns in found.arms.items():
        refused = any(str(answer).startswith("refused") for answer in turns.asked.values())
        rounds = {kind: len(times) for kind, times in turns.late_ns.items()}
        assert refused or set(rounds.values()) == {ROUNDS}, name
        assert all(late > 0 for late in turns.all_of("pipe")), "a stamp is taken before its byte arrives"
    assert found.host in usable_cores()
    assert found.device != found.host or len(usable_cores()) == 1
    rows = settings_of(machine, found)
    assert {"SCHED_FIFO", "affinity", "core kept awake", "C-states", "governor", "isolcpus", "mlockall"} <= {
        row.setting for row in rows
    }
    assert all(row.do for row in rows)
    assert {"without", "with"} <= set(payload_of(rows, found)["settings"][0])
    assert all(row.setting in table_text(rows, found) for row in rows)


@linux
def test_conditions_hold_inside_and_are_undone() -> None:
    core = max(os.sched_getaffinity(0))
    before = os.sched_getaffinity(0), slack_ns()
    with bound(core) as answer, timer_slack(1) as slack:
        assert (answer, slack) == (GRANTED, GRANTED)
        assert os.sched_getaffinity(0) == {core}
        assert slack_ns() == 1
    assert (os.sched_getaffinity(0), slack_ns()) == before
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


@linux
def test_locked_memory_has_no_fault_at_first_touch() -> None:
    pages = 64
    assert first_touch(lock=False, pages=pages)["faults"] >= pages
    locked = first_touch(lock=True, pages=pages)
    assert locked["asked"] != GRANTED or locked["faults"] < pages // 4


def core(number: int, away: float, p99: float = 50.0) -> dict[str, object]:
    return {"core": number, "sleep": {"p99_us": p99}, "away_ms_per_s": away}


def machine(isolated: tuple[int, ...] = (), pairs: tuple[tuple[int, ...], ...] = ()) -> Machine:
    return Machine(frozenset(isolated), tuple(map(frozenset, pairs)), "", "", (), False, None, ())


def test_the_quietest_core_is_the_hosts_and_the_devices_is_no_sibling_of_it() -> None:
    cores = [core(0, 9.0), core(1, 1.0), core(2, 2.0), core(3, 3.0)]
    assert pair_of(cores, machine()) == (1, 2)
    assert pair_of(cores, machine(pairs=((0, 3), (1, 2)))) == (1, 3)
    assert pair_of(cores, machine(isolated=(0,))) == (0, 1)
    assert pair_of(cores[:1], machine()) == (0, None)
    assert pair_of([], machine()) == (None, None)


def test_the_facts_of_a_machine_are_read(tmp_path: Path) -> None:
    files = {
        "sys/devices/system/cpu/isolated": "2-3\n",
        "sys/devices/system/cpu/cpu0/topology/thread_siblings_list": "0,2\n",
        "sys/devices/system/cpu/cpu1/topology/thread_siblings_list": "1,3\n",
        "sys/devices/system/cpu/cpu2/topology/thread_siblings_list": "0,2\n",
        "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave\n",
        "sys/devices/system/cpu/cpuidle/current_driver": "intel_idle\n",
        "sys/devices/system/cpu/cpu0/cpuidle/state0/name": "POLL\n",
        "sys/devices/system/cpu/cpu0/cpuidle/state0/latency": "0\n",
        "sys/devices/system/cpu/cpu0/cpuidle/state1/name": "C6\n",
        "sys/devices/system/cpu/cpu0/cpuidle/state1/latency": "133\n",
        "sys/devices/system/cpu/cpu0/cpuidle/state2/name": "C10\n",
        "sys/devices/system/cpu/cpu0/cpuidle/state2/disable": "1\n",
        "sys/class/tty/ttyS0/type": "0\n",
        "sys/class/tty/ttyS1/type": "4\n",
        "sys/class/tty/ttyS1/flags": "0x10002040\n",
        "sys/class/tty/ttyUSB0/dev": "188:0\n",
        "sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16\n",
        "proc/sys/kernel/sched_rt_runtime_us": "950000\n",
        "proc/sys/kernel/sched_rt_period_us": "1000000\n",
        "proc/cpuinfo": "processor\t: 0\nflags\t\t: fpu hypervisor sse2\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert read_machine(tmp_path) == Machine(
        isolated=frozenset({2, 3}),
        siblings=(frozenset({0, 2}), frozenset({1, 3})),
        governor="powersave",
        idle_driver="intel_idle",
        idle_states=(IdleState("POLL", 0), IdleState("C6", 133)),
        hypervisor=True,
        rt_share=0.95,
        serial=(SerialTimer("ttyS1", None, True), SerialTimer("ttyUSB0", 16, None)),
    )
    assert read_machine(tmp_path / "nothing").isolated == frozenset()
