"""The decisions on objects in flow, cells or a tape of bars: onset, best window, release, and the pulses that are asked for.

In come settings (`read_flow`), a bundle and stream messages; out come a plan (`build_flow_plan`), a core (`make_flow_core`) and its
outputs. Like core it does no input or output and reads no clock; live sends the pulses. Start with core.py; kernels.py has the loops over
frames.
"""

from .core import FlowCore
from .make import build_flow_plan, make_flow_core
from .settings import FlowSettings, read_flow

__all__ = ["FlowCore", "FlowSettings", "build_flow_plan", "make_flow_core", "read_flow"]
