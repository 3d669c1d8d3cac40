"""One run in real time, from an open device to timed, recorded decisions. Read this page first.

    open_session -> arm -> [ receive -> record -> act -> account -> show -> keep alive ] -> stop
         ^------------------------- reconnect <--- LinkError

Data goes one way. `Receiver.receive` is the only wait, `Session` is the only sender (except the next SHOW of the kernel), the link has the
only clock. Nothing here knows whether objects stand still or flow past: that is in the core. The rules for each batch are stream.py's.

`run_live` returns a `RunResult`, also when the link is lost for good (`link_lost`); a device that cannot be armed raises LinkError. However
a run ends, the device is told to stop; one that cannot be told goes dark when its lease runs out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from pans.base.errors import DeviceError, LinkError, RecordingError
from pans.base.machine import GRANTED, ThreadCounts, apart, arm_realtime, busy_core
from pans.decide import Follower, exposure_timing
from pans.decide.dark import dark_report
from pans.decide.still import Core
from pans.instrument.click_law import click_law, click_probability
from pans.protocol.links import Link, link_facts
from pans.protocol.session import ArmTooLate
from pans.protocol.wire import DeviceState, StateReason
from pans.record.recorder import Recorder

from .accounts import Account as Account
from .accounts import Accounts
from .dark_run import DarkFigures as DarkFigures
from .dark_run import DarkRun as DarkRun
from .device_check import scene_facts as scene_facts
from .device_check import scene_words as scene_words
from .drive import HostDriver as HostDriver
from .drive import WalkPlace as WalkPlace
from .flow_run import FlowFigures as FlowFigures
from .flow_run import FlowRun as FlowRun
from .gates import open_actuator as open_actuator
from .job import Job as Job
from .journal import words_of as words_of
from .receiver import Receiver, why_fed
from .reconnect import Progress
from .reconnect import Recovery as Recovery
from .session import Session as Session
from .session import open_session as open_session
from .status import NO_OBSERVERS
from .status import Observers as Observers
from .status import Status as Status
from .stop import INTERRUPTED, REFUSED, Stop
from .stream import NS_PER_MS, NS_PER_S, Arming, come_back, held, lose_link, stop, take_all
from .tally import RunResult as RunResult
from .tally import TallyFigures as TallyFigures

PROBE_EVERY_NS = 97 * NS_PER_MS  # odd on purpose: nothing in the loop has this period or a multiple of it
FLUSH_EVERY_NS = 500 * NS_PER_MS
UNHEARD_NS = 2_500 * NS_PER_MS  # without any frame: STATUS alone comes every second
SILENCE_NS = 5 * NS_PER_S  # without clicks


def run_live(
    link: Link,
    job: Job,
    core: Follower,
    recorder: Recorder | None = None,
    recovery: Recovery | None = None,
    observers: Observers = NO_OBSERVERS,
) -> RunResult:
    """Do `job` on the device behind `link`, let `core` decide until it is done, and close the link; see `running`."""
    with running(link, job, core, recorder, recovery, observers) as result:
        return result


@contextmanager
def running(
    link: Link,
    job: Job,
    core: Follower,
    recorder: Recorder | None = None,
    recovery: Recovery | None = None,
    observers: Observers = NO_OBSERVERS,
) -> Iterator[RunResult]:
    """Run as the module's docstring says; yield the result while the link is open, since closing it may take seconds.

    `recovery` says how to reconnect when the device is lost; without it the run ends there.
    """
    began_ns = job.options.started_ns or time.perf_counter_ns()
    accounts = Accounts(job, core, link, recorder)

    def prepare(opened: Link) -> Session:
        return open_session(opened, job, recorder, accounts.close_books, observers.uploaded)

    try:
        session = prepare(link)
    except BaseException:
        link.close()
        raise
    accounts.tally.distinct = int(session.facts.get("objects", 0))  # of a simulator: they come again in turn
    driver = None
    if job.plan.drive == "host" and job.plan.automaton is not None and isinstance(core, Core):
        driver = HostDriver(core, WalkPlace(job.plan, job.plan.automaton))
    prompt = observers.acts and observers.watch is not None
    receiver = Receiver(core, accounts.lateness, driver, prompt=prompt, gather_ns=observers.gather_ns)
    run = Status(job, core, session, accounts, receiver, began_ns, observers.watch)
    try:
        core.warm_up()
        receiver.attach(session)  # before the heap is touched: loading kernels takes memory
        with _granted(run):
            _light_on(run, recovery, prepare, observers)
        yield _result(run)
    finally:
        try:
            receiver.close()
        finally:
            run.session.close()


@contextmanager
def _granted(run: Status) -> Iterator[None]:
    """What the machine grants to a run at real pace, as long as it lasts; `run.realtime` says what that is."""
    link, reader, options = run.session.link, run.session.reader.thread_id, run.job.options
    own = run.receiver.thread_id  # None: this thread decides, and the reader's may stand in for it
    deciding = [0, *([] if reader is None else [reader])] if own is None else [own]
    simulated = link.simulated or bool(run.session.facts.get("simulated"))
    wanted = options.realtime and not link.virtual and (options.realtime_simulated or not simulated)
    with ExitStack() as until_dark:
        awake = until_dark.enter_context(busy_core(None if link.virtual else options.core, own or 0))
        granted = until_dark.enter_context(arm_realtime(wanted, deciding))
        # a thread of real-time priority gets a free core by itself, and the user may have chosen one
        if own is not None and not awake and not options.any_core and granted.get("sched_fifo") != GRANTED:
            granted |= until_dark.enter_context(apart(own))
        run.realtime = granted | awake | {"turn": "; ".join(filter(None, ("compiled", why_fed(link))))}
        yield


def _light_on(run: Status, recovery: Recovery | None, prepare: Callable[[Link], Session], observers: Observers) -> None:
    """From arming to dark: however it ends, the device is told to stop."""
    counts, arming = ThreadCounts(run.receiver.thread_id), Arming()
    try:
        if observers.prepared is not None:
            observers.prepared(run)
        arming.arm(run)
        counts.restart()  # the first exposure begins when ARM has had its time to arrive
        _until_ended(run, recovery, prepare, arming, observers.stop or Stop())
    except KeyboardInterrupt as interrupt:
        run.ended = str(interrupt) or INTERRUPTED
    except RecordingError:
        run.accounts.drop_recorder(run.session)
        raise
    finally:  # whatever went wrong: light off first
        run.page_faults = counts.since()
        stop(run)


def _until_ended(
    run: Status, recovery: Recovery | None, prepare: Callable[[Link], Session], arming: Arming, asked: Stop
) -> None:
    """Turn until the run is over; a device that is lost on the way is found again, where `recovery` says how."""
    due, progress = Timetable(), Progress()
    due.begin(run)
    while not run.ended:
        try:
            asked.polled = True
            _turn(run, due, arming)
            run.ended = run.ended or asked.word
            asked.polled = False
        except LinkError as error:
            asked.polled = False
            done = run.core.tracker.counters.exposures, run.accounts.tally.decisions
            if isinstance(error, ArmTooLate) and arming.arm_later(run):
                due.begin(run)
            elif isinstance(error, DeviceError) and progress.refused_again(error.message, *done):
                run.ended = f"{REFUSED}{error.message}"
            elif recovery is None:
                lose_link(run, error)
            else:
                come_back(run, error, progress, recovery, prepare, arming)
                if not run.ended:
                    due.begin(run)


class Timetable:
    """What is due besides bytes, and when, in host ns: a probe of the clock, the lease and the receive window, a flush of the recording."""

    def __init__(self) -> None:
        self._probe_ns = self._lease_ns = self._flush_ns = 0

    def begin(self, run: Status) -> None:
        """The device has been armed. ARM is on record before its first exposure: a run that is killed right then can be told."""
        now_ns = self._flush_ns = run.now_ns()
        self._grant(run, now_ns)

    def next_ns(self, *, recorded: bool) -> int:
        """When the loop has to turn again, whatever comes."""
        return min(self._probe_ns, self._lease_ns, self._flush_ns if recorded else self._lease_ns)

    def keep_alive(self, run: Status, now_ns: int) -> None:
        """Do what is due."""
        recorder = run.accounts.recorder
        if now_ns >= self._probe_ns:
            run.session.host.probe(now_ns)
            self._probe_ns = now_ns + PROBE_EVERY_NS
        if now_ns >= self._lease_ns or run.session.granted(run.core.tracker.next_seq) < 0:
            self._grant(run, now_ns)
        if recorder is not None and now_ns >= self._flush_ns:
            run.accounts.journal.clock(run.session)
            recorder.flush()
            self._flush_ns = now_ns + FLUSH_EVERY_NS

    def _grant(self, run: Status, now_ns: int) -> None:
        lease_ms = run.job.options.lease_ms
        run.session.grant(run.core.tracker.next_seq, lease_ms)
        self._lease_ns = now_ns + lease_ms * NS_PER_MS // 4


def _turn(run: Status, due: Timetable, arming: Arming) -> None:
    """Wait for bytes, take what came, do what is due; sets `run.ended` when the run is over, LinkError when the device is lost."""
    session, accounts, lateness = run.session, run.accounts, run.accounts.lateness
    run.turned_s, looked_ns = time.monotonic(), run.now_ns()
    due_ns = due.next_ns(recorded=accounts.recorder is not None)
    idle = not take_all(run, run.receiver.receive(lateness.poll_s(looked_ns), due_ns))
    accounts.turn_gates(session)
    now_ns = run.now_ns()
    if (verdict := lateness.settled(session, now_ns, idle=idle and not run.receiver.serves)) is not None:
        accounts.journal.take(verdict)
    accounts.journal.refusals(session)
    due.keep_alive(run, now_ns)
    _turn_page(run, arming, now_ns)
    run.ended = _why_ended(run, arming, now_ns, looked_ns, idle=idle)


def _why_ended(run: Status, arming: Arming, now_ns: int, looked_ns: int, *, idle: bool) -> str:
    """Return why the run is over ("" while it is not); LinkError when the device is lost in a way that may be recovered from.

    Silence counts up to `looked_ns`, and only where nothing came since: after a stop of this process what came meanwhile is read first.
    """
    core, host, options, plan = run.core, run.session.host, run.job.options, run.job.plan
    if core.completed:
        return "completed"
    status = host.status
    is_news = status is not None and status.tick >= core.start_tick  # of this run, not of what was before it
    if status is not None and is_news and status.state == DeviceState.SAFE:
        if status.reason == StateReason.LEASE_EXPIRED:
            raise LinkError("the device went dark: it had not heard from us for a whole lease")
        run.link_lost = True
        return f"the device went dark by itself: reason {status.reason}"
    if options.seconds and now_ns - run.start_ns >= options.seconds * NS_PER_S:
        return "time is up"
    if looked_ns > arming.over_ns + SILENCE_NS and core.contradictions["beyond_plan"]:
        return "the device goes on beyond its plan"
    if idle and looked_ns - host.heard_ns > UNHEARD_NS:
        raise LinkError("the device fell silent")
    if idle and looked_ns - run.accounts.lateness.block_ns > SILENCE_NS + plan.cycle_us * 1000:
        raise LinkError("the device answers, but sends no clicks")
    return ""


def _turn_page(run: Status, arming: Arming, now_ns: int) -> None:
    """Go on in the recording's next part when this one is full and no window is open."""
    recorder = run.accounts.recorder
    if recorder is None or recorder.limits is None:
        return
    for event in recorder.news():
        run.accounts.journal.note(**event)
    if not recorder.wants_part:
        return
    with held(run):  # what came before belongs to this part
        if (place := run.core.part()) is not None:
            recorder.next_part(place.facts(), arming.setup, now_ns)
            recorder.add_clock(run.session.known_clock().history())
            run.accounts.journal.session(run.session)


def _result(run: Status) -> RunResult:
    """Return the run's figures."""
    accounts, core, plan, session = run.accounts, run.core, run.job.plan, run.session
    accounts.close_books(session)
    account = accounts.account()
    device = session.facts | link_facts(session.link)
    # a simulator behind an ordinary port says so itself
    device["simulated"] = bool(device["simulated"] or session.facts.get("simulated"))
    one = float(click_probability(click_law(run.job.profile, plan.exposure_us), 0.0))
    # an exposure counts when any of several detectors clicks in it; log1p and expm1 hold for tiny rates too
    dark = one if one == 1.0 else -math.expm1(plan.channels_at_once * math.log1p(-one))
    found = dark_report(dark, account.dark_exposures, account.dark_clicks)
    fit, announced = session.known_clock().fit, session.host.tells_exposed
    tolerance_us = run.job.profile.exposure_tolerance_us(plan.exposure_us)
    driver = run.receiver.driver
    return RunResult(
        tally=accounts.tally,
        timing=accounts.timing,
        dark=found if core.guard is None else core.guard.report(found),
        contradictions=account.contradictions,
        stream=account.stream,
        decoder=account.decoder,
        clock={} if fit is None else {"drift_ppm": fit.drift_ppm, "uncertainty_us": fit.uncertainty_ns / 1000},
        realtime=run.realtime,
        page_faults=run.page_faults,
        device=device,
        slot_jitter_us=core.jitter_ticks * plan.tick_us,
        exposure_timing=exposure_timing(
            core.exposed, plan.tick_us, tolerance_us, announced=announced, untold=core.untold
        ),
        wrong_patterns=account.wrong_patterns,
        armed_after_s=run.armed_after_s,
        seconds=max(0, run.now_ns() - run.start_ns) / NS_PER_S,  # it may end before its first exposure
        ended=run.ended,
        link_lost=run.link_lost,
        reconnects=run.reconnects,
        late_cause=account.late_cause,
        lost_cause=account.lost_cause,
        events=accounts.journal.events,
        late_slots=account.late_slots,
        turn_us={} if driver is None else driver.turns.summary(),
        states_shown=core.windows.walks.shown if isinstance(core, Core) else np.zeros(0, np.int64),
    )
