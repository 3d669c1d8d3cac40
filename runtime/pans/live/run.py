"""One live run in progress, iteration by iteration: receive, judge the time, record, act, renew the lease.

The order of a whole run is loop.py's, its outages are reconnect.py's. Any `Follower` can be driven. `iterate` sets `ended` when the run
is over.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, suppress
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from pans.base.errors import DeviceError, LinkError, RecordingError
from pans.decide import DECISION_DTYPE, Action, Follower, Output, Standing
from pans.decide.plan import Plan
from pans.decide.still import Core
from pans.live.timing.causes import INFERENCE, LateWork, Stamped
from pans.live.timing.lateness import Lateness
from pans.live.timing.ledger import TimingLedger
from pans.protocol.clock import future_tick
from pans.protocol.tracker import Gap
from pans.protocol.wire import (
    LARGEST_TICK,
    Arm,
    DeviceState,
    Frame,
    Gate,
    MalformedMessage,
    MessageType,
    Opcode,
    StateReason,
    decode_status,
    pack_body,
    pack_command,
)
from pans.record.reading import TIMING_RUN_DTYPE
from pans.record.recorder import Recorder, repeated_setup

from .connection import ARM_LEAD_NS, Connection
from .drive import HostDriver, WalkPlace
from .gates import GateQueue
from .journal import Journal
from .options import RunOptions
from .tally import RunTally, unknown_photons

NS_PER_US, NS_PER_MS, NS_PER_S = 1_000, 1_000_000, 1_000_000_000
PROBE_EVERY_NS = 97 * NS_PER_MS  # odd on purpose: nothing in the loop has this period or a multiple of it
RECEIVE_WINDOW = 4096  # stream messages
FLUSH_EVERY_NS = 500 * NS_PER_MS
POLL_S = 0.02
LONGEST_LEAD_NS = 32 * ARM_LEAD_NS  # five refusals, each twice as far ahead
STOP_GIVE_UP_NS = 1 * NS_PER_S
UNHEARD_NS = 2_500 * NS_PER_MS  # without any frame: STATUS alone comes every second
SILENCE_NS = 5 * NS_PER_S  # without clicks

Watcher = Callable[["LiveRun", Output], None]
I64 = npt.NDArray[np.int64]
Rows = npt.NDArray[np.void]


class Taken(NamedTuple):
    """A message that the core has taken, what came of it, and when it arrived, was decoded and decided, in ns."""

    frame: Frame
    output: Output
    times_ns: tuple[int, int, int]


class Receives(Protocol):
    """What a run needs of its receiver (receiver.Receiver)."""

    def prepare(self) -> None: ...

    def receive(self, poll_s: float) -> list[Output]: ...

    def last(self, poll_s: float) -> None: ...

    def rest(self) -> None: ...

    def held(self, outputs: list[Output]) -> AbstractContextManager[None]: ...

    def stop_serving(self, outputs: list[Output]) -> None: ...

    def close(self) -> None: ...

    @property
    def serves(self) -> bool: ...

    @property
    def thread_id(self) -> int | None: ...

    def next_id(self) -> int: ...


class LiveRun:
    """One run in progress: what `run_live` calls again and again, and what a live view may look at."""

    receiver: Receives  # set before the run is armed
    driver: HostDriver | None = None  # of an automaton that the host follows
    armed: Connection | None = None  # whose session was sent ARM last
    _counted: Connection | None = None

    def __init__(
        self,
        connection: Connection,
        plan: Plan,
        core: Follower,
        n_classes: int,
        config: RunOptions,
        recorder: Recorder | None,
        started_ns: int,
    ) -> None:
        self.connection, self.plan, self.core, self.config = connection, plan, core, config
        self.timing = TimingLedger(int(config.deadline_us * NS_PER_US))
        welcome = connection.session.welcome
        # of a simulator: they come again in turn
        shown = 0 if welcome is None else int(welcome.facts.get("objects", 0))
        self.tally = RunTally(n_classes, config.shots, shown)
        self.journal = Journal(recorder)
        self.gates = GateQueue(recorder, self.journal)
        if plan.drive == "host" and plan.automaton is not None and isinstance(core, Core):
            self.driver = HostDriver(core, WalkPlace(plan, plan.automaton))
        self.lateness = Lateness(plan, self.timing.deadline_ns, connection.link, recorder)
        self.realtime: dict[str, Any] = {}
        self.page_faults: dict[str, int] = {}  # of the loop's thread while armed
        self.ended, self.link_lost, self.reconnects = "", False, 0
        self.turned_s = time.monotonic()  # the loop's heartbeat: when an iteration began last
        self.stops = False  # the device is being told to go dark
        self.stopped = False  # it has been told, and what came is recorded
        self.outage_ns: int | None = None  # since when there has been no block
        self.decoded: Counter[str] = Counter()  # what the connections that are gone have counted
        self.contradictions: Counter[str] = Counter()  # between messages and the clock, or the host's own books
        self.armed_after_s, self.start_ns, self.last_data_ns = 0.0, 0, 0
        self.failed: list[Connection] = []  # those that broke before they could be armed
        self.taken_here = 0  # messages of the present connection that the core was given, or came before ARM
        self.late: list[int] = []  # numbers of the late ones among the decisions that `report` gives next
        self.recorder = recorder
        self._watch: Watcher | None = None  # of the iteration under way
        self._idle = True  # nothing has come in it
        self._broken: LinkError | None = None  # met while acting, kept until all that has arrived is decided
        self._setup: list[bytes] = []  # what each part of the recording must repeat
        self._started_ns = started_ns
        self._fruitless = self._decided = 0
        self._lead_ns = ARM_LEAD_NS  # of a start before its first exposure; a host that is too slow for it learns
        self._probe_due_ns = self._flush_due_ns = self._lease_due_ns = self._granted_until = 0
        self._over_ns = 0  # when the plan has long been done

    def now_ns(self) -> int:
        """The link's host clock."""
        return self.connection.link.now_ns()

    @property
    def due_ns(self) -> int:
        """When the loop has to turn again, whatever comes: for a probe, a lease, a flush."""
        recorded = self._flush_due_ns if self.recorder is not None else self._lease_due_ns
        return min(self._probe_due_ns, self._lease_due_ns, recorded)

    @property
    def messages_granted(self) -> int:
        """How many messages the device may send before the next grant is due."""
        return self._granted_until - self.core.tracker.next_seq - RECEIVE_WINDOW // 2

    @property
    def is_broken(self) -> bool:
        """Whether nothing more can be sent."""
        return self._broken is not None

    # -- arming and stopping -------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Start the exposures a little in the future, at an absolute device tick."""
        n_cycles = self.core.cycles_left(self.config.n_cycles) if self.config.n_cycles else 0
        self.journal.session(self.connection)
        self.receiver.prepare()
        self.taken_here, self.armed = self.connection.delivered, self.connection
        now_ns, start_tick = self._start()
        self.settle(self.core.begin(start_tick, n_cycles))
        self._send_arm(now_ns, Arm(start_tick, n_cycles, self.config.lease_ms))

    def arm_later(self) -> bool:
        """ARM came too late: ask for a start twice as far ahead, in the same session; False where that has been done often enough."""
        if self._lead_ns >= LONGEST_LEAD_NS:
            return False
        self._lead_ns *= 2
        self.journal.note("armed_too_late", lead_ms=self._lead_ns // NS_PER_MS)
        n_cycles = self.core.cycles_left(self.config.n_cycles) if self.config.n_cycles else 0
        outputs: list[Output] = []
        with self.receiver.held(outputs):
            now_ns, start_tick = self._start()
            self.core.begin_later(start_tick)
            self._send_arm(now_ns, Arm(start_tick, n_cycles, self.config.lease_ms))
        self.report(outputs)
        return True

    def _start(self) -> tuple[int, int]:
        """Return the time, and the tick at which exposures that are asked for now can begin."""
        now_ns = self.now_ns()
        start_tick = self.connection.known_clock().to_tick(now_ns + self._lead_ns)
        if not 0 <= start_tick <= LARGEST_TICK:
            raise DeviceError(
                f"the device's clock says that it is tick {start_tick}, allowed 0 to {LARGEST_TICK}",
                remedy="restart the device, so that its counter begins anew",
            )
        return now_ns, start_tick

    def _send_arm(self, now_ns: int, arm: Arm) -> None:
        start_ns = now_ns + self._lead_ns
        self.lateness.attach(self.connection, start_ns, self.receiver.thread_id)
        self.connection.session.submit(Opcode.ARM, pack_command(arm))
        if self.driver is not None:
            self.driver.begin(self.connection)
        if self.recorder is not None and self.recorder.limits is not None:
            self._setup = repeated_setup(self.plan, arm, self.connection.session.nonce)
        self.last_data_ns = start_ns
        planned_ns = round((arm.n_cycles + 1) * self.plan.cycle_us * NS_PER_US)
        self._over_ns = start_ns + planned_ns + SILENCE_NS if arm.n_cycles else 1 << 63
        self._flush_due_ns = now_ns + FLUSH_EVERY_NS
        if not self.reconnects:
            self.start_ns = start_ns
            self.armed_after_s = (time.perf_counter_ns() - self._started_ns) / NS_PER_S
        self._renew(now_ns)

    def stop(self) -> None:
        """Tell the device to go dark. One that does not answer any more does so by itself when its lease runs out."""
        session, self._watch = self.connection.session, None
        unwritten: RecordingError | None = None
        if self.driver is not None:  # what the kernel sends has its numbers from the same session
            unwritten = self._stop_serving()
        give_up_ns = self.now_ns() + (0 if self.link_lost else STOP_GIVE_UP_NS)
        try:
            session.submit(Opcode.STOP)
            self.stops = True
            while self.now_ns() < give_up_ns and (session.in_flight or not self._is_dark()):
                self.receiver.last(POLL_S)
        except LinkError as error:
            self.lose_link(error)
        except KeyboardInterrupt:  # a second Ctrl-C: STOP is sent, and the lease does the rest
            self.ended = self.ended or "interrupted"
        unwritten = self._stop_serving() or unwritten
        self.take_rest()
        self.settle(self.core.end())
        self.gates.finish(session)
        while (verdict := self.lateness.incidents.verdict(self.now_ns(), final=True)) is not None:
            self.journal.take(verdict)
        self.lateness.evidence.close()
        self.journal.clock(self.connection)
        self.stopped = True
        if unwritten is not None:
            raise unwritten

    def _stop_serving(self) -> RecordingError | None:
        """Call the kernel in turn from here on; return why the recording had to be given up: the light goes off first."""
        try:
            self.receiver.stop_serving([])
        except RecordingError as error:
            self.drop_recorder()
            return error
        except LinkError as error:
            self.lose_link(error)
        return None

    def take_rest(self) -> None:
        """Decide on and record what has arrived on a connection that is given up: lost is only what never came."""
        self.receiver.rest()
        self._broken = None  # nothing can be sent any more

    def _is_dark(self) -> bool:
        status = self.connection.session.status
        return status is not None and status.state in (DeviceState.IDLE, DeviceState.SAFE)

    def is_fruitless(self, most: int) -> bool:
        """Note that the device was lost; whether that is now more than `most` times in a row without one whole decision in between."""
        decided = self.tally.decisions - self.tally.abstained + self.tally.unsure  # those given up do not count
        self._fruitless, self._decided = (0 if decided > self._decided else self._fruitless) + 1, decided
        return self._fruitless > most

    # -- acting --------------------------------------------------------------------------------------------------------

    def gate(self, tick: int, duration_ticks: int, channel: int) -> int:
        """Ask for a pulse at an absolute device tick and return the command's id; a refusal (too late) becomes an event.

        What is acted upon must be on record first, so the recording is flushed before the command leaves.
        """
        if self.recorder is not None:
            self.recorder.flush_decisions()
        body = pack_command(Gate(tick, duration_ticks, channel))
        return self.connection.session.submit(Opcode.GATE, body, may_be_refused=True)

    # -- one iteration -------------------------------------------------------------------------------------------------

    def iterate(self, watch: Watcher | None) -> None:
        """Wait for bytes, decide on them, do what is due; sets `ended` when the run is over."""
        self.turned_s = time.monotonic()
        looked_ns = self.now_ns()
        poll_s = self.lateness.poll_s(looked_ns)
        self._watch, self._idle = watch, True
        outputs = self.receiver.receive(poll_s)
        idle = self._idle and not outputs
        now_ns = self.now_ns()
        self._act(now_ns)
        if (
            verdict := self.lateness.settled(self.connection, now_ns, idle=idle and not self.receiver.serves)
        ) is not None:
            self.journal.take(verdict)
        self.journal.refusals(self.connection)
        self.report(outputs)
        if now_ns >= self._probe_due_ns:
            self.connection.session.probe(now_ns)
            self._probe_due_ns = now_ns + PROBE_EVERY_NS
        if now_ns >= self._lease_due_ns or self._granted_until - self.core.tracker.next_seq < RECEIVE_WINDOW // 2:
            self._renew(now_ns)
        if self.recorder is not None and now_ns >= self._flush_due_ns:
            self.journal.clock(self.connection)
            self.recorder.flush()
            self._flush_due_ns = now_ns + FLUSH_EVERY_NS
        self._turn_page(now_ns, outputs)
        self.ended = self._why_ended(now_ns, looked_ns, idle=idle)

    def report(self, outputs: list[Output]) -> None:
        """Give outputs to the watcher of this iteration, and forget them."""
        self._idle = self._idle and not outputs
        if self._watch is not None:
            for output in outputs:
                self._watch(self, output)
        outputs.clear()
        self.late.clear()

    def _why_ended(self, now_ns: int, looked_ns: int, *, idle: bool) -> str:
        """Return why the run is over ("" while it is not); LinkError when the device is lost in a way that may be recovered from.

        Silence counts up to `looked_ns`, and only where nothing came since: after a stop of this process what came meanwhile is read first.
        """
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
        if self.config.seconds and now_ns - self.start_ns >= self.config.seconds * NS_PER_S:
            return "time is up"
        if looked_ns > self._over_ns and self.core.contradictions["beyond_plan"]:
            return "the device goes on beyond its plan"
        if idle and looked_ns - session.heard_ns > UNHEARD_NS:
            raise LinkError("the device fell silent")
        if idle and looked_ns - self.last_data_ns > SILENCE_NS + self.plan.cycle_us * NS_PER_US:
            raise LinkError("the device answers, but sends no clicks")
        return ""

    def _act(self, now_ns: int) -> None:
        """Send the pulses that wait, at once: a pulse does not wait for the rest of what has to be done."""
        if self.gates.turn(self.connection.session, self.connection.known_clock(), now_ns):
            self.connection.session.poll(now_ns)
            self.connection.flush()

    def take_frame(self, arrival_ns: int, frame: Frame) -> Taken | None:
        """Let the core take one message, record it, and return what `book_frame` accounts for; None of a connection that was not armed."""
        if self.connection is not self.armed:
            return None
        taken = self.stepped(arrival_ns, frame)
        self._drive(arrival_ns)
        self.taken_here += 1
        if self.recorder is not None:
            self.recorder.add_message(arrival_ns, pack_body(frame))
        return taken

    def stepped(self, arrival_ns: int, frame: Frame, standing: Standing | None = None) -> Taken:
        """Let the core take one message, as the stream stood then; return what came of it."""
        decoded_ns = self.now_ns()
        output = self.core.step(frame, standing)
        decided_ns = self.now_ns()
        self.lateness.evidence.worked(INFERENCE, decoded_ns, decided_ns)
        return Taken(frame, output, (arrival_ns, decoded_ns, decided_ns))

    def book_frame(self, taken: Taken, outputs: list[Output]) -> None:
        """Account for what came of a message that the core has taken."""
        frame, arrival_ns = taken.frame, taken.times_ns[0]
        self.book(taken.output, taken.times_ns, outputs)
        if frame.type == MessageType.STATUS:
            with suppress(MalformedMessage):  # counted where it was taken
                status = decode_status(frame.payload)  # the session may know a later one, where the host was held up
                self.check_tick(status.tick, arrival_ns)
                left_ns, _ = self.connection.known_clock().to_host_ns(status.tick)
                self.lateness.evidence.stamped(Stamped(None, None, left_ns, arrival_ns))

    def _drive(self, arrival_ns: int) -> None:
        """Where the host drives: name the next state before anything else is done with what has come."""
        if self.driver is not None and not self.stops and self._broken is None:
            try:
                self.driver.turn(self.connection, arrival_ns)
            except LinkError as error:
                self._broken = error

    def note_broken(self, error: LinkError) -> None:
        """Keep why nothing more can be sent until all that has arrived is decided."""
        self._broken = self._broken or error

    def raise_broken(self) -> None:
        """Raise why nothing more can be sent, once."""
        broken, self._broken = self._broken, None
        if broken is not None:
            raise broken

    def book(self, output: Output, times_ns: tuple[int, int, int], outputs: list[Output]) -> None:
        """Account for what a message brought, and when that came, was decoded and decided."""
        self._account(output, times_ns)
        if output.block_end_tick is not None:
            self.check_tick(output.block_end_tick, times_ns[0])
            self.block_came(times_ns[0])
        if output.actions:
            self.pulse()
        outputs.append(output)

    def take_pulses(self, actions: Iterable[Action], arrival_ns: int, decided_ns: int) -> None:
        """Queue the pulses of decisions made at `decided_ns` on what came at `arrival_ns`; late ones expire, as `account_times` judges."""
        clock, deadline_ns = self.connection.known_clock(), self.timing.deadline_ns

        def late_us(action: Action) -> float:
            end_ns, unsure_ns = clock.to_host_ns(action.end_tick)
            end_ns = arrival_ns if end_ns - unsure_ns > arrival_ns else end_ns
            return (decided_ns - end_ns - unsure_ns - deadline_ns) / NS_PER_US

        self.gates.take(actions, late_us)

    def pulse(self) -> None:
        """Send the pulses that wait, unless nothing more can be sent."""
        try:
            if self._broken is None:
                self._act(self.now_ns())
        except LinkError as error:
            self._broken = error

    def block_came(self, arrival_ns: int) -> None:
        """Note that the stream goes on."""
        self.last_data_ns = arrival_ns
        self.outage_ns = None
        self.lateness.block_came(arrival_ns)

    def check_tick(self, tick: int, arrival_ns: int) -> None:
        """Note a tick that lies in the future."""
        wrong = future_tick(self.connection.known_clock(), tick, arrival_ns)
        if wrong is not None:
            self.contradictions[wrong.what] += 1
            self.journal.take(wrong)

    def settle(self, output: Output) -> None:
        """Account for what the core settled without a message."""
        now_ns = self.now_ns()
        self._account(output, (now_ns, now_ns, now_ns))

    def _account(self, output: Output, times_ns: tuple[int, int, int]) -> None:
        """Judge, tally and record one step's output; windows given up at the end of the plan have no exposure to be late for."""
        for event in output.events:
            self.journal.take(event)
            if isinstance(event, Gap):
                self.journal.take(self.lateness.lost(event, self.connection, self.now_ns()))
        if not output.decisions:
            return
        if output.block_end_tick is None:
            self.gates.take(output.actions)
        elif output.actions:
            self.take_pulses(output.actions, times_ns[0], times_ns[2])
        rows = np.array(output.decisions, DECISION_DTYPE)
        self.tally.add_rows(rows, unknown_photons if output.passages else self.core.marks.photons_of)
        if self.recorder is not None:
            self.recorder.add_decisions(rows)
        if output.block_end_tick is None:
            return
        counts, end_ticks = np.array([len(rows)]), [output.block_end_tick]
        if output.passages:  # each has a time of its own
            counts, end_ticks = np.ones(len(rows), np.int64), [passage.leave_tick for passage in output.passages]
        ends = np.minimum(np.array(end_ticks, np.uint64), 1 << 62).astype(np.int64)
        stamps = np.tile(np.array([*times_ns, self.now_ns()]), (len(ends), 1))
        self.account_times(int(rows["index"][0]), counts, *self.connection.known_clock().to_host_ns_many(ends), stamps)

    def account_times(self, first: int, counts: I64, ends_ns: I64, unsure_ns: I64, stamps_ns: I64) -> None:
        """Judge and record the times of decisions from number `first` on, of which `counts` each share theirs.

        ends_ns and unsure_ns (n,): when the last exposure ended, and how uncertain that is; stamps_ns (n, 4): arrival, decoded, decided,
        recorded.
        """
        # what has arrived has happened
        ends_ns = np.where(ends_ns - unsure_ns > stamps_ns[:, 0], stamps_ns[:, 0], ends_ns)
        marks_ns = np.column_stack((ends_ns, stamps_ns))
        late, numbers = self.timing.judge(marks_ns, unsure_ns, counts), first + np.cumsum(counts) - counts
        if self.recorder is not None:
            runs = np.zeros(len(counts), TIMING_RUN_DTYPE)
            runs["index"], runs["count"], runs["device_end_ns"] = numbers, counts, ends_ns
            runs["arrival_ns"], runs["decided_ns"], runs["recorded_ns"] = marks_ns[:, 1], marks_ns[:, 3], marks_ns[:, 4]
            self.recorder.add_timing_runs(runs)
        for at in np.flatnonzero(late).tolist():
            for number in range(int(numbers[at]), int(numbers[at] + counts[at])):
                self.late.append(number)
                self.journal.note("late", decision=number, latency_us=float(marks_ns[at, 3] - marks_ns[at, 0]) / 1000)
                begin_ns, arrival_ns, _, decided_ns, _ = marks_ns[at].tolist()
                self.lateness.incidents.late(LateWork(number, begin_ns, arrival_ns, decided_ns))

    def _turn_page(self, now_ns: int, outputs: list[Output]) -> None:
        """Go on in the recording's next part when this one is full and no window is open."""
        recorder = self.recorder
        if recorder is None or recorder.limits is None:
            return
        for event in recorder.news():
            self.journal.note(**event)
        if not recorder.wants_part:
            return
        with self.receiver.held(outputs):  # what came before belongs to this part
            self.report(outputs)
            if (place := self.core.part()) is not None:
                recorder.next_part(place.facts(), self._setup, now_ns)
                recorder.add_clock(self.connection.known_clock().history())
                self.journal.session(self.connection)

    def _renew(self, now_ns: int) -> None:
        self._granted_until = self.core.tracker.next_seq + RECEIVE_WINDOW
        self.connection.session.grant(self._granted_until, self.config.lease_ms)
        self._lease_due_ns = now_ns + self.config.lease_ms * NS_PER_MS // 4

    # -- the books of all connections ----------------------------------------------------------------------------------

    def lose_link(self, error: LinkError) -> None:
        """End the run because the link is gone; what was decided so far stands."""
        self.ended = self.ended or f"the link was lost: {error.message}"
        self.link_lost = True

    def close(self) -> None:
        """Close the link, and end the thread that decides."""
        try:
            if hasattr(self, "receiver"):
                self.receiver.close()
        finally:
            self.connection.close()

    def drop_recorder(self) -> None:
        """Go on without a recording, which cannot be written any further, so that the device can be told to stop."""
        self.recorder = self.journal.recorder = None
        self.connection.on_sent = self.connection.on_answer = None

    def count_decoded(self) -> None:
        """Add up what the present connection's decoder has counted, once: before it goes, or at the end; those that failed too."""
        while self.failed:
            self._add_counters(self.failed.pop())
        if self._counted is not self.connection:
            self._counted = self.connection
            self._add_counters(self.connection)
            self._reconcile(self.connection.decoder.counters.frames)

    def _add_counters(self, connection: Connection) -> None:
        counters, session = connection.decoder.counters, connection.session.counters
        self.decoded.update({name: getattr(counters, name) for name in counters.__slots__})
        self.decoded.update({name: getattr(session, name) for name in ("wrong_session", "unknown_type")})
        self.decoded.update(malformed_answers=session.malformed, implausible_answers=session.implausible)

    def _reconcile(self, frames: int) -> None:
        """Compare the books of the decoder, the connection and this run: every frame is an answer or was taken."""
        lost = frames - self.connection.answers - self.connection.delivered
        untaken = self.connection.delivered - self.taken_here if self.connection is self.armed else 0
        self.taken_here = 0
        for what, count in (("frames_lost_in_host", lost), ("messages_not_taken", untaken)):
            if count:
                self.contradictions[what] += abs(count)
                self.journal.note("contradiction", what=what, found=count, expected=0)
