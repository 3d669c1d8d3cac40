"""The live loop: from an open device to timed, recorded decisions. One screen, in the order in which data flows.

    handshake -> check -> upload -> clock -> [arm] -> pump -> core.step -> judge the timing -> record -> show -> ... -> stop -> close

Owns the order of things and the ends of a run; the physics, the protocol and the decisions live in the modules it calls.
`run_live` returns a `RunResult`, also when the link is lost on the way (`link_lost`); a device that cannot be armed raises LinkError.
"""

from __future__ import annotations

import time
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
from .tally import RunTally
from .timing import TimingLedger, arm_realtime
from .window import DARK_CLICKS, DARK_EXPOSURES, WRONG_PATTERNS
from .wire import DeviceState, Opcode, pack_body
from .wire_commands import Arm, pack_arm

NS_PER_US, NS_PER_MS, NS_PER_S = 1_000, 1_000_000, 1_000_000_000
ARM_LEAD_NS = 30 * NS_PER_MS  # long enough for ARM and GRANT to arrive, and for one retransmission to be told apart
PROBE_EVERY_NS = 97 * NS_PER_MS  # odd on purpose: nothing in the loop has this period or a multiple of it
RECEIVE_WINDOW = 4096  # stream messages
FLUSH_EVERY_NS = 500 * NS_PER_MS
POLL_S = 0.02
SILENCE_NS = 5 * NS_PER_S
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
) -> RunResult:
    """Run `plan` on the device behind `link` and decide until it is done; see the module's docstring.

    `watch` is called after every block, when there is slack, with the run and the block's output (for a live view).
    `started_ns` is the time from which "armed after" counts, on time.perf_counter_ns (default: now).
    """
    connection = Connection(link, None if recorder is None else recorder.add_command)
    run = LiveRun(connection, profile, plan, decider, config, recorder, started_ns or time.perf_counter_ns())
    try:
        welcome = connection.handshake()
        check_device(welcome.facts, plan, bundle, profile.clock.tick_hz)
        connection.upload(plan, bundle)
        run.clock = connection.synchronise()
        run.core.warm_up()
        reader = connection.reader.thread_id
        with arm_realtime(config.realtime and not link.virtual, [] if reader is None else [reader]) as granted:
            run.realtime = granted
            run.arm()
            try:
                while not run.ended:
                    run.turn(watch)
            except KeyboardInterrupt:
                run.ended = "interrupted"
            except LinkError as error:
                run.lose_link(error)
            run.stop()
        return run.result(dict(welcome.facts) | link_facts(link))
    finally:
        connection.close()


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
        self.core = Core(plan, decider, config.shots, config.n_cycles)
        self.timing = TimingLedger(int(config.deadline_us * NS_PER_US))
        self.tally = RunTally(decider.n_classes, config.shots)
        self.realtime: dict[str, Any] = {}
        self.clock: ClockModel | None = None
        self.ended = ""
        self.link_lost = False
        self._connection, self._plan, self._config, self._recorder = connection, plan, config, recorder
        self._now = connection.link.now_ns
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
        clock = self._known_clock()
        now_ns = self._now()
        self._start_ns = now_ns + ARM_LEAD_NS
        self.core.start_tick = clock.to_tick(self._start_ns)
        arm = Arm(self.core.start_tick, self._config.n_cycles, self._config.lease_ms)
        self._connection.session.submit(Opcode.ARM, pack_arm(arm))
        self._last_data_ns = self._start_ns
        self._flush_due_ns = now_ns + FLUSH_EVERY_NS
        self._armed_after_s = (time.perf_counter_ns() - self._started_ns) / NS_PER_S
        self._renew(now_ns)

    def stop(self) -> None:
        """Tell the device to go dark. One that does not answer any more does so by itself when its lease runs out."""
        session = self._connection.session
        give_up_ns = self._now() + STOP_GIVE_UP_NS
        try:
            session.submit(Opcode.STOP)
            while not session.settled and self._now() < give_up_ns:
                self._take(self._connection.pump(POLL_S))
        except LinkError as error:
            self.lose_link(error)

    def lose_link(self, error: LinkError) -> None:
        """End the run because the link is gone; what was decided so far stands."""
        self.ended = self.ended or f"the link was lost: {error.message}"
        self.link_lost = True

    # -- one turn ------------------------------------------------------------------------------------------------------

    def turn(self, watch: Watcher | None) -> None:
        """Wait for bytes, decide on them, do what is due; sets `ended` when the run is over."""
        outputs = self._take(self._connection.pump(POLL_S))
        now_ns = self._now()
        if watch is not None:
            for output in outputs:
                watch(self, output)
        if now_ns >= self._probe_due_ns:
            self._connection.session.probe(now_ns)
            self._probe_due_ns = now_ns + PROBE_EVERY_NS
        if now_ns >= self._lease_due_ns or self._granted_until - self.core.tracker.next_seq < RECEIVE_WINDOW // 2:
            self._renew(now_ns)
        if self._recorder is not None and now_ns >= self._flush_due_ns:
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
            outputs.append(output)
        return outputs

    def _account(self, output: Output, times_ns: tuple[int, int, int]) -> None:
        """Judge, tally and record one step's output; windows given up at the end of the plan have no exposure to be late for."""
        for event in output.events:
            self._event(event)
        if output.block_end_tick is not None:
            self._check_slot(output.block_end_tick)
        if not output.decisions:
            return
        end_ns, uncertainty_ns = 0, 0
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
        self._connection.session.grant(self._granted_until, self._config.lease_ms)
        self._lease_due_ns = now_ns + self._config.lease_ms * NS_PER_MS // 4

    def _end(self, now_ns: int) -> str:
        if self.core.completed:
            return "completed"
        status = self._connection.session.status
        is_news = status is not None and status.tick >= self.core.start_tick  # of this run, not of what was before it
        if status is not None and is_news and status.state == DeviceState.SAFE:
            return f"the device went dark: reason {status.reason}"
        if self._config.seconds and now_ns - self._start_ns >= self._config.seconds * NS_PER_S:
            return "time is up"
        if now_ns - self._last_data_ns > SILENCE_NS + self._plan.cycle_us * NS_PER_US:
            self.link_lost = True
            return "the device fell silent"
        return ""

    def _event(self, event: dict[str, Any]) -> None:
        if len(self._events) < 1000:  # the recording has them all
            self._events.append(event)
        if self._recorder is not None:
            self._recorder.add_event(event)

    def _known_clock(self) -> ClockModel:
        assert self.clock is not None  # run_live measures it before arming
        return self.clock

    # -- what came of it -----------------------------------------------------------------------------------------------

    def result(self, device: dict[str, Any]) -> RunResult:
        """Return the run's figures."""
        tallies = self.core.windows.tallies
        fit = self._known_clock().fit
        result = RunResult(
            tally=self.tally,
            timing=self.timing,
            dark=self._dark.report(int(tallies[DARK_EXPOSURES]), int(tallies[DARK_CLICKS])),
            stream=_counts(self.core.tracker.counters),
            decoder=_counts(self._connection.decoder.counters),
            clock={} if fit is None else {"drift_ppm": fit.drift_ppm, "uncertainty_us": fit.uncertainty_ns / 1000},
            realtime=self.realtime,
            device=device,
            slot_jitter_us=self._jitter_ticks * self._plan.tick_us,
            wrong_patterns=int(tallies[WRONG_PATTERNS]),
            armed_after_s=self._armed_after_s,
            seconds=(self._now() - self._start_ns) / NS_PER_S,
            ended=self.ended,
            link_lost=self.link_lost,
            events=self._events,
        )
        return result


def _counts(counters: Any) -> dict[str, int]:
    return {name: getattr(counters, name) for name in counters.__slots__}
