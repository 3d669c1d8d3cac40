"""Ticks against the host's clock: what has arrived has happened, so that no tick may lie in the future.

Owns that comparison; never changes a message or a decision. The bound is the clock model's own (clock.py), which holds whatever the
link does. Costs a block two multiplications.
"""

from __future__ import annotations

from pans.runtime.core.follower import Contradiction

from .clock import STEP_MARGIN_NS, ClockModel


def future_tick(clock: ClockModel, tick: int, arrival_ns: int) -> Contradiction | None:
    """Return what is wrong when `tick` is later than `arrival_ns` by more than the clock's uncertainty; the device's clock has moved."""
    fit = clock.fit
    if fit is None or fit.reference_host_ns + (tick - fit.reference_tick) * fit.ns_per_tick <= arrival_ns:
        return None
    host_ns, uncertainty_ns = clock.to_host_ns(tick)
    if host_ns - uncertainty_ns - STEP_MARGIN_NS <= arrival_ns:
        return None
    return Contradiction("future_tick", 0, tick, clock.to_tick(arrival_ns))
