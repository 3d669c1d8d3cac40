"""How late a thread wakes: from a timer, and from a byte that another process sends; how long its core does something else.

Owns the measuring loops and the other process; never asks for a condition (conditions.py) and never judges. All times are of
time.perf_counter_ns, common to all processes of a computer, in ns. Loops are Python's, which takes part in what is measured: about a
microsecond.
"""

from __future__ import annotations

import os
import random
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

PAUSE_S = (0.0002, 0.0006)  # random: nothing on the machine has this period
SPIN_GAP_NS = 20_000  # a reading of the clock takes 0.1 us: what is longer was spent elsewhere
PATIENCE_MS = 2000
SENDER_PRIORITY = 20  # of a simulated instrument
_STAMP = struct.Struct("<q")

# The other process, at the priority of a simulated instrument where that is allowed: for each line with a count, so many stamps at random
# pauses, each taken right before it is written.
_SENDER = """
import os, random, struct, sys, time
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({priority}))
except (OSError, AttributeError):
    pass
pack, write, clock, sleep, dice = struct.Struct("<q").pack, os.write, time.perf_counter_ns, time.sleep, random.Random(1)
for line in sys.stdin.buffer:
    for _ in range(int(line)):
        sleep(dice.uniform({low}, {high}))
        write(1, pack(clock()))
"""


def figures(late_ns: Sequence[int]) -> dict[str, float]:
    """Return {samples, p50_us, p99_us, p999_us, max_us} of times in ns; no quantile of nothing."""
    if not len(late_ns):
        return {"samples": 0}
    p50, p99, p999 = (float(value) / 1000 for value in np.quantile(late_ns, [0.5, 0.99, 0.999]))
    return {"samples": len(late_ns), "p50_us": p50, "p99_us": p99, "p999_us": p999, "max_us": max(late_ns) / 1000}


def sleeps(seconds: float) -> list[int]:
    """Sleep for random times until `seconds` are over; return by how much each sleep was too long."""
    clock, dice, late = time.perf_counter_ns, random.Random(2), []
    until = clock() + round(seconds * 1e9)
    while clock() < until:
        pause_s = dice.uniform(*PAUSE_S)
        due = clock() + round(pause_s * 1e9)
        time.sleep(pause_s)
        late.append(clock() - due)
    return late


def clock_gaps(seconds: float) -> list[int]:
    """Read the clock for `seconds`; return the gaps in which this thread did not run, beyond SPIN_GAP_NS."""
    clock = time.perf_counter_ns
    last, gaps = clock(), list[int]()
    until = last + round(seconds * 1e9)
    while last < until:
        now = clock()
        if now - last > SPIN_GAP_NS:
            gaps.append(now - last)
        last = now
    return gaps


def work_times(seconds: float, pause_s: float) -> list[int]:
    """Do the same small calculation until `seconds` are over, each after a pause (0: none); return how long each took."""
    clock, took = time.perf_counter_ns, []
    until = clock() + round(seconds * 1e9)
    while clock() < until:
        if pause_s:
            time.sleep(pause_s)
        begin = clock()
        sum(range(1000))
        took.append(clock() - begin)
    return took


class Sender:
    """Another process that sends stamps, as an instrument sends bytes; `close` ends it.

    Through a pipe, through a terminal, whose bytes a worker of the kernel hands on, as those of every serial port, or through TCP on this
    computer. `pause_s` are the shortest and the longest pause between two stamps.
    """

    def __init__(self, through: str = "pipe", pause_s: tuple[float, float] = PAUSE_S) -> None:
        code = _SENDER.format(low=pause_s[0], high=pause_s[1], priority=SENDER_PRIORITY)
        words = [sys.executable, "-S", "-c", code]
        self._pause_s = sum(pause_s) / 2
        theirs, self._ours = _ENDS[through]()
        self._child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=theirs, bufsize=0)
        os.close(theirs)
        self._cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
        self.wakes(0.01)  # it has started

    def bind(self, core: int | None) -> None:
        """Put it on `core`; None: wherever this process may run."""
        if self._cores:
            with suppress(OSError):
                os.sched_setaffinity(self._child.pid, self._cores if core is None else {core})

    def wakes(self, seconds: float) -> list[int]:
        """Wait for stamps for about `seconds`; return how long after each stamp this thread had it."""
        return [came - sent for sent, came in self.stamps(seconds)]

    def stamps(self, seconds: float) -> Iterator[tuple[int, int]]:
        """Wait for stamps for about `seconds`; yield when each was taken, and when this thread had it."""
        assert self._child.stdin is not None
        count = max(1, round(seconds / (self._pause_s + 60e-6)))  # a sleep takes about 60 us longer than asked for
        file, clock, data, unpack = self._ours, time.perf_counter_ns, b"", _STAMP.unpack
        waiting = select.poll()
        waiting.register(file, select.POLLIN)
        self._child.stdin.write(f"{count}\n".encode())
        while count and waiting.poll(PATIENCE_MS):
            try:
                piece = os.read(file, _STAMP.size - len(data))
            except OSError:  # a terminal whose other end is closed
                break
            now, data = clock(), data + piece
            if len(data) == _STAMP.size:
                yield unpack(data)[0], now
                data, count = b"", count - 1
            elif not piece:
                break  # it has ended

    def close(self) -> None:
        """End it; idempotent."""
        if self._ours < 0:
            return
        os.close(self._ours)
        self._ours = -1
        if self._child.stdin is not None:
            with suppress(OSError):
                self._child.stdin.close()
        try:
            self._child.wait(2.0)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()


def _pipe() -> tuple[int, int]:
    ours, theirs = os.pipe()
    return theirs, ours


def _terminal() -> tuple[int, int]:
    import tty  # POSIX

    theirs, ours = os.openpty()
    tty.setraw(ours)
    return theirs, ours


def _tcp() -> tuple[int, int]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        theirs = socket.create_connection(listener.getsockname())
        ours, _ = listener.accept()
    theirs.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return theirs.detach(), ours.detach()


_ENDS = {"pipe": _pipe, "terminal": _terminal, "tcp": _tcp}
