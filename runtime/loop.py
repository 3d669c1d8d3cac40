"""The live loop: from an open device to timed, recorded decisions. One screen, in the order in which data flows.

    handshake -> check -> upload -> clock -> [arm] -> pump -> core.step -> judge the timing -> record -> show -> ... -> stop -> close
                     ^----------- recover (bounded) <---- the link broke, the device fell silent or went dark

Owns the order of things and the ends of a run; the physics, the protocol and the decisions live in the modules it calls.
`run_live` returns a `RunResult`, also when the link is lost for good (`link_lost`); a device that cannot be armed raises LinkError.
However a run ends, the device is told to stop; one that cannot be told goes dark when its lease runs out.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from .bundle import Bundle
from .clicks import click_law, click_probability
from .clock import ClockModel
from .connection import Arrived, Connection, check_device
from .core import Core, Output
from .dark import DarkMonitor, DarkReport
from .decide import Decider
from .errors import LinkError
from .link import Link, link_facts
from .plan import Plan
from .profile import Profile
from .record import Recorder
from .recovery import Recovery, reconnect
from .tally import RunTally
from .timing import TimingLedger, arm_realtime
from .window import DARK_CLICKS, DARK_EXPOSURES, WRONG_PATTERNS
from .wire import DecoderCounters, DeviceState, Opcode, StateReason, pack_body
from .wire_commands import Arm, Gate, pack_arm, pack_gate

NS_PER_US, NS_PER_MS, NS_PER_S = 1_000, 1_000_000, 1_000_000_000
ARM_LEAD_NS = 30 * NS_PER_MS  # long enough for ARM and GRANT to arrive, and for one retransmission to be told apart
PROBE_EVERY_NS = 97 * NS_PER_MS  # odd on purpose: nothing in the loop has this period or a multiple of it
RECEIVE_WINDOW = 4096  # stream messages
FLUSH_EVERY_NS = 500 * NS_PER_MS
POLL_S = 0.02
UNHEARD_NS = 2_500 * NS_PER_MS  # without any frame: STATUS alone comes every second
SILENCE_NS = 5 * NS_PER_S  # without clicks
KERNEL_BLOCK_BYTES = 512  # on the wire: from here on, decoding a block in Python takes longer than deciding on it
STOP_GIVE_UP_NS = 1 * NS_PER_S


@dataclass(frozen=True, slots=True)
class RunConfig:
    """What to run: `shots` per decision, how many cycles (0: until `seconds` have passed or the device stops)."""

    shots: int = 1
    n_cycles: int = 0
    seconds: float = 0.0
    deadline_us: float = 0.0
    lease_ms: int = 1000
    realtime: bool = True


@dataclass(slots=True)
class RunResult:
    """Everything a report needs; figures are measured, none is inferred from the configuration."""

    tally: RunTally
    timing: TimingLedger
    dark: DarkReport
    stream: dict[str, int]
    decoder: dict[str, int]
    clock: dict[str, Any]
    realtime: dict[str, Any]
    device: dict[str, Any]
    slot_jitter_us: float
    wrong_patterns: int
    armed_after_s: float
    seconds: float
    ended: str
    link_lost: bool
    reconnects: int = 0
    decisions_sha256: str = ""
    events: list[dict[str, Any]] = field(default_factory=list)


Watcher = Callable[["LiveRun", Output], None]


def run_live(
    link: Link,
    profile: Profile,
    bundle: Bundle,
    plan: Plan,
    decider: Decider,
    config: RunConfig,
    recorder: Recorder | None = None,
    watch: Watcher | None = None,
    started_ns: int | None = None,
    recovery: Recovery | None = None,
    prepared: Callable[[LiveRun], None] | None = None,
) -> RunResult:
    """Run `plan` on the device behind `link` and decide until it is done; see the module's docstring.

    `watch` is called after every block, when there is slack, with the run and the block's output (for a live view).
    `started_ns` is the time from which "armed after" counts, on time.perf_counter_ns (default: now).
    `recovery` says how to come back when the device is lost; without it the run ends there. `prepared` is called once, before
    arming, with the run (for checks that look deeper than a view).
    """
    on_sent = None if recorder is None else recorder.add_command

    def prepare(opened: Link) -> Connection:
        """Open a session, check that it is the right device, and bring it to where ARM can follow."""
        connection = Connection(opened, on_sent)
        try:
            facts = connection.handshake().facts
            check_device(facts, plan, bundle, profile.clock.tick_hz)
            connection.upload(plan, bundle)
            connection.synchronise()
        except BaseException:
            connection.detach()
            raise
        return connection

    try:
        connection = prepare(link)
    except BaseException:
        link.close()
        raise
    run = LiveRun(connection, profile, plan, decider, config, recorder, started_ns or time.perf_counter_ns())
    try:
        run.core.warm_up()
        if plan.block_bytes >= KERNEL_BLOCK_BYTES:
            connection.decoder.use_kernels()
        reader = connection.reader.thread_id
        with arm_realtime(config.realtime and not link.virtual, [] if reader is None else [reader]) as granted:
            run.realtime = granted
            try:
                if prepared is not None:
                    prepared(run)
                run.arm()
                _until_ended(run, recovery, prepare, watch)
            except KeyboardInterrupt:
                run.ended = "interrupted"
            finally:  # whatever went wrong: light off first
                run.stop()
        return run.result()
    finally:
        run.connection.close()


def _until_ended(
    run: LiveRun, recovery: Recovery | None, prepare: Callable[[Link], Connection], watch: Watcher | None
) -> None:
    while not run.ended:
        try:
            run.turn(watch)
        except LinkError as error:
            if recovery is None:
                run.lose_link(error)
            else:
                run.recover(error, recovery, prepare)


class LiveRun:
    """One run in progress: what `run_live` calls in turn, and what a live view may look at."""

    def __init__(
        self,
        connection: Connection,
        profile: Profile,
        plan: Plan,
        decider: Decider,
        config: RunConfig,
        recorder: Recorder | None,
        started_ns: int,
    ) -> None:
        self.connection = connection
        self.core = Core(plan, decider, config.shots, config.n_cycles)
        self.timing = TimingLedger(int(config.deadline_us * NS_PER_US))
        self.tally = RunTally(decider.n_classes, config.shots)
        self.realtime: dict[str, Any] = {}
        self.ended = ""
        self.link_lost = False
        self.reconnects = 0
        self._plan, self._config, self._recorder = plan, config, recorder
        self._outage_ns: int | None = None  # since when there has been no block
        self._decoded: Counter[str] = Counter()  # by connections that are gone
        expected_dark = float(click_probability(click_law(profile, plan.exposure_us), 0.0))
        self._dark = DarkMonitor(expected_dark)
        self._started_ns = started_ns
        self._armed_after_s = 0.0
        self._start_ns = self._last_data_ns = self._probe_due_ns = self._flush_due_ns = self._lease_due_ns = 0
        self._granted_until = 0
        self._jitter_ticks = 0
        self._events: list[dict[str, Any]] = []

    # -- arming and stopping -------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Start the exposures a little in the future, at an absolute device tick."""
        n_cycles = self.core.cycles_left(self._config.n_cycles) if self._config.n_cycles else 0
        self._note_session()
        now_ns = self._now()
        start_tick = self._known_clock().to_tick(now_ns + ARM_LEAD_NS)
        self._digest(self.core.begin(start_tick, n_cycles))
        self.connection.session.submit(Opcode.ARM, pack_arm(Arm(start_tick, n_cycles, self._config.lease_ms)))
        self._last_data_ns = now_ns + ARM_LEAD_NS
        self._flush_due_ns = now_ns + FLUSH_EVERY_NS
        if not self.reconnects:
            self._start_ns = now_ns + ARM_LEAD_NS
            self._armed_after_s = (time.perf_counter_ns() - self._started_ns) / NS_PER_S
        self._renew(now_ns)

    def stop(self) -> None:
        """Tell the device to go dark. One that does not answer any more does so by itself when its lease runs out."""
        session = self.connection.session
        give_up_ns = self._now() + (0 if self.link_lost else STOP_GIVE_UP_NS)
        try:
            session.submit(Opcode.STOP)
            while self._now() < give_up_ns and not (session.settled and self._is_dark()):
                self._take(self.connection.pump(POLL_S))
        except LinkError as error:
            self.lose_link(error)
        except KeyboardInterrupt:  # a second Ctrl-C: STOP is sent, and the lease does the rest
            self.ended = self.ended or "interrupted"
        self._digest(self.core.end())
        self._note_clock()

    def _is_dark(self) -> bool:
        status = self.connection.session.status
        return status is not None and status.state in (DeviceState.IDLE, DeviceState.SAFE)

    def lose_link(self, error: LinkError) -> None:
        """End the run because the link is gone; what was decided so far stands."""
        self.ended = self.ended or f"the link was lost: {error.message}"
        self.link_lost = True

    def recover(self, error: LinkError, recovery: Recovery, prepare: Callable[[Link], Connection]) -> None:
        """Come back to the device and arm it for what is left of the run, or end the run because that failed."""
        now_ns = self._now()
        self._outage_ns = now_ns if self._outage_ns is None else self._outage_ns
        self._event({"kind": "link_lost", "reason": error.message})
        self._note_clock()
        self._decoded.update(_counts(self.connection.decoder.counters))
        self.connection.decoder.counters = DecoderCounters()
        try:
            self.connection, attempts = reconnect(recovery, self.connection, self._outage_ns, prepare)
        except LinkError as failure:
            self.lose_link(failure)
            return
        self.reconnects += 1
        outage_ms = (self._now() - self._outage_ns) / NS_PER_MS
        self._event({"kind": "reconnected", "attempts": attempts, "outage_ms": outage_ms})
        self._digest(self.core.end())
        if self._config.n_cycles and self.core.cycles_left(self._config.n_cycles) <= 0:
            self.ended = "the link was lost within the last object"
            return
        self.arm()

    @property
    def next_command_id(self) -> int:
        """The id that the next command of this session will have."""
        return self.connection.session.next_id

    def gate(self, tick: int, duration_ticks: int, channel: int) -> int:
        """Ask for a pulse at an absolute device tick and return the command's id; a refusal (too late) becomes an event.

        What is acted upon must be on record first, so the recording is flushed before the command leaves.
        """
        if self._recorder is not None:
            self._recorder.flush()
        body = pack_gate(Gate(tick, duration_ticks, channel))
        return self.connection.session.submit(Opcode.GATE, body, may_be_refused=True)

    # -- one turn ------------------------------------------------------------------------------------------------------

    def turn(self, watch: Watcher | None) -> None:
        """Wait for bytes, decide on them, do what is due; sets `ended` when the run is over."""
        outputs = self._take(self.connection.pump(POLL_S))
        now_ns = self._now()
        self._note_refusals()
        if watch is not None:
            for output in outputs:
                watch(self, output)
        if now_ns >= self._probe_due_ns:
            self.connection.session.probe(now_ns)
            self._probe_due_ns = now_ns + PROBE_EVERY_NS
        if now_ns >= self._lease_due_ns or self._granted_until - self.core.tracker.next_seq < RECEIVE_WINDOW // 2:
            self._renew(now_ns)
        if self._recorder is not None and now_ns >= self._flush_due_ns:
            self._note_clock()
            self._recorder.flush()
            self._flush_due_ns = now_ns + FLUSH_EVERY_NS
        self.ended = self._end(now_ns)

    def _take(self, arrived: list[Arrived]) -> list[Output]:
        outputs = []
        for arrival_ns, frame in arrived:
            decoded_ns = self._now()
            output = self.core.step(frame)
            if self._recorder is not None:
                self._recorder.add_message(arrival_ns, pack_body(frame))
            self._account(output, (arrival_ns, decoded_ns, self._now()))
            if output.block_end_tick is not None:
                self._last_data_ns = arrival_ns
                self._outage_ns = None
            outputs.append(output)
        return outputs

    def _digest(self, output: Output) -> None:
        """Account for what the core settled without a message."""
        now_ns = self._now()
        self._account(output, (now_ns, now_ns, now_ns))

    def _account(self, output: Output, times_ns: tuple[int, int, int]) -> None:
        """Judge, tally and record one step's output; windows given up at the end of the plan have no exposure to be late for."""
        for event in output.events:
            self._event(event)
        if output.block_end_tick is not None:
            self._check_slot(output.block_end_tick)
        if not output.decisions:
            return
        end_ns = uncertainty_ns = 0
        if output.block_end_tick is not None:
            end_ns, uncertainty_ns = self._known_clock().to_host_ns(output.block_end_tick)
        for decision in output.decisions:
            mark = self.core.marks.get(decision.object)
            self.tally.add(decision, float("nan") if mark is None else mark.photons)
            if self._recorder is not None:
                self._recorder.add_decision(decision)
            if output.block_end_tick is None:
                continue
            marks_ns = (end_ns, *times_ns, self._now())
            if self.timing.judge(marks_ns, uncertainty_ns):
                self._event({"kind": "late", "decision": decision.number, "latency_us": (marks_ns[3] - end_ns) / 1000})
            if self._recorder is not None:
                self._recorder.add_timing((decision.number, end_ns, times_ns[0], times_ns[2], marks_ns[4]))

    def _check_slot(self, block_end_tick: int) -> None:
        """Compare when the block's last exposure ended with when the plan says that it should."""
        exposure = self.core.tracker.next_exposure - 1
        cycle, slot = divmod(exposure, self._plan.slots_per_cycle)
        planned = self.core.start_tick + cycle * self._plan.cycle_ticks + int(self._plan.slot_offset_ticks[slot])
        self._jitter_ticks = max(self._jitter_ticks, abs(block_end_tick - planned - self._plan.exposure_ticks))

    def _renew(self, now_ns: int) -> None:
        self._granted_until = self.core.tracker.next_seq + RECEIVE_WINDOW
        self.connection.session.grant(self._granted_until, self._config.lease_ms)
        self._lease_due_ns = now_ns + self._config.lease_ms * NS_PER_MS // 4

    def _end(self, now_ns: int) -> str:
        if self.core.completed:
            return "completed"
        session = self.connection.session
        status = session.status
        is_news = status is not None and status.tick >= self.core.start_tick  # of this run, not of what was before it
        if status is not None and is_news and status.state == DeviceState.SAFE:
            if status.reason == StateReason.LEASE_EXPIRED:
                raise LinkError("the device went dark: it had not heard from us for a whole lease")
            self.link_lost = True
            return f"the device went dark by itself: reason {status.reason}"
        if self._config.seconds and now_ns - self._start_ns >= self._config.seconds * NS_PER_S:
            return "time is up"
        if now_ns - session.heard_ns > UNHEARD_NS:
            raise LinkError("the device fell silent")
        if now_ns - self._last_data_ns > SILENCE_NS + self._plan.cycle_us * NS_PER_US:
            raise LinkError("the device answers, but sends no clicks")
        return ""

    def _note_session(self) -> None:
        """Record which session and device clock the following ticks belong to."""
        welcome = self.connection.session.welcome
        facts = {} if welcome is None else welcome.facts
        self._event(
            {"kind": "session", "nonce": self.connection.session.nonce, "epoch": str(facts.get("epoch", "unknown"))}
        )
        self._note_clock()

    def _note_clock(self) -> None:
        """Record the probes and the jumps of the device's clock."""
        for step in self.connection.clock_steps:
            self._event({"kind": "clock_step", "tick": step.tick, "off_ns": step.off_ns, "allowed_ns": step.allowed_ns})
        self.connection.clock_steps.clear()
        samples = self._known_clock().take_samples()
        if self._recorder is not None and len(samples):
            self._recorder.add_clock(samples)

    def _note_refusals(self) -> None:
        refusals = self.connection.session.refusals
        while refusals:
            self._event({"kind": "gate_refused", **refusals.popleft()._asdict()})

    def _now(self) -> int:
        return self.connection.link.now_ns()

    def _event(self, event: dict[str, Any]) -> None:
        if len(self._events) < 1000:  # the recording has them all
            self._events.append(event)
        if self._recorder is not None:
            self._recorder.add_event(event)

    def _known_clock(self) -> ClockModel:
        assert self.connection.clock is not None  # run_live measures it before arming
        return self.connection.clock

    # -- what came of it -----------------------------------------------------------------------------------------------

    def result(self) -> RunResult:
        """Return the run's figures."""
        welcome = self.connection.session.welcome
        facts = dict({} if welcome is None else welcome.facts)
        device = facts | link_facts(self.connection.link)
        device["simulated"] = bool(
            device["simulated"] or facts.get("simulated")
        )  # a simulator behind an ordinary port says so
        self._decoded.update(_counts(self.connection.decoder.counters))
        tallies = self.core.windows.tallies
        fit = self._known_clock().fit
        result = RunResult(
            tally=self.tally,
            timing=self.timing,
            dark=self._dark.report(int(tallies[DARK_EXPOSURES]), int(tallies[DARK_CLICKS])),
            stream=_counts(self.core.tracker.counters),
            decoder=dict(self._decoded),
            clock={} if fit is None else {"drift_ppm": fit.drift_ppm, "uncertainty_us": fit.uncertainty_ns / 1000},
            realtime=self.realtime,
            device=device,
            slot_jitter_us=self._jitter_ticks * self._plan.tick_us,
            wrong_patterns=int(tallies[WRONG_PATTERNS]),
            armed_after_s=self._armed_after_s,
            seconds=(self._now() - self._start_ns) / NS_PER_S,
            ended=self.ended,
            link_lost=self.link_lost,
            reconnects=self.reconnects,
            events=self._events,
        )
        return result


def _counts(counters: Any) -> dict[str, int]:
    return {name: getattr(counters, name) for name in counters.__slots__}
