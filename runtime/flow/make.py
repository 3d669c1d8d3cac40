"""From settings to the core of a flow: cells or a tape.

Owns the choice and the checks against the bundle; `make_flow_core` returns a core with the shape of core.Core.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.plan import Plan
from pans.runtime.decide.backends import Decider
from pans.runtime.errors import UsageError
from pans.runtime.instrument.click_law import click_law, click_probability
from pans.runtime.instrument.profile import Profile

from .core import FlowCore
from .matching import PassageFigures
from .plan import build_flow_plan
from .settings import FlowSettings, flow_limits, flow_of_header


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
    gated = frozenset(classes.index(name) for name in settings.gate_classes)
    core = FlowCore(plan, decider, settings, flow_limits(settings, plan, dark_probability), gated, shots, n_cycles)
    core.dark_probability = dark_probability
    return core


def plan_flow(
    profile: Profile, bundle: Bundle, decider: Decider, settings: FlowSettings, shots: int, seconds: float
) -> tuple[Plan, FlowCore, int]:
    """Return plan, core and number of cycles (0: until stopped) of a flow that lasts `seconds`."""
    if bundle.largest > 1:
        raise UsageError(f"{bundle.name} takes photon numbers, a flow measures clicks", remedy="leave --flow out")
    plan = build_flow_plan(profile, bundle, block_us=settings.block_us, dark_every=settings.dark_every)
    dark = float(click_probability(click_law(profile, plan.exposure_us), 0.0))
    cycles = math.ceil(seconds * 1e6 / plan.cycle_us * (1 - 1e-12)) if seconds else 0
    core = make_flow_core(plan, decider, settings, bundle.classes, shots=shots, dark_probability=dark, n_cycles=cycles)
    return plan, core, cycles


def recorded_flow_core(
    header: Mapping[str, Any], plan: Plan, decider: Decider, bundle: Bundle, shots: int, n_cycles: int
) -> FlowCore:
    """Return the core of a recorded flow; `header` is what the recording says of it. KeyError, TypeError or UsageError if it is damaged."""
    settings, dark = flow_of_header(header["settings"]), float(header["dark_probability"])
    return make_flow_core(
        plan, decider, settings, bundle.classes, shots=shots, dark_probability=dark, n_cycles=n_cycles
    )


def replayed_figures(core: FlowCore, events: Iterable[Mapping[str, Any]]) -> PassageFigures:
    """Return what a replayed flow was worth; `events` tell which pulses were not made."""
    core.matcher.finish()
    for event in events:
        if event["kind"] in ("gate_refused", "gate_expired") and "decision" in event:
            core.matcher.undo(int(event["decision"]))
    return core.matcher.figures(core.frames)
