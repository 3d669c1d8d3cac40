"""A scheduling probe: a process of high priority on a core, which wakes at a fixed pace and notes when it was kept from waking.

Owns the probe, both ends of it; never attributes a gap (the usual tool of this kind is cyclictest). Two things keep a
process of the highest priority from a core: the hypervisor runs another machine (its timer then fires late), or the kernel runs others
before it (it then waits in the run queue: real-time throttling, the share that kernels from 6.12 on keep for ordinary programs). It
runs as a `Child` until SIGTERM (or until its parent is gone), then says one JSON object. Linux, with the right to SCHED_FIFO. Times are
those of time.perf_counter_ns, common to all processes.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
from typing import NamedTuple

from .processes import Child, leave_on_sigterm, say

PRIORITY = 30  # above the simulated instrument (20) and the host's loop (10)
EVERY_US = 200  # takes some 4 % of a core, and sees gaps of a fifth of the shortest deadline (1 ms)
MAX_GAPS = 1_000_000
CHECK_EVERY = 100  # wake-ups: whether the parent is there, and for how long it has waited in the run queue


class Gap(NamedTuple):
    """A core was away: the probe went to sleep at `seen_ns`, should have been awake at `begin_ns`, and was at `end_ns`.

    The core was certainly away from `begin_ns` to `end_ns`; it may have been since `seen_ns`, one period before at the most. Of this
    time the probe waited in the run queue for at most `queued_ns`, while the core ran something else; for the rest nothing ran here.
    """

    core: int
    seen_ns: int
    begin_ns: int
    end_ns: int
    queued_ns: int = 0

    @property
    def length_ns(self) -> int:
        """For how long the core was certainly away."""
        return self.end_ns - self.begin_ns

    @property
    def queued(self) -> bool:
        """Whether the core ran something else for most of it."""
        return 2 * self.queued_ns > self.length_ns


class ProbeLog(NamedTuple):
    """What a probe saw: `gaps` in the order of time, how often it woke, and the share of its core that it took."""

    core: int
    gaps: tuple[Gap, ...]
    wakes: int
    own_share: float


class SchedulingProbe:
    """A probe's process, from construction to `end`; `priority` of SCHED_FIFO, a wake-up every `every_us`, a gap beyond `late_us`."""

    def __init__(
        self, core: int, priority: int = PRIORITY, every_us: int = EVERY_US, late_us: int | None = None
    ) -> None:
        self.core = core
        late_us = every_us if late_us is None else late_us
        self._child = Child(f"{__package__}.scheduling_probe", core, priority, every_us, late_us)
        self.pid = self._child.process.pid
        self._child.said()  # it is ready

    def end(self) -> ProbeLog:
        """Let it stop and say what it saw."""
        self._child.process.send_signal(signal.SIGTERM)
        said = self._child.said()
        self._child.end()
        gaps = tuple(Gap(self.core, *gap) for gap in said["gaps"])
        return ProbeLog(self.core, gaps, int(said["wakes"]), float(said["own_share"]))

    def kill(self) -> None:
        """End it without a word, if it is still there."""
        self._child.kill()


def watch(every_ns: int, late_ns: int, gaps: list[tuple[int, int, int, int]]) -> int:
    """Wake every `every_ns` on an absolute schedule until SystemExit or the parent's end; append each gap, return the wake-ups."""
    clock, sleep, parent = time.perf_counter_ns, time.sleep, os.getppid()
    counters = os.open("/proc/self/schedstat", os.O_RDONLY)
    wakes, now, queued = 0, clock(), _queued_ns(counters)
    due = now + every_ns
    try:
        while True:
            seen = now
            if due > seen:
                sleep((due - seen) * 1e-9)
            now = clock()
            wakes += 1
            if now - due > late_ns:
                before, queued = queued, _queued_ns(counters)
                if len(gaps) < MAX_GAPS:
                    gaps.append((seen, due, now, min(queued - before, now - seen)))
                due = now + every_ns - (now - due) % every_ns
            else:
                due += every_ns
            if wakes % CHECK_EVERY == 0:
                queued = _queued_ns(counters)
                if os.getppid() != parent:
                    return wakes
    except SystemExit:
        return wakes


def _queued_ns(counters: int) -> int:
    return int(os.pread(counters, 64, 0).split()[1])


def main(core: int, priority: int, every_us: int, late_us: int) -> None:
    """Watch a core; the process of `SchedulingProbe`."""
    os.sched_setaffinity(0, {core})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    gc.freeze()
    gc.disable()
    gaps: list[tuple[int, int, int, int]] = []
    leave_on_sigterm()
    say(ready=True)
    began_ns, began_cpu_ns = time.perf_counter_ns(), time.process_time_ns()
    wakes = watch(every_us * 1000, late_us * 1000, gaps)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    share = (time.process_time_ns() - began_cpu_ns) / (time.perf_counter_ns() - began_ns)
    say(gaps=gaps, wakes=wakes, own_share=share)


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
