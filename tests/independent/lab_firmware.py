"""Firmware of an instrument, as a lab would write it from docs/reference/protocol.md alone.

Owns one device from power-on: session, commands, states, lease, receive window, stream. Bytes and ticks in, bytes out; the serving of a
port is lab_port.py's. Its `books` are what it knows it has done, to be held against the host's. Imports nothing of the package.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from lab_frames import (
    ACK,
    COMMAND,
    GRANT,
    HELLO,
    PING,
    PONG,
    PROTOCOL,
    SCHEMA,
    STATUS,
    WELCOME,
    FrameCutter,
    frame,
)
from lab_light import Light
from lab_memory import LATE, MALFORMED, MAX_PIXELS, PATTERN_MEMORY, RANGE, SLOT_MEMORY, STATE, UNKNOWN, Memory, Refused
from lab_run import Maker, Run

IDLE, ARMED, RUNNING, SAFE = range(4)
NO_REASON, COMPLETED, STOPPED, LEASE_EXPIRED, POWER_ON = range(5)
U32 = 1 << 32
HOUR_MS = 3_600_000


@dataclass
class Books:
    """What the device has done since power-on."""

    exposures: int = 0  # in stream messages with a sequence number, of all runs
    dropped: int = 0
    messages: int = 0  # stream messages with a sequence number
    sent: int = 0  # and of those, sent
    commands: dict[int, int] = field(default_factory=dict)  # opcode -> executed
    refused: list[tuple[int, int]] = field(default_factory=list)  # opcode, status
    repeated: int = 0
    grants: int = 0
    pings: int = 0
    sessions: int = 0
    foreign: int = 0
    lease_expiries: int = 0
    most_held: int = 0
    pulses: list[tuple[int, int, int]] = field(default_factory=list)  # tick, duration, output


@dataclass
class Firmware:
    """One device; `receive` and `advance` must be called with ticks that never go back, `take` gives what is to be sent."""

    light: Light
    tick_hz: int = 1_000_000
    parallel: bool = False
    channels: int = 1
    buffer_messages: int = 64
    outputs: int = 1
    facts: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.books = Books()
        self.cutter = FrameCutter()
        self.tick = 0
        self.session = 0
        self.line_full = False
        self.state, self.reason = IDLE, POWER_ON
        self._out: list[bytes] = []
        self._forget()

    def _forget(self) -> None:
        channels = self.channels if self.parallel else 0
        self.memory = Memory(channels, self.light.levels, self.light.images[0].size)
        self.ack = (0, 0, 0, 0, b"")
        self.limit = self.sequence = self.drops = self.next_exposure = 0
        self.held: deque[tuple[int, bytes]] = deque()
        self.run: Run | None = None
        self.status_due: int | None = None
        self.lease_end = 0

    def take(self) -> bytes:
        """Return the bytes to send now."""
        data = b"".join(self._out)
        self._out.clear()
        return data

    # -- time ----------------------------------------------------------------------------------------------------------

    def next_due(self) -> int | None:
        """Tick of what the device does by itself next."""
        due = [] if self.status_due is None else [self.status_due]
        if self.run is not None:
            due += [self.lease_end, *([self.run.start] if self.state == ARMED else self.run.dues())]
        return min(due, default=None)

    def advance(self, tick: int) -> None:
        """Do what is due up to `tick`, in order."""
        while (due := self.next_due()) is not None and due <= tick:
            self.tick = max(self.tick, due)
            run = self.run
            if run is not None and self.state == ARMED and run.start == due:
                self._enter(RUNNING, NO_REASON)
            elif run is not None and self.state == RUNNING and due in run.dues() and run.dues()[0] == due:
                if run.over:
                    self._end(IDLE, COMPLETED)
                else:
                    self._put(*run.emit())
            elif run is not None and self.lease_end == due:
                self.books.lease_expiries += 1
                self._end(SAFE, LEASE_EXPIRED)
            else:
                self._status()
        self.tick = tick

    def _enter(self, state: int, reason: int) -> None:
        self.state, self.reason = state, reason
        self._status()

    def _end(self, state: int, reason: int) -> None:
        if self.run is None:
            return
        if (rest := self.run.cut(self.tick)) is not None:
            self._put(*rest)
        self.next_exposure = self.run.ended(self.tick)
        self.run = None
        if reason != COMPLETED:
            now = self.tick
            self.books.pulses = [(t, min(length, now - t), n) for t, length, n in self.books.pulses if t < now]
        self._enter(state, reason)

    def _send(self, kind: int, payload: bytes) -> None:
        self._out.append(frame(kind, payload, self.session))

    def _status(self) -> None:
        if not self.session:
            return
        self.status_due = self.tick + self.tick_hz
        left = 0 if self.run is None else (self.lease_end - self.tick) * 1000 // self.tick_hz
        following = self.next_exposure if self.run is None else self.run.begun(self.tick)
        fields = (self.state, self.reason, 0, left, self.drops % U32, self.tick, following)
        self._send(STATUS, struct.pack("<BBHIIQQ", *fields))

    # -- the stream ----------------------------------------------------------------------------------------------------

    def _put(self, kind: int, exposures: int, message: Maker) -> None:
        if len(self.held) >= self.buffer_messages:
            self.drops += exposures
            self.books.dropped += exposures
            return
        self.held.append((self.sequence, frame(kind, message(self.sequence, self.drops % U32), self.session)))
        self.books.messages += 1
        self.books.exposures += exposures
        self.sequence = (self.sequence + 1) % U32
        self._release()
        self.books.most_held = max(self.books.most_held, len(self.held))

    def line(self, full: bool) -> None:
        """Say whether the line takes stream messages: while it does not, they wait as if the window were shut."""
        self.line_full = full
        self._release()

    def _release(self) -> None:
        while self.held and not self.line_full and 0 < (self.limit - self.held[0][0]) % U32 < 1 << 31:
            self._out.append(self.held.popleft()[1])
            self.books.sent += 1

    # -- what the host says --------------------------------------------------------------------------------------------

    def receive(self, data: bytes, tick: int) -> None:
        """Digest bytes that have come by `tick`."""
        self.advance(tick)
        for kind, session, payload in self.cutter.feed(data):
            if kind == HELLO and session and len(payload) >= 8:
                self._hello(session, *struct.unpack_from("<IH", payload))
            elif not self.session or session != self.session:
                self.books.foreign += 1
            elif kind == PING and len(payload) == 12:
                self.books.pings += 1
                self._send(PONG, payload + struct.pack("<QQ", self.tick, self.tick))
            elif kind == GRANT and len(payload) == 8:
                self.books.grants += 1
                self.limit, lease_ms = struct.unpack("<II", payload)
                if lease_ms and self.run is not None:
                    self._renew(lease_ms)
                self._release()
            elif kind == COMMAND and len(payload) >= 8:
                number, opcode = struct.unpack_from("<IB", payload)
                self._command(number, opcode, payload[8:])

    def _renew(self, lease_ms: int) -> None:
        self.lease_end = self.tick + max(1, min(lease_ms, HOUR_MS) * self.tick_hz // 1000)

    def _hello(self, session: int, schema: int, protocol: int) -> None:
        agreed = (schema, protocol) == (SCHEMA, PROTOCOL)
        if session != self.session or not agreed:
            self._end(IDLE, STOPPED)
            self._forget()
            self.books.sessions += 1
            self.session = session
        self._send(WELCOME, struct.pack("<IHH", SCHEMA, PROTOCOL, 0) + msgpack_map(self._welcome()))
        if agreed:
            self._status()
        else:
            self.session = 0

    def _welcome(self) -> dict[str, Any]:
        own: dict[str, Any] = {"tick_hz": self.tick_hz, "tick": self.tick, "epoch": 7, "simulated": True}
        own |= {"mode": "parallel" if self.parallel else "sequential", "channels": self.channels}
        own |= {"levels": self.light.levels, "pattern_memory": PATTERN_MEMORY, "pattern_pixels": MAX_PIXELS}
        own |= {"slot_memory": SLOT_MEMORY, "buffer_messages": self.buffer_messages}
        return own | {"firmware": "lab 1", "serial": "LAB-1"} | self.facts

    def _command(self, number: int, opcode: int, body: bytes) -> None:
        last, refused, mask, status, text = self.ack
        if number == last + 1:
            last, mask = number, (mask << 1) % U32
            try:
                self._execute(opcode, body)
                self.books.commands[opcode] = self.books.commands.get(opcode, 0) + 1
            except (Refused, struct.error) as error:
                status, words = error.args if isinstance(error, Refused) else (MALFORMED, str(error))
                self.books.refused.append((opcode, status))
                refused, mask, text = number, mask | 1, words.encode()
            self.ack = last, refused, mask, status, text
        elif number <= last:
            self.books.repeated += 1
        head = struct.pack("<IIIHH", *self.ack[:4], len(self.ack[4]))
        self._send(ACK, head + self.ack[4])

    # -- commands ------------------------------------------------------------------------------------------------------

    def _execute(self, opcode: int, body: bytes) -> None:
        carry_out = {
            1: self.memory.load_pattern,
            2: self.memory.load_plan,
            3: self._arm,
            4: self._stop,
            5: self._reset,
            6: self._gate,
        }
        if opcode not in carry_out:
            raise Refused(UNKNOWN, f"opcode {opcode}")
        if opcode <= 3 and self.state != IDLE:
            raise Refused(STATE, f"the state is {self.state}, not IDLE")
        carry_out[opcode](body)

    def _arm(self, body: bytes) -> None:
        start, cycles, lease_ms, _ = struct.unpack("<QQII", body)
        plan, patterns = self.memory.complete()
        if start <= self.tick:
            raise Refused(LATE, f"tick {start} has passed")
        beyond = start > self.tick + 3600 * self.tick_hz or start + plan.cycle_ticks * cycles >= 1 << 62
        if beyond or not 0 < lease_ms <= HOUR_MS:
            raise Refused(RANGE, "start, cycles or lease")
        self.light.show(patterns, plan.exposure_ticks / self.tick_hz)
        self.run = Run(plan, start, cycles, self.light, self.channels)
        self.held.clear()
        self.sequence = self.drops = self.next_exposure = 0
        self._renew(lease_ms)
        self._enter(ARMED, NO_REASON)

    def _stop(self, body: bytes) -> None:
        if body:
            raise Refused(MALFORMED, "a body where none belongs")
        self._end(IDLE, STOPPED)

    def _reset(self, body: bytes) -> None:
        self._stop(body)
        if self.state == SAFE:
            self._enter(IDLE, NO_REASON)

    def _gate(self, body: bytes) -> None:
        tick, length, output, _ = struct.unpack("<QIHH", body)
        if self.state not in (ARMED, RUNNING):
            raise Refused(STATE, "no run")
        if tick <= self.tick:
            raise Refused(LATE, f"tick {tick} has passed, it is {self.tick}")
        if output >= self.outputs or not length:
            raise Refused(RANGE, f"output {output} for {length} ticks")
        self.books.pulses.append((tick, length, output))


def msgpack_map(facts: dict[str, Any]) -> bytes:
    """Return a flat map as msgpack: text, booleans and integers that are not negative."""
    out = b"\xde" + struct.pack(">H", len(facts))
    for name, value in facts.items():
        for one in (name, value):
            if isinstance(one, bool):
                out += b"\xc3" if one else b"\xc2"
            elif isinstance(one, int):
                out += b"\xcf" + struct.pack(">Q", one)
            else:
                text = str(one).encode()
                out += b"\xd9" + bytes([len(text)]) + text
    return out
