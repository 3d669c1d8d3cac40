"""Decisions on objects that stand still: windows of shots, one decision for each.

windows.py knows which windows a gap has broken, core.py flags them and abstains. The kernel of a call never sees a gap:
it leaves the message to `step` of the follower, which goes on from the same state.
"""

from .core import Core
from .kernel_state import CoreState
from .window_kernels import DARK_CLICKS, DARK_EXPOSURES, LATE_SLOTS, N_TALLIES, WRONG_PATTERNS
from .windows import DecisionWindows, visit_maps

__all__ = [
    "DARK_CLICKS",
    "DARK_EXPOSURES",
    "LATE_SLOTS",
    "N_TALLIES",
    "WRONG_PATTERNS",
    "Core",
    "CoreState",
    "DecisionWindows",
    "visit_maps",
]
