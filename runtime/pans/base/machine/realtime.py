"""What a process asks of its machine to be on time: real-time priority, resident memory, a core that never sleeps; and what it got.

Each context manager yields "granted" or the reason why not, belongs to the calling thread, and undoes what it asked for.
"""

from __future__ import annotations

import ctypes
import gc
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.errors import UsageError

GRANTED = "granted"
SWITCH_INTERVAL_S = 0.0005
FIFO_PRIORITY = 10
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
LOOK_EVERY_S = 0.0005  # whether the spinner spins
ENDED, SPINS = 0, 1  # places in the state of a spin
DMA_LATENCY = Path("/dev/cpu_dma_latency")
HELD_BYTES = 8 << 20  # more than a run of the fastest shipped profile keeps between two writes of its recording
HELD_LARGEST = 32 << 20  # glibc takes no more as M_MMAP_THRESHOLD
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
USUAL_THRESHOLD = 128 << 10  # of both
PAGE_BYTES = 4096
SMALL_BYTES, PIN_EVERY_BYTES = 400, 128 << 10  # pymalloc: objects to 512 bytes, in arenas of 256 KiB or 1 MiB
COUNTED = {"minor": 7, "major": 9}  # fields of /proc/PID/stat behind the name: minflt, majflt

OF_SYSTEM: Mapping[str, Callable[[], bool]] = {
    "real-time priority (SCHED_FIFO)": lambda: hasattr(os, "sched_setscheduler"),
    "locked memory (mlockall)": lambda: sys.platform == "linux",
    "binding to a core (--core)": lambda: hasattr(os, "sched_setaffinity"),
    "page faults by thread": lambda: sys.platform == "linux",
    "pseudo-terminals": lambda: hasattr(os, "openpty"),
    "systemd (pans service)": lambda: sys.platform == "linux",
}


def lacking() -> list[str]:
    """Return what this system does not have of what runs, ports and services use where they can."""
    return [what for what, is_there in OF_SYSTEM.items() if not is_there()]


@contextmanager
def arm_realtime(wanted: bool, deciding: Sequence[int] = (0,)) -> Iterator[dict[str, Any]]:
    """Ask for a steady process while the loop runs; yield {what: "granted" or the reason why not}, undo it afterwards.

    The garbage collector is frozen and switched off in any case: a collection costs milliseconds with numba loaded. With `wanted`,
    SCHED_FIFO (for the threads that are `deciding`, by native id, 0: this one) and locked memory are asked for; both need privileges,
    and neither is needed to be correct. The interpreter's other threads go one step below: whoever holds the interpreter must not wait
    for the rest of the machine, since the loop may be waiting for it.
    """
    granted: dict[str, Any] = {"gc_off": GRANTED, "switch_interval_s": SWITCH_INTERVAL_S}
    with ExitStack() as held:
        held.callback(sys.setswitchinterval, sys.getswitchinterval())
        held.callback(gc.enable)
        held.callback(gc.unfreeze)
        if gc.isenabled():  # else all is as it was loaded, and to look through it takes 50 ms
            gc.collect()
        gc.freeze()
        gc.disable()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        if wanted:
            granted["sched_fifo"] = held.enter_context(scheduled("SCHED_FIFO", FIFO_PRIORITY, deciding))
            for number in _ordinary_threads(deciding) if granted["sched_fifo"] == GRANTED else ():
                with suppress(OSError):  # it has ended
                    held.enter_context(scheduled("SCHED_FIFO", FIFO_PRIORITY - 1, [number]))
            granted["mlockall"] = held.enter_context(locked_memory())
            granted["heap_touched"] = held.enter_context(held_heap())
        yield granted


# ---- one request each ----


@contextmanager
def _asked(request: Callable[[], object], undo: Callable[[], object]) -> Iterator[str]:
    try:
        request()
        answer = GRANTED
    except OSError as error:
        answer = f"refused: {error.strerror}"
    try:
        yield answer
    finally:
        if answer == GRANTED:
            with suppress(OSError):  # a thread that has ended needs nothing, and not everybody may go back
                undo()


def scheduled(policy: str, priority: int = 0, threads: Sequence[int] = (0,)) -> AbstractContextManager[str]:
    """Return the context in which `threads` (native ids, 0: the calling one) have a policy such as SCHED_FIFO."""
    if not hasattr(os, "sched_setscheduler") or not hasattr(os, policy):
        return nullcontext(f"this system has no {policy}")
    before = [(thread, os.sched_getscheduler(thread), os.sched_getparam(thread)) for thread in threads]
    after = [(thread, getattr(os, policy), os.sched_param(priority)) for thread in threads]

    def apply(rows: Sequence[tuple[int, int, os.sched_param]]) -> None:
        for row in rows:
            os.sched_setscheduler(*row)

    return _asked(lambda: apply(after), lambda: apply(before))


def _ordinary_threads(but: Sequence[int]) -> list[int]:
    """The interpreter's threads of ordinary priority, by native id, but for those of `but` (0: the calling one)."""
    numbers = {thread.native_id or 0 for thread in threading.enumerate()} - {*but, 0}
    numbers -= {threading.get_native_id()} if 0 in but else set()
    found = []
    for number in numbers:
        with suppress(OSError):  # it has ended
            if os.sched_getscheduler(number) == os.SCHED_OTHER:
                found.append(number)
    return found


def bound(core: int, thread: int = 0) -> AbstractContextManager[str]:
    """Return the context in which a thread, by native id (0: the calling one), runs on `core` alone."""
    if not hasattr(os, "sched_setaffinity"):
        return nullcontext("this system does not bind threads to cores")
    return _kept_on({core}, thread)


@contextmanager
def shallow_idle(device: Path = DMA_LATENCY) -> Iterator[str]:
    """No core may enter an idle state that it takes time to leave, for as long as the file is open (Linux: PM QoS)."""
    with ExitStack() as held:

        def ask() -> None:
            file = os.open(device, os.O_WRONLY)
            held.callback(os.close, file)
            os.write(file, bytes(4))  # an int: 0 us

        linux = sys.platform == "linux"
        yield held.enter_context(_asked(ask, bool)) if linux else "not asked for on this system"


def locked_memory() -> AbstractContextManager[str]:
    """Return the context in which all memory that this process has touched, or will touch, stays resident."""
    if sys.platform != "linux":
        return nullcontext("not asked for on this system")
    libc = ctypes.CDLL(None, use_errno=True)

    def ask() -> None:
        # Without ONFAULT (Linux 4.4), the whole of LLVM and every thread's stack are read into memory: 190 MiB become 440.
        if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    return _asked(ask, libc.munlockall)


@contextmanager
def held_heap(n_bytes: int = HELD_BYTES) -> Iterator[str]:
    """Touch `n_bytes` of heap and keep what is freed: what is allocated in the block has been touched before.

    Else the C library maps large blocks afresh each time and gives them back, so that every page is touched for the first time again.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        yield "this C library has no mallopt"
        return
    granted = mallopt(M_MMAP_THRESHOLD, HELD_LARGEST) and mallopt(M_TRIM_THRESHOLD, 1 << 30)
    room = bytearray(n_bytes)
    room[::PAGE_BYTES] = bytes(len(range(0, n_bytes, PAGE_BYTES)))
    del room
    small = [bytes(SMALL_BYTES) for _ in range(n_bytes // SMALL_BYTES)]
    pinned = small[:: PIN_EVERY_BYTES // SMALL_BYTES]  # a few keep the interpreter from giving its arenas back
    del small
    try:
        yield GRANTED if granted else "refused"
    finally:
        del pinned
        mallopt(M_MMAP_THRESHOLD, USUAL_THRESHOLD)
        mallopt(M_TRIM_THRESHOLD, USUAL_THRESHOLD)


# ---- cores ----


def deciding_core() -> int | None:
    """Return the core that a thread that decides gets for itself: the last one; None where there is one core, or the user has chosen.

    A process that may not use every core of the machine was confined by somebody (taskset, a cpuset): nothing is bound then.
    """
    if not hasattr(os, "sched_getaffinity"):
        return None
    cores = os.sched_getaffinity(0)
    return max(cores) if 1 < len(cores) == os.cpu_count() else None


@contextmanager
def apart(thread: int) -> Iterator[dict[str, Any]]:
    """Keep the thread that decides, by native id, on a core where no simulated instrument computes, while the block runs.

    A wake-up puts a thread on the core of whoever woke it, at ordinary priority: there it waits for 1 to 3 ms until that has computed
    (docs/explanation/timing.md). Yields {"deciding_core": core, or why the thread is not bound}.
    """
    core = deciding_core()
    if core is None:
        yield {"deciding_core": "not bound: one core, or the user has chosen the cores"}
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as mark:
        try:
            mark.bind(
                f"\0pans-deciding-on-core-{core}"
            )  # of this machine; nobody's any more once the process has ended
        except OSError:
            yield {"deciding_core": f"not bound: another run decides on core {core}"}
            return
        with bound(core, thread) as answer:
            yield {"deciding_core": core if answer == GRANTED else answer}


def give_way() -> None:
    """Let a thread run that waits for this core: at ordinary priority it would wait until this one's slice, some 3 ms, has passed."""
    if hasattr(os, "sched_yield"):
        os.sched_yield()


@contextmanager
def off_the_deciding_core() -> Iterator[bool]:
    """Keep the calling thread, and those that it starts, off the core where a run on this machine decides; yield whether that was done."""
    core = deciding_core()
    if core is None:
        yield False
        return
    with _kept_on(os.sched_getaffinity(0) - {core}, 0) as answer:
        yield answer == GRANTED


def _kept_on(cores: set[int], thread: int) -> AbstractContextManager[str]:
    """Return the context in which a thread, by native id, runs on these cores alone."""
    try:
        before = os.sched_getaffinity(thread)
    except OSError:  # it has ended
        return nullcontext("ended")
    return _asked(lambda: os.sched_setaffinity(thread, cores), lambda: os.sched_setaffinity(thread, before))


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
    mask, allowed = os.sched_getaffinity(0), []
    for core in isolated_cores() - mask:
        with bound(core) as answer:  # a container's cpuset may leave it out
            allowed += [core] if answer == GRANTED else []
    return sorted([*mask, *allowed])


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


def load_average() -> float:
    """Return how many programs computed or waited for a processor in the last minute, in the mean; 0.0 where that is not known."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0


def steal_ms(root: Path = Path("/")) -> float | None:
    """Return for how long the hypervisor ran something else since the start, all cores together; None where that is not known."""
    fields = first_line(root / "proc/stat").split()
    if len(fields) < 9 or not hasattr(os, "sysconf"):
        return None
    return int(fields[8]) * 1000 / os.sysconf("SC_CLK_TCK")


@contextmanager
def busy_core(core: int | None, thread: int = 0) -> Iterator[dict[str, Any]]:
    """Pin a thread, by native id (0: the calling one), to `core` and keep that core busy while the block runs.

    Yields {what: "granted" or why not}, {} for None.

    A core that halts between two blocks wakes with cold caches and, in a virtual machine, after somebody else's turn
    (docs/explanation/timing.md). A spinning thread of idle priority keeps it awake: whatever has something to do goes before it.
    """
    if core is None or not hasattr(os, "sched_setaffinity"):
        yield {}
        return
    with bound(core, thread) as answer:
        if answer != GRANTED:
            yield {"core": answer}
            return
        with _spinning(core) as awake:
            yield {"core": core, "kept_awake": awake}


@contextmanager
def _spinning(core: int) -> Iterator[str]:
    """A thread of idle priority, on `core`, spins in compiled code without the interpreter's lock.

    It gets its priority only while it spins and loses it before it ends: a thread of idle priority that holds the interpreter's lock on a
    core that others want would stop this process for seconds.
    """
    from .jit_bytes import spin  # numba, only where a core is kept awake

    state = np.array([1, 0])
    spin(state)  # compiled before it is waited for
    state[:] = 0
    thread = threading.Thread(target=spin, args=(state,), name="pans-awake", daemon=True)
    with ExitStack() as held:
        held.callback(thread.join)
        held.callback(state.__setitem__, ENDED, 1)
        # a thread inherits its core and its priority: with a real-time one it would spin for good
        with scheduled("SCHED_OTHER"), bound(core):
            thread.start()
            while not state[SPINS]:
                time.sleep(LOOK_EVERY_S)
            answer = held.enter_context(scheduled("SCHED_IDLE", 0, [thread.native_id or 0]))
        state[ENDED] = answer != GRANTED
        yield answer


# ---- what the kernel did to a thread ----


class ThreadCounts:
    """Page faults of a thread, how often it lost its core, and for how long it waited for one, since the last `restart`.

    A minor fault is the first touch of a page, one to a few microseconds; a major one waits for the disk. The thread is the calling one,
    or one of this process by its native id.
    """

    def __init__(self, thread: int | None = None) -> None:
        self._task = Path(f"/proc/self/task/{threading.get_native_id() if thread is None else thread}")
        self.restart()

    def restart(self) -> None:
        """Count from here on."""
        self._before = self._counts()

    def since(self) -> dict[str, int]:
        """Return {minor, major, involuntary_switches, waited_ms} so far; {} where the system has no such counts."""
        return {name: count - self._before[name] for name, count in self._counts().items() if name in self._before}

    def _counts(self) -> dict[str, int]:
        """Read what Linux says of a thread (proc(5)); other systems count for whole processes only."""
        fields = first_line(self._task / "stat").rpartition(")")[2].split()  # the name before may hold spaces
        counts = {name: int(fields[place]) for name, place in COUNTED.items()} if len(fields) > 9 else {}
        with suppress(OSError):
            for line in (self._task / "status").read_text().splitlines():
                if line.startswith("nonvoluntary_ctxt_switches"):
                    counts["involuntary_switches"] = int(line.split()[1])
        if times := first_line(self._task / "schedstat").split():  # computing, waiting, time slices; ns
            counts["waited_ms"] = int(times[1]) // 1_000_000
        return counts


def fault_words(counts: Mapping[str, int]) -> str:
    """Return the counts in words.

    >>> fault_words({"minor": 12, "major": 0, "involuntary_switches": 3})
    '12 minor, 0 major; the loop lost its core 3 times'
    """
    if not counts:
        return "not told by this system"
    switches = counts.get("involuntary_switches", 0)
    waited = f", and waited {counts['waited_ms']} ms for one" if "waited_ms" in counts else ""
    return f"{counts.get('minor', 0)} minor, {counts.get('major', 0)} major; the loop lost its core {switches} times{waited}"
