"""The instrument as a sans-I/O state machine: bytes and ticks in, bytes out (docs/PROTOCOL.md is its specification).

Owns the session, commands, states, lease, receive window and gates; never reads a clock, sleeps or opens a port.
`Instrument.step(tick, data)` moves device time to `tick`, digests what the host sent by then and returns what the device has
sent. Whatever arrives, it answers, refuses or counts; it never raises over bytes and never allocates beyond its limits.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime import wire
from pans.runtime.errors import ConfigError
from pans.runtime.profile import Profile
from pans.runtime.wire import AckStatus, DeviceState, Frame, MessageType, Opcode, StateReason
from pans.runtime.wire_commands import Arm, unpack_arm, unpack_gate, unpack_pattern, unpack_plan

from .detector import DetectorModel, detector_model, first_click_probability
from .measurement import LightTable, Measurement, StreamMessage
from .optics import expected_photoelectrons
from .scene import Scene
from .upload import MAX_PATTERN_PIXELS, MAX_SLOTS, PatternMemory, PlanMemory, Program, Refused

FIRMWARE = "pans-sim 1"
BUFFER_MESSAGES = 256
GATE_CHANNELS = 8
MAX_PENDING_GATES = 256
MAX_LEASE_MS = 3_600_000
MAX_ARM_AHEAD_S = 3600
MAX_TICK = 1 << 62
_U32 = 0xFFFFFFFF


@dataclass(slots=True)
class InstrumentCounters:
    """What the instrument has seen since power-on; nothing is dropped without one of these moving."""

    sessions: int = 0
    foreign_session: int = 0
    unknown_type: int = 0
    malformed: int = 0
    refused: int = 0
    repeated_commands: int = 0
    commands_out_of_order: int = 0
    dropped_messages: int = 0
    lease_expiries: int = 0


class GatePulse(NamedTuple):
    """One accepted actuation: output `channel` opens at `tick` and closes at `end_tick`, unless cut short."""

    tick: int
    end_tick: int
    channel: int


class Instrument:
    """A simulated instrument from power-on; `step` and `next_event_tick` are all that a shell needs."""

    def __init__(
        self,
        profile: Profile,
        scene: Scene,
        *,
        seed: int = 0,
        power_on_tick: int = 0,
        epoch: int = 1,
        buffer_messages: int = BUFFER_MESSAGES,
    ) -> None:
        self.profile = profile
        self.scene = scene
        self.counters = InstrumentCounters()
        self.decoder = wire.FrameDecoder()
        self.state, self.reason = DeviceState.IDLE, StateReason.POWER_ON
        self.session = 0  # the host's nonce; 0 before the first HELLO
        self.gate_pulses: deque[GatePulse] = deque(maxlen=4096)  # ground truth for tests: what was actuated, and when
        self._seed, self._epoch, self._tick, self._tick_hz = seed, epoch, power_on_tick, profile.clock.tick_hz
        self._draws = 0  # exposures drawn in earlier runs
        self._buffer: deque[tuple[int, bytes]] = deque()
        self._buffer_messages = buffer_messages
        self._out: list[bytes] = []
        self._forget_session()

    def _forget_session(self) -> None:
        projector = self.profile.projector
        pixels = min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS)
        self._patterns = PatternMemory(projector.pattern_memory, pixels, projector.levels)
        self._plan = PlanMemory(self.profile)
        self._light: tuple[tuple[int, int, int], LightTable] | None = None
        self._ack = wire.Ack(0, 0, AckStatus.DONE, "")
        self._run: Measurement | None = None
        self._lease_tick: int | None = None
        self._status_tick: int | None = None
        self._stream_limit = 0
        self._forget_stream()

    def _forget_stream(self) -> None:
        """Start numbering anew; the receive window stays, since the host may grant just before it arms."""
        self._buffer.clear()
        self._sequence = self._drops = self._exposures_ended = 0

    @property
    def tick(self) -> int:
        """Device time of the latest step."""
        return self._tick

    @property
    def projector_lit(self) -> bool:
        """Whether light can leave the projector: in a run, and in no other state."""
        return self.state is DeviceState.RUNNING

    def gate_open(self, channel: int) -> bool:
        """Whether output `channel` is open at the present tick."""
        return any(one.channel == channel and one.tick <= self._tick < one.end_tick for one in self.gate_pulses)

    # -- time ----------------------------------------------------------------------------------------------------------

    def step(self, tick: int, data: bytes) -> bytes:
        """Advance to `tick` (never back), digest `data` as having arrived then, and return all bytes sent by then."""
        if tick < self._tick:
            raise ValueError(f"device time cannot go back: at {self._tick}, asked for {tick}")
        while (event := self._next_event()) is not None and event[0] <= tick:
            self._tick = event[0]
            self._happen(event[1])
        self._tick = tick
        if data:
            for frame in self.decoder.feed(data):
                self._receive(frame)
        sent = b"".join(self._out)
        self._out.clear()
        return sent

    def next_event_tick(self) -> int | None:
        """Tick at which the device does something by itself next; None when it only waits for the host."""
        event = self._next_event()
        return None if event is None else event[0]

    def _next_event(self) -> tuple[int, str] | None:
        """The earliest event; at the same tick in the order start, message, end, lease, status."""
        run = self._run
        events: list[tuple[int | None, str]] = []
        if run is not None:
            if self.state is DeviceState.ARMED:
                events.append((run.start_tick, "start"))
            else:
                events += [(run.next_tick, "message"), (run.end_tick, "end")]
            events.append((self._lease_tick, "lease"))
        events.append((self._status_tick, "status"))
        due = [event for event in events if event[0] is not None]
        return min(due, key=lambda event: event[0], default=None)  # type: ignore[arg-type, return-value]

    def _happen(self, what: str) -> None:
        run = self._run
        if what == "status":
            self._send_status()
        elif what == "start":
            self._enter(DeviceState.RUNNING, StateReason.NONE)
        elif what == "message" and run is not None:
            self._stream(run.emit())
        elif what == "end":
            self._end_run(DeviceState.IDLE, StateReason.COMPLETED)
        elif what == "lease":
            self.counters.lease_expiries += 1
            self._end_run(DeviceState.SAFE, StateReason.LEASE_EXPIRED)

    def _enter(self, state: DeviceState, reason: StateReason) -> None:
        self.state, self.reason = state, reason
        self._send_status()

    def _end_run(self, state: DeviceState, reason: StateReason) -> None:
        """Leave ARMED or RUNNING: what was exposed is sent, the projector goes dark, gates close unless the run completed."""
        run = self._run
        if run is None:
            return
        rest = run.cut(self._tick)
        if rest is not None:
            self._stream(rest)
        self._exposures_ended = run.ended_by(self._tick)
        self._draws += run.begun_by(self._tick)
        self._run = self._lease_tick = None
        if reason is not StateReason.COMPLETED:
            self._close_gates()
        self._enter(state, reason)

    def _close_gates(self) -> None:
        now = self._tick
        kept = [one._replace(end_tick=min(one.end_tick, now)) for one in self.gate_pulses if one.tick <= now]
        self.gate_pulses.clear()
        self.gate_pulses.extend(kept)

    # -- what the device sends -----------------------------------------------------------------------------------------

    def _send_status(self) -> None:
        if not self.session:
            return
        self._status_tick = self._tick + self._tick_hz
        left = 0 if self._lease_tick is None else (self._lease_tick - self._tick) * 1000 // self._tick_hz
        following = self._exposures_ended if self._run is None else self._run.begun_by(self._tick)
        status = wire.Status(self.state, self.reason, left, self._drops & _U32, self._tick, following)
        self._out.append(wire.encode_status(status, self.session))

    def _send_ack(self) -> None:
        self._out.append(wire.encode_ack(self._ack, self.session))

    def _stream(self, message: StreamMessage) -> None:
        """Number a stream message and send it, hold it back, or drop it whole when the buffer is full."""
        if len(self._buffer) >= self._buffer_messages:
            self.counters.dropped_messages += 1
            self._drops += _exposures_in(message)
            return
        self._buffer.append((self._sequence, self._encode(message)))
        self._sequence = (self._sequence + 1) & _U32
        self._release()

    def _encode(self, message: StreamMessage) -> bytes:
        if isinstance(message, wire.Mark):
            return wire.encode_mark(message._replace(seq=self._sequence), self.session)
        if isinstance(message, wire.ClickBlock):
            return wire.encode_clicks(message._replace(seq=self._sequence, drops=self._drops & _U32), self.session)
        return wire.encode_frames(message._replace(seq=self._sequence, drops=self._drops & _U32), self.session)

    def _release(self) -> None:
        """Send what the receive window allows; sequence numbers compare modulo 2^32."""
        while self._buffer and 0 < (self._stream_limit - self._buffer[0][0]) & _U32 < 1 << 31:
            self._out.append(self._buffer.popleft()[1])

    # -- what the device receives --------------------------------------------------------------------------------------

    def _receive(self, frame: Frame) -> None:
        try:
            if frame.type == MessageType.HELLO:
                self._hello(frame)
            elif not self.session or frame.session != self.session:
                self.counters.foreign_session += 1
            elif frame.type == MessageType.PING:
                ping = wire.decode_ping(frame.payload)
                pong = wire.Pong(ping.probe_id, ping.host_ns, self._tick, self._tick)
                self._out.append(wire.encode_pong(pong, self.session))
            elif frame.type == MessageType.GRANT:
                self._grant(wire.decode_grant(frame.payload))
            elif frame.type == MessageType.COMMAND:
                self._command(wire.decode_command(frame.payload))
            else:
                self.counters.unknown_type += 1
        except wire.MalformedMessage:
            self.counters.malformed += 1

    def _hello(self, frame: Frame) -> None:
        hello = wire.decode_hello(frame.payload)
        if not frame.session:
            raise wire.MalformedMessage("HELLO without a nonce")
        self.counters.sessions += 1
        self._end_run(DeviceState.IDLE, StateReason.STOPPED)
        self._forget_session()
        self._out.append(wire.encode_welcome(self._facts(), frame.session))
        # Another schema would misread every further byte: say who we are and go no further.
        same = hello == (wire.SCHEMA, wire.PROTOCOL_VERSION)
        self.session = frame.session if same else 0
        self._send_status()

    def _facts(self) -> dict[str, Any]:
        profile = self.profile
        return {
            "firmware": FIRMWARE,
            "serial": f"SIM-{self._seed & _U32:08X}",
            "epoch": self._epoch,
            "tick_hz": self._tick_hz,
            "tick": self._tick,
            "mode": profile.mode,
            "channels": profile.detector.channels,
            "levels": profile.projector.levels,
            "pattern_memory": profile.projector.pattern_memory,
            "pattern_pixels": min(profile.projector.width_px * profile.projector.height_px, MAX_PATTERN_PIXELS),
            "slot_memory": MAX_SLOTS,
            "buffer_messages": self._buffer_messages,
            "simulated": True,
            "profile": profile.name,
            "gate_channels": GATE_CHANNELS,
            "scene": self.scene.name[:200],
            "objects": self.scene.n_objects,
            "seed": self._seed,
        }

    def _grant(self, grant: wire.Grant) -> None:
        self._stream_limit = grant.stream_limit
        if self._run is not None and grant.lease_ms:
            self._renew(grant.lease_ms)
        self._release()

    def _renew(self, lease_ms: int) -> None:
        self._lease_tick = self._tick + max(1, min(lease_ms, MAX_LEASE_MS) * self._tick_hz // 1000)

    def _command(self, command: wire.CommandMessage) -> None:
        expected = self._ack.last_id + 1
        if command.command_id == expected:
            self._ack = self._ack._replace(last_id=expected)
            try:
                self._execute(command)
            except Refused as refusal:
                self.counters.refused += 1
                self._ack = wire.Ack(expected, expected, refusal.status, refusal.text)
            except wire.MalformedMessage as error:
                self.counters.refused += 1
                self._ack = wire.Ack(expected, expected, AckStatus.MALFORMED, str(error))
        elif command.command_id < expected:
            self.counters.repeated_commands += 1
        else:
            self.counters.commands_out_of_order += 1
        self._send_ack()

    # -- commands ------------------------------------------------------------------------------------------------------

    def _execute(self, command: wire.CommandMessage) -> None:
        opcode, body = command.opcode, command.body
        if opcode == Opcode.LOAD_PATTERN:
            self._require_idle("LOAD_PATTERN")
            self._patterns.load(unpack_pattern(body))
        elif opcode == Opcode.LOAD_PLAN:
            self._require_idle("LOAD_PLAN")
            self._plan.load(unpack_plan(body))
        elif opcode == Opcode.ARM:
            self._require_idle("ARM")
            self._arm(unpack_arm(body))
        elif opcode == Opcode.GATE:
            self._gate(body)
        elif opcode in (Opcode.STOP, Opcode.RESET):
            if body:
                raise wire.MalformedMessage(f"{Opcode(opcode).name} has a body of {len(body)} bytes, expected none")
            self._end_run(DeviceState.IDLE, StateReason.STOPPED)
            if opcode == Opcode.RESET and self.state is DeviceState.SAFE:
                self._enter(DeviceState.IDLE, StateReason.NONE)
        else:
            raise Refused(AckStatus.UNKNOWN_OPCODE, f"opcode {opcode:#04x} is not in protocol {wire.PROTOCOL_VERSION}")

    def _require_idle(self, what: str) -> None:
        if self.state is not DeviceState.IDLE:
            hint = ": RESET leaves it" if self.state is DeviceState.SAFE else ""
            raise Refused(AckStatus.WRONG_STATE, f"{what} needs IDLE, the device is {self.state.name}{hint}")

    def _arm(self, arm: Arm) -> None:
        program = self._plan.program
        if program is None:
            raise Refused(AckStatus.WRONG_STATE, "no complete plan is loaded")
        if arm.start_tick <= self._tick:
            raise Refused(AckStatus.TOO_LATE, f"start tick {arm.start_tick} has passed, it is {self._tick}")
        if arm.start_tick > self._tick + MAX_ARM_AHEAD_S * self._tick_hz:
            raise Refused(AckStatus.OUT_OF_RANGE, f"start tick {arm.start_tick} is more than {MAX_ARM_AHEAD_S} s ahead")
        if not 0 < arm.lease_ms <= MAX_LEASE_MS:
            raise Refused(AckStatus.OUT_OF_RANGE, f"lease of {arm.lease_ms} ms: allowed 1..{MAX_LEASE_MS}")
        if arm.start_tick + max(program.cycle_ticks, program.n_slots) * arm.n_cycles >= MAX_TICK:
            raise Refused(AckStatus.OUT_OF_RANGE, f"{arm.n_cycles} cycles last beyond tick {MAX_TICK}")
        light = self._light_table(program)
        model = detector_model(self.profile, self._exposure_us(program))
        self._forget_stream()
        self._run = Measurement(program, arm, self.scene, light, model, self._seed, self._draws)
        self._renew(arm.lease_ms)
        self._enter(DeviceState.ARMED, StateReason.NONE)

    def _exposure_us(self, program: Program) -> float:
        return program.exposure_ticks * 1e6 / self._tick_hz

    def _light_table(self, program: Program) -> LightTable:
        """Return the table of this pattern set at this exposure, computed at most once for each."""
        key = (self._patterns.revision, program.n_patterns, program.exposure_ticks)
        if self._light is None or self._light[0] != key:
            exposure_us = self._exposure_us(program)
            levels = self._patterns.stack(program.n_patterns)
            try:
                photons = expected_photoelectrons(self.profile, self.scene, levels, exposure_us)
            except ConfigError as error:
                raise Refused(AckStatus.OUT_OF_RANGE, error.message) from error
            self._light = (key, _tabulate(photons, detector_model(self.profile, exposure_us)))
        return self._light[1]

    def _gate(self, body: bytes) -> None:
        gate = unpack_gate(body)
        if self.state not in (DeviceState.ARMED, DeviceState.RUNNING):
            raise Refused(AckStatus.WRONG_STATE, f"GATE needs a run, the device is {self.state.name}")
        if gate.tick <= self._tick:
            raise Refused(AckStatus.TOO_LATE, f"gate tick {gate.tick} has passed, it is {self._tick}")
        if gate.channel >= GATE_CHANNELS or not gate.duration_ticks:
            text = f"gate {gate.channel} for {gate.duration_ticks} ticks: channels are 0..{GATE_CHANNELS - 1}"
            raise Refused(AckStatus.OUT_OF_RANGE, text)
        if sum(one.tick > self._tick for one in self.gate_pulses) >= MAX_PENDING_GATES:
            raise Refused(AckStatus.OUT_OF_RANGE, f"{MAX_PENDING_GATES} gate pulses are pending already")
        self.gate_pulses.append(GatePulse(gate.tick, gate.tick + gate.duration_ticks, gate.channel))


def _tabulate(photons: NDArray[np.float64], model: DetectorModel) -> LightTable:
    with_dark = np.column_stack([photons, np.zeros(len(photons))])
    return LightTable(first_click_probability(model, with_dark), photons.sum(axis=1))


def _exposures_in(message: StreamMessage) -> int:
    if isinstance(message, wire.Mark):
        return 0
    return len(message.patterns) if isinstance(message, wire.ClickBlock) else len(message.words)
