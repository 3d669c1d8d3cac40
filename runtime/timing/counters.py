"""The system's counters of a run's threads, read beside the loop: what the kernel makes up afresh for each reading costs the loop nothing.

Owns the reading, its thread and its rate; never says what a counter means for late work (evidence.py). A reading keeps the bytes as they
came; `sample` takes them apart when somebody asks. Where the system does not tell, there is no thread, and a reading holds zeros.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from itertools import count, pairwise
from statistics import median
from typing import NamedTuple

NS_PER_S = 1_000_000_000
READ_EVERY_S = 0.02
MAX_READINGS = 160
USUAL_STEPS, USUAL_LEAST = 8, 32  # the usual waiting is the median of so many stretches; of fewer readings, unknown
LOOK_BACK_EVERY = 50  # readings
USUAL_MOST = 0.05  # of the time: who waits for a processor for longer than this is starved all the time
READ_BYTES = 4096  # more than one of these files needs, /proc/stat apart, whose first line counts
JOIN_S = 2.0


class Sample(NamedTuple):
    """Counters of the system at `at_ns`; they only ever grow. `run_delays_ns`: how long each thread, the loop's first, waited to run."""

    at_ns: int
    cpu_ns: int  # that the loop's thread has computed
    run_delays_ns: tuple[int, ...]
    steal_ns: int  # of the whole machine: time in which the hypervisor ran somebody else
    switches: int  # involuntary, of the loop's thread


class Reading(NamedTuple):
    """Files as they were at some time between `began_ns` and `ended_ns`: the loop's status, /proc/stat, and schedstat of each thread."""

    began_ns: int
    ended_ns: int
    cpu_ns: int  # of the thread that has read
    files: tuple[bytes, ...]


class Counters:
    """Readings of the counters of some threads, the loop's first; made by a thread of their own, or by `read` in the caller's.

    The thread runs one step below the loop's priority, where that is a real-time one: it never takes the processor from the loop. Not
    further down: whoever holds the interpreter must not wait for the rest of the machine, since the loop may be waiting for it.
    """

    def __init__(self, now_ns: Callable[[], int], threads: list[int]) -> None:
        self.heard_ns = 0  # when the latest reading began
        self.usual: tuple[float, ...] = ()
        self._now = now_ns
        self._readings: deque[Reading] = deque(maxlen=MAX_READINGS)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        paths = [f"/proc/self/task/{thread}/schedstat" for thread in threads]
        paths = [f"/proc/self/task/{threads[0]}/status", "/proc/stat", *paths] if threads else []
        self._files = [_open(path) for path in paths]
        self._tick_ns = NS_PER_S // (os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100)
        self._thread: threading.Thread | None = None
        if len(self._files) > 2 and self._files[2] is not None:
            self._thread = threading.Thread(target=self._watch, name="pans-counters", daemon=True)
        self.read()
        if self._thread is not None:
            self._thread.start()

    def read(self) -> None:
        """Make a reading in the calling thread: some ten to a hundred microseconds; nothing if the other thread is at it."""
        if self._stop.is_set() or not self._lock.acquire(blocking=False):
            return
        try:
            began_ns = self._now()
            files = tuple(_read(file) for file in self._files)
            self._readings.append(Reading(began_ns, self._now(), time.thread_time_ns(), files))
            self.heard_ns = began_ns
        finally:
            self._lock.release()

    def around(self, begin_ns: int, end_ns: int) -> tuple[Sample, Sample]:
        """Return the latest sample that was whole at `begin_ns` and the first one begun at `end_ns`; as near as there are."""
        readings = list(self._readings)
        if not readings:
            nothing = Sample(0, 0, (), 0, 0)
            return nothing, nothing
        before = next((reading for reading in reversed(readings) if reading.ended_ns <= begin_ns), readings[0])
        after = next((reading for reading in readings if reading.began_ns >= end_ns), readings[-1])
        return self.sample(before), self.sample(after)

    def look_back(self) -> tuple[float, ...]:
        """Return, and keep as `usual`, the share of time for which each thread usually waits for a processor; () if not known yet.

        Each wake-up takes some microseconds. The median over the time of the readings that are kept, so that one bad stretch is not
        taken for the rule.
        """
        readings = list(self._readings)
        if self._thread is None or len(readings) < USUAL_LEAST:
            return ()
        samples = [self.sample(reading) for reading in readings[:: len(readings) // USUAL_STEPS]]
        shares = [
            [
                (late - early) / max(after.at_ns - before.at_ns, 1)
                for early, late in zip(before.run_delays_ns, after.run_delays_ns)
            ]
            for before, after in pairwise(samples)
        ]
        self.usual = tuple(min(median(of_thread), USUAL_MOST) for of_thread in zip(*shares))
        return self.usual

    def sample(self, reading: Reading) -> Sample:
        """Take a reading apart."""
        if self._thread is None:
            return Sample(reading.began_ns, reading.cpu_ns, (), 0, 0)
        status, stat, *threads = reading.files
        return Sample(
            reading.began_ns,
            _number(threads[0], 0),
            tuple(_number(text, 1) for text in threads),
            _number(stat.partition(b"\n")[0], 8) * self._tick_ns,
            _number(status.partition(b"\nnonvoluntary_ctxt_switches:")[2], 0),
        )

    def close(self) -> None:
        """End the thread and close the files; idempotent."""
        self._stop.set()
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(JOIN_S)
        with self._lock:
            for file in self._files:
                if file is not None:
                    os.close(file)
            self._files = []

    def _watch(self) -> None:
        _give_way()
        for turn in count():
            if self._stop.wait(READ_EVERY_S):
                return
            self.read()
            if turn % LOOK_BACK_EVERY == 0:
                self.look_back()


def _give_way() -> None:
    """Go one step below the real-time priority that this thread has from the loop, which started it."""
    if not hasattr(os, "sched_setscheduler"):
        return
    priority = os.sched_getparam(0).sched_priority
    if priority > 1:
        with suppress(OSError):  # a reading in time is worth little against a run
            os.sched_setscheduler(0, os.sched_getscheduler(0), os.sched_param(priority - 1))


def _open(path: str) -> int | None:
    try:
        return os.open(path, os.O_RDONLY)
    except OSError:
        return None


def _read(file: int | None) -> bytes:
    """Return a file's first bytes, which the kernel makes afresh for each read from its start; the interpreter is free meanwhile."""
    if file is None:
        return b""
    try:
        return os.pread(file, READ_BYTES, 0)
    except OSError:
        return b""


def _number(text: bytes, index: int) -> int:
    """Field `index` of a text, 0 where there is none."""
    try:
        return int(text.split(None, index + 1)[index])
    except (ValueError, IndexError):
        return 0
