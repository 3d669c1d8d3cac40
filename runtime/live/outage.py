"""A live run without its device: how that is noticed, and how the run goes on in a new session or ends.

Owns what counts as an outage and what is told about it; the pauses and attempts are recovery.py's, and what a torn stream means is
the core's. `why_ended` returns the reason for an end, "" for none, and raises LinkError for a device that is lost; `come_back` arms again.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import TYPE_CHECKING

from pans.runtime.errors import LinkError
from pans.runtime.link.base import Link
from pans.runtime.link.connection import Connection
from pans.runtime.link.recovery import Recovery, reconnect
from pans.runtime.wire.messages import DeviceState, StateReason

if TYPE_CHECKING:
    from .run import LiveRun

NS_PER_US, NS_PER_MS, NS_PER_S = 1_000, 1_000_000, 1_000_000_000
UNHEARD_NS = 2_500 * NS_PER_MS  # without any frame: STATUS alone comes every second
SILENCE_NS = 5 * NS_PER_S  # without clicks


def why_ended(run: LiveRun, now_ns: int) -> str:
    """Return why the run is over ("" while it is not); LinkError when the device is lost in a way that may be recovered from."""
    if run.core.completed:
        return "completed"
    session = run.connection.session
    status = session.status
    is_news = status is not None and status.tick >= run.core.start_tick  # of this run, not of what was before it
    if status is not None and is_news and status.state == DeviceState.SAFE:
        if status.reason == StateReason.LEASE_EXPIRED:
            raise LinkError("the device went dark: it had not heard from us for a whole lease")
        run.link_lost = True
        return f"the device went dark by itself: reason {status.reason}"
    if run.config.seconds and now_ns - run.start_ns >= run.config.seconds * NS_PER_S:
        return "time is up"
    if now_ns - session.heard_ns > UNHEARD_NS:
        raise LinkError("the device fell silent")
    if now_ns - run.last_data_ns > SILENCE_NS + run.plan.cycle_us * NS_PER_US:
        raise LinkError("the device answers, but sends no clicks")
    return ""


def come_back(run: LiveRun, error: LinkError, recovery: Recovery, prepare: Callable[[Link], Connection]) -> None:
    """Find the device again and arm it for what is left of the run, or end the run because that failed."""
    now_ns = run.now_ns()
    run.outage_ns = now_ns if run.outage_ns is None else run.outage_ns
    run.journal.event({"kind": "link_lost", "reason": error.message})
    run.journal.clock(run.connection)
    run.count_decoded()
    try:
        run.connection, attempts = reconnect(recovery, run.connection, run.outage_ns, prepare)
    except LinkError as failure:
        run.lose_link(failure)
        return
    run.reconnects += 1
    gc.collect()  # it is off while armed, and an old connection's objects name each other: here nobody waits
    outage_ms = (run.now_ns() - run.outage_ns) / NS_PER_MS
    run.journal.event({"kind": "reconnected", "attempts": attempts, "outage_ms": outage_ms})
    run.settle(run.core.end())
    if run.config.n_cycles and run.core.cycles_left(run.config.n_cycles) <= 0:
        run.ended = "the link was lost within the last object"
        return
    run.arm()
