"""`Link`: what an open connection to an instrument can do; `whole_link` adds what a driver of another package leaves out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Protocol

MEMBERS = ("name", "simulated", "virtual", "read", "write", "now_ns", "close")  # what every driver has
OPTIONAL = ("pause", "fileno", "read_ahead", "is_shared")  # and `reopen`


class Link(Protocol):
    """An open connection to an instrument; a lab's own driver implements MEMBERS and an opener (`pans.devices`).

    `read` is called by two threads, never at once, and `write` by one of them, maybe while the other reads. A link of this package
    inherits the abilities that it does not have of its own.
    """

    name: str
    simulated: bool
    virtual: bool  # True: time passes only inside `read`, in one thread (the in-process simulator)
    reads_ahead: bool = False  # whether it has `read_ahead`

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, b"" after `timeout_s` without data; LinkError when the link is gone."""

    def write(self, data: bytes) -> None:
        """Send all of `data`; LinkError when the link is gone."""

    def now_ns(self) -> int:
        """Return this link's host clock in nanoseconds (monotonic; its zero means nothing)."""

    def close(self) -> None:
        """Release the port; idempotent."""

    def reopen(self) -> Link | None:
        """Come back after an outage, or raise LinkError; None: it cannot, and its URL is opened again."""
        return None

    def pause(self, seconds: float) -> None:
        """Wait between two attempts to come back."""
        time.sleep(seconds)

    def fileno(self) -> int | None:
        """Return a non-blocking POSIX descriptor that carries the bytes as they are, for the kernel to read and write; else None."""
        return None

    def read_ahead(self, timeout_s: float, frames: int, size: int, until_ns: int) -> Sequence[tuple[int, bytes]]:
        """Return many reads of a virtual link in one call, see reader.LinkReader.ahead."""
        return []

    def is_shared(self) -> bool:
        """Whether another connection of this machine leads to the same device; False where the system does not tell."""
        return False


class _Driver(Link):
    """A driver of another package, and what every link does where the driver leaves it out."""

    def __init__(self, driver: Any) -> None:
        self._driver = driver
        self.name, self.simulated, self.virtual = driver.name, driver.simulated, driver.virtual
        self.reads_ahead = hasattr(driver, "read_ahead")
        for name in OPTIONAL:
            if hasattr(driver, name):
                setattr(self, name, getattr(driver, name))

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        data: bytes = self._driver.read(timeout_s)
        return data

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._driver.write(data)

    def now_ns(self) -> int:
        """See `Link.now_ns`."""
        now: int = self._driver.now_ns()
        return now

    def close(self) -> None:
        """See `Link.close`."""
        self._driver.close()

    def reopen(self) -> Link | None:
        """See `Link.reopen`."""
        return whole_link(self._driver.reopen()) if hasattr(self._driver, "reopen") else None


def whole_link(driver: Any) -> Link:
    """Return `driver`, which has MEMBERS, with everything that a link has."""
    return driver if Link in type(driver).__mro__ else _Driver(driver)
