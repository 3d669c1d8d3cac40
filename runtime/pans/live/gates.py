"""Acting on decisions: pulses at absolute device ticks, on time or not at all.

A pulse whose tick has passed, or will have before the command can be there, or whose decision was late, is not sent: it expires, as an
event. What is acted upon is on record before its command leaves. The instrument refuses what comes too late; that is an event too.

`--act` may name a second instrument: a pulse's tick is then converted to the host's time and on to the other clock's tick, and what both
conversions may be off stands in the event beside it. An actuator of a laboratory's own is found by entry point (`pans.actuators`): a
function from the URL's rest to an object with `fire` and `close`, see docs/how-to/flow.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import entry_points
from typing import Any, Protocol, TypeVar

import numpy as np

from pans.base.console import load_offered
from pans.base.errors import DeviceError, LinkError, UsageError
from pans.decide import Action
from pans.decide.plan import Cycle, Plan, lay_out, plan_chunks, ticks_of
from pans.instrument.profile import Profile
from pans.protocol.clock import ClockModel
from pans.protocol.links import Link, open_link
from pans.protocol.session import COMMAND_WINDOW, HostSession
from pans.protocol.wire import DARK_PATTERN, Arm, DeviceState, Gate, Opcode, PatternChunk, pack_command
from pans.record.recorder import Recorder

from .journal import Journal
from .session import ARM_LEAD_NS, NS_PER_S, Session

T = TypeVar("T")

LEASE_MS = 2000  # a host that is away for longer has lost its right to pulse
PROBE_EVERY_NS = 89_000_000  # odd on purpose, and not that of the instrument that measures
LOOK_EVERY_NS = 20_000_000
LOOK_SOON_NS = 1_000_000  # while a pulse has no answer
SETTLE_NS = NS_PER_S  # longest wait at the end for a pulse that is still to come


class SecondInstrument:
    """An instrument of `profile` behind `link`, used for its outputs alone."""

    def __init__(self, url: str, link: Link, profile: Profile) -> None:
        if link.virtual:
            link.close()
            raise UsageError(f"{url}: a second instrument needs the host's real time", remedy="pace=real")
        self.url, self.profile, self._link = url, profile, link
        self._session: Session | None = None
        self.worst_uncertainty_ns = 0
        self._probe_due_ns = self._lease_due_ns = self._look_due_ns = 0
        self._last_pulse_ns = 0
        self._arm_sent_ns = 0

    @staticmethod
    def open(url: str, profile: Profile) -> SecondInstrument:
        """Open the port that `url` names; `tcp:HOST:PORT` is a socket. UsageError, LinkError."""
        scheme, _, rest = url.partition(":")
        return SecondInstrument(url, open_link(f"serial:socket://{rest}" if scheme == "tcp" else url), profile)

    @property
    def session(self) -> Session:
        """Its session; LinkError before `connect`."""
        if self._session is None:
            raise LinkError(f"{self.url}: the second instrument is not connected")
        return self._session

    def now_ns(self) -> int:
        """The host's clock."""
        return self._link.now_ns()

    def connect(self) -> None:
        """Shake hands, measure its clock and arm it; DeviceError if it is not of the profile, LinkError if it is silent."""
        # not before: its reader's thread shares the interpreter with the loop, and has its priority only if it starts after the loop got it
        session = self._session = Session(self._link)
        profile = self.profile
        facts = session.handshake().facts
        found = (facts["mode"], int(facts["tick_hz"]))
        if found != (profile.mode, profile.clock.tick_hz):
            raise DeviceError(
                f"{self.url} measures in {found[0]} mode at {found[1]} ticks per second, {profile.name} says {profile.mode} at "
                f"{profile.clock.tick_hz}",
                remedy="name its hardware profile with --act-profile",
            )
        plan = idle_plan(profile)
        dark = PatternChunk(0, 0, 1, np.zeros(1, np.uint16))
        session.host.submit(Opcode.LOAD_PATTERN, pack_command(dark))
        for chunk in plan_chunks(plan):
            session.host.submit(Opcode.LOAD_PLAN, pack_command(chunk))
        session.wait_acknowledged()
        session.synchronise()
        self._arm()
        session.wait_acknowledged()

    def exchange(self, now_ns: int, *, waits: bool) -> None:
        """Read what came and send what is due; `waits` for an answer: look soon. LinkError when it is gone."""
        host = self.session.host
        if now_ns >= self._probe_due_ns:
            host.probe(self.now_ns())
            self.session.flush()  # its round trip begins now, not at the next look
            self._probe_due_ns = now_ns + PROBE_EVERY_NS
        if now_ns >= self._lease_due_ns:
            host.grant(0, LEASE_MS)
            self._lease_due_ns = now_ns + LEASE_MS * 1_000_000 // 4
        if now_ns < self._look_due_ns:
            return
        self._look_due_ns = now_ns + (LOOK_SOON_NS if waits else LOOK_EVERY_NS)
        self.session.pump(0.0)
        status = host.status
        lapsed = status is not None and status.state in (DeviceState.SAFE, DeviceState.IDLE)
        if lapsed and not host.in_flight and now_ns - self._arm_sent_ns > NS_PER_S:
            host.submit(Opcode.RESET)
            self._arm()

    def submit(self, at_ns: int, duration_us: float, channel: int) -> tuple[int, int, int]:
        """Send a pulse for `at_ns` of the host's clock, at once; return the command's id, the tick, and how far off that may be in ns."""
        clock = self.session.known_clock()
        tick = clock.to_tick(at_ns)
        uncertainty_ns = clock.to_host_ns(tick)[1]
        gate = Gate(tick, max(1, round(duration_us * clock.tick_hz / 1e6)), channel)
        command_id = self.session.host.submit(Opcode.GATE, pack_command(gate), may_be_refused=True)
        self.session.host.poll(self.now_ns())
        self.session.flush()
        self._last_pulse_ns = max(self._last_pulse_ns, at_ns + round(duration_us * 1000))
        self._look_due_ns = 0
        return command_id, tick, uncertainty_ns

    def finish(self) -> None:
        """Let the pulses that are still to come happen and be answered, within a second, then stop the instrument."""
        host = self.session.host
        until_ns = self.now_ns() + SETTLE_NS
        while self.now_ns() < min(until_ns, self._last_pulse_ns) or host.in_flight:
            self.session.pump(0.005)
            if self.now_ns() >= until_ns:
                break
        host.submit(Opcode.STOP)
        while host.in_flight and self.now_ns() < until_ns + SETTLE_NS:
            self.session.pump(0.005)

    def close(self) -> None:
        """Close its port."""
        if self._session is None:
            self._link.close()
        else:
            self._session.close()

    def facts(self) -> dict[str, Any]:
        """What the summary says about it."""
        if self._session is None:
            return {"url": self.url}
        welcome = self.session.host.welcome
        fit = None if self.session.clock is None else self.session.clock.fit
        return {
            "url": self.url,
            "serial": None if welcome is None else welcome.facts.get("serial"),
            "simulated": self._link.simulated or bool(welcome and welcome.facts.get("simulated")),
            "drift_ppm": None if fit is None else fit.drift_ppm,
            "uncertainty_us": None if fit is None else fit.uncertainty_ns / 1000,
            "worst_uncertainty_us": self.worst_uncertainty_ns / 1000,  # of a pulse, both clocks together
        }

    def _arm(self) -> None:
        now_ns = self.now_ns()
        start_tick = self.session.known_clock().to_tick(now_ns + ARM_LEAD_NS)
        self.session.host.submit(Opcode.ARM, pack_command(Arm(start_tick, 0, LEASE_MS)))
        self._arm_sent_ns = now_ns


def idle_plan(profile: Profile) -> Plan:
    """Return a plan of one dark exposure per second, the shortest that `profile` carries."""
    ticks = ticks_of(profile, max(profile.exposure.min_us, 1e6 / profile.clock.tick_hz))
    cycle_ticks, zero = max(profile.clock.tick_hz, ticks.spacing), np.zeros(1, np.int64)
    return lay_out(profile, 1, Cycle(zero + DARK_PATTERN, zero, zero, cycle_ticks, ticks.spacing, 1, 1, 1), ticks)


GROUP = "pans.actuators"
OWN = "device"
DEVICES = "pans.devices"
LINKS = ("serial", "tcp", "usb")
MAX_WAITING = 4096
FREE_COMMANDS = 2  # of the command window, for what is not a pulse


class Actuator(Protocol):
    """Something that makes a pulse at a time of the host's clock."""

    def fire(self, at_ns: int, duration_us: float, channel: int) -> str:
        """Arrange a pulse at `at_ns` (time.perf_counter_ns) and return at once: "" when it will be made, else why not."""

    def close(self) -> None:
        """Let go of the hardware; nothing is pulsed afterwards."""


@dataclass(slots=True)
class GateCounters:
    """What became of the pulses that decisions asked for; what is none of the other three is not known yet."""

    asked: int = 0
    done: int = 0  # accepted before their tick
    refused: int = 0  # by the instrument or the actuator
    expired: int = 0  # not sent: it would have been late


class GateQueue:
    """Takes actions from outputs and gets them done within the session's window; `failed` is told the decision of each that was not."""

    def __init__(self, recorder: Recorder | None, journal: Journal) -> None:
        self.counters = GateCounters()
        self.actuator: Actuator | None = None  # None: a GATE command, to the instrument itself or to the second one
        self.second: SecondInstrument | None = None
        self._lost = ""  # why the second instrument is gone
        self.failed: Callable[[int], None] = lambda number: None
        self._recorder, self._journal = recorder, journal
        self._waiting: deque[Action] = deque()
        self._sent: deque[tuple[int, Action]] = deque()  # command id, action
        self._session: HostSession | None = None

    def take(self, actions: Iterable[Action], late_us: float = 0.0) -> None:
        """Queue pulses of decisions that were `late_us` after their deadline: late ones expire, and beyond MAX_WAITING the oldest."""
        for action in actions:
            self.counters.asked += 1
            if late_us > 0:
                self._expire(action, f"its decision was {late_us:.0f} us later than the deadline allows")
            else:
                self._waiting.append(action)
        while len(self._waiting) > MAX_WAITING:
            self._expire(self._waiting.popleft(), "too many pulses wait")

    def turn(self, session: HostSession, clock: ClockModel, now_ns: int) -> bool:
        """Note what the device has answered and submit what there is room for; return whether there is something to send at once."""
        if (second := self.second) is not None:
            self._ask_second(lambda: second.exchange(now_ns, waits=bool(self._sent)))
        if not self._waiting and not self._sent:
            return False
        target = session if self.second is None else self.second.session.host
        self._collect(target)
        now_tick = clock.to_tick(now_ns)
        first = True
        while self._waiting:
            action = self._waiting[0]
            if action.tick <= now_tick:
                late_us = (now_tick - action.tick) * 1e6 / clock.tick_hz
                self._expire(self._waiting.popleft(), f"its time passed {late_us:.0f} us before it could be sent")
                continue
            if self.actuator is None and target.in_flight >= COMMAND_WINDOW - FREE_COMMANDS:
                break
            if first and self._recorder is not None:
                self._recorder.flush_decisions()
            first = False
            self._do(self._waiting.popleft(), session, clock)
        return not first

    def finish(self, session: HostSession) -> None:
        """The run is over: what was answered counts, what waits expires, what has no answer was refused as far as is known."""
        if self.second is not None:
            self._ask_second(self.second.finish)
            session = self.second.session.host
        self._collect(session)
        self._refuse_sent("no answer before the end of the run")
        while self._waiting:
            self._expire(self._waiting.popleft(), "the run ended")

    def _do(self, action: Action, session: HostSession, clock: ClockModel) -> None:
        if self.actuator is None and self.second is None:
            body = pack_command(Gate(action.tick, action.duration_ticks, action.channel))
            self._session = session
            self._sent.append((session.submit(Opcode.GATE, body, may_be_refused=True), action))
            return
        at_ns, uncertainty_ns = clock.to_host_ns(action.tick)
        if self.second is not None:
            self._send_on(self.second, action, at_ns, uncertainty_ns, action.duration_ticks * 1e6 / clock.tick_hz)
            return
        assert self.actuator is not None
        reason = self.actuator.fire(at_ns, action.duration_ticks * 1e6 / clock.tick_hz, action.channel)
        self._journal.note("fired", decision=action.number, tick=action.tick, refusal=reason)
        if reason:
            self._refuse(action, reason)
        else:
            self.counters.done += 1

    def _send_on(
        self, second: SecondInstrument, action: Action, at_ns: int, uncertainty_ns: int, duration_us: float
    ) -> None:
        """Let the second instrument pulse at `at_ns` of the host's clock, which is known to `uncertainty_ns`."""
        sent = self._ask_second(lambda: second.submit(at_ns, duration_us, action.channel))
        if sent is None:
            self._refuse(action, self._lost)
            return
        command_id, tick, own_ns = sent
        self._session = second.session.host
        self._sent.append((command_id, action))
        off_ns = uncertainty_ns + own_ns
        second.worst_uncertainty_ns = max(second.worst_uncertainty_ns, off_ns)
        facts = {"host_ns": at_ns, "second_tick": tick, "uncertainty_us": off_ns / 1000}
        self._journal.note("gate_sent", decision=action.number, tick=action.tick, **facts)

    def _ask_second(self, call: Callable[[], T]) -> T | None:
        """Return what `call` gives; None where the second instrument is gone: the run goes on, and every pulse is refused."""
        try:
            return None if self._lost else call()
        except (LinkError, DeviceError) as error:
            self._lost = f"the second instrument was lost: {error.message}"
        self._journal.note("actuator_lost", words=self._lost)
        self._refuse_sent(self._lost)
        return None

    def _collect(self, session: HostSession) -> None:
        """Match acknowledgements with pulses, in the order of their commands."""
        if self._session is not None and session is not self._session:  # the old session took its answers with it
            self._refuse_sent("the link was lost before the device answered")
        refusals = {}
        while session.refusals:
            refusal = session.refusals.popleft()
            refusals[refusal.command_id] = refusal
        while self._sent and self._sent[0][0] <= session.answered:
            command_id, action = self._sent.popleft()
            if command_id in refusals:
                self._refuse(action, refusals.pop(command_id).text)
            else:
                self.counters.done += 1
        for refusal in refusals.values():
            self._journal.refused(refusal)

    def _refuse_sent(self, why: str) -> None:
        while self._sent:
            self._refuse(self._sent.popleft()[1], why)

    def _refuse(self, action: Action, why: str) -> None:
        self.counters.refused += 1
        self._journal.note("gate_refused", decision=action.number, tick=action.tick, text=why)
        self.failed(action.number)

    def _expire(self, action: Action, why: str) -> None:
        self.counters.expired += 1
        self._journal.note("gate_expired", decision=action.number, tick=action.tick, text=why)
        self.failed(action.number)

    def summary(self) -> dict[str, Any]:
        """Return the counters by name."""
        return asdict(self.counters)


def open_actuator(url: str, profile: Profile) -> Actuator | SecondInstrument | None:
    """Return what `url` names: None for the instrument's own output, an actuator (NAME or NAME:REST), or a second instrument.

    That is one of `profile` behind a device URL (`tcp:HOST:PORT` too). UsageError for an unknown one, LinkError for a port that
    cannot be opened.
    """
    name, _, rest = url.partition(":")
    if name == OWN:
        return None
    found = {point.name: point for point in entry_points(group=GROUP)}
    if name in found:
        actuator: Actuator = load_offered(found[name])(rest)
        return actuator
    links = {*LINKS, *(point.name for point in entry_points(group=DEVICES))}
    if name not in links:
        names = ", ".join([OWN, *sorted(found), *(f"{link}:..." for link in sorted(links))])
        raise UsageError(f"no actuator {name!r}, known: {names}", remedy=f"offer one by the entry point group {GROUP}")
    return SecondInstrument.open(url, profile)
