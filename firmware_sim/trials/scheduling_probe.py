"""A canary on a core: a process above everybody else there, which wakes at a fixed pace and notes when it was kept from waking.

    python -m pans.firmware_sim.trials.scheduling_probe --core 0 [--priority 30] [--every-us 200] [--late-us 200]

Owns the watching and its process; never says whose fault a gap is. Two things keep a process of the highest priority from a core: the
hypervisor runs somebody else (its timer then fires late), or the kernel lets others run before it (it then stands in the queue: real-time
throttling, the share that kernels from 6.12 on keep for ordinary programs). Runs until SIGTERM (or until its parent is gone), then prints
one JSON object. Linux, with the right to SCHED_FIFO. Times are those of time.perf_counter_ns, common to all processes.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import signal
import subprocess
import sys
import time
from typing import Any, NamedTuple, NoReturn

PRIORITY = 30  # above the simulated instrument (20) and the host's loop (10)
EVERY_US, LATE_US = 200, 200
MAX_GAPS = 1_000_000
LOOK_EVERY = 100  # wake-ups: at the parent, and at how long it has stood in the queue
READY_S, GOODBYE_S = 20.0, 10.0


class Gap(NamedTuple):
    """A core was away: the canary went to sleep at `seen_ns`, should have been awake at `begin_ns`, and was at `end_ns`.

    The core was certainly away from `begin_ns` to `end_ns`; it may have been since `seen_ns`, one period before at the most. Of this
    time the canary stood in the queue for at most `queued_ns`, while the core ran something else; for the rest nothing ran here.
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


class Watched(NamedTuple):
    """What a canary saw: `gaps` in the order of time, how often it woke, and the share of its core that it took."""

    core: int
    gaps: tuple[Gap, ...]
    wakes: int
    own_share: float


class Canary:
    """A canary's process, from construction to `end`; `priority` of SCHED_FIFO, a wake-up every `every_us`."""

    def __init__(self, core: int, priority: int = PRIORITY, every_us: int = EVERY_US, late_us: int = LATE_US) -> None:
        self.core = core
        numbers = {"core": core, "priority": priority, "every-us": every_us, "late-us": late_us}
        words = [word for name, value in numbers.items() for word in (f"--{name}", str(value))]
        command = [sys.executable, "-m", "pans.firmware_sim.trials.scheduling_probe", *words]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        if self.process.stdout.readline().strip() != "ready":
            raise RuntimeError(f"the canary on core {core} ended with {self.process.wait(READY_S)}")

    def end(self) -> Watched:
        """Let it stop and tell."""
        self.process.send_signal(signal.SIGTERM)
        text, _ = self.process.communicate(timeout=GOODBYE_S)
        told = json.loads(text)
        gaps = tuple(Gap(self.core, *gap) for gap in told["gaps"])
        return Watched(self.core, gaps, int(told["wakes"]), float(told["own_share"]))

    def kill(self) -> None:
        """End it unheard, if it is still there."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


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
            if wakes % LOOK_EVERY == 0:
                queued = _queued_ns(counters)
                if os.getppid() != parent:
                    return wakes
    except SystemExit:
        return wakes


def _queued_ns(counters: int) -> int:
    return int(os.pread(counters, 64, 0).split()[1])


def _leave(signum: int, frame: object) -> NoReturn:
    raise SystemExit(0)


def main() -> int:
    """Watch a core from the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m pans.firmware_sim.trials.scheduling_probe", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--core", type=int, required=True, help="to sit on")
    parser.add_argument("--priority", type=int, default=PRIORITY, help=f"of SCHED_FIFO (default {PRIORITY})")
    parser.add_argument("--every-us", type=int, default=EVERY_US, help=f"how often to wake (default {EVERY_US})")
    parser.add_argument("--late-us", type=int, default=LATE_US, help=f"later than this is a gap (default {LATE_US})")
    args = parser.parse_args()
    os.sched_setaffinity(0, {args.core})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(args.priority))
    gc.freeze()
    gc.disable()
    gaps: list[tuple[int, int, int, int]] = []
    signal.signal(signal.SIGTERM, _leave)
    print("ready", flush=True)
    began_ns, began_cpu_ns = time.perf_counter_ns(), time.process_time_ns()
    wakes = watch(args.every_us * 1000, args.late_us * 1000, gaps)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    share = (time.process_time_ns() - began_cpu_ns) / (time.perf_counter_ns() - began_ns)
    told: dict[str, Any] = {"gaps": gaps, "wakes": wakes, "own_share": share}
    print(json.dumps(told), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
