"""A core kept awake: bound while it lasts, free afterwards, refused with the cores that there are."""

from __future__ import annotations

import os
import threading
import time

import pytest

from pans.runtime.errors import UsageError
from pans.runtime.timing.cpu import busy_core, check_core

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="this system does not bind threads to cores"
)


def spinners() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "pans-awake"]


def test_the_thread_is_bound_and_its_core_spins_until_the_end() -> None:
    before = os.sched_getaffinity(0)
    core = max(before)
    with busy_core(core) as granted:
        assert granted == {"core": core, "kept_awake": "granted"}
        assert os.sched_getaffinity(0) == {core}
        (spinner,) = spinners()
        assert spinner.native_id is not None
        assert os.sched_getscheduler(spinner.native_id) == os.SCHED_IDLE
        assert os.sched_getaffinity(spinner.native_id) == {core}
        with open(f"/proc/self/task/{spinner.native_id}/schedstat") as file:
            started_ns = int(file.read().split()[0])
        deadline = time.monotonic() + 20  # a machine that is busy gives an idle thread little
        spun_ns = 0
        while spun_ns < 1_000_000 and time.monotonic() < deadline:
            time.sleep(0.05)
            with open(f"/proc/self/task/{spinner.native_id}/schedstat") as file:
                spun_ns = int(file.read().split()[0]) - started_ns
        assert spun_ns >= 1_000_000, "it does not spin"
    assert os.sched_getaffinity(0) == before
    assert spinners() == []


def test_it_is_undone_when_the_run_breaks() -> None:
    before = os.sched_getaffinity(0)
    with pytest.raises(RuntimeError), busy_core(min(before)):
        raise RuntimeError
    assert os.sched_getaffinity(0) == before
    assert spinners() == []


def test_a_thread_of_real_time_priority_is_not_shut_out_by_its_own_spinner() -> None:
    policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
    except OSError:
        pytest.skip("no real-time priority is granted here")
    try:
        with busy_core(max(os.sched_getaffinity(0))) as granted:
            assert granted["kept_awake"] == "granted"
            assert os.sched_getscheduler(0) == os.SCHED_FIFO
            assert os.sched_getparam(0).sched_priority == 2
    finally:
        os.sched_setscheduler(0, policy, before)
    assert spinners() == []


def test_a_core_that_is_not_there_is_refused_with_those_that_are() -> None:
    allowed = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
    with pytest.raises(UsageError, match=f"--core 4095, allowed: {allowed}"):
        check_core(4095)
    with busy_core(4095) as granted:
        assert granted["core"].startswith("refused: ")
    check_core(None)
    check_core(min(os.sched_getaffinity(0)))
