"""A bench for the simulated instrument: a host that sends what it is told at the tick it is told, and keeps every answer."""

from __future__ import annotations

from typing import Any

import numpy as np

from pans.bundle.automaton import Automaton
from pans.decide.plan.plan import Plan
from pans.decide.plan.plan_codec import plan_commands
from pans.instrument.profile import Profile, load_profile
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, SLOT_DTYPE, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Arm, PatternChunk, PlanChunk, Show, mask_chunks, pack_command
from pans_sim.device.instrument import Instrument
from pans_sim.scene.still import load_scene

NONCE = 0x11223344
POWER_ON = 1000
IDEAL = load_profile("ideal")  # 1 MHz clock, exposures from 10 us, no readout


class Bench:
    """A host that sends what it is told at the tick it is told, and keeps every answer with the tick at which it came."""

    def __init__(self, profile: Profile = IDEAL, scene: Any = None, **options: Any) -> None:
        scene = load_scene("uniform") if scene is None else scene
        self.device = Instrument(profile, scene, power_on_tick=POWER_ON, **options)
        self.decoder = wire.FrameDecoder()
        self.command_id = 0
        self.got: list[tuple[int, Any]] = []

    def send(self, data: bytes) -> list[Any]:
        return self._keep(self.device.tick, self.device.step(self.device.tick, data))

    def run_to(self, tick: int) -> list[Any]:
        """Step from event to event until `tick`; return the messages that came."""
        messages = []
        while (due := self.device.next_event_tick()) is not None and due <= tick:
            messages += self._keep(due, self.device.step(due, b""))
        return messages + self._keep(tick, self.device.step(tick, b""))

    def _keep(self, tick: int, sent: bytes) -> list[Any]:
        frames = self.decoder.feed(sent)
        assert all(frame.session == self.device.session for frame in frames)
        messages = [wire.DECODERS[frame.type](frame.payload) for frame in frames]
        self.got += [(tick, message) for message in messages]
        return messages

    def hello(self) -> list[Any]:
        self.command_id = 0
        if self.device.session == NONCE:  # another host in between, or it would be a repetition
            self.device.step(self.device.tick, wire.encode_hello(NONCE + 1))
        return self.send(wire.encode_hello(NONCE))

    def command(self, opcode: int, body: bytes = b"", command_id: int | None = None) -> Any:
        if command_id is None:
            self.command_id = command_id = self.command_id + 1
        answers = self.send(wire.encode_command(command_id, opcode, body, NONCE))
        acks = [answer for answer in answers if isinstance(answer, wire.Ack)]
        assert len(acks) == 1
        return acks[0]

    def done(self, opcode: int, body: bytes = b"") -> None:
        ack = self.command(opcode, body)
        assert ack.refused_id != ack.last_id, ack.text

    def refused(self, opcode: int, body: bytes = b"") -> tuple[int, str]:
        ack = self.command(opcode, body)
        assert ack.last_id == ack.refused_id == self.command_id
        return ack.status, ack.text

    def gate_open(self, channel: int) -> bool:
        return self.device.gates.is_open(channel, self.device.tick)

    def grant(self, limit: int = 1 << 30, lease_ms: int = 0) -> list[Any]:
        return self.send(wire.encode_grant(wire.Grant(limit, lease_ms), NONCE))

    def upload(self, levels: np.ndarray, shown: list[int], **changes: Any) -> None:
        for index, row in enumerate(levels):
            self.done(Opcode.LOAD_PATTERN, pack_command(PatternChunk(index, 0, len(row), row)))
        self.done(Opcode.LOAD_PLAN, pack_command(plan(len(levels), shown, **changes)))

    def load(self, levels: np.ndarray, made: Plan) -> None:
        """Load patterns of two levels and a plan, and open the window."""
        for masks in mask_chunks(levels):
            self.done(Opcode.LOAD_MASKS, pack_command(masks))
        for opcode, body in plan_commands(made):
            self.done(opcode, body)
        self.grant()

    def ready(self, levels: np.ndarray | None = None, shown: list[int] | None = None, **changes: Any) -> Bench:
        levels = np.full((2, 4), 100, np.uint16) if levels is None else levels
        self.hello()
        self.upload(levels, [0, 1, DARK_PATTERN] if shown is None else shown, **changes)
        return self

    def arm(self, start: int = 2000, cycles: int = 2, lease_ms: int = 100) -> Bench:
        self.done(Opcode.ARM, pack_command(Arm(start, cycles, lease_ms)))
        return self

    def granted(self) -> Bench:
        self.grant()
        return self


def greeted(*args: Any, **options: Any) -> Bench:
    bench = Bench(*args, **options)
    bench.hello()
    return bench


def slots_at(patterns: list[int], period: int = 100) -> np.ndarray:
    slots = np.zeros(len(patterns), SLOT_DTYPE)
    slots["offset_ticks"] = np.arange(len(patterns)) * period
    slots["pattern"] = patterns
    return slots


def plan(n_patterns: int, patterns: list[int], **changes: Any) -> PlanChunk:
    """Exposures of 80 ticks every 100, one cycle per object, unless changed."""
    slots = slots_at(patterns)
    head = PlanChunk(0, n_patterns, len(slots), 0, 80, 100, 100 * len(slots), 16, 1, slots)
    return head._replace(**changes)


def of_type(messages: list[Any], kind: type) -> list[Any]:
    return [message for message in messages if isinstance(message, kind)]


def stamps_and_readings(messages: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return what is stamped on the exposures of all blocks, and what was read in them."""
    blocks = of_type(messages, wire.ClickBlock)
    return np.concatenate([block.patterns for block in blocks]), np.concatenate([block.bits for block in blocks])


def show(automaton: Automaton, state: int, exposure: int) -> Show:
    """Return the command that names a state for an exposure."""
    return Show(exposure, state, int(automaton.pattern[state]), int(automaton.dwell[state]), automaton.dwell_steps)


def run_hosted(bench: Bench, made: Plan, automaton: Automaton, cycles: int) -> tuple[np.ndarray, np.ndarray]:
    """Arm and name every state as soon as the reading before it is known."""
    start = bench.device.tick + 2000
    bench.done(Opcode.ARM, pack_command(Arm(start, cycles, 1_000_000)))
    slots, node, messages = made.slots_per_cycle, 0, []
    for exposure in range(cycles * slots):
        cycle, slot = divmod(exposure, slots)
        node = node if slot else 0
        shown = made.slot_pattern[slot] == ADAPTIVE_PATTERN and node < automaton.n_states
        if shown:
            bench.done(Opcode.SHOW, pack_command(show(automaton, node, exposure)))
        end = start + cycle * made.cycle_ticks + int(made.slot_offset_ticks[slot]) + made.exposure_ticks
        (block,) = of_type(bench.run_to(end), wire.ClickBlock)
        messages.append(block)
        node = int(automaton.successors[node, int(block.bits[0])]) if shown else node
    return stamps_and_readings(messages)
