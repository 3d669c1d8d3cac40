"""One stream of a run, from ARM to dark: what came is taken, the device is armed, stopped, and found again.

`take` is what happens to each batch: record, act, account, show.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

from pans.base.errors import DeviceError, LinkError, RecordingError
from pans.protocol.links import Link
from pans.protocol.wire import LARGEST_TICK, Arm, Opcode
from pans.record.recorder import repeated_setup

from .receiver import Batch, Batches
from .reconnect import MOST_FRUITLESS, Progress, Recovery, reconnect
from .session import ARM_LEAD_NS, Session
from .status import Status
from .timing.lateness import POLL_S

NS_PER_MS, NS_PER_S = 1_000_000, 1_000_000_000
LONGEST_LEAD_NS = 32 * ARM_LEAD_NS  # five refusals, each twice as far ahead
STOP_GIVE_UP_NS = 1 * NS_PER_S  # for STOP, its answer and a STATUS; a lease ends the light of a device that is slower


def take(run: Status, batch: Batch) -> bool:
    """Record, act, account, show: always in this order. Return whether anything was shown."""
    accounts, session = run.accounts, run.session
    accounts.record(batch)
    accounts.act(batch, session)
    outputs = accounts.add(batch, session)
    if batch.has_block:
        run.outage_ns = None
    if run.show is not None:
        for output in outputs:
            run.show(run, output)
    accounts.late.clear()
    return bool(outputs)


def take_all(run: Status, batches: Batches) -> bool:
    """Take batches until there are no more; return whether anything was shown."""
    some = False
    with closing(batches):  # the kernel gets its memory back also where a file cannot be written
        for batch in batches:
            some |= take(run, batch)
    return some


@contextmanager
def held(run: Status) -> Iterator[None]:
    """While the block runs, the core may be changed: nothing is decided, and all is accounted for that came before."""
    take_all(run, run.receiver.hold())
    yield
    take_all(run, run.receiver.resume())


def take_rest(run: Status) -> None:
    """Decide on and record what has arrived on a session that is given up: lost is only what never came."""
    session = run.session
    if session.armed:
        take_all(run, run.receiver.rest())
    else:
        session.rest()
    session.broken = None  # nothing can be sent any more


def lose_link(run: Status, error: LinkError) -> None:
    """End the run because the link is gone; what was decided so far stands."""
    run.ended = run.ended or f"the link was lost: {error.message}"
    run.link_lost = True


class Arming:
    """Arms the device, again and again; `over_ns` says when the exposures of the last ARM end."""

    def __init__(self) -> None:
        self._lead_ns = ARM_LEAD_NS  # of a start before its first exposure; a host that is too slow for it learns
        self.over_ns = 0
        self.setup: list[bytes] = []  # what each part of the recording must repeat

    def arm(self, run: Status) -> None:
        """Start the exposures a little in the future, at an absolute device tick."""
        accounts, n_cycles = run.accounts, _cycles_left(run)
        accounts.journal.session(run.session)
        run.receiver.attach(run.session)
        now_ns, start_tick = self._start(run)
        accounts.settle(run.core.begin(start_tick, n_cycles), run.session)
        self._send(run, now_ns, Arm(start_tick, n_cycles, run.job.options.lease_ms))

    def arm_later(self, run: Status) -> bool:
        """ARM came too late: ask for a start twice as far ahead, in the same session; False where that has been done often enough."""
        if self._lead_ns >= LONGEST_LEAD_NS:
            return False
        self._lead_ns *= 2
        run.accounts.journal.note("armed_too_late", lead_ms=self._lead_ns // NS_PER_MS)
        with held(run):
            now_ns, start_tick = self._start(run)
            run.core.begin_later(start_tick)
            self._send(run, now_ns, Arm(start_tick, _cycles_left(run), run.job.options.lease_ms))
        return True

    def _start(self, run: Status) -> tuple[int, int]:
        """Return the time, and the tick at which exposures that are asked for now can begin."""
        now_ns = run.now_ns()
        start_tick = run.session.known_clock().to_tick(now_ns + self._lead_ns)
        if not 0 <= start_tick <= LARGEST_TICK:
            raise DeviceError(
                f"the device's clock says that it is tick {start_tick}, allowed 0 to {LARGEST_TICK}",
                remedy="restart the device, so that its counter begins anew",
            )
        return now_ns, start_tick

    def _send(self, run: Status, now_ns: int, arm: Arm) -> None:
        session, receiver, recorder = run.session, run.receiver, run.accounts.recorder
        start_ns = now_ns + self._lead_ns
        run.accounts.lateness.attach(session, start_ns, receiver.thread_id)
        session.arm(arm)
        if receiver.driver is not None:
            receiver.driver.begin(session)
        if recorder is not None and recorder.limits is not None:
            self.setup = repeated_setup(run.job.plan, arm, session.host.nonce)
        planned_ns = round((arm.n_cycles + 1) * run.job.plan.cycle_us * 1000)
        self.over_ns = start_ns + planned_ns if arm.n_cycles else 1 << 62
        if not run.reconnects:
            run.start_ns = start_ns
            run.armed_after_s = (time.perf_counter_ns() - run.began_ns) / NS_PER_S


def _cycles_left(run: Status) -> int:
    """Return for how many cycles the device is to be armed; 0: until it is stopped."""
    n_cycles = run.job.options.n_cycles
    return run.core.cycles_left(n_cycles) if n_cycles else 0


# -- the end -----------------------------------------------------------------------------------------------------------


def stop(run: Status) -> None:
    """Tell the device to go dark. One that does not answer any more does so by itself when its lease runs out."""
    session, receiver, accounts, run.show = run.session, run.receiver, run.accounts, None
    unwritten: RecordingError | None = None
    if receiver.driver is not None:  # what the kernel sends has its numbers from the same session
        unwritten = _stop_serving(run)
    give_up_ns = run.now_ns() + (0 if run.link_lost else STOP_GIVE_UP_NS)
    try:
        session.host.submit(Opcode.STOP)
        receiver.stops = True
        while run.now_ns() < give_up_ns and (session.host.in_flight or not session.is_dark):
            if session.armed:
                take_all(run, receiver.receive(POLL_S, run.now_ns() + int(POLL_S * NS_PER_S)))
            else:  # a new one, broken off before it was armed
                session.pump(POLL_S)
    except LinkError as error:
        lose_link(run, error)
    except KeyboardInterrupt:  # a second Ctrl-C: STOP is sent, and the lease does the rest
        run.ended = run.ended or "interrupted"
    unwritten = _stop_serving(run) or unwritten
    take_rest(run)
    accounts.settle(run.core.end(), session)
    accounts.gates.finish(session.host)
    while (verdict := accounts.lateness.incidents.verdict(run.now_ns(), final=True)) is not None:
        accounts.journal.take(verdict)
    accounts.lateness.evidence.close()
    accounts.journal.clock(session)
    run.stopped = True
    if unwritten is not None:
        raise unwritten


def _stop_serving(run: Status) -> RecordingError | None:
    """Call the kernel in turn from here on; return why the recording had to be given up: the light goes off first."""
    try:
        take_all(run, run.receiver.stop_serving())
    except RecordingError as error:
        run.accounts.drop_recorder(run.session)
        return error
    except LinkError as error:
        lose_link(run, error)
    return None


# -- a lost device -----------------------------------------------------------------------------------------------------


def come_back(
    run: Status,
    error: LinkError,
    progress: Progress,
    recovery: Recovery,
    prepare: Callable[[Link], Session],
    arming: Arming,
) -> None:
    """Find the device again and arm it for what is left of the run, or end the run because that failed."""
    accounts, tally = run.accounts, run.accounts.tally
    take_rest(run)
    # decisions that were given up do not count
    if progress.is_fruitless(tally.decisions - tally.abstained + tally.unsure):
        words = f"lost {MOST_FRUITLESS + 1} times in a row without one whole decision in between"
        lose_link(run, LinkError(f"the device was {words}; the last time: {error.message}"))
        return
    run.outage_ns = run.now_ns() if run.outage_ns is None else run.outage_ns
    accounts.journal.note("link_lost", reason=error.message)
    accounts.journal.clock(run.session)
    accounts.close_books(run.session)

    def pause(seconds: float) -> None:
        run.turned_s = time.monotonic()
        recovery.pause(seconds)

    try:
        run.session, attempts = reconnect(replace(recovery, pause=pause), run.session, run.outage_ns, prepare)
    except LinkError as failure:
        lose_link(run, failure)
        return
    except KeyboardInterrupt:
        run.link_lost = True  # nothing is waited for at the end
        raise
    run.reconnects += 1
    gc.collect()  # it is off while armed, and an old session's objects name each other: here nobody waits
    accounts.journal.note("reconnected", attempts=attempts, outage_ms=(run.now_ns() - run.outage_ns) / NS_PER_MS)
    accounts.settle(run.core.end(), run.session)
    if run.job.options.n_cycles and _cycles_left(run) <= 0:
        run.ended = "the link was lost within the last object"
        return
    arming.arm(run)
