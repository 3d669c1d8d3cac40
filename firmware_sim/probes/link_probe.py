"""A link probe: two plain processes joined as host and instrument are; one sends its clock's reading, the other notes which came late.

Owns the probe, both ends of it; never attributes a delay. What such a pair sees late, the kernel or the hypervisor held back between two
cores, and no program's own work: the receiver has priority over the host's loop, the sender that of the instrument. It runs as a `Child`
until SIGTERM (or until its parent is gone), then says one JSON object. Times are those of time.perf_counter_ns, common to all processes.
Linux, with the right to SCHED_FIFO.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from contextlib import closing
from typing import NamedTuple

import numpy as np

from pans.runtime.timing.wakeups import Sender

from .processes import Child, leave_on_sigterm, say

PRIORITY = (
    25  # above the host's loop (10, 11), whose work must not delay the receiver; below the scheduling probes (30)
)
PAUSE_S = (0.0006, 0.0014)  # random; a delay of a millisecond is seen by one message at least
LATE_US = 200  # as a gap of the scheduling probes
PORTION_S = 0.1
MAX_DELAYS = 1_000_000
LINKS = {"pty": "terminal", "tcp": "tcp"}


class Delay(NamedTuple):
    """A message was sent at `sent_ns` and came at `came_ns`, more than LATE_US later; without the delay it would have at `due_ns`."""

    sent_ns: int
    due_ns: int
    came_ns: int


class LinkLog(NamedTuple):
    """What a pair saw: `delays` in the order of time, the number of messages, and how long the usual one (median) took."""

    delays: tuple[Delay, ...]
    messages: int
    usual_ns: int


class LinkProbe:
    """A pair from construction to `end`; `link` is "pty" or "tcp", `cores` are those of receiver (host) and sender (instrument)."""

    def __init__(self, link: str, cores: tuple[int, int]) -> None:
        self._child = Child(f"{__package__}.link_probe", LINKS[link], *cores)
        self.pid = self._child.process.pid
        self._child.said()  # it is ready

    def end(self) -> LinkLog:
        """Let it stop and say what it saw."""
        self._child.process.send_signal(signal.SIGTERM)
        said = self._child.said()
        self._child.end()
        usual_ns = int(said["usual_ns"])
        delays = tuple(Delay(sent, min(sent + usual_ns, came), came) for sent, came in said["delays"])
        return LinkLog(delays, int(said["messages"]), usual_ns)

    def kill(self) -> None:
        """End it without a word, if it is still there."""
        self._child.kill()


def watch(sender: Sender, delays: list[tuple[int, int]], histogram: list[int]) -> None:
    """Take messages until SystemExit or the parent's end; append each late one, count all by their microseconds (the last: LATE_US on)."""
    late_ns, parent = LATE_US * 1000, os.getppid()
    try:
        while os.getppid() == parent:
            for sent, came in sender.stamps(PORTION_S):
                took = came - sent
                if took <= late_ns:
                    histogram[max(took, 0) // 1000] += 1
                    continue
                histogram[-1] += 1
                if len(delays) < MAX_DELAYS:
                    delays.append((sent, came))
    except SystemExit:
        return


def main(through: str, host: int, device: int) -> None:
    """Watch a link; the process of `LinkProbe`."""
    os.sched_setaffinity(0, {host})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    gc.freeze()
    gc.disable()
    delays: list[tuple[int, int]] = []
    histogram = [0] * (LATE_US + 1)
    leave_on_sigterm()
    with closing(Sender(through, PAUSE_S)) as sender:
        sender.bind(device)
        say(ready=True)
        watch(sender, delays, histogram)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    messages = sum(histogram)
    usual_us = int(np.searchsorted(np.cumsum(histogram), (messages + 1) // 2))
    say(delays=delays, messages=messages, usual_ns=usual_us * 1000)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
