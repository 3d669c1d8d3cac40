"""Decisions on objects in flow, cells or a tape of bars: onset, best window, release, pulses.

In: settings (`read_flow`), a bundle and stream messages. Out: a plan (`build_flow_plan`), a core (`make_flow_core`) and its decisions.
Start at core.py; kernels.py has the loops over frames.
"""

from .core import FlowCore
from .make import build_flow_plan, make_flow_core, plan_flow, recorded_flow_core, replayed_figures
from .matching import PassageFigures, abort_reason
from .settings import FlowSettings, read_flow, with_gate

__all__ = [
    "FlowCore",
    "FlowSettings",
    "PassageFigures",
    "abort_reason",
    "build_flow_plan",
    "make_flow_core",
    "plan_flow",
    "read_flow",
    "recorded_flow_core",
    "replayed_figures",
    "with_gate",
]
