"""Firmware of an instrument, as a lab would write it from docs/reference/protocol.md alone: bytes and ticks in, bytes out.

Its `books` are what it knows it has done, to be held against the host's.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from lab_frames import (
    ACK,
    CLICKS,
    COMMAND,
    FRAMES,
    GRANT,
    HELLO,
    MARK,
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
from numpy.typing import NDArray

IDLE, ARMED, RUNNING, SAFE = range(4)
NO_REASON, COMPLETED, STOPPED, LEASE_EXPIRED, POWER_ON = range(5)
U32 = 1 << 32
HOUR_MS = 3_600_000


DARK = 0xFFFF
Maker = Callable[[int, int], bytes]  # sequence, drops -> payload


@dataclass
class Plan:
    """A complete plan and how its cycle is cut into blocks: (first slot, exposures)."""

    mode: int
    patterns: int
    exposure_ticks: int
    spacing: int
    cycle_ticks: int
    longest_block: int
    cycles_per_object: int
    slots: list[tuple[int, int, int]]

    def blocks(self) -> list[tuple[int, int]]:
        """Consecutive, equally spaced slots, as many as a block may hold."""
        cut, first = [], 0
        for slot in range(1, len(self.slots) + 1):
            ends = slot == len(self.slots) or slot - first == self.longest_block
            if ends or self.slots[slot][0] - self.slots[slot - 1][0] != self.spacing:
                cut.append((first, slot - first))
                first = slot
        return cut


class Run:
    """One armed run: which stream message is due when, and what is in it."""

    def __init__(self, plan: Plan, start: int, cycles: int, light: Light, channels: int) -> None:
        self.plan, self.start, self.cycles, self.light, self.channels = plan, start, cycles, light, channels
        self.over = False
        self._blocks = plan.blocks()
        self._cycle = self._block = 0
        self._marked = -1  # the latest object that has been announced

    def dues(self) -> list[int]:
        """Tick of the next message, or of the end of the run."""
        base = self.start + self._cycle * self.plan.cycle_ticks
        if self.over:
            return [base]
        if self._marked < self._cycle // self.plan.cycles_per_object:
            return [base + self.plan.slots[0][0]]
        first, count = self._blocks[self._block]
        return [base + self.plan.slots[first + count - 1][0] + self.plan.exposure_ticks]

    def emit(self) -> tuple[int, int, Maker]:
        """Return type, exposures and maker of the message that is due; the maker takes sequence and drops."""
        number = self._cycle // self.plan.cycles_per_object
        if self._marked < number:
            self._marked = number
            truth, photons = self.light.truth(number)
            exposure, tick = self._cycle * len(self.plan.slots), self._mark_tick()
            return MARK, 0, lambda seq, drops: struct.pack("<IIhHQQf", seq, number, truth, 0, exposure, tick, photons)
        first, count = self._blocks[self._block]
        message = self._message(first, count)
        self._block += 1
        if self._block == len(self._blocks):
            self._block, self._cycle = 0, self._cycle + 1
            self.over = bool(self.cycles) and self._cycle == self.cycles
        return message

    def _mark_tick(self) -> int:
        """Tick of the first exposure on the present object."""
        return self.start + self._cycle * self.plan.cycle_ticks + self.plan.slots[0][0]

    def cut(self, tick: int) -> tuple[int, int, Maker] | None:
        """Return the exposures of the block under way that have ended by `tick`."""
        if self.over:
            return None
        first, count = self._blocks[self._block]
        latest = tick - self.start - self._cycle * self.plan.cycle_ticks - self.plan.exposure_ticks
        ended = sum(start <= latest for start, _, _ in self.plan.slots[first : first + count])
        return self._message(first, ended) if ended else None

    def begun(self, tick: int) -> int:
        """Exposures that have begun by `tick`."""
        cycle, within = divmod(tick - self.start, self.plan.cycle_ticks)
        if cycle < 0:
            return 0
        if self.cycles and cycle >= self.cycles:
            return self.cycles * len(self.plan.slots)
        return cycle * len(self.plan.slots) + sum(start <= within for start, _, _ in self.plan.slots)

    def ended(self, tick: int) -> int:
        """Exposures that have ended by `tick`."""
        return self.begun(tick - self.plan.exposure_ticks)

    def _message(self, first: int, count: int) -> tuple[int, int, Maker]:
        plan = self.plan
        number = self._cycle // plan.cycles_per_object
        slots = plan.slots[first : first + count]
        tick = self.start + self._cycle * plan.cycle_ticks + slots[0][0]
        exposure = self._cycle * len(plan.slots) + first
        shown = [pattern for _, pattern, _ in slots]
        if plan.mode:
            width = next(size for size in (1, 2, 4, *range(8, 8193, 8)) if 8 * size >= self.channels)
            bits = np.zeros((count, 8 * width), np.uint8)
            for row, pattern in zip(bits, shown, strict=True):
                used = np.full(plan.patterns, -1) if pattern == DARK else np.arange(plan.patterns)
                row[: plan.patterns] = self.light.clicks(number, used)
            kind, patterns = FRAMES, b""
        else:
            width, kind = 0, CLICKS
            bits = self.light.clicks(number, np.array([-1 if one == DARK else one for one in shown]))
            patterns = struct.pack(f"<{count}H", *shown)
        data = patterns + np.packbits(bits.ravel(), bitorder="little").tobytes()

        def message(sequence: int, drops: int) -> bytes:
            head = (sequence, drops, tick, exposure, plan.spacing, count, width, number % 0xFFFFFFFF)
            return struct.pack("<IIQQIHHI", *head) + data

        return kind, count, message


UNKNOWN, MALFORMED, RANGE, STATE, LATE = range(1, 6)
MAX_PIXELS = 1 << 22
PATTERN_MEMORY = 1024
SLOT_MEMORY = 1 << 16


class Refused(Exception):
    """A command that is not carried out: status and text."""


@dataclass
class Memory:
    """Patterns and plan of one session; `channels` is 0 for one detector, `pixels` is the width times the height that it is set to."""

    channels: int
    levels: int
    pixels: int
    patterns: dict[int, tuple[int, list[int]]] = field(default_factory=dict)  # pixels in all, levels so far
    plan_head: tuple[int, ...] = ()
    plan_slots: list[tuple[int, int, int]] = field(default_factory=list)

    def load_pattern(self, body: bytes) -> None:
        """LOAD_PATTERN."""
        index, _, first, pixels = struct.unpack_from("<HHII", body)
        count, odd = divmod(len(body) - 12, 2)
        if odd or not 0 < count <= 4096 or first + count > pixels:
            raise Refused(MALFORMED, "levels of a pattern")
        levels = list(struct.unpack_from(f"<{count}H", body, 12))
        if first == 0:
            self.patterns[index] = (pixels, [])
        wanted, held = self.patterns.get(index, (0, []))
        good = index < PATTERN_MEMORY and pixels <= MAX_PIXELS and max(levels) < self.levels
        if not good or first != len(held) or pixels != wanted or pixels != self.pixels:
            raise Refused(RANGE, f"pattern {index}, pixel {first} of {pixels}")
        held += levels

    def load_plan(self, body: bytes) -> None:
        """LOAD_PLAN."""
        head = struct.unpack_from("<BBHIIIIQHHI", body)
        mode, _, patterns, n_slots, first, exposure, spacing, cycle, longest, _, per_object = head
        count, odd = divmod(len(body) - 36, 12)
        if odd or not 0 < count <= 1024 or first + count > n_slots:
            raise Refused(MALFORMED, "slots of a plan")
        slots = list(struct.iter_unpack("<QHH", body[36:]))
        if first == 0:
            self.plan_head, self.plan_slots = head, []
        follows = first == len(self.plan_slots) and (*head[:4], *head[5:]) == (*self.plan_head[:4], *self.plan_head[5:])
        most = self.channels if self.channels else PATTERN_MEMORY
        good = bool(mode) == bool(self.channels) and 0 < patterns <= most and n_slots <= SLOT_MEMORY
        if not (follows and good and exposure and spacing and longest and per_object and cycle <= 1 << 48):
            raise Refused(RANGE, f"plan from slot {first}")
        shown = [pattern for _, pattern, _ in slots if pattern != DARK]
        starts = [start for start, _, _ in self.plan_slots[-1:] + slots]
        apart = all(after - before >= exposure for before, after in pairwise(starts))
        if not apart or starts[-1] + exposure > cycle or max(shown, default=0) >= patterns:
            raise Refused(RANGE, f"slots from {first} on")
        self.plan_slots += slots

    def complete(self) -> tuple[Plan, NDArray[np.uint16]]:
        """Return plan and patterns, (patterns, pixels), if all of them are here."""
        if not self.plan_head or len(self.plan_slots) < self.plan_head[3]:
            raise Refused(STATE, "no complete plan")
        mode, _, n_patterns, _, _, exposure, spacing, cycle, longest, _, per_object = self.plan_head
        chosen = [self.patterns.get(index, (1, [])) for index in range(n_patterns)]
        if any(len(levels) < pixels for pixels, levels in chosen):
            raise Refused(STATE, "a pattern is missing")
        plan = Plan(mode, n_patterns, exposure, spacing, cycle, longest, per_object, list(self.plan_slots))
        return plan, np.array([levels for _, levels in chosen], np.uint16)


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
        if output >= self.outputs or not length or tick >= 1 << 63:
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
