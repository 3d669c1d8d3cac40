"""The instrument as a state machine without I/O: bytes and ticks in, bytes out (docs/reference/protocol.md is its specification).

`Instrument.step(tick, data)` moves device time to `tick`, takes what the host sent by then and returns what the device has sent.
Whatever arrives, it answers, refuses or counts; it never raises over bytes and never allocates beyond its limits.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from pans.bundle.sensor import Analyser
from pans.instrument.profile import Profile
from pans.protocol.wire import (
    AckStatus,
    Arm,
    DeviceState,
    Extension,
    Frame,
    Gate,
    MaskChunk,
    MessageType,
    Opcode,
    PatternChunk,
    PlanChunk,
    ReadCounts,
    Show,
    StateReason,
    unpack_command,
    unpack_states,
)
from pans.protocol.wire import messages as wire
from pans_sim.scene.light import Table
from pans_sim.scene.moving import SceneFile
from pans_sim.scene.program import Program
from pans_sim.scene.still import Scene

from .clock import BUFFER_MESSAGES
from .facts import Now, facts_of, largest_number
from .gates import Gates
from .sequential import MAX_LEASE_MS, Measurement, check_arm
from .states import ShowList, StateMemory, piece_of
from .stream_buffer import U32, StreamBuffer
from .upload import MAX_PATTERN_PIXELS, PatternMemory, PlanMemory, Refused
from .view import View
from .walking import PatternLight

if TYPE_CHECKING:
    from .parallel import FrameRun

NEVER = 1 << 64


class Instrument:
    """A simulated instrument from power-on; `step` and `next_event_tick` are all that a shell needs."""

    def __init__(
        self,
        profile: Profile,
        scene: Scene | SceneFile,
        *,
        seed: int = 0,
        power_on_tick: int = 0,
        epoch: int = 1,
        buffer_messages: int = BUFFER_MESSAGES,
        optics: Analyser | None = None,
        exposure_late_us: float = 0.0,
        exposure_short_us: float = 0.0,
    ) -> None:
        self.profile = profile
        scene = SceneFile(scene.name, scene) if isinstance(scene, Scene) else scene
        # by how much exposures begin later and are shorter than planned: a fault
        self._late_ticks, short_ticks = (
            round(us * 1e-6 * profile.clock.tick_hz) for us in (exposure_late_us, exposure_short_us)
        )
        self.view = View(profile, scene, optics, seed, short_ticks)
        self.view.check_and_warm_up()
        self.decoder = wire.FrameDecoder()
        self.state, self.reason = DeviceState.IDLE, StateReason.POWER_ON
        self.session = 0  # the host's nonce; 0 before the first HELLO
        self.gates = Gates()
        self._epoch, self._tick, self._tick_hz = epoch, power_on_tick, profile.clock.tick_hz
        self._draws = 0  # exposures drawn in earlier runs
        projector = profile.projector
        # what the clicks choose must be shown one after another
        automata = profile.mode == "sequential" and optics is None
        self.extension = Extension(projector.automaton_states, projector.dwell_steps) if automata else None
        self.number_max = largest_number(profile) if automata else 1  # of a detector that counts photons
        self.channels_max = profile.detector.channels if automata else 1  # detectors that are read at once
        self.stream = StreamBuffer(buffer_messages)
        self._out: list[bytes | memoryview] = []
        self._forget_session()

    def _forget_session(self) -> None:
        projector = self.profile.projector
        pixels = min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS)
        self._patterns = PatternMemory(projector.pattern_memory, pixels, projector.levels)
        self._plan = PlanMemory(self.profile, adaptive=self.extension is not None)
        turn_ticks = math.ceil(self.profile.timing.device_turn_us * self._tick_hz / 1e6)
        self._states = StateMemory(self.extension or Extension(0, 1), turn_ticks, self.number_max, self.channels_max)
        self._shows: ShowList | None = None  # of a run that the host drives
        self._light: tuple[tuple[int, int, int, bool, bytes], Table | PatternLight] | None = None
        self._ack = wire.Ack(0, 0, AckStatus.DONE, "")
        self._run: Measurement | FrameRun | None = None
        self._errors = 0, 0  # of its exposures' start and length, in ticks
        self._lease_tick: int | None = None
        self._status_tick: int | None = None
        self._exposures_ended = self._exposures_told = 0
        self.stream.limit = 0
        self.stream.restart()

    @property
    def tick(self) -> int:
        """Device time of the latest step."""
        return self._tick

    @property
    def projector_lit(self) -> bool:
        """Whether light can leave the projector: in a run, and in no other state."""
        return self.state is DeviceState.RUNNING

    # -- time ----------------------------------------------------------------------------------------------------------

    def step(self, tick: int, data: bytes) -> bytes:
        """Advance to `tick` (never back), digest `data` as having arrived then, and return all bytes sent by then."""
        if tick < self._tick:
            raise ValueError(f"device time cannot go back: at {self._tick}, asked for {tick}")
        while True:
            due, what = self._next_event()
            if self.state is DeviceState.RUNNING and self._run is not None:
                self._out += self.stream.put_due(self._run, min(due, tick), self.session)
            if due > tick:
                break
            self._tick = due
            self._happen(what)
        self._tick = tick
        if data:
            for frame in self.decoder.feed(data):
                self._receive(frame)
        sent = b"".join(self._out)
        self._out.clear()
        return sent

    def next_event_tick(self) -> int | None:
        """Tick at which the device does something by itself next; None when it only waits for the host."""
        due, _ = self._next_event()
        if self.state is DeviceState.RUNNING and self._run is not None and (message := self._run.next_tick) is not None:
            due = min(due, message)
        return None if due == NEVER else due

    def draw_ahead(self) -> bool:
        """Do a piece of work that will be needed: for shells that have nothing else to do. Whether there was any."""
        return self._run is not None and self._run.draw_ahead()

    def _next_event(self) -> tuple[int, str]:
        """The earliest event but for the stream's messages, which go before it; at the same tick in the order end, lease, status."""
        due, what = NEVER if self._status_tick is None else self._status_tick, "status"
        if self._run is None:
            return due, what
        if self._lease_tick is not None and self._lease_tick <= due:
            due, what = self._lease_tick, "lease"
        if self.state is DeviceState.ARMED:
            return (self._run.start_tick, "start") if self._run.start_tick <= due else (due, what)
        end = self._run.end_tick
        return (end, "end") if end is not None and end <= due else (due, what)

    def _happen(self, what: str) -> None:
        if what == "status":
            self._send_status()
        elif what == "start":
            self._enter(DeviceState.RUNNING, StateReason.NONE)
        elif what == "end":
            self._end_run(DeviceState.IDLE, StateReason.COMPLETED)
        elif what == "lease":
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
            self._out += self.stream.put(rest, self.session)
        self._exposures_ended = run.ended_by(self._tick)
        self._draws += run.begun_by(self._tick)
        self._run = self._lease_tick = self._shows = None
        if reason is not StateReason.COMPLETED:
            self.gates.close_all(self._tick)
        self._enter(state, reason)

    # -- what the device sends -----------------------------------------------------------------------------------------

    def _send_status(self) -> None:
        if not self.session:
            return
        self._status_tick = self._tick + self._tick_hz
        left = 0 if self._lease_tick is None else (self._lease_tick - self._tick) * 1000 // self._tick_hz
        following = self._exposures_ended if self._run is None else self._run.begun_by(self._tick)
        self._send_exposed(self._exposures_ended if self._run is None else self._run.ended_by(self._tick))
        status = wire.Status(self.state, self.reason, left, self.stream.dropped_exposures & U32, self._tick, following)
        self._out.append(wire.encode_status(status, self.session))

    def _send_exposed(self, ended: int) -> None:
        """Tell when the exposures happened that have ended since it was told last: all are off alike, so the first stands for them."""
        told, self._exposures_told = self._exposures_told, ended
        if ended > told:
            exposed = wire.Exposed(ended - told, *self._errors, told, told)
            self._out.append(wire.encode_exposed(exposed, self.session))

    # -- what the device receives --------------------------------------------------------------------------------------

    def _receive(self, frame: Frame) -> None:
        try:
            if frame.type == MessageType.HELLO:
                self._hello(frame)
            elif not self.session or frame.session != self.session:
                return
            elif frame.type == MessageType.PING:
                ping = wire.Ping(*wire.fields("PING", frame.payload))
                pong = wire.Pong(ping.probe_id, ping.host_ns, self._tick, self._tick)
                self._out.append(wire.encode_pong(pong, self.session))
            elif frame.type == MessageType.GRANT:
                self._grant(wire.Grant(*wire.fields("GRANT", frame.payload)))
            elif frame.type == MessageType.COMMAND:
                self._command(wire.decode_command(frame.payload))
        except wire.MalformedMessage:
            return  # nothing says what it was: the host asks again

    def _hello(self, frame: Frame) -> None:
        hello = wire.Hello(*wire.fields("HELLO", frame.payload, exact=False))
        if not frame.session:
            raise wire.MalformedMessage("HELLO without a nonce")
        if frame.session == self.session and hello == (wire.SCHEMA, wire.PROTOCOL_VERSION):
            # A repetition: starting afresh here would let commands that came in between be executed twice.
            self._out.append(wire.encode_welcome(self._facts(), self.session))
            self._send_status()
            return
        self._end_run(DeviceState.IDLE, StateReason.STOPPED)
        self._forget_session()
        self._out.append(wire.encode_welcome(self._facts(), frame.session))
        # Another schema would misread every further byte: say who we are and go no further.
        same = hello == (wire.SCHEMA, wire.PROTOCOL_VERSION)
        self.session = frame.session if same else 0
        self._send_status()

    def _facts(self) -> dict[str, Any]:
        now = Now(self._epoch, self._tick, self.stream.capacity)
        return facts_of(self.view, self.extension, self.number_max, now)

    def _grant(self, grant: wire.Grant) -> None:
        if self._run is not None and grant.lease_ms:
            self._renew(grant.lease_ms)
        self._out += self.stream.grant(grant.stream_limit)

    def _renew(self, lease_ms: int) -> None:
        self._lease_tick = self._tick + max(1, min(lease_ms, MAX_LEASE_MS) * self._tick_hz // 1000)

    def _command(self, command: wire.CommandMessage) -> None:
        expected = self._ack.last_id + 1
        if command.command_id == expected:
            mask = self._ack.refused_mask << 1 & U32
            self._ack = self._ack._replace(last_id=expected, refused_mask=mask)
            try:
                self._execute(command)
            except Refused as refusal:
                self._ack = wire.Ack(expected, expected, refusal.status, refusal.text, mask | 1)
            except wire.MalformedMessage as error:
                self._ack = wire.Ack(expected, expected, AckStatus.MALFORMED, str(error), mask | 1)
        self._out.append(wire.encode_ack(self._ack, self.session))

    # -- commands ------------------------------------------------------------------------------------------------------

    def _execute(self, command: wire.CommandMessage) -> None:
        opcode, body = command.opcode, command.body
        if opcode == Opcode.LOAD_PATTERN:
            self._require_idle("LOAD_PATTERN")
            if self.view.optics is not None:
                raise Refused(AckStatus.OUT_OF_RANGE, "passive optics: there is no projector to show a pattern")
            self._patterns.load(unpack_command(PatternChunk, body))
        elif opcode in (Opcode.LOAD_MASKS, Opcode.LOAD_STATES, Opcode.SHOW) and self.extension is not None:
            self._automaton(Opcode(opcode), body)
        elif opcode in (Opcode.READ_COUNTS, Opcode.LOAD_COUNT_STATES) and max(self.number_max, self.channels_max) > 1:
            self._counts(Opcode(opcode), body)
        elif opcode == Opcode.LOAD_PLAN:
            self._require_idle("LOAD_PLAN")
            chunk = unpack_command(PlanChunk, body)
            self._plan.load(chunk)
            if chunk.first_slot == 0:
                self._states.forget()
            if self._plan.program is not None:
                with suppress(Refused):  # ARM says what is wrong
                    self._light_table(self._plan.program)  # seconds for many pictures in flow: ARM must not wait for it
        elif opcode == Opcode.ARM:
            self._require_idle("ARM")
            self._arm(unpack_command(Arm, body))
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

    def _automaton(self, opcode: Opcode, body: bytes) -> None:
        """The commands of protocol.md, section 11."""
        if opcode == Opcode.SHOW:
            run, shows, program = self._run, self._shows, self._plan.program
            if run is None or shows is None or program is None:
                raise Refused(AckStatus.WRONG_STATE, "SHOW needs a run whose states the host names")
            shows.put(unpack_command(Show, body), program, run.begun_by(self._tick), run.n_exposures)
            return
        self._require_idle(opcode.name)
        if opcode == Opcode.LOAD_MASKS:
            self._patterns.load_masks(unpack_command(MaskChunk, body))
            return
        self._states.load(piece_of(unpack_states(opcode, body)), self._plan.program)
        if self._states.states is not None:
            from . import readings

            readings.warm_up()  # ARM must not wait for a compiler

    def _counts(self, opcode: Opcode, body: bytes) -> None:
        """The commands of protocol.md, section 13."""
        from . import readings

        self._require_idle(opcode.name)
        program = self._plan.program
        if opcode == Opcode.LOAD_COUNT_STATES:
            self._states.load(piece_of(unpack_states(opcode, body)), program)
            return
        asked = unpack_command(ReadCounts, body)
        self._states.read_counts(asked, program)
        readings.warm_up(self._states.largest + 1, self._states.channels)
        if program is not None:
            with suppress(Refused):  # ARM says what is wrong
                self._light_table(program)

    def _require_idle(self, what: str) -> None:
        if self.state is not DeviceState.IDLE:
            hint = ": RESET leaves it" if self.state is DeviceState.SAFE else ""
            raise Refused(AckStatus.WRONG_STATE, f"{what} needs IDLE, the device is {self.state.name}{hint}")

    def _arm(self, arm: Arm) -> None:
        program = self._plan.program
        if program is None:
            raise Refused(AckStatus.WRONG_STATE, "no complete plan is loaded")
        check_arm(program, arm, self._tick, self._tick_hz)
        if self._states.begun:
            raise Refused(AckStatus.WRONG_STATE, "some states of the automaton have not come")
        states = self._states
        shows = ShowList(states.extension, states.channels) if program.adaptive and states.states is None else None
        drive = states.states if shows is None else shows
        reading = ReadCounts(states.largest, states.channels)
        begun = arm._replace(start_tick=arm.start_tick + self._late_ticks)
        self._errors = begun.start_tick - arm.start_tick, self.view.exposure_ticks(program) - program.exposure_ticks
        self._run = self.view.run(program, begun, self._light_table(program), self._draws, drive, reading)
        self._shows = shows
        self.stream.restart()
        self._exposures_ended = self._exposures_told = 0
        self._renew(arm.lease_ms)
        self._enter(DeviceState.ARMED, StateReason.NONE)

    def _light_table(self, program: Program) -> Table | PatternLight:
        """Return the table of this pattern set at this exposure, computed at most once for each."""
        largest, stay = self._states.largest, self.view.stay(program)
        one_by_one = program.adaptive or largest > 1
        key = (self._patterns.revision, program.n_patterns, program.exposure_ticks, one_by_one, stay)
        if self._light is None or self._light[0] != key:
            patterns = self._patterns.stack(program.n_patterns) if self.view.optics is None else None
            self._light = (key, self.view.tabulate(program, patterns, largest))
        return self._light[1]

    def _gate(self, body: bytes) -> None:
        gate = unpack_command(Gate, body)
        if self.state not in (DeviceState.ARMED, DeviceState.RUNNING):
            raise Refused(AckStatus.WRONG_STATE, f"GATE needs a run, the device is {self.state.name}")
        self.gates.add(gate, self._tick)
