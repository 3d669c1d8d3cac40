"""The actuation outputs: which pulses were accepted, and which output is open when; whether the state allows one is instrument.py's."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from pans.protocol.wire import AckStatus, Gate

from .sequential import MAX_TICK
from .upload import Refused

GATE_CHANNELS = 8  # this simulator's; a device says its number in WELCOME
MAX_PENDING_GATES = 256
MAX_KEPT_PULSES = 4096


class GatePulse(NamedTuple):
    """One accepted actuation: output `channel` opens at `tick` and closes at `end_tick`, unless cut short."""

    tick: int
    end_tick: int
    channel: int


class Gates:
    """All outputs; `pulses` in the order of their commands, the oldest forgotten; `refused` counts those that were not accepted."""

    def __init__(self) -> None:
        self.pulses: deque[GatePulse] = deque(maxlen=MAX_KEPT_PULSES)
        self.refused = 0
        self._pending: list[int] = []  # ticks, some of them passed

    def add(self, gate: Gate, now: int) -> None:
        """Accept a pulse, or raise `Refused`: a pulse that comes too late is never executed."""
        try:
            self._check(gate, now)
        except Refused:
            self.refused += 1
            raise
        self._pending.append(gate.tick)
        self.pulses.append(GatePulse(gate.tick, gate.tick + gate.duration_ticks, gate.channel))

    def _check(self, gate: Gate, now: int) -> None:
        if gate.tick <= now:
            raise Refused(AckStatus.TOO_LATE, f"gate tick {gate.tick} has passed, it is {now}")
        if gate.tick >= MAX_TICK:
            raise Refused(AckStatus.OUT_OF_RANGE, f"gate tick {gate.tick}: allowed up to {MAX_TICK - 1}")
        if gate.channel >= GATE_CHANNELS or not gate.duration_ticks:
            text = f"gate {gate.channel} for {gate.duration_ticks} ticks: channels are 0..{GATE_CHANNELS - 1}"
            raise Refused(AckStatus.OUT_OF_RANGE, text)
        if len(self._pending) >= MAX_PENDING_GATES:
            self._pending = [tick for tick in self._pending if tick > now]
        if len(self._pending) >= MAX_PENDING_GATES:
            raise Refused(AckStatus.OUT_OF_RANGE, f"{MAX_PENDING_GATES} gate pulses are pending already")

    def is_open(self, channel: int, now: int) -> bool:
        """Whether output `channel` is open at tick `now`."""
        return any(pulse.channel == channel and pulse.tick <= now < pulse.end_tick for pulse in self.pulses)

    def close_all(self, now: int) -> None:
        """Close what is open and cancel what is to come."""
        kept = [pulse._replace(end_tick=min(pulse.end_tick, now)) for pulse in self.pulses if pulse.tick <= now]
        self.pulses = deque(kept, maxlen=MAX_KEPT_PULSES)
        self._pending.clear()
