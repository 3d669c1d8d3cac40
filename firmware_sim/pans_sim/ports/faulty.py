"""A device behind a bad link: wraps an instrument and damages, delays, repeats or loses what passes, by seed.

`FaultyDevice` is a `SteppedDevice`: shells drive it like an instrument. It looks at no more of a message than its type.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from pans.protocol.session import STREAM_TYPES
from pans_sim.device.clock import DeviceClock, SteppedDevice

from .faults import Faults, Recurring

MAX_REORDER_FRAMES = 8
HOLD_NS = 20_000_000  # a frame held back for others leaves by then at the latest
MAX_LANE_BYTES = 1 << 24
RESET_TICK = 1000

MakeDevice = Callable[[int, int], SteppedDevice]  # (epoch, tick at power-on) -> a device that has just been switched on


@dataclass(slots=True)
class FaultCounters:
    """What was done to the frames of both directions, and to the device."""

    frames: int = 0
    lost: int = 0
    flipped: int = 0
    duplicated: int = 0
    truncated: int = 0
    reordered: int = 0
    dripped: int = 0
    overflowed: int = 0
    stalls: int = 0
    disconnects: int = 0
    pauses: int = 0
    clock_steps: int = 0
    resets: int = 0
    lates: int = 0


@dataclass(slots=True)
class Held:
    """A frame that lets others pass: so many, or until a tick."""

    to_pass: int
    leave_by: int
    frame: bytes


class Lane:
    """One direction: whole frames in, damaged bytes out, in the order in which they are due."""

    def __init__(self, faults: Faults, dice: random.Random, hold_ticks: int, counters: FaultCounters) -> None:
        self._faults, self._dice, self._hold_ticks, self._counters = faults, dice, hold_ticks, counters
        self._clean = not faults.any_frame_fault
        self._due: deque[tuple[int, bytes]] = deque()
        self._held: list[Held] = []
        self._partial = b""
        self._queued_bytes = 0
        self.blocked_until = 0

    def put(self, tick: int, data: bytes) -> None:
        """Take bytes that were sent at `tick`; a frame's damage is decided when its delimiter has come."""
        if self._clean:
            self._queue(tick, data)
            return
        *frames, self._partial = (self._partial + data).split(b"\0")
        for frame in frames:
            self._pass(tick, frame + b"\0")

    def next_tick(self) -> int | None:
        """When the next bytes leave; None when there are none."""
        first = self._due[0][0] if self._due else None
        for held in self._held:
            first = held.leave_by if first is None else min(first, held.leave_by)
        return None if first is None else max(first, self.blocked_until)

    def take(self, tick: int) -> bytes:
        """Return what has arrived by `tick`."""
        if tick < self.blocked_until:
            return b""
        if self._held:
            for held in [held for held in self._held if held.leave_by <= tick]:
                self._held.remove(held)
                self._queue(tick, held.frame)
        if not self._due or self._due[0][0] > tick:
            return b""
        arrived = []
        while self._due and self._due[0][0] <= tick:
            arrived.append(self._due.popleft()[1])
        data = b"".join(arrived)
        self._queued_bytes -= len(data)
        return data

    def clear(self) -> None:
        """Lose what is on the way."""
        self._due.clear()
        self._held.clear()
        self._partial = b""
        self._queued_bytes = 0

    def _queue(self, tick: int, data: bytes) -> None:
        if self._queued_bytes + len(data) > MAX_LANE_BYTES:
            self._counters.overflowed += 1
            return
        if data:
            after = self._due[-1][0] if self._due else 0
            self._due.append((max(tick, after), data))
            self._queued_bytes += len(data)

    def _pass(self, tick: int, frame: bytes) -> None:
        faults, dice, counters = self._faults, self._dice, self._counters
        counters.frames += 1
        if faults.loss and dice.random() < faults.loss:
            counters.lost += 1
        elif faults.reorder and dice.random() < faults.reorder:
            counters.reordered += 1
            self._held.append(Held(dice.randint(1, MAX_REORDER_FRAMES), tick + self._hold_ticks, frame))
            return
        else:
            self._deliver(tick, frame)
        for held in list(self._held):
            held.to_pass -= 1
            if held.to_pass <= 0:
                self._held.remove(held)
                self._queue(tick, held.frame)

    def _deliver(self, tick: int, frame: bytes) -> None:
        faults, dice, counters = self._faults, self._dice, self._counters
        copies = 1
        if faults.duplicate and dice.random() < faults.duplicate:
            counters.duplicated += 1
            copies = 2
        if faults.flip and len(frame) > 1 and dice.random() < faults.flip:
            counters.flipped += 1
            frame = self._flip(frame)
        if faults.truncate and len(frame) > 1 and dice.random() < faults.truncate:
            counters.truncated += 1
            frame = frame[: dice.randrange(1, len(frame))]
        if faults.drip and dice.random() < faults.drip:
            counters.dripped += 1
            for position in range(len(frame)):
                self._queue(tick + position, frame[position : position + 1])
            return
        for _ in range(copies):
            self._queue(tick, frame)

    def _flip(self, frame: bytes) -> bytes:
        damaged = bytearray(frame)
        for _ in range(self._dice.randint(1, 3)):
            damaged[self._dice.randrange(len(damaged))] ^= 1 << self._dice.randrange(8)
        return bytes(damaged)


class Schedule:
    """When something that recurs begins and ends, in ticks; the first time at a random part of its period."""

    def __init__(self, what: Recurring, ticks: Callable[[int], int], dice: random.Random, start_tick: int) -> None:
        self.length_ticks, self._every, self._dice = ticks(what.length_ns), ticks(what.every_ns), dice
        self.next_tick = start_tick + int(self._every * (0.3 + dice.random()))

    def begin(self) -> tuple[int, int]:
        """Return (begin, end) of what is due and plan the next one, after 0.5 to 1.5 periods."""
        begin = self.next_tick
        end = begin + self.length_ticks
        self.next_tick = max(end + 1, begin + int(self._every * (0.5 + self._dice.random())))
        return begin, end


class FaultyDevice:
    """An instrument and its bad link; `connected` is False while the link is broken."""

    def __init__(self, make: MakeDevice, clock: DeviceClock, faults: Faults, seed: int, start_tick: int) -> None:
        self.counters = FaultCounters()
        self.faults = faults
        self._make, self._epoch = make, 1
        self.device = make(1, start_tick)
        self._shift = 0  # device tick = shell tick + shift
        self._tick = start_tick
        dice = random.Random(seed)

        def ticks(nanoseconds: int) -> int:
            return nanoseconds * clock.tick_hz // 10**9

        self._up = Lane(faults, random.Random(dice.random()), ticks(HOLD_NS), self.counters)
        self._down = Lane(faults, random.Random(dice.random()), ticks(HOLD_NS), self.counters)
        kinds = ("stall", "disconnect", "clock_step", "reset", "pause", "late")
        recurring = {kind: getattr(faults, kind) for kind in kinds}
        self._schedules = {
            kind: Schedule(what, ticks, random.Random(dice.random()), start_tick)
            for kind, what in recurring.items()
            if what is not None
        }
        self._gone_until = 0
        self._late_until = 0
        self._kept: list[bytes] = []  # stream messages that the device is late with

    @property
    def session(self) -> int:
        return self.device.session

    @property
    def connected(self) -> bool:
        """Whether the link holds at the tick of the latest step."""
        return self._tick >= self._gone_until

    def pause_until(self, tick: int) -> int | None:
        """The tick until which the host stands still, if a pause is due at `tick`; the shell that owns time asks."""
        schedule = self._schedules.get("pause")
        if schedule is None or schedule.next_tick > tick:
            return None
        self.counters.pauses += 1
        schedule.begin()
        return tick + schedule.length_ticks

    def step(self, tick: int, data: bytes) -> bytes:
        """See `SteppedDevice`: move to `tick`, through everything that happens on the way."""
        arrived = []
        while (due := self.next_event_tick()) is not None and due <= tick:
            arrived.append(self._advance(due, b""))
        arrived.append(self._advance(max(tick, self._tick), data))
        return b"".join(arrived)

    def next_event_tick(self) -> int | None:
        """See `SteppedDevice`."""
        own = self.device.next_event_tick()
        ticks = [self._up.next_tick(), self._down.next_tick(), None if own is None else own - self._shift]
        ticks += [schedule.next_tick for kind, schedule in self._schedules.items() if kind != "pause"]
        if not self.connected:
            ticks.append(self._gone_until)
        if self._kept:
            ticks.append(self._late_until)
        return min((max(tick, self._tick) for tick in ticks if tick is not None), default=None)

    def draw_ahead(self) -> bool:
        """See `SteppedDevice`."""
        return self.device.draw_ahead()

    def _advance(self, tick: int, data: bytes) -> bytes:
        self._tick = tick
        for kind, schedule in self._schedules.items():
            if kind != "pause" and schedule.next_tick <= tick:
                getattr(self, f"_{kind}")(*schedule.begin())
        if data and self.connected:
            self._up.put(tick, data)
        sent = self._punctual(tick, self.device.step(tick + self._shift, self._up.take(tick)))
        if sent and self.connected:
            self._down.put(tick, sent)
        return self._down.take(tick)

    def _punctual(self, tick: int, sent: bytes) -> bytes:
        """What of `sent` leaves the device now; COBS leaves a first byte that is not zero, the type, where it stood."""
        if tick >= self._late_until:
            sent, self._kept = b"".join(self._kept) + sent, []
            return sent
        passed = b""
        for frame in sent.split(b"\0")[:-1]:
            if len(frame) > 1 and frame[1] in STREAM_TYPES:
                self._kept.append(frame + b"\0")
            else:
                passed += frame + b"\0"
        return passed

    def _late(self, begin: int, end: int) -> None:
        self.counters.lates += 1
        self._late_until = end

    def _stall(self, begin: int, end: int) -> None:
        self.counters.stalls += 1
        self._up.blocked_until = self._down.blocked_until = end

    def _disconnect(self, begin: int, end: int) -> None:
        self.counters.disconnects += 1
        self._gone_until = end
        self._up.clear()
        self._down.clear()

    def _clock_step(self, begin: int, end: int) -> None:
        self.counters.clock_steps += 1
        self._shift += end - begin

    def _reset(self, begin: int, end: int) -> None:
        self.counters.resets += 1
        self._epoch += 1
        self._shift = RESET_TICK - self._tick
        self.device = self._make(self._epoch, RESET_TICK)
        self._down.clear()  # what stood in its transmit buffer is gone
        self._kept = []
