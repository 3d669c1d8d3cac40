"""The live loop: from an open device to timed, recorded decisions. One screen, in the order in which data flows.

    handshake -> check -> upload -> clock -> [arm] -> kernel -> settle: tally, clock, record -> act -> report -> ... -> stop -> close
                     ^----------- reconnect (bounded) <---- the link broke, the device fell silent or went dark

An iteration is run.py's, an outage reconnect.py's. `run_live` returns a `RunResult`, also when the link is lost for good (`link_lost`); a
device that cannot be armed raises LinkError. However a run ends, the device is told to stop; one that cannot be told goes dark when
its lease runs out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np

from pans.base.errors import DeviceError, LinkError, RecordingError
from pans.base.machine import GRANTED, ThreadCounts, apart, arm_realtime, busy_core
from pans.bundle.sensor import Bundle
from pans.decide import Follower, exposure_timing
from pans.decide.dark import dark_report
from pans.decide.kernel import BATCH_NS
from pans.decide.plan import Plan
from pans.decide.still import DARK_CLICKS, DARK_EXPOSURES, LATE_SLOTS, WRONG_PATTERNS, Core
from pans.instrument.click_law import click_law, click_probability
from pans.instrument.profile import Profile
from pans.protocol.links import Link, link_facts
from pans.protocol.session import ArmTooLate
from pans.record.recorder import Recorder

from .connection import Connection as Connection
from .dark_run import DarkFigures as DarkFigures
from .dark_run import DarkRun as DarkRun
from .device_check import check_device, check_scene
from .device_check import scene_facts as scene_facts
from .device_check import scene_words as scene_words
from .drive import HostDriver as HostDriver
from .drive import WalkPlace as WalkPlace
from .flow_run import FlowFigures as FlowFigures
from .flow_run import FlowRun as FlowRun
from .gates import open_actuator as open_actuator
from .journal import words_of as words_of
from .options import RunOptions
from .receiver import Receiver, StillReceiver, why_fed
from .reconnect import Recovery as Recovery
from .reconnect import Refusals, reconnect_run
from .run import LiveRun as LiveRun
from .run import Watcher
from .stop import INTERRUPTED, REFUSED, Stop
from .tally import RunResult as RunResult
from .tally import TallyFigures as TallyFigures

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Observers:
    """Who observes a run: `watch` after every block, with the run and the block's output; `prepared` once, before arming.

    `uploaded` is called when the device has the plan, before the first kernel is needed: what compiles them elsewhere can be waited for.

    A watcher that only looks (`acts` is False) gets what a call of the kernel brought all at once. Where the kernel decides in a thread of
    its own, what came in `gather_ns` is accounted for and shown at once.
    """

    watch: Watcher | None = None
    prepared: Callable[[LiveRun], None] | None = None
    stop: Stop | None = None
    acts: bool = True
    uploaded: Callable[[], None] | None = None
    gather_ns: int = BATCH_NS


NO_OBSERVERS = Observers()


def run_live(
    link: Link,
    profile: Profile,
    bundle: Bundle,
    plan: Plan,
    core: Follower,
    config: RunOptions,
    recorder: Recorder | None = None,
    recovery: Recovery | None = None,
    observers: Observers = NO_OBSERVERS,
) -> RunResult:
    """Run `plan` on the device behind `link`, let `core` decide until it is done, and close the link; see `running`."""
    with running(link, profile, bundle, plan, core, config, recorder, recovery, observers) as result:
        return result


@contextmanager
def running(
    link: Link,
    profile: Profile,
    bundle: Bundle,
    plan: Plan,
    core: Follower,
    config: RunOptions,
    recorder: Recorder | None = None,
    recovery: Recovery | None = None,
    observers: Observers = NO_OBSERVERS,
) -> Iterator[RunResult]:
    """Run `plan` as the module's docstring says; yield the result while the link is open, since closing it may take seconds.

    `recovery` says how to reconnect when the device is lost; without it the run ends there.
    """
    started_ns = config.started_ns or time.perf_counter_ns()
    failed: list[Connection] = []

    def prepare(opened: Link) -> Connection:
        return open_session(opened, recorder, plan, bundle, profile.clock.tick_hz, failed, observers.uploaded)

    try:
        connection = prepare(link)
    except BaseException:
        link.close()
        raise
    run = LiveRun(connection, plan, core, len(bundle.classes), config, recorder, started_ns)
    run.failed = failed
    try:
        _warm_up(run, observers)
        with _granted(run):
            _light_on(run, recovery, prepare, observers)
        yield _result(run, profile)
    finally:
        run.close()


def _warm_up(run: LiveRun, observers: Observers) -> None:
    """Load what receives."""
    run.core.warm_up()
    prompt = observers.acts and observers.watch is not None
    run.receiver = receiver_of(run, run.core, prompt=prompt, gather_ns=observers.gather_ns)
    run.receiver.prepare()  # before the heap is touched: loading kernels takes memory


def receiver_of(run: LiveRun, core: Follower, *, prompt: bool, gather_ns: int) -> Receiver:
    """Return the receiver for `core`."""
    if isinstance(core, Core):
        return StillReceiver(run, core, prompt=prompt, gather_ns=gather_ns)
    if not core.moving:  # it takes every message itself
        return Receiver(run, core, prompt=prompt)
    from .flow_run import FlowReceiver

    return FlowReceiver(run, core, prompt=prompt, gather_ns=gather_ns)


@contextmanager
def _granted(run: LiveRun) -> Iterator[None]:
    """What the machine grants to a run at real pace, as long as it lasts; `run.realtime` says what that is."""
    link, reader, config = run.connection.link, run.connection.reader.thread_id, run.config
    own = run.receiver.thread_id  # None: this thread decides, and the reader's may stand in for it
    deciding = [0, *([] if reader is None else [reader])] if own is None else [own]
    welcome = run.connection.session.welcome
    simulated = link.simulated or bool(welcome and welcome.facts.get("simulated"))
    wanted = config.realtime and not link.virtual and (config.realtime_simulated or not simulated)
    with ExitStack() as held:
        awake = held.enter_context(busy_core(None if link.virtual else config.core, own or 0))
        granted = held.enter_context(arm_realtime(wanted, deciding))
        # a thread of real-time priority gets a free core by itself, and the user may have chosen one
        if own is not None and not awake and not config.any_core and granted.get("sched_fifo") != GRANTED:
            granted |= held.enter_context(apart(own))
        run.realtime = granted | awake | {"turn": "; ".join(filter(None, ("compiled", why_fed(link))))}
        yield


def _light_on(
    run: LiveRun, recovery: Recovery | None, prepare: Callable[[Link], Connection], observers: Observers
) -> None:
    """From arming to dark: however it ends, the device is told to stop."""
    counts = ThreadCounts(run.receiver.thread_id)
    try:
        if observers.prepared is not None:
            observers.prepared(run)
        run.arm()
        counts.restart()  # the first exposure begins when ARM has had its time to arrive
        _until_ended(run, recovery, prepare, observers)
    except KeyboardInterrupt as interrupt:
        run.ended = str(interrupt) or INTERRUPTED
    except RecordingError:
        run.drop_recorder()
        raise
    finally:  # whatever went wrong: light off first
        run.page_faults = counts.since()
        run.stop()


def open_session(
    link: Link,
    recorder: Recorder | None,
    plan: Plan,
    bundle: Bundle,
    tick_hz: int,
    failed: list[Connection],
    uploaded: Callable[[], None] | None = None,
) -> Connection:
    """Open a session, check that it is the right device, and bring it to where ARM can follow; one that breaks goes to `failed`."""
    connection = Connection(link) if recorder is None else Connection(link, recorder.add_command, recorder.add_answer)
    try:
        facts = connection.handshake().facts
        check_device(facts, plan, bundle, tick_hz)
        check_scene(facts, bundle)
        connection.upload(plan, bundle)
        if uploaded is not None:
            uploaded()
        connection.synchronise()
    except BaseException:
        connection.detach()
        failed.append(connection)
        raise
    return connection


def _until_ended(
    run: LiveRun, recovery: Recovery | None, prepare: Callable[[Link], Connection], observers: Observers
) -> None:
    stop, refusals = observers.stop or Stop(), Refusals()
    while not run.ended:
        try:
            stop.polled = True
            run.iterate(observers.watch)
            run.ended = run.ended or stop.word
            stop.polled = False
        except LinkError as error:
            stop.polled = False
            if isinstance(error, ArmTooLate) and run.arm_later():
                continue
            if isinstance(error, DeviceError) and refusals.again(run, error):
                run.ended = f"{REFUSED}{error.message}"
            elif recovery is None:
                run.lose_link(error)
            else:
                reconnect_run(run, error, recovery, prepare)


def _result(run: LiveRun, profile: Profile) -> RunResult:
    """Return the run's figures."""
    run.count_decoded()
    welcome = run.connection.session.welcome
    facts = dict({} if welcome is None else welcome.facts)
    device = facts | link_facts(run.connection.link)
    # a simulator behind an ordinary port says so itself
    device["simulated"] = bool(device["simulated"] or facts.get("simulated"))
    one = float(click_probability(click_law(profile, run.plan.exposure_us), 0.0))
    # an exposure counts when any of several detectors clicks in it; log1p and expm1 hold for tiny rates too
    dark = one if one == 1.0 else -math.expm1(run.plan.channels_at_once * math.log1p(-one))
    tallies, stream = run.core.tallies, run.core.tracker.counters
    found = dark_report(dark, int(tallies[DARK_EXPOSURES]), int(tallies[DARK_CLICKS]))
    guard = run.core.guard
    fit, announced = run.connection.known_clock().fit, run.connection.session.tells_exposed
    told, tolerance_us = run.core.exposed, profile.exposure_tolerance_us(run.plan.exposure_us)
    return RunResult(
        tally=run.tally,
        timing=run.timing,
        dark=found if guard is None else guard.report(found),
        contradictions=dict(run.core.contradictions + run.contradictions),
        stream={name: getattr(stream, name) for name in stream.__slots__},
        decoder=dict(run.decoded),
        clock={} if fit is None else {"drift_ppm": fit.drift_ppm, "uncertainty_us": fit.uncertainty_ns / 1000},
        realtime=run.realtime,
        page_faults=run.page_faults,
        device=device,
        slot_jitter_us=run.core.jitter_ticks * run.plan.tick_us,
        exposure_timing=exposure_timing(
            told, run.plan.tick_us, tolerance_us, announced=announced, untold=run.core.untold
        ),
        wrong_patterns=int(tallies[WRONG_PATTERNS]),
        armed_after_s=run.armed_after_s,
        seconds=(run.now_ns() - run.start_ns) / NS_PER_S,
        ended=run.ended,
        link_lost=run.link_lost,
        reconnects=run.reconnects,
        late_cause=dict(run.lateness.incidents.causes),
        lost_cause=dict(run.lateness.incidents.missing),
        events=run.journal.events,
        late_slots=int(tallies[LATE_SLOTS]),
        turn_us={} if run.driver is None else run.driver.turns.summary(),
        states_shown=run.core.windows.walks.shown if isinstance(run.core, Core) else np.zeros(0, np.int64),
    )
