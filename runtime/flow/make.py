"""From settings to the core of a flow: cells or a tape.

Owns the choice and the checks against the bundle; `make_flow_core` returns a core with the shape of core.Core.
"""

from __future__ import annotations

from collections.abc import Sequence

from pans.runtime.core.plan import Plan
from pans.runtime.decide.backends import Decider
from pans.runtime.errors import UsageError

from .cells import CellCore
from .core import FlowCore
from .settings import FlowSettings, flow_limits
from .tape import TapeCore


def make_flow_core(
    plan: Plan,
    decider: Decider,
    settings: FlowSettings,
    classes: Sequence[str],
    *,
    shots: int,
    dark_probability: float,
    n_cycles: int = 0,
) -> FlowCore:
    """Return the core that `settings` ask for; `shots` frames are a window, `classes` the bundle's names.

    `dark_probability` of a click per channel and exposure without light sets the onset level. UsageError for what cannot be done.
    """
    unknown = sorted(set(settings.gate_classes) - set(classes))
    if unknown:
        raise UsageError(f"gate class {', '.join(unknown)}, allowed: {', '.join(classes)}")
    if not 1 <= shots * settings.pool <= plan.block_exposures * 4:
        raise UsageError(
            f"{shots} shots times {settings.pool} windows, allowed: 1 to {plan.block_exposures * 4} frames"
        )
    kind = CellCore if settings.kind == "cells" else TapeCore
    gated = frozenset(classes.index(name) for name in settings.gate_classes)
    core = kind(plan, decider, settings, flow_limits(settings, plan, dark_probability), gated, shots, n_cycles)
    core.dark_probability = dark_probability
    return core
