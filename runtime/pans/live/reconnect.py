"""A lost device: look for it with growing pauses for a bounded time.

`reconnect` returns a session that has been prepared anew, or raises the LinkError of the last attempt.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, repeat

from pans.base.errors import DeviceError, LinkError
from pans.protocol.links import Link, opened_again

from .session import Session

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
    recovery: Recovery, lost: Session, since_ns: int, prepare: Callable[[Link], Session]
) -> tuple[Session, int]:
    """Try until `prepare(link)` succeeds or `give_up_s` have passed since `since_ns`; return the session and the attempts.

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


class Progress:
    """Whether a run gets on between one loss of the device and the next."""

    def __init__(self) -> None:
        self._fruitless = self._decided = 0
        self._refusal: tuple[str | int, ...] = ()

    def is_fruitless(self, decided: int) -> bool:
        """Note that the device was lost; whether that is too often in a row without one whole decision, of `decided`, in between."""
        self._fruitless, self._decided = (0 if decided > self._decided else self._fruitless) + 1, decided
        return self._fruitless > MOST_FRUITLESS

    def refused_again(self, refusal: str, *done: int) -> bool:
        """Note a refusal; whether the device has refused the same before, and nothing of what is `done` has changed since.

        Asking again would change nothing then. Refusals are the same that differ in numbers alone: ids of commands, ticks.
        """
        now: tuple[str | int, ...] = (re.sub(r"\d+", "0", refusal), *done)
        again, self._refusal = now == self._refusal, now
        return again
