"""Slow oracles for the window kernels, in plain loops over Python numbers: the meaning, not the speed."""

from __future__ import annotations

from typing import Any

from pans.runtime.core.plan import Plan
from pans.runtime.wire.messages import DARK_PATTERN


def count_visits(
    plan: Plan, n_features: int, shots: int, exposures: dict[int, tuple[int, int]]
) -> dict[tuple[int, int], Any]:
    """Return {(visit, window): (counts, missing, wrong)} from {exposure: (shown pattern, bit)} of a sequential run."""
    per_cycle = plan.slots_per_cycle
    per_visit = per_cycle * plan.cycles_per_object
    found: dict[tuple[int, int], Any] = {}
    for exposure, (shown, bit) in exposures.items():
        visit, relative = divmod(exposure, per_visit)
        cycle, slot = divmod(relative, per_cycle)
        planned = int(plan.slot_pattern[slot])
        if planned == DARK_PATTERN:
            continue
        window = (cycle * plan.shots_per_cycle + int(plan.slot_shot[slot])) // shots
        counts, right, wrong = found.setdefault((visit, window), ([0] * n_features, 0, 0))
        if shown == planned:
            counts[planned] += bit
            found[visit, window] = (counts, right + 1, wrong)
        else:
            found[visit, window] = (counts, right, wrong + 1)
    return {key: (counts, shots * n_features - right - wrong, wrong) for key, (counts, right, wrong) in found.items()}
