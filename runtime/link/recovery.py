"""What to do when the device is lost in the middle of a run: try again, with growing pauses, for a bounded time.

Owns the schedule and the way back to an open link; never decides what a lost stream means (core.py) and never starts one (loop.py).
`reconnect` returns a connection that has been prepared anew, or raises the LinkError of the last attempt.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pans.runtime.errors import DeviceError, LinkError

from .base import Link, open_link
from .connection import Connection

FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0


def pauses_s(first_s: float = FIRST_PAUSE_S, longest_s: float = LONGEST_PAUSE_S) -> Iterator[float]:
    """Yield the pauses before each attempt: doubling, then constant."""
    pause_s = first_s
    while True:
        yield pause_s
        pause_s = min(2 * pause_s, longest_s)


@dataclass(frozen=True, slots=True)
class Recovery:
    """How to come back: `reopen` takes the lost link and returns an open one, or raises LinkError; `pause` waits."""

    reopen: Callable[[Link], Link]
    give_up_s: float = 10.0
    pause: Callable[[float], None] = time.sleep

    @classmethod
    def of(cls, link: Link, url: str, give_up_s: float) -> Recovery:
        """Return the way back to `link`: its own `reopen` and `pause` where it has them, else the URL and the wall clock."""

        def by_url(lost: Link) -> Link:
            lost.close()
            return open_link(url)

        own = getattr(link, "reopen", None)
        return cls(
            (lambda lost: lost.reopen()) if own is not None else by_url,  # type: ignore[attr-defined]
            give_up_s,
            getattr(link, "pause", time.sleep),
        )


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
