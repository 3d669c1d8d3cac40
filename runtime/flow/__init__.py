"""The core for objects in flow, cells or a tape of bars: onset, best window, release, and the pulses asked for.

Owns the search for passages in a stream of frames, one decision for each, and the comparison of decisions with the device's marks
afterwards. Like core it does no input or output and reads no clock; pulses are sent by live. `make_flow_core` makes the core that a flow's
settings (`read_flow`) ask for, `build_flow_plan` its plan.
"""

from .core import FlowCore
from .make import build_flow_plan, make_flow_core
from .settings import FlowSettings, read_flow

__all__ = ["FlowCore", "FlowSettings", "build_flow_plan", "make_flow_core", "read_flow"]
