"""What was going on while work became late: spans of the loop's time, the scheduler's counters, messages that say when they left.

Owns the collecting, in bounded memory: nothing here looks at a photon, and a thread of its own reads the system (counters.py). Never
judges (attribution.py). `Evidence.facts` returns what is known about one stretch of time. Spans shorter than `floor_ns` are not kept:
none of them alone can make anything late. In virtual time the counters of the machine mean nothing and are not read.
"""

from __future__ import annotations

import gc
import threading
import time
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from pans.runtime.core.plan import Plan

from .counters import Counters

NS_PER_US, NS_PER_MS, NS_PER_S = 1_000, 1_000_000, 1_000_000_000
STALE_NS = 250 * NS_PER_MS  # a counters' thread that was not heard for so long is starved: the loop reads for itself
FLOOR_NS = 100 * NS_PER_US
OVERSLEPT_NS = 500 * NS_PER_US  # a timer that fires later than this was not the timer's fault
MAX_SPANS = 1024
MAX_STAMPED = 64
MAX_ARRIVALS = 512

GC, DISK, INFERENCE, IDLE, OVERSLEPT = "gc", "disk", "inference", "idle", "overslept"


class Span(NamedTuple):
    """What the loop did from `begin_ns` to `end_ns`: one of GC, DISK, INFERENCE, IDLE (awake, waiting for bytes), OVERSLEPT.

    `cpu_ns` is how long its thread had computed since it last waited, an upper bound for the span; -1 where nobody looked.
    """

    kind: str
    begin_ns: int
    end_ns: int
    cpu_ns: int = -1


class Stamped(NamedTuple):
    """A message that says when it left the device, in host time. A PONG also says when its PING was sent and came there."""

    sent_ns: int | None
    reached_ns: int | None
    left_ns: int
    arrival_ns: int


class Facts(NamedTuple):
    """What is known about late work: its exposure ended at `begin_ns`, its bytes came at `arrival_ns`, it was decided at `end_ns`."""

    begin_ns: int
    arrival_ns: int
    end_ns: int
    uncertainty_ns: int
    spans: tuple[Span, ...]
    arrivals_ns: tuple[int, ...]  # when the reader stamped bytes
    pause_ns: int  # the longest time between two blocks when everything is on time
    cpu_ns: int  # the loop's thread computed for so long, at most
    run_delay_ns: int  # it, or its reader while it did not compute, waited for a processor, beyond what is usual
    steal_ns: int
    switches: int
    stamped: tuple[Stamped, ...]


class Evidence:
    """Collects while a run lasts, from `watch` to `close`. `now_ns` is the link's clock."""

    def __init__(
        self, now_ns: Callable[[], int], deadline_ns: int, *, pause_ns: int = 0, virtual: bool = False
    ) -> None:
        self.floor_ns = max(FLOOR_NS, deadline_ns // 16)
        self._now, self._virtual, self._pause_ns = now_ns, virtual, pause_ns
        self._arrivals: deque[int] = deque(maxlen=MAX_ARRIVALS)
        self._spans: deque[Span] = deque(maxlen=MAX_SPANS)
        self._stamped: deque[Stamped] = deque(maxlen=MAX_STAMPED)
        self._collecting_ns = self._cpu_mark_ns = 0
        self._apart = False  # another thread than the one that tells of them waits and works
        self._counters = Counters(now_ns, [])

    def watch(self, threads: Iterable[int | None] = (), loop: int | None = None) -> None:
        """From here on watch collections and `threads`, by native id; a new link has a new reader.

        `loop` is the thread that waits for bytes and decides, None: the calling one.
        """
        if self._virtual:
            return
        if self._on_gc not in gc.callbacks:
            gc.callbacks.append(self._on_gc)
        self._counters.close()
        self._apart = loop is not None
        own = threading.get_native_id() if loop is None else loop
        self._counters = Counters(self._now, [own, *(thread for thread in threads if thread)])

    def close(self) -> None:
        """End: leave the collector as it was found; idempotent."""
        with suppress(ValueError):
            gc.callbacks.remove(self._on_gc)
        self._counters.close()

    # -- what the loop tells -------------------------------------------------------------------------------------------

    def worked(self, kind: str, begin_ns: int, end_ns: int) -> None:
        """Note that the loop was busy with `kind`."""
        if end_ns - begin_ns >= self.floor_ns:
            looked = not self._virtual and not self._apart
            cpu_ns = time.thread_time_ns() - self._cpu_mark_ns if looked else -1
            self._spans.append(Span(kind, begin_ns, end_ns, cpu_ns))

    def waited(self, begin_ns: int, asked_s: float, end_ns: int) -> None:
        """Note a wait for bytes of at most `asked_s`: what it took beyond that, no timer takes; the machine gave us no time."""
        if not self._virtual:
            self._cpu_mark_ns = time.thread_time_ns()
        asked_ns = begin_ns + int(asked_s * NS_PER_S)
        last = self._spans[-1] if self._spans else None
        if last is not None and last.kind == IDLE and begin_ns - last.end_ns < self.floor_ns:
            self._spans[-1] = Span(IDLE, last.begin_ns, min(end_ns, asked_ns))  # nothing of note was done in between
        else:
            self._spans.append(Span(IDLE, begin_ns, min(end_ns, asked_ns)))
        if end_ns - asked_ns >= OVERSLEPT_NS:
            self._spans.append(Span(OVERSLEPT, asked_ns, end_ns))

    def arrived(self, *arrivals_ns: int) -> None:
        """Note when bytes were stamped by whoever read them."""
        self._arrivals.extend(arrivals_ns)

    def stamped(self, message: Stamped) -> None:
        """Note a message that says when it left the device."""
        self._stamped.append(message)

    def heard_since(self, end_ns: int) -> bool:
        """Return whether the system's counters were read after `end_ns`; in virtual time nobody asks them."""
        return self._virtual or self._counters.heard_ns >= end_ns

    def read_if_stale(self, now_ns: int) -> None:
        """Read the counters here and now if nobody has done so for STALE_NS, as a loop that is never away makes it happen."""
        if not self._virtual and now_ns - self._counters.heard_ns >= STALE_NS:
            self._counters.read()

    # -- what is known -------------------------------------------------------------------------------------------------

    def facts(self, begin_ns: int, arrival_ns: int, end_ns: int, uncertainty_ns: int) -> Facts:
        """Return what is known about the time from `begin_ns` to `end_ns`, both host times."""
        if not self.heard_since(end_ns):
            self._counters.read()
        first, last = self._counters.around(begin_ns, end_ns)
        cpu_ns = last.cpu_ns - first.cpu_ns
        delays_ns = [after - before for before, after in zip(first.run_delays_ns, last.run_delays_ns)] or [0]
        usual = self._counters.usual or [0.0] * len(delays_ns)
        own, *readers = [
            max(delay - round(share * (last.at_ns - first.at_ns)), 0) for delay, share in zip(delays_ns, usual)
        ]
        # a reader that waits while the loop computes waits for the loop
        delay_ns = max([own, *(delay - cpu_ns for delay in readers)])
        spans, arrivals_ns = list(self._spans), list(self._arrivals)  # both in the order of their ends
        first_span = bisect_right(spans, begin_ns, key=attrgetter("end_ns"))
        first_arrival = bisect_right(arrivals_ns, begin_ns)
        return Facts(
            begin_ns,
            arrival_ns,
            end_ns,
            uncertainty_ns,
            tuple(span for span in spans[first_span:] if span.begin_ns < end_ns),
            tuple(arrivals_ns[first_arrival : bisect_left(arrivals_ns, end_ns)]),
            self._pause_ns,
            cpu_ns,
            delay_ns,
            last.steal_ns - first.steal_ns,
            last.switches - first.switches,
            tuple(
                message
                for message in self._stamped
                if message.arrival_ns >= begin_ns
                and (message.left_ns if message.sent_ns is None else message.sent_ns) <= end_ns
            ),
        )

    def _on_gc(self, phase: str, info: dict[str, Any]) -> None:
        if phase == "start":
            self._collecting_ns = self._now()
        elif self._collecting_ns:
            self.worked(GC, self._collecting_ns, self._now())
            self._collecting_ns = 0


def longest_pause_ns(plan: Plan) -> int:
    """Return the longest time between the ends of two blocks that follow each other, when everything is on time."""
    offsets = plan.slot_offset_ticks.astype(np.int64)
    ends, length = [], 0
    for slot, offset in enumerate(offsets.tolist()):
        length += 1
        last = slot + 1 == len(offsets)
        if last or length == plan.block_exposures or int(offsets[slot + 1]) - offset != plan.slot_period_ticks:
            ends.append(offset)
            length = 0
    pauses = np.diff([*ends, ends[0] + plan.cycle_ticks])
    return round(int(pauses.max()) * plan.tick_us * NS_PER_US)
