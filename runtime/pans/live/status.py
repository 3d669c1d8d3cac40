"""`Status`: how a run stands. Views, metrics, the watchdog and other observers read it, from any thread; only the loop writes it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pans.decide import Follower, Output
from pans.decide.kernel import BATCH_NS

from .accounts import Accounts
from .job import Job
from .receiver import Receiver
from .session import Session
from .stop import Stop


@dataclass(slots=True)
class Status:
    """How one run stands. `accounts.account()` gives its figures so far."""

    job: Job
    core: Follower
    session: Session  # the present one
    accounts: Accounts
    receiver: Receiver
    began_ns: int  # of the process or the call, time.perf_counter_ns
    show: Show | None = None  # who sees what comes; nobody while the device is being stopped
    start_ns: int = 0  # when the first exposure began
    armed_after_s: float = 0.0
    turned_s: float = field(default_factory=time.monotonic)  # the loop's heartbeat: when it turned last
    ended: str = ""  # why, "" while it runs
    link_lost: bool = False
    reconnects: int = 0
    outage_ns: int | None = None  # since when there has been no block
    stopped: bool = False  # the device has been told to go dark, and what came is recorded
    realtime: dict[str, Any] = field(default_factory=dict)
    page_faults: dict[str, int] = field(default_factory=dict)  # of the deciding thread while armed

    def now_ns(self) -> int:
        """The link's host clock."""
        return self.session.link.now_ns()


Show = Callable[[Status, Output], None]


@dataclass(frozen=True, slots=True)
class Observers:
    """Who observes a run: `watch` after every block, with the run and the block's output; `prepared` once, before arming.

    `uploaded` is called when the device has the plan, before the first kernel is needed: what compiles them elsewhere can be waited for.

    A watcher that only looks (`acts` is False) gets what a call of the kernel brought all at once. Where the kernel decides in a thread of
    its own, what came in `gather_ns` is accounted for and shown at once.
    """

    watch: Show | None = None
    prepared: Callable[[Status], None] | None = None
    stop: Stop | None = None
    acts: bool = True
    uploaded: Callable[[], None] | None = None
    gather_ns: int = BATCH_NS


NO_OBSERVERS = Observers()
