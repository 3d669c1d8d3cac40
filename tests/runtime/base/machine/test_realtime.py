"""What a process asks of its machine: held while it lasts, undone afterwards, refused with a reason; what the kernel counts."""

import gc
import hashlib
import mmap
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pans.base.errors import UsageError
from pans.base.machine.realtime import (
    GRANTED,
    ThreadCounts,
    apart,
    arm_realtime,
    bound,
    busy_core,
    check_core,
    deciding_core,
    fault_words,
    isolated_cores,
    off_the_deciding_core,
    scheduled,
    shallow_idle,
    steal_ms,
)
from pans.live.loop import _granted
from pans.live.options import RunOptions

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="conditions of Linux")
PAGES = 256


def spinners() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "pans-awake"]


def spun_ns(thread: int | None) -> int:
    return int(Path(f"/proc/self/task/{thread}/schedstat").read_text().split()[0])


def test_the_thread_is_bound_and_its_core_spins_until_the_end() -> None:
    before = os.sched_getaffinity(0)
    core = max(before)
    with busy_core(core) as granted:
        assert granted == {"core": core, "kept_awake": GRANTED}
        assert os.sched_getaffinity(0) == {core}
        (spinner,) = spinners()
        assert spinner.native_id is not None
        assert os.sched_getscheduler(spinner.native_id) == os.SCHED_IDLE
        assert os.sched_getaffinity(spinner.native_id) == {core}
        started_ns = spun_ns(spinner.native_id)
        give_up_s = time.monotonic() + 20  # a machine that is busy gives an idle thread little
        while spun_ns(spinner.native_id) - started_ns < 1_000_000:
            assert time.monotonic() < give_up_s, "it does not spin"
            time.sleep(0.05)
    assert (os.sched_getaffinity(0), spinners()) == (before, [])
    with pytest.raises(RuntimeError), busy_core(core):
        raise RuntimeError
    assert (os.sched_getaffinity(0), spinners()) == (before, [])


def test_a_thread_of_real_time_priority_is_not_shut_out_by_its_own_spinner() -> None:
    with scheduled("SCHED_FIFO", 2) as answer:
        if answer != GRANTED:
            pytest.skip(answer)
        with busy_core(max(os.sched_getaffinity(0))) as granted:
            assert granted["kept_awake"] == GRANTED
            assert os.sched_getscheduler(0) == os.SCHED_FIFO
            assert os.sched_getparam(0).sched_priority == 2
    assert spinners() == []


def test_the_thread_that_decides_gets_a_core_that_a_simulator_leaves_alone() -> None:
    """One run of a machine has it; what the user has bound stays as it is."""
    before, core = os.sched_getaffinity(0), deciding_core()
    if core is None:
        pytest.skip("one core, or this process is confined to some of them")
    with off_the_deciding_core() as is_off:
        assert is_off
        assert os.sched_getaffinity(0) == before - {core}
        assert deciding_core() is None  # confined: nothing is bound
    ended = threading.Event()
    thread = threading.Thread(target=ended.wait)
    thread.start()
    assert thread.native_id is not None
    with apart(thread.native_id) as place, apart(threading.get_native_id()) as refused:
        if place["deciding_core"] == core:  # else another run of this machine has it
            assert os.sched_getaffinity(thread.native_id) == {core}
        assert "another run decides on core" in refused["deciding_core"]
        assert os.sched_getaffinity(0) == before
    assert os.sched_getaffinity(thread.native_id) == before
    ended.set()
    thread.join()


def test_a_core_that_is_not_there_is_refused_with_those_that_are() -> None:
    allowed = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
    with pytest.raises(UsageError, match=f"4095, allowed: {allowed}"):
        check_core(4095)
    with busy_core(4095) as granted:
        assert granted["core"].startswith("refused: ")
    check_core(None)
    check_core(min(os.sched_getaffinity(0)))


def test_conditions_hold_inside_and_are_undone() -> None:
    before = os.sched_getaffinity(0)
    core = max(before)
    with bound(core) as answer:
        assert (answer, os.sched_getaffinity(0)) == (GRANTED, {core})
    assert os.sched_getaffinity(0) == before
    with scheduled("SCHED_FIFO", 10) as answer:
        assert (answer == GRANTED) == (os.sched_getscheduler(0) == os.SCHED_FIFO)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


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


def test_the_facts_of_a_machine_are_read(tmp_path: Path) -> None:
    cpu = tmp_path / "sys/devices/system/cpu"
    cpu.mkdir(parents=True)
    (cpu / "isolated").write_text("2-3\n")
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/stat").write_text("cpu  1 2 3 4 5 6 7 200 9 10\n")
    assert (isolated_cores(tmp_path), isolated_cores(tmp_path / "nothing")) == ({2, 3}, frozenset())
    assert steal_ms(tmp_path) == 200_000 / os.sysconf("SC_CLK_TCK")
    assert steal_ms(tmp_path / "nothing") is None


@pytest.mark.parametrize(
    ("simulated", "told", "options", "asked"),
    [
        (False, False, {}, True),
        (False, False, {"realtime": False}, False),
        (True, False, {}, False),
        (False, True, {}, False),  # a simulator behind a port, as the device says
        (True, True, {"realtime_simulated": True}, True),
        (True, True, {"realtime_simulated": True, "realtime": False}, False),
    ],
)
def test_real_time_is_asked_for_with_a_device_and_not_with_a_simulated_one(
    simulated: bool, told: bool, options: dict[str, bool], asked: bool
) -> None:
    link = SimpleNamespace(virtual=False, simulated=simulated, now_ns=time.perf_counter_ns, fileno=lambda: None)
    reader = SimpleNamespace(thread_id=None)
    session = SimpleNamespace(link=link, reader=reader, facts={"simulated": told})
    receiver = SimpleNamespace(thread_id=None)
    run: Any = SimpleNamespace(
        session=session,
        job=SimpleNamespace(options=RunOptions(**options)),
        realtime=dict[str, Any](),
        receiver=receiver,
    )
    with _granted(run):
        assert ("sched_fifo" in run.realtime, "mlockall" in run.realtime) == (asked, asked)


@pytest.mark.usefixtures("freezing")
@pytest.mark.parametrize("wanted", [False, True])
def test_the_realtime_set_up_is_undone(wanted: bool) -> None:
    interval = sys.getswitchinterval()
    with arm_realtime(wanted) as granted:
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
        assert sys.getswitchinterval() == pytest.approx(granted["switch_interval_s"])
        assert granted["gc_off"] == GRANTED
        asked = {"sched_fifo", "mlockall", "heap_touched"}
        assert granted.keys() - {"gc_off", "switch_interval_s"} == (asked if wanted else set())
        assert all(granted[name] == GRANTED or "refused" in granted[name] for name in granted.keys() & asked)
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    assert sys.getswitchinterval() == interval
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_other_threads_of_the_interpreter_go_one_step_below_the_loop_and_come_back() -> None:
    ended = threading.Event()
    thread = threading.Thread(target=ended.wait)
    thread.start()
    number = thread.native_id or 0
    try:
        with arm_realtime(True) as granted:
            if granted["sched_fifo"] != GRANTED:
                pytest.skip(granted["sched_fifo"])
            assert os.sched_getscheduler(number) == os.SCHED_FIFO
            assert os.sched_getparam(number).sched_priority == os.sched_getparam(0).sched_priority - 1
        assert os.sched_getscheduler(number) == os.SCHED_OTHER
    finally:
        ended.set()
        thread.join()


def answers(program: str) -> list[str]:
    """What a process of its own says, in which others have touched nothing."""
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()


LOCKED = """
import mmap
from pans.base.machine import arm_realtime
here = mmap.mmap(-1, 256 << 20)  # as large a library as nobody calls
with arm_realtime(True) as granted:
    held = {line.split(":")[0]: int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("Vm")}
    print(held["VmLck"], held["VmRSS"], granted["mlockall"])
"""


def test_locked_memory_is_what_was_touched() -> None:
    locked_kb, resident_kb, *answer = answers(LOCKED)
    if answer != [GRANTED]:
        pytest.skip(" ".join(answer))
    assert int(locked_kb) > 256 << 10
    assert int(resident_kb) < 200 << 10


ALLOCATE = """
from pans.base.machine import ThreadCounts, held_heap
def allocate():
    counts = ThreadCounts()
    for size in range(1, 5):
        b"x" * (size << 20)
    return counts.since()["minor"]
print(allocate())
with held_heap() as answer:
    print(allocate(), answer)
"""


def test_a_held_heap_has_been_touched_before() -> None:
    as_it_comes, held, *answer = answers(ALLOCATE)
    if answer != [GRANTED]:
        pytest.skip(" ".join(answer))
    assert int(as_it_comes) > (4 << 20) // mmap.PAGESIZE
    assert int(held) < 32


def touch(pages: int) -> None:
    with mmap.mmap(-1, pages * mmap.PAGESIZE) as memory:
        memory.madvise(mmap.MADV_NOHUGEPAGE)  # else one fault brings many pages
        for page in range(pages):
            memory[page * mmap.PAGESIZE] = 1


def test_each_page_that_this_thread_touches_first_is_a_minor_fault() -> None:
    counts = ThreadCounts()
    touch(PAGES)
    assert counts.since()["minor"] >= PAGES
    counts.restart()
    thread = threading.Thread(target=touch, args=(PAGES,))
    thread.start()
    thread.join()
    assert counts.since()["minor"] < PAGES


@pytest.mark.skipif(not Path("/proc/thread-self/schedstat").exists(), reason="needs the scheduler's statistics")
def test_time_in_which_another_thread_has_the_core_is_waited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two threads that each hash for a while on one core, without the interpreter's lock: this one waits about as long."""
    data, core = bytes(1 << 24), os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(core)})
    try:
        counts, other = ThreadCounts(), threading.Thread(target=hash_for, args=(0.3, data))
        other.start()
        hash_for(0.3, data)
        waited_ms = counts.since()["waited_ms"]
        other.join()
    finally:
        os.sched_setaffinity(0, core)
    assert 60 <= waited_ms <= 10_000


def hash_for(seconds: float, data: bytes) -> None:
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        hashlib.sha256(data)


def test_words_say_when_the_system_does_not_tell() -> None:
    assert fault_words({}) == "not told by this system"
    counts = {"minor": 1, "major": 0, "involuntary_switches": 3, "waited_ms": 7}
    assert fault_words(counts).endswith("lost its core 3 times, and waited 7 ms for one")
