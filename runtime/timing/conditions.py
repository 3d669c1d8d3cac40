"""Conditions under which a thread may run, each tried for a while and put back: priority, core, idle states, timer slack.

Owns the asking and the undoing; only what a process may change for itself is asked for, never a setting of the machine. Each context
manager yields "granted" or the reason why not, and never raises for a refusal. They belong to the calling thread.
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

GRANTED = "granted"
PR_SET_TIMERSLACK, PR_GET_TIMERSLACK = 29, 30  # linux/prctl.h
DMA_LATENCY = Path("/dev/cpu_dma_latency")


@contextmanager
def fifo(priority: int) -> Iterator[str]:
    """SCHED_FIFO for the calling thread."""
    if not hasattr(os, "sched_setscheduler"):
        yield "this system has no SCHED_FIFO"
        return
    policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
    answer = _asked(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority)))
    try:
        yield answer
    finally:
        if answer == GRANTED:
            os.sched_setscheduler(0, policy, before)


@contextmanager
def bound(core: int) -> Iterator[str]:
    """The calling thread on `core` alone."""
    if not hasattr(os, "sched_setaffinity"):
        yield "this system does not bind threads to cores"
        return
    before = os.sched_getaffinity(0)
    answer = _asked(lambda: os.sched_setaffinity(0, {core}))
    try:
        yield answer
    finally:
        if answer == GRANTED:
            os.sched_setaffinity(0, before)


@contextmanager
def shallow_idle(device: Path = DMA_LATENCY) -> Iterator[str]:
    """No core may enter an idle state that it takes time to leave, for as long as the file is open (Linux: PM QoS)."""
    file: list[int] = []

    def ask() -> None:
        file.append(os.open(device, os.O_WRONLY))
        os.write(file[0], struct.pack("i", 0))

    answer = _asked(ask) if sys.platform == "linux" else "not asked for on this system"
    try:
        yield answer
    finally:
        for one in file:
            os.close(one)


@contextmanager
def timer_slack(slack_ns: int) -> Iterator[str]:
    """By how much the kernel may delay this thread's timers to fire several at once (usually 50 us; none under SCHED_FIFO)."""
    if sys.platform != "linux":
        yield "not asked for on this system"
        return
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    before = prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0)
    answer = GRANTED if prctl(PR_SET_TIMERSLACK, slack_ns, 0, 0, 0) == 0 else "refused"
    try:
        yield answer
    finally:
        with suppress(OSError):
            prctl(PR_SET_TIMERSLACK, max(before, 1), 0, 0, 0)


@contextmanager
def locked(address: int, length: int) -> Iterator[str]:
    """`length` bytes of memory from `address` on are resident before anything touches them (mlock)."""
    if sys.platform != "linux":
        yield "not asked for on this system"
        return
    libc = ctypes.CDLL(None, use_errno=True)
    here, size = ctypes.c_void_p(address), ctypes.c_size_t(length)
    answer = GRANTED if libc.mlock(here, size) == 0 else f"refused: {os.strerror(ctypes.get_errno())}"
    try:
        yield answer
    finally:
        if answer == GRANTED:
            libc.munlock(here, size)


def _asked(request: Callable[[], object]) -> str:
    try:
        request()
    except OSError as error:
        return f"refused: {error.strerror}"
    return GRANTED
