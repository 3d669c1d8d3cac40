"""A core that never falls asleep, and conditions that a process may ask for: priority, core, idle states.

A core that halts between two blocks wakes with cold caches and, in a virtual machine, after somebody else's turn
(docs/explanation/timing.md). A spinning thread of idle priority in the same process keeps it awake: whatever has something to do goes
before it. That costs a whole core, hence only when asked for. Every context manager here yields "granted" or the reason why not, belongs
to the calling thread, and undoes what it asked for.
"""

from __future__ import annotations

import os
import platform
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pans.runtime.errors import UsageError

GRANTED = "granted"
LOOK_EVERY_S = 0.0005  # whether the spinner spins
ENDED, SPINS = 0, 1  # places in the state of a spin
DMA_LATENCY = Path("/dev/cpu_dma_latency")


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
    return sorted(mask | {core for core in isolated_cores() if _can_be_bound(core, mask)})


def isolated_cores(root: Path = Path("/")) -> frozenset[int]:
    """Return the cores that the kernel keeps other programs away from (isolcpus)."""
    return cores_of(first_line(root / "sys/devices/system/cpu/isolated"))


def cores_of(text: str) -> frozenset[int]:
    """Return the cores of a list as the kernel writes it.

    >>> sorted(cores_of("0-2,5"))
    [0, 1, 2, 5]
    """
    found: set[int] = set()
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if first.isdecimal():
            found |= set(range(int(first), int(last or first) + 1))
    return frozenset(found)


def first_line(path: Path) -> str:
    """Return the first line of a file of the system, "" where there is none."""
    try:
        return path.read_text().split("\n", 1)[0].strip()
    except (OSError, UnicodeDecodeError):
        return ""


def steal_ms(root: Path = Path("/")) -> float | None:
    """Return for how long the hypervisor ran something else since the start, all cores together; None where that is not known."""
    fields = first_line(root / "proc/stat").split()
    if len(fields) < 9 or not hasattr(os, "sysconf"):
        return None
    return int(fields[8]) * 1000 / os.sysconf("SC_CLK_TCK")


def _can_be_bound(core: int, mask: set[int]) -> bool:
    try:
        os.sched_setaffinity(0, {core})
    except OSError:  # a container's cpuset leaves it out
        return False
    os.sched_setaffinity(0, mask)
    return True


# -- conditions --------------------------------------------------------------------------------------------------------


def _asked(request: Callable[[], object]) -> str:
    try:
        request()
    except OSError as error:
        return f"refused: {error.strerror}"
    return GRANTED


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


# -- a core kept awake -------------------------------------------------------------------------------------------------


@contextmanager
def busy_core(core: int | None) -> Iterator[dict[str, Any]]:
    """Pin the calling thread to `core` and keep that core busy while the block runs; yield {what: "granted" or why not}, {} for None."""
    if core is None or not hasattr(os, "sched_setaffinity"):
        yield {}
        return
    with bound(core) as answer:
        if answer != GRANTED:
            yield {"core": answer}
            return
        spinner = _Spinner(core)
        try:
            yield {"core": core, "kept_awake": spinner.answer}
        finally:
            spinner.stop()


class _Spinner:
    """A thread of idle priority on `core` that spins in compiled code without the interpreter's lock.

    It gets its priority only while it spins and loses it before it ends: a thread of idle priority that holds the interpreter's lock on a
    core that others want would stop this process for seconds.
    """

    def __init__(self, core: int) -> None:
        spin = _spin()
        self._state = np.array([1, 0])
        spin(self._state)  # compiled before it is waited for
        self._state[:] = 0
        self._thread = threading.Thread(target=spin, args=(self._state,), name="pans-awake", daemon=True)
        with _ordinary():
            self._thread.start()
            while not self._state[SPINS]:
                time.sleep(LOOK_EVERY_S)
            self.answer = _idle_on(core, self._thread.native_id)
        if self.answer != GRANTED:
            self.stop()

    def stop(self) -> None:
        """End the thread; idempotent."""
        if self.answer == GRANTED and self._thread.native_id is not None and self._thread.is_alive():
            with suppress(OSError):  # not everybody may go back; it then takes a little longer
                os.sched_setscheduler(self._thread.native_id, os.SCHED_OTHER, os.sched_param(0))
        self._state[ENDED] = 1
        self._thread.join()


@contextmanager
def _ordinary() -> Iterator[None]:
    """Ordinary priority for the calling thread: one that begins here inherits it, and with a real-time one would spin for good."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    realtime = policy in (os.SCHED_FIFO, os.SCHED_RR)
    if realtime:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        if realtime:
            os.sched_setscheduler(0, policy, parameters)


def _idle_on(core: int, thread: int | None) -> str:
    """Give `thread` idle priority on `core`: everything else goes before it."""
    if sys.platform != "linux" or thread is None:
        return "this system has no SCHED_IDLE"

    def ask() -> None:
        os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))
        os.sched_setaffinity(thread, {core})

    return _asked(ask)


@cache
def _spin() -> Any:
    """Return the compiled loop that waits until state[ENDED], int64, is not 0; state[SPINS] is 1 from the beginning on."""
    from llvmlite import ir  # numba, only where a core is kept awake
    from numba import njit, types
    from numba.extending import intrinsic

    @intrinsic
    def pause(typing_context: Any) -> Any:
        """The processor's hint that a loop waits; memory counts as changed, so that the loop looks at it again."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            if platform.machine() in ("x86_64", "AMD64"):
                kind = ir.FunctionType(ir.VoidType(), [])
                builder.call(builder.module.declare_intrinsic("llvm.x86.sse2.pause", (), kind), [])
            else:
                builder.fence("seq_cst")
            return context.get_dummy_value()

        return types.void(), generate

    @njit(nogil=True)
    def spin(state):  # type: ignore[no-untyped-def]
        state[1] = 1
        while state[0] == 0:
            pause()

    return spin
