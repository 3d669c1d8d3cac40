"""The instrument as a state machine without I/O: bytes and ticks in, bytes out.

Start with `instrument`: sessions, commands, lease and status, as docs/reference/protocol.md says. `view` makes a run from a plan and the
scene; `walking` and `parallel` are the two kinds of run; `readings` is what the detector reads.

>>> from pans_sim.device import Instrument
>>> from pans_sim.scene import load_scene
>>> from pans.instrument.profile import load_profile
>>> Instrument(load_profile("ideal"), load_scene("uniform")).step(1000, b"")
b''
"""

from .clock import DeviceClock, SteppedDevice
from .instrument import Instrument

__all__ = ["DeviceClock", "Instrument", "SteppedDevice"]
