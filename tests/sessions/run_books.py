"""The books of a run that are not the host's: the instrument's log of what it emits and executes, and a decoder on the wire."""

from __future__ import annotations

import hashlib
import random
from bisect import bisect_left
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from pans.protocol.links.base import Link
from pans.protocol.session import ANSWER_TYPES, STREAM_TYPES
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Gate, unpack_command
from pans_sim.device.clock import DeviceClock, SteppedDevice
from pans_sim.device.instrument import Instrument
from pans_sim.device.stream_buffer import StreamBuffer
from pans_sim.ports.virtual import VirtualLink

RECORDED = STREAM_TYPES | {wire.MessageType.STATUS, wire.MessageType.EXPOSED}
WAITS_NS = (0, 300_000, 3_000_000, 16_000_000)  # USB's frame is 1 ms, a serial adapter's latency timer up to 16 ms


class Emitted(NamedTuple):
    """One block as it left the detector; `dropped` when the device's buffer was full."""

    first: int
    stamps: np.ndarray
    readings: np.ndarray
    dropped: bool


def read_of(block: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return what is stamped on the exposures of a block, nothing on frames, and what was read in them."""
    return (block.patterns, block.bits) if isinstance(block, wire.ClickBlock) else (np.zeros(0), block.words)


@dataclass(slots=True)
class DeviceLog:
    """What the device did: blocks by session, commands (epoch, session, id), accepted pulses (session, gate, tick)."""

    messages: int = 0
    blocks: dict[int, list[Emitted]] = field(default_factory=dict)
    commands: list[tuple[int, int, int]] = field(default_factory=list)
    pulses: list[tuple[int, Gate, int]] = field(default_factory=list)

    def block(self, session: int, first: int) -> Emitted | None:
        """Return the block that a session's exposure `first` begins."""
        blocks = self.blocks.get(session, [])
        place = bisect_left(blocks, first, key=attrgetter("first"))
        return blocks[place] if place < len(blocks) and blocks[place].first == first else None


class _LoggedStream(StreamBuffer):
    log: DeviceLog

    def put(self, message: Any, session: int) -> list[bytes]:
        dropped = len(self._held) >= self.capacity
        self.log.messages += not dropped
        if not isinstance(message, wire.Mark):
            stamps, readings = (part.copy() for part in read_of(message))
            block = Emitted(message.exposure_index, stamps, readings, dropped)
            self.log.blocks.setdefault(session, []).append(block)
        return super().put(message, session)

    def put_due(self, run: Any, tick: int, session: int) -> Any:
        return self.put_each(run, tick, session)


class LoggedInstrument(Instrument):
    """An instrument that logs what it emits and executes."""

    log: DeviceLog

    def log_to(self, log: DeviceLog) -> LoggedInstrument:
        """Log to `log` from now on; call before the first step."""
        self.log, self.stream = log, _LoggedStream(self.stream.capacity)
        self.stream.log = log
        return self

    def _execute(self, command: Any) -> None:
        self.log.commands.append((self._epoch, self.session, command.command_id))
        super()._execute(command)

    def _gate(self, body: bytes) -> None:
        super()._gate(body)
        self.log.pulses.append((self.session, unpack_command(Gate, body), self.tick))


class SlowReads(VirtualLink):
    """A virtual link that brings what came within a while in a share `slow` of the reads, as some drivers do."""

    def __init__(self, device: SteppedDevice, clock: DeviceClock, name: str, seed: int, slow: float) -> None:
        super().__init__(device, clock, name)
        self._dice, self._slow = random.Random(seed), slow

    def read(self, timeout_s: float) -> bytes:
        data = super().read(timeout_s)
        wait_ns = self._dice.choice(WAITS_NS) if data and self._dice.random() < self._slow else 0
        if not wait_ns:
            return data
        self._step(self._now_ns + wait_ns, b"")
        later, self._arrived = self._arrived, b""
        return data + later


@dataclass(slots=True)
class Heard:
    """Messages that a recording must hold: how many, and the SHA-256 of all, each with its length."""

    messages: int = 0
    digest: Any = field(default_factory=hashlib.sha256)
    last_status: wire.Status | None = None

    def add(self, body: bytes) -> None:
        """Count the header and payload of one message."""
        self.messages += 1
        self.digest.update(len(body).to_bytes(4, "little") + body)

    def same(self, other: Heard) -> bool:
        """Whether both hold the same messages in the same order."""
        return self.messages == other.messages and bool(self.digest.digest() == other.digest.digest())


class ObservedLink(Link):
    """An ordinary link around another one, with books on what passed: messages by session, answers, gates, acknowledged commands."""

    def __init__(self, link: Any) -> None:
        self._link = link
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.heard: dict[int, Heard] = {}  # by session that was sent ARM, in their order
        self.answers = Heard()  # WELCOME, ACK and PONG
        self.gates: dict[tuple[int, int], Gate] = {}  # by session and command
        self.acknowledged: dict[int, int] = {}  # the last command, by session
        self.decoders: list[wire.FrameDecoder] = []  # of what came, one for each opening
        self._open()

    def _open(self) -> None:
        self._from_device, self._from_host = wire.FrameDecoder(), wire.FrameDecoder()
        self.decoders.append(self._from_device)
        self._session, self._armed = 0, False

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        data: bytes = self._link.read(timeout_s)
        for frame in self._from_device.feed(data):
            if frame.type in ANSWER_TYPES:
                self.answers.add(wire.pack_body(frame))
            if frame.session != self._session:
                continue
            if frame.type == wire.MessageType.ACK:
                self.acknowledged[self._session] = wire.decode_ack(frame.payload).last_id
            if self._armed and frame.type in RECORDED:
                heard = self.heard[self._session]
                heard.add(wire.pack_body(frame))
                if frame.type == wire.MessageType.STATUS:
                    heard.last_status = wire.decode_status(frame.payload)
        return data

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._link.write(data)
        for frame in self._from_host.feed(data):
            if frame.type == wire.MessageType.HELLO:
                self._session, self._armed = frame.session, False
            elif frame.type == wire.MessageType.COMMAND:
                command = wire.decode_command(frame.payload)
                if command.opcode == wire.Opcode.ARM:
                    self._armed = True
                    self.heard.setdefault(self._session, Heard())
                elif command.opcode == wire.Opcode.GATE:
                    self.gates[self._session, command.command_id] = unpack_command(Gate, command.body)

    def now_ns(self) -> int:
        """See `Link.now_ns`."""
        return int(self._link.now_ns())

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        self._link.pause(seconds)

    def reopen(self) -> Link:
        """Come back to the same device, with new decoders."""
        self._link = self._link.reopen()
        self._open()
        return self

    def close(self) -> None:
        """See `Link.close`."""
        self._link.close()

    def decoded(self, names: tuple[str, ...]) -> dict[str, int]:
        """Return the sums of the decoders' counters."""
        return {name: sum(getattr(one.counters, name) for one in self.decoders) for name in names}


STOPPED = (wire.DeviceState.IDLE, wire.DeviceState.SAFE)
