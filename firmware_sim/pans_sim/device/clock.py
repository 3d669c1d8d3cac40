"""The device's imperfect clock, in exact integer arithmetic, and what a shell needs of a device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

DEFAULT_OFFSET_TICKS = 123_456_789  # any number that is not 0: device time is not host time
BUFFER_MESSAGES = 256  # that a device can hold back
DEFAULT_DRIFT_PPM = 20.0  # the tolerance of an ordinary quartz crystal
_E18 = 10**18


class SteppedDevice(Protocol):
    """What a shell drives: an `Instrument`, or a wrapper that damages the bytes on their way in and out of one."""

    @property
    def session(self) -> int: ...

    def step(self, tick: int, data: bytes) -> bytes: ...

    def next_event_tick(self) -> int | None: ...

    def draw_ahead(self) -> bool:
        """Do a piece of work that will be needed, of a fraction of a millisecond; whether there was any."""


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """tick = offset_ticks + host_s * tick_hz * (1 + drift), drift in parts per billion."""

    tick_hz: int
    offset_ticks: int = DEFAULT_OFFSET_TICKS
    drift_ppb: int = round(DEFAULT_DRIFT_PPM * 1000)

    def tick_at(self, host_ns: int) -> int:
        """The tick that the device counts at `host_ns`."""
        return self.offset_ticks + host_ns * self.tick_hz * (10**9 + self.drift_ppb) // _E18

    def host_ns_at(self, tick: int) -> int:
        """The first nanosecond at which the device counts `tick`."""
        return -(-(tick - self.offset_ticks) * _E18 // (self.tick_hz * (10**9 + self.drift_ppb)))
