"""Strange bytes and frames for decoder, instrument, session, core and compiled turn, and the limits that all of them keep.

Owns the making of the input and the limits; how much is sent, fuzz.py says. Random bytes go to the decoder and through the whole
instrument; structured frames have a right CRC and strange contents. Never changes what it tests.
"""

from __future__ import annotations

import collections
import functools
import random
import struct
import time
from dataclasses import dataclass

import numpy as np

from pans.firmware_sim.checks import flowing
from pans.firmware_sim.checks.flow_stream import FlowStream
from pans.firmware_sim.checks.strange import StrangeCommands
from pans.firmware_sim.checks.twin import SocketTwin
from pans.firmware_sim.device import counting, walk_kernels
from pans.firmware_sim.device.gates import MAX_KEPT_PULSES
from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.device.states import MAX_SHOWS
from pans.firmware_sim.device.upload import MAX_UPLOAD_BYTES
from pans.firmware_sim.scene.still import Scene, load_scene
from pans.firmware_sim.testing import following_profile, small_setup
from pans.runtime.core.decision import Decision
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.errors import LinkError
from pans.runtime.flow.core import FlowCore
from pans.runtime.turn.streaming import StreamCore
from pans.runtime.turn.system import offered
from pans.runtime.wire import messages as wire
from pans.runtime.wire.messages import Mark, MessageType, Opcode, encode_counts
from pans.runtime.wire.session import MAX_KEPT, HostSession

# Of processor time: one piece or frame takes microseconds, the longest gap that is believed about a second.
MAX_CALL_S = 5.0
NONCE = 0x5EED
WALKS = ("device-driven", "host-driven", "device-driven-counts", "device-driven-detectors")
MODES = ("sequential", "parallel", *WALKS, *flowing.KINDS)
HOST_TYPES = (MessageType.HELLO, MessageType.PING, MessageType.COMMAND, MessageType.GRANT)
DEVICE_TYPES = tuple(kind for kind in MessageType if kind >= 0x80)


@functools.cache
def _setup(mode: str) -> tuple[Plan, Decider]:
    _, bundle, plan = small_setup(mode)
    return plan, make_decider(bundle, shots=1, backend="table" if bundle.automaton is None else "automaton")


@functools.cache
def _flow(mode: str) -> flowing.SmallFlow:
    return flowing.small_flow(mode)


def plan_of(mode: str) -> Plan:
    """Return the plan of one of MODES."""
    return _flow(mode).plan if mode in flowing.KINDS else _setup(mode)[0]


def fuzzed_core(mode: str) -> Core | FlowCore:
    """Return a core for the plan of `mode`, without an end."""
    return _flow(mode).core(0) if mode in flowing.KINDS else Core(*_setup(mode), 1, 0)


def fuzzed_stream(mode: str) -> StreamCore:
    """Return the streaming core for the plan of `mode`, which is no flow's."""
    return StreamCore(*_setup(mode), 1, 0, NONCE)


def _twin_of(mode: str) -> StreamCore | FlowStream | None:
    """The compiled turn of a new host of `mode`, begun; None where this machine has none, or the plan's blocks are COUNTS."""
    if offered() or plan_of(mode).largest > 1:
        return None
    core = fuzzed_core(mode)
    twin = FlowStream(core, plan_of(mode), NONCE) if isinstance(core, FlowCore) else fuzzed_stream(mode)
    collections.deque(twin.begin(NONCE, 0, 0), 0)
    return twin


class CountingInstrument(Instrument):
    """An instrument that counts what it has carried out."""

    executed = armed = automata_armed = counting_armed = 0

    def _execute(self, command: wire.CommandMessage) -> None:
        super()._execute(command)
        self.executed += 1
        if command.opcode == Opcode.ARM:
            self.armed += 1
            self.automata_armed += self._plan.program is not None and self._plan.program.adaptive
            self.counting_armed += self._states.largest > 1


@functools.cache
def warm_up() -> None:
    """Compile or load what hosts and instruments need, once: who measures a call does not measure the compiler.

    The compiled turn too: a host that ends within judged bytes makes the next one there.
    """
    counting.warm_up()
    walk_kernels.warm_up()
    for mode in MODES:
        fuzzed_core(mode).warm_up()
        twin = _twin_of(mode)
        if twin is not None:
            twin.warm_up()


class LimitBroken(AssertionError):
    """A limit that the protocol or the module states did not hold."""


@dataclass(slots=True)
class FuzzCounts:
    """How much was sent, and how far it came: a fuzzer whose input is always refused at once proves little."""

    bytes: int = 0
    frames: int = 0
    frames_decoded: int = 0
    commands_executed: int = 0
    commands_refused: int = 0
    runs_armed: int = 0
    automata_armed: int = 0
    counting_armed: int = 0
    blocks_accepted: int = 0
    counts_accepted: int = 0  # of these, blocks of photon numbers, or of several detectors
    walks_accepted: int = 0  # of automata
    flow_accepted: int = 0  # of objects in flow
    decisions: int = 0
    compiled_bytes: int = 0  # random ones that the compiled turn has read from a socket
    compiled_frames: int = 0  # structured ones
    compiled_messages: int = 0  # that it has taken of both
    slowest_call_s: float = 0.0


class Fuzzer:
    """One seed: the same input on every machine."""

    def __init__(self, seed: int) -> None:
        warm_up()
        self.seed = seed
        self.counts = FuzzCounts()
        self._dice = random.Random(seed)
        self._strange = StrangeCommands(self._dice)
        self._profile = following_profile(channels=2)
        self._scene: Scene = load_scene("uniform")
        self._here = (0, 0, 0)  # sequence number and exposure that the host expects next
        self._decoder, self._compiled = wire.FrameDecoder(), wire.FrameDecoder()
        self._compiled.use_kernels()
        self._fresh_device()
        self._fresh_host()

    def random_bytes(self, size: int) -> None:
        """Send `size` bytes at the decoder, the instrument and the host, in pieces of all sizes."""
        data = self._strange_bytes(size)
        decoder, compiled = self._decoder, self._compiled
        position = 0
        while position < len(data):
            piece = data[position : position + self._dice.choice((1, 3, 64, 1000, 1 << 16))]
            position += len(piece)
            found = decoder.feed(piece)
            if compiled.feed(piece) != found:
                raise LimitBroken("the compiled decoder and the plain one disagree")
            self.counts.frames_decoded += len(found)
            self._device_takes(piece)
            self.counts.compiled_bytes += len(piece) * self._host_takes(piece)
        self.counts.bytes += len(data)
        if decoder.counters.bytes_in != self.counts.bytes:
            raise LimitBroken(f"the decoder counted {decoder.counters.bytes_in} of {self.counts.bytes} bytes")
        self._check_limits(decoder)
        if (compiled.counters, compiled.held_bytes) != (decoder.counters, decoder.held_bytes):
            raise LimitBroken(f"the decoders counted {decoder.counters} and, compiled, {compiled.counters}")

    def structured_frames(self, count: int) -> None:
        """Send `count` frames with a right CRC at the instrument and at the host, and what the instrument answers at the host."""
        at_host = count - count // 2
        for _ in range(count // 2):
            self._device_takes(self._frame_for_device())
        while at_host:
            bunch = min(at_host, self._dice.choice((1, 1, 3, 12)))  # that come in one read
            self._here = self._core.tracker.position
            frames = b"".join([self._frame_for_host() for _ in range(bunch)])
            self.counts.compiled_frames += bunch * self._host_takes(frames)
            at_host -= bunch
        self.counts.frames += count
        self._check_limits(self._device.decoder)
        if self._dice.random() < 0.02:
            self.count_device()
            self._fresh_device()
        if self._dice.random() < 0.2:
            self._fresh_host()

    # -- both ends -----------------------------------------------------------------------------------------------------

    def _fresh_device(self) -> None:
        self._device = CountingInstrument(self._profile, self._scene, seed=self.seed, buffer_messages=16)
        self._device.step(0, wire.encode_hello(NONCE))

    def _fresh_host(self) -> None:
        self._session = HostSession(NONCE)
        self._session.start(0)
        mode = self._dice.choice(MODES)
        self._core = fuzzed_core(mode)
        self._host_plan = plan_of(mode)
        self._core.begin(0, 0)
        self._host_decoder = wire.FrameDecoder()
        self._host_decoder.use_kernels()
        self._host_ns = 0
        twin = _twin_of(mode)
        self._twin = None if twin is None else SocketTwin(twin)

    def _device_takes(self, data: bytes) -> None:
        device = self._device
        tick = device.tick + self._dice.choice((0, 0, 1, 100, 20_000))
        started = time.process_time()
        sent = device.step(tick, data)
        self._judge_time(started, "instrument", data)
        if len(sent) > 1 << 24:
            raise LimitBroken(f"the instrument answered {len(data)} bytes with {len(sent)}")

    def _judge_time(self, started: float, who: str, data: bytes) -> None:
        taken_s = time.process_time() - started
        self.counts.slowest_call_s = max(self.counts.slowest_call_s, taken_s)
        if taken_s > MAX_CALL_S:
            raise LimitBroken(f"the {who} took {taken_s:.1f} s over {data[:100].hex()}, allowed {MAX_CALL_S}")

    def _host_takes(self, data: bytes) -> bool:
        """Let the host take bytes; return whether the compiled turn read them too, and agreed."""
        started = time.process_time()
        core, decisions = self._core, list[Decision]()
        self._host_digests(data, decisions)
        self._judge_time(started, "host", data)
        self.counts.decisions += len(decisions)
        if self._twin is None or core is not self._core:  # the session has ended within the bytes
            return False
        started = time.process_time()
        wrong = self._twin.takes(data, core, decisions)
        self._judge_time(started, "compiled turn", data)
        self.counts.compiled_messages += self._twin.took
        if wrong:
            raise LimitBroken(wrong)
        return True

    def _host_digests(self, data: bytes, decisions: list[Decision]) -> None:
        self._host_ns += 1_000_000
        counts, plan = self.counts, self._host_plan
        for frame in self._host_decoder.feed(data):
            try:
                if self._session.on_frame(frame, self._host_ns):
                    output = self._core.step(frame)
                    decisions += output.decisions
                    accepted = output.block_end_tick is not None
                    counts.blocks_accepted += accepted
                    counts.counts_accepted += accepted and plan.largest > 1
                    counts.walks_accepted += accepted and plan.automaton is not None
                    counts.flow_accepted += accepted and isinstance(self._core, FlowCore)
                if self._dice.random() < 0.1:
                    self._session.probe(self._host_ns)
                    self._session.submit(Opcode.GATE, b"", may_be_refused=True)
                self._session.poll(self._host_ns)
            except LinkError:  # what a session says that cannot go on: an allowed end
                self._fresh_host()
                return
            self._session.take_output()

    def _check_limits(self, decoder: wire.FrameDecoder) -> None:
        for name, one in (("decoder", decoder), ("instrument", self._device.decoder), ("host", self._host_decoder)):
            if one.held_bytes > wire.MAX_FRAME_BYTES:
                raise LimitBroken(f"the {name} holds {one.held_bytes} bytes, allowed {wire.MAX_FRAME_BYTES}")
        device = self._device
        if len(device.gates.pulses) > MAX_KEPT_PULSES or len(device.stream._held) > device.stream.capacity:
            raise LimitBroken("the instrument remembers more than its limits allow")
        held = sum(pattern.levels.nbytes for pattern in device._patterns._patterns.values())
        if held > MAX_UPLOAD_BYTES or held != device._patterns.held_bytes:
            raise LimitBroken(
                f"the instrument holds {held} bytes of patterns, and counts {device._patterns.held_bytes}"
            )
        if device._shows is not None and len(device._shows) > MAX_SHOWS:
            raise LimitBroken(f"the instrument remembers {len(device._shows)} names of exposures")
        if max(len(self._session.pongs), len(self._session.refusals)) > MAX_KEPT or len(self._core.marks) > 4096:
            raise LimitBroken("the host remembers more than its limits allow")

    def count_device(self) -> None:
        """Add up what the present instrument has carried out."""
        self.counts.commands_refused += self._device.counters.refused
        self.counts.commands_executed += self._device.executed
        self.counts.runs_armed += self._device.armed
        self.counts.automata_armed += self._device.automata_armed
        self.counts.counting_armed += self._device.counting_armed

    # -- strange input -------------------------------------------------------------------------------------------------

    def _strange_bytes(self, size: int) -> bytes:
        dice = self._dice
        kind = dice.randrange(4) if self.counts.bytes else 3  # a short run meets damaged frames too
        if kind == 0:
            return dice.randbytes(size)
        if kind == 1:  # mostly delimiters and codes at their edges
            return bytes(dice.choices((0, 1, 2, 254, 255, 129, 3), k=size))
        if kind == 2:  # long runs without an end
            return bytes([dice.choice((1, 2, 255))]) * size
        frames = bytearray()
        while len(frames) < size:  # good frames with damage
            frame = bytearray(self._frame_for_device() if dice.random() < 0.5 else self._frame_for_host())
            for _ in range(dice.randrange(3)):
                frame[dice.randrange(len(frame))] ^= 1 << dice.randrange(8)
            frames += frame
        return bytes(frames[:size])

    def _frame_for_device(self) -> bytes:
        dice = self._dice
        kind = dice.choices((*HOST_TYPES, dice.randrange(256)), (1, 10, 60, 10, 2))[0]
        session = self._device.session if dice.random() < 0.97 else self._strange.number(32)
        if kind == MessageType.HELLO and dice.random() < 0.5:
            return wire.encode_hello(NONCE + dice.randrange(2))
        if kind == MessageType.PING:
            return wire.encode_ping(self._strange.number(32), self._strange.number(64), session)
        if kind == MessageType.GRANT:
            return wire.encode_grant(wire.Grant(self._strange.number(32), self._strange.number(32)), session)
        if kind == MessageType.COMMAND:
            return self._strange.command(self._device, session)
        return wire.encode_frame(kind, dice.randbytes(dice.choice((0, 1, 8, 36, 300))), session)

    def _frame_for_host(self) -> bytes:
        dice, plan = self._dice, self._host_plan
        often = MessageType.COUNTS if plan.largest > 1 else MessageType.CLICKS
        often = MessageType.FRAMES if plan.mode == "parallel" else often
        kind = dice.choice((*DEVICE_TYPES, often, often, often, often, dice.randrange(256)))
        session = NONCE if dice.random() < 0.97 else self._strange.number(32)
        if kind in (MessageType.CLICKS, MessageType.FRAMES, MessageType.COUNTS) and dice.random() < 0.9:
            return self._block(MessageType(kind), session)
        if kind == MessageType.MARK and dice.random() < 0.7:
            seq, exposure, _ = self._here
            self._here = (seq + 1, exposure, 0)
            tick = exposure * plan.slot_period_ticks
            mark = Mark(seq, dice.randrange(9), dice.randrange(-1, 3), exposure, tick, 1.0, 9)
            return wire.encode_mark(mark, session)
        layouts = {
            MessageType.PONG: "<IQQQ", MessageType.ACK: "<IIIHH", MessageType.STATUS: "<BBHIIQQ", MessageType.MARK: "<IIhHQQf",
            MessageType.WELCOME: "<IHH", MessageType.CLICKS: "<IIQQIHHI", MessageType.FRAMES: "<IIQQIHHI",
            MessageType.COUNTS: "<IIQQIHHI",
        }  # fmt: skip
        size = struct.calcsize(layouts.get(MessageType(kind), "<I")) if kind in set(MessageType) else dice.randrange(64)
        body = bytearray(dice.randbytes(size)) if dice.random() < 0.7 else bytearray(size)
        if kind == MessageType.ACK and dice.random() < 0.9:
            body[:4] = struct.pack("<I", dice.randrange(12))
            body[-2:] = b"\0\0"
        if kind == MessageType.WELCOME and dice.random() < 0.9:
            body = bytearray(struct.pack("<IHH", wire.SCHEMA, wire.PROTOCOL_VERSION, 0))
            body += dice.choice((b"\x80", b"\x81\xa1a\x01", b"\xdf\xff\xff\xff\xff", dice.randbytes(20)))
        return wire.encode_frame(kind, bytes(body) + dice.randbytes(dice.choice((0, 0, 0, 1, 9))), session)

    def _block(self, kind: MessageType, session: int) -> bytes:
        """Exposures of all kinds; most are what the plan has next, so that some get as far as the windows."""
        dice, plan = self._dice, self._host_plan
        next_seq, next_exposure, _ = self._here
        count = dice.randrange(1, 6)
        good = dice.random() < 0.94  # a long gap takes Python a decision for each window in it
        seq = next_seq if good else self._strange.number(32)
        first = next_exposure + dice.choice((0,) * 9 + (1, 50)) if good else self._strange.number(64)
        cycle, slot = divmod(first, plan.slots_per_cycle)
        stamps = np.array([dice.choice((0, 1, 2, 3, 5, 6, 0xFFFF)) for _ in range(count)], np.uint16)
        if good and dice.random() < 0.9:
            tick = cycle * plan.cycle_ticks + int(plan.slot_offset_ticks[slot])
            head = (seq, 0, tick, first, plan.slot_period_ticks, wire.NO_OBJECT)
            count = dice.randrange(1, 1 + min(plan.block_exposures, plan.slots_per_cycle - slot))
            wanted = plan.slot_pattern[slot : slot + count]
            stamps = wanted if plan.automaton is None else np.arange(slot, slot + count, dtype=np.uint16) % 6
            if dice.random() < 0.2:
                stamps = np.array([dice.choice((0, 1, 2, 3, 5, 6, 0xFFFF)) for _ in range(count)], np.uint16)
            self._here = (seq + 1, first + count, 0)
        else:
            number = self._strange.number
            head = (seq, number(32), number(63), first, number(32), number(32))
        if kind == MessageType.CLICKS:
            return wire.encode_clicks(wire.ClickBlock(*head, stamps, self._clicks(count)), session)
        if kind == MessageType.COUNTS:
            largest = plan.largest if dice.random() < 0.8 else self._strange.number(16)
            numbers = np.array([dice.choice((0, 0, 1, 2, 2, 3)) for _ in range(count)], np.uint8)
            return encode_counts(wire.ClickBlock(*head, stamps, numbers, largest), session)
        width = dice.choice((-(-plan.n_patterns // 8), 8))
        lit = self._clicks(count)[:, None] * np.frombuffer(dice.randbytes(count * width), np.uint8).reshape(
            count, width
        )
        return wire.encode_frames(wire.FrameBlock(*head, np.ascontiguousarray(lit)), session)

    def _clicks(self, count: int) -> wire.U8:
        """Clicks, uint8 (count,): none, all, or some; in flow objects come and go with them."""
        often = self._dice.choice((0.0, 0.02, 0.5, 1.0))
        return np.array([self._dice.random() < often for _ in range(count)], np.uint8)
