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
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from pans.runtime.errors import UsageError


def check_core(core: int | None) -> None:
    """Raise UsageError for a core that this process may not use."""
    if core is None:
        return
    if not hasattr(os, "sched_setaffinity"):
        raise UsageError(f"--core {core}: this system cannot pin threads to cores", remedy="leave --core out")
    allowed = sorted(os.sched_getaffinity(0))
    if core not in allowed:
        raise UsageError(f"--core {core}, allowed: {', '.join(map(str, allowed))}")


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
    """A thread of idle priority on `core` that spins in compiled code without the interpreter's lock."""

    def __init__(self, core: int) -> None:
        from .cpu_kernels import spin  # numba, for those who ask

        self._ended = np.ones(1, np.int64)
        spin(self._ended)  # compiled before it is waited for
        self._ended[0] = 0
        self._started = threading.Event()
        self.answer = ""

        def run() -> None:
            self.answer = _idle_on(core)
            self._started.set()
            if self.answer == "granted":
                spin(self._ended)

        self._thread = threading.Thread(target=run, name="pans-awake", daemon=True)
        self._thread.start()
        self._started.wait()

    def stop(self) -> None:
        """End the thread."""
        self._ended[0] = 1
        self._thread.join()


def _idle_on(core: int) -> str:
    """Give the calling thread idle priority on `core`: everything else goes before it."""
    if sys.platform != "linux":
        return "this system has no SCHED_IDLE"
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        os.sched_setaffinity(0, {core})
    except OSError as error:
        return f"refused: {error.strerror}"
    return "granted"
