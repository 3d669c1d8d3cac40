"""A second instrument that pulses: its own link, session and clock, beside the one that measures.

Owns its connection and what keeps it armed; never measures with it and never decides when a pulse is due (gates.py). Its plan is one dark
exposure per second, for which no receive window is granted: GATE needs a run, and the lease of a run is what lets go of the
outputs when the host dies. A pulse asked for at a time of the host's clock becomes a tick of this instrument's clock; what the
conversion may be off is returned with it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from pans.runtime.core.plan import NO_SHOT, Plan, ticks_of
from pans.runtime.core.plan_codec import plan_chunks
from pans.runtime.errors import DeviceError, LinkError, UsageError
from pans.runtime.instrument.profile import Profile
from pans.runtime.link.base import Link, open_link
from pans.runtime.link.connection import ARM_LEAD_NS, NS_PER_S, Connection
from pans.runtime.wire.commands import Arm, Gate, PatternChunk, pack_arm, pack_gate, pack_pattern, pack_plan
from pans.runtime.wire.messages import DARK_PATTERN, DeviceState, Opcode

LEASE_MS = 2000  # a host that is away for longer has lost its right to pulse
PROBE_EVERY_NS = 89_000_000  # odd on purpose, and not that of the instrument that measures
LOOK_EVERY_NS = 20_000_000
LOOK_SOON_NS = 1_000_000  # while a pulse has no answer
SETTLE_NS = NS_PER_S  # longest wait at the end for a pulse that is still to come


class Sent(NamedTuple):
    """A pulse on its way: the command's id, the tick of the second instrument's clock, and how far off the conversion may be in ns."""

    command_id: int
    tick: int
    uncertainty_ns: int


class SecondInstrument:
    """An instrument of `profile` behind `link`, used for its outputs alone."""

    def __init__(self, url: str, link: Link, profile: Profile) -> None:
        if link.virtual:
            link.close()
            raise UsageError(f"{url}: a second instrument needs the host's real time", remedy="pace=real")
        self.url, self.profile, self._link = url, profile, link
        self._connection: Connection | None = None
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
    def connection(self) -> Connection:
        """Its session; LinkError before `connect`."""
        if self._connection is None:
            raise LinkError(f"{self.url}: the second instrument is not connected")
        return self._connection

    def now_ns(self) -> int:
        """The host's clock."""
        return self._link.now_ns()

    def connect(self) -> None:
        """Shake hands, measure its clock and arm it; DeviceError if it is not of the profile, LinkError if it is silent."""
        # not before: its reader's thread shares the interpreter with the loop, and has its priority only if it starts after the loop got it
        connection = self._connection = Connection(self._link)
        profile = self.profile
        facts = connection.handshake().facts
        found = (facts["mode"], int(facts["tick_hz"]))
        if found != (profile.mode, profile.clock.tick_hz):
            raise DeviceError(
                f"{self.url} measures in {found[0]} mode at {found[1]} ticks per second, {profile.name} says {profile.mode} at "
                f"{profile.clock.tick_hz}",
                remedy="name its hardware profile with --act-profile",
            )
        plan = idle_plan(profile)
        dark = PatternChunk(0, 0, 1, np.zeros(1, np.uint16))
        connection.session.submit(Opcode.LOAD_PATTERN, pack_pattern(dark))
        for chunk in plan_chunks(plan):
            connection.session.submit(Opcode.LOAD_PLAN, pack_plan(chunk))
        connection.settle()
        connection.synchronise()
        connection.decoder.use_kernels()
        self._arm()
        connection.settle()

    def turn(self, now_ns: int, *, waits: bool) -> None:
        """Read what came and send what is due; `waits` for an answer: look soon. LinkError when it is gone."""
        session = self.connection.session
        if now_ns >= self._probe_due_ns:
            session.probe(self.now_ns())
            self.connection.flush()  # its round trip begins now, not at the next look
            self._probe_due_ns = now_ns + PROBE_EVERY_NS
        if now_ns >= self._lease_due_ns:
            session.grant(0, LEASE_MS)
            self._lease_due_ns = now_ns + LEASE_MS * 1_000_000 // 4
        if now_ns < self._look_due_ns:
            return
        self._look_due_ns = now_ns + (LOOK_SOON_NS if waits else LOOK_EVERY_NS)
        self.connection.pump(0.0)
        status = session.status
        lapsed = status is not None and status.state in (DeviceState.SAFE, DeviceState.IDLE)
        if lapsed and session.settled and now_ns - self._arm_sent_ns > NS_PER_S:
            session.submit(Opcode.RESET)
            self._arm()

    def submit(self, at_ns: int, duration_us: float, channel: int) -> Sent:
        """Send a pulse for `at_ns` of the host's clock, at once."""
        clock = self.connection.known_clock()
        tick = clock.to_tick(at_ns)
        uncertainty_ns = clock.to_host_ns(tick)[1]
        gate = Gate(tick, max(1, round(duration_us * clock.tick_hz / 1e6)), channel)
        command_id = self.connection.session.submit(Opcode.GATE, pack_gate(gate), may_be_refused=True)
        self.connection.session.poll(self.now_ns())
        self.connection.flush()
        self._last_pulse_ns = max(self._last_pulse_ns, at_ns + round(duration_us * 1000))
        self._look_due_ns = 0
        return Sent(command_id, tick, uncertainty_ns)

    def finish(self) -> None:
        """Let the pulses that are still to come happen and be answered, within a second, then stop the instrument."""
        session = self.connection.session
        until_ns = self.now_ns() + SETTLE_NS
        while self.now_ns() < min(until_ns, self._last_pulse_ns) or not session.settled:
            self.connection.pump(0.005)
            if self.now_ns() >= until_ns:
                break
        session.submit(Opcode.STOP)
        while not session.settled and self.now_ns() < until_ns + SETTLE_NS:
            self.connection.pump(0.005)

    def close(self) -> None:
        """Close its port."""
        if self._connection is None:
            self._link.close()
        else:
            self._connection.close()

    def facts(self) -> dict[str, Any]:
        """What the summary says about it."""
        if self._connection is None:
            return {"url": self.url}
        welcome = self.connection.session.welcome
        fit = None if self.connection.clock is None else self.connection.clock.fit
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
        start_tick = self.connection.known_clock().to_tick(now_ns + ARM_LEAD_NS)
        self.connection.session.submit(Opcode.ARM, pack_arm(Arm(start_tick, 0, LEASE_MS)))
        self._arm_sent_ns = now_ns


def idle_plan(profile: Profile) -> Plan:
    """Return a plan of one dark exposure per second, the shortest that `profile` carries."""
    ticks = ticks_of(profile, max(profile.exposure.min_us, 1e6 / profile.clock.tick_hz))
    return Plan(
        mode=profile.mode,
        n_patterns=1,
        slot_offset_ticks=np.zeros(1, np.int64),
        slot_pattern=np.full(1, DARK_PATTERN, np.uint16),
        slot_shot=np.full(1, NO_SHOT, np.uint16),
        exposure_ticks=ticks.exposure,
        slot_period_ticks=ticks.spacing,
        cycle_ticks=max(profile.clock.tick_hz, ticks.spacing),
        shots_per_cycle=1,
        cycles_per_object=1,
        block_exposures=1,
        exposure_us=ticks.exposure * 1e6 / profile.clock.tick_hz,
    )
