"""The plan of a flow: parallel frames without end, for objects in flow.

Owns the layout of one cycle and the refusal of what the hardware cannot do, with the numbers; which frames belong to an object is found
out afterwards (flow.py). `build_flow_plan` returns a `Plan` or raises PlanError. The device ends a block at the end of a cycle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pans.runtime.core.plan import (
    DARK_PATTERN,
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
from pans.runtime.errors import PlanError
from pans.runtime.instrument.profile import Profile

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle


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
