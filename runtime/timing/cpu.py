"""A processor core for the loop alone to fall asleep on, which it never does.

Owns the binding of a thread to a core, and the spinning thread of idle priority that keeps this core from halting; undone afterwards.
A core that halts between two blocks wakes with cold caches and, in a virtual machine, after somebody else's turn: a turn of the
loop then takes about twice as long (docs/explanation/timing.md). The spinner belongs to the same process, so that only
threads change over, and whatever has something to do goes before it. It costs a whole core, hence only when asked for.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from pans.runtime.errors import UsageError

from .machine import read_machine

LOOK_EVERY_S = 0.0005  # whether the spinner spins


def check_core(core: int | None) -> None:
    """Raise UsageError for a core that this process may not use."""
    if core is None:
        return
    if not hasattr(os, "sched_setaffinity"):
        raise UsageError(f"--core {core}: this system cannot pin threads to cores", remedy="leave --core out")
    allowed = usable_cores()
    if core not in allowed:
        raise UsageError(f"--core {core}, allowed: {', '.join(map(str, allowed))}")


def usable_cores() -> list[int]:
    """Return the cores on which this process may run or can be bound to: isolated ones are not in its mask, and yet allowed."""
    mask = os.sched_getaffinity(0)
    return sorted(mask | {core for core in read_machine().isolated if _can_be_bound(core, mask)})


def _can_be_bound(core: int, mask: set[int]) -> bool:
    try:
        os.sched_setaffinity(0, {core})
    except OSError:  # a container's cpuset leaves it out
        return False
    os.sched_setaffinity(0, mask)
    return True


@contextmanager
def busy_core(core: int | None) -> Iterator[dict[str, Any]]:
    """Pin the calling thread to `core` and keep that core busy while the block runs; yield {what: "granted" or why not}, {} for None."""
    if core is None or not hasattr(os, "sched_setaffinity"):
        yield {}
        return
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {core})
    except OSError as error:
        yield {"core": f"refused: {error.strerror}"}
        return
    spinner = _Spinner(core)
    try:
        yield {"core": core, "kept_awake": spinner.answer}
    finally:
        spinner.stop()
        os.sched_setaffinity(0, before)


class _Spinner:
    """A thread of idle priority on `core` that spins in compiled code without the interpreter's lock.

    It gets its priority only while it spins and loses it before it ends: a thread of idle priority that holds the interpreter's lock on a
    core that others want would stop this process for seconds.
    """

    def __init__(self, core: int) -> None:
        from .cpu_kernels import ENDED, SPINS, spin  # numba, for those who ask

        self._state = np.zeros(2, np.int64)
        self._state[ENDED] = 1
        spin(self._state)  # compiled before it is waited for
        self._state[:] = 0
        self._ended = ENDED
        self._thread = threading.Thread(target=spin, args=(self._state,), name="pans-awake", daemon=True)
        with _ordinary():
            self._thread.start()
            while not self._state[SPINS]:
                time.sleep(LOOK_EVERY_S)
            self.answer = _idle_on(core, self._thread.native_id)
        if self.answer != "granted":
            self.stop()

    def stop(self) -> None:
        """End the thread; idempotent."""
        if self.answer == "granted" and self._thread.native_id is not None and self._thread.is_alive():
            with suppress(OSError):  # not everybody may go back; it then takes a little longer
                os.sched_setscheduler(self._thread.native_id, os.SCHED_OTHER, os.sched_param(0))
        self._state[self._ended] = 1
        self._thread.join()


@contextmanager
def _ordinary() -> Iterator[None]:
    """Ordinary priority for the calling thread: one that begins here inherits it, and with a real-time one would spin for good."""
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    if policy in (os.SCHED_FIFO, os.SCHED_RR):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        if policy in (os.SCHED_FIFO, os.SCHED_RR):
            os.sched_setscheduler(0, policy, parameters)


def _idle_on(core: int, thread: int | None) -> str:
    """Give `thread` idle priority on `core`: everything else goes before it."""
    if sys.platform != "linux" or thread is None:
        return "this system has no SCHED_IDLE"
    try:
        os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))
        os.sched_setaffinity(thread, {core})
    except OSError as error:
        return f"refused: {error.strerror}"
    return "granted"
