"""A lost device: look for it with growing pauses for a bounded time, and arm it for what is left of the run.

`reconnect` returns a connection that has been prepared anew, or raises the LinkError of the last attempt.
"""

from __future__ import annotations

import gc
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, repeat

from pans.base.errors import DeviceError, LinkError
from pans.protocol.links import Link, opened_again

from .connection import Connection
from .run import LiveRun

NS_PER_MS = 1_000_000
MOST_FRUITLESS = 8  # reconnections in a row without one decision in between


def pauses_s() -> Iterator[float]:
    """Yield the pauses before each attempt: doubling, then constant."""
    return chain((0.1, 0.2, 0.4, 0.8, 1.6), repeat(2.0))


@dataclass(frozen=True, slots=True)
class Recovery:
    """How to come back: `reopen` takes the lost link and returns an open one, or raises LinkError; `pause` waits."""

    reopen: Callable[[Link], Link]
    give_up_s: float = 10.0
    pause: Callable[[float], None] = time.sleep

    @classmethod
    def of(cls, link: Link, url: str, give_up_s: float) -> Recovery:
        """Return the way back to `link`, which `url` names."""
        return cls(lambda lost: opened_again(lost, url), give_up_s, link.pause)


def reconnect(
    recovery: Recovery, lost: Connection, since_ns: int, prepare: Callable[[Link], Connection]
) -> tuple[Connection, int]:
    """Try until `prepare(link)` succeeds or `give_up_s` have passed since `since_ns`; return the connection and the attempts.

    A device that answers and refuses (DeviceError) is not asked again.
    """
    lost.detach()
    now = lost.link.now_ns
    link, error, attempts = lost.link, LinkError("no time was left to connect again"), 0
    for pause_s in pauses_s():
        if now() - since_ns + pause_s * 1e9 > recovery.give_up_s * 1e9:
            break
        recovery.pause(pause_s)
        attempts += 1
        try:
            link = recovery.reopen(link)
            now = link.now_ns
            return prepare(link), attempts
        except DeviceError:
            link.close()
            raise
        except LinkError as failure:
            error = failure
    link.close()
    raise LinkError(f"{error.message} ({attempts} attempts in {recovery.give_up_s:g} s)", remedy=error.remedy)


class Refusals:
    """What the device refused last. The same refusal without progress in between ends a run: asking again would change nothing.

    Refusals are the same that differ in numbers alone: ids of commands, ticks.
    """

    def __init__(self) -> None:
        self._latest: tuple[str | int, ...] = ()

    def again(self, run: LiveRun, error: DeviceError) -> bool:
        """Whether the device has refused the same since the run last made progress."""
        words = re.sub(r"\d+", "0", error.message)
        now = (words, run.core.tracker.counters.exposures, run.tally.decisions)
        again, self._latest = now == self._latest, now
        return again


def reconnect_run(run: LiveRun, error: LinkError, recovery: Recovery, prepare: Callable[[Link], Connection]) -> None:
    """Find the device again and arm it for what is left of the run, or end the run because that failed."""
    run.take_rest()
    if run.is_fruitless(MOST_FRUITLESS):
        words = f"lost {MOST_FRUITLESS + 1} times in a row without one whole decision in between"
        run.lose_link(LinkError(f"the device was {words}; the last time: {error.message}"))
        return
    now_ns = run.now_ns()
    run.outage_ns = now_ns if run.outage_ns is None else run.outage_ns
    run.journal.note("link_lost", reason=error.message)
    run.journal.clock(run.connection)
    run.count_decoded()

    def pause(seconds: float) -> None:
        run.turned_s = time.monotonic()
        recovery.pause(seconds)

    try:
        run.connection, attempts = reconnect(replace(recovery, pause=pause), run.connection, run.outage_ns, prepare)
    except LinkError as failure:
        run.lose_link(failure)
        return
    except KeyboardInterrupt:
        run.link_lost = True  # nothing is waited for at the end
        raise
    run.reconnects += 1
    gc.collect()  # it is off while armed, and an old connection's objects name each other: here nobody waits
    outage_ms = (run.now_ns() - run.outage_ns) / NS_PER_MS
    run.journal.note("reconnected", attempts=attempts, outage_ms=outage_ms)
    run.settle(run.core.end())
    if run.config.n_cycles and run.core.cycles_left(run.config.n_cycles) <= 0:
        run.ended = "the link was lost within the last object"
        return
    run.arm()
