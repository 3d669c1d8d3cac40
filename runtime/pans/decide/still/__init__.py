"""Decisions on objects that stand still: windows of shots, one decision for each.

windows.py knows which windows a gap has broken, core.py flags them and abstains. kernels.py never sees a gap: it leaves the message to
`step` of the follower.
"""

from .core import Core
from .kernel_state import CoreState
from .windows import DARK_CLICKS, DARK_EXPOSURES, LATE_SLOTS, N_TALLIES, WRONG_PATTERNS, DecisionWindows, visit_maps

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
