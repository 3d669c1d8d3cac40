"""From the settings of a flow to its plan and its core, with the checks against hardware and bundle.

A cycle of the plan is one block of frames of all channels; frames run without end, and the device ends a block at the end of a cycle.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pans.base.errors import PlanError, UsageError
from pans.bundle.backends import Decider
from pans.bundle.sensor import Bundle
from pans.decide.plan.plan import (
    MAX_BLOCK_BYTES,
    MAX_BLOCK_EXPOSURES,
    MAX_SLOTS,
    NO_SHOT,
    Cycle,
    Plan,
    check_fit,
    exposure_us,
    lay_out,
    ticks_of,
)
from pans.instrument.click_law import click_law, click_probability
from pans.instrument.profile import Profile
from pans.protocol.wire import DARK_PATTERN

from .core import FlowCore
from .matching import PassageFigures
from .settings import FlowSettings, flow_limits, flow_of_header


def build_flow_plan(profile: Profile, bundle: Bundle, *, block_us: float, dark_every: int = 0) -> Plan:
    """Lay out frames of all channels at once, a block of them every `block_us` or a little less.

    A cycle is one block; with `dark_every` = n > 0 it is n blocks, and its last frame is dark. Raises PlanError with the numbers where
    the hardware cannot do it, or where a block alone would last as long as a decision may take.
    """
    if profile.mode != "parallel":
        raise PlanError(
            f"objects in flow need all patterns at once, {profile.name} measures in {profile.mode} mode",
            remedy="use a parallel profile, for example --profile wdm-snspd",
        )
    check_fit(profile, bundle)
    ticks = ticks_of(profile, exposure_us(profile, bundle))
    spacing_us = ticks.spacing * 1e6 / profile.clock.tick_hz
    most = min(MAX_BLOCK_EXPOSURES, MAX_BLOCK_BYTES // (-(-bundle.n_features // 8) + 8))
    longest_us = min(most * spacing_us, profile.timing.decision_deadline_us)
    frames = int(block_us / spacing_us * (1 + 1e-12)) if 0 < block_us <= longest_us * (1 + 1e-12) else 0
    if not frames:
        raise PlanError(
            f"block_us is {block_us:g}, with a frame every {spacing_us:.6g} us allowed: {spacing_us:.6g} to {longest_us:.6g}",
            remedy="change block_us in the flow settings",
        )
    slots = frames * max(1, dark_every)
    if dark_every < 0 or slots > min(NO_SHOT, MAX_SLOTS) or (dark_every and slots == 1):
        raise PlanError(
            f"dark_every is {dark_every} blocks of {frames} frames, allowed: 0, or a cycle of 2 to {NO_SHOT} frames",
            remedy="change dark_every in the flow settings",
        )
    patterns = np.zeros(slots, np.int64)
    if dark_every:
        patterns[-1] = DARK_PATTERN
    cycle = Cycle(
        patterns,
        np.arange(slots),
        offsets=np.arange(slots) * ticks.spacing,
        cycle_ticks=slots * ticks.spacing,
        period=ticks.spacing,
        shots_per_cycle=slots - bool(dark_every),
        cycles_per_object=1,
        block=frames,
    )
    return lay_out(profile, bundle.n_features, cycle, ticks)


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
