"""The instrument as a state machine without I/O: bytes and ticks in, bytes out.

Owns session, commands, lease, runs, the stream's buffer and the gates, as docs/reference/protocol.md says; never reads a clock, sleeps
or opens a port. `Instrument` is the device; `DeviceClock` is the truth about its ticks, `SteppedDevice` what a shell needs of either.

>>> from pans.firmware_sim.device import Instrument
>>> from pans.firmware_sim.scene import load_scene
>>> from pans.runtime.instrument.profile import load_profile
>>> Instrument(load_profile("ideal"), load_scene("uniform")).step(1000, b"")
b''
"""

from .clock import DeviceClock, SteppedDevice
from .instrument import Instrument

__all__ = ["DeviceClock", "Instrument", "SteppedDevice"]
