"""Small plans for tests, made by hand so that they do not depend on a profile."""

from __future__ import annotations

import numpy as np

from pans.runtime.core.plan import NO_SHOT, Plan
from pans.runtime.wire.messages import DARK_PATTERN


def shot_major(n_features: int, shots: int, dark_first: bool = True) -> Plan:
    """One exposure per pattern and cycle, `shots` cycles per object, a dark slot at the start of each cycle."""
    patterns = [DARK_PATTERN] * dark_first + list(range(n_features))
    return _plan("sequential", patterns, [NO_SHOT] * dark_first + [0] * n_features, n_features, 1, shots)


def pattern_major(n_features: int, shots: int) -> Plan:
    """Each pattern held for `shots` exposures, one cycle per object, one dark display first."""
    patterns = np.repeat([DARK_PATTERN, *range(n_features)], shots)
    numbers = [NO_SHOT] * shots + list(range(shots)) * n_features
    return _plan("sequential", list(patterns), numbers, n_features, shots, 1)


def parallel(n_features: int, shots: int) -> Plan:
    """`shots` frames per object after one dark frame."""
    return _plan("parallel", [DARK_PATTERN] + [0] * shots, [NO_SHOT, *range(shots)], n_features, shots, 1)


def _plan(
    mode: str, patterns: list[int], numbers: list[int], n_features: int, shots_per_cycle: int, cycles: int
) -> Plan:
    return Plan(
        mode=mode,
        n_patterns=n_features,
        slot_offset_ticks=np.arange(len(patterns), dtype=np.int64) * 100,
        slot_pattern=np.array(patterns, np.uint16),
        slot_shot=np.array(numbers, np.uint16),
        exposure_ticks=60,
        slot_period_ticks=100,
        cycle_ticks=100 * len(patterns),
        shots_per_cycle=shots_per_cycle,
        cycles_per_object=cycles,
        block_exposures=4,
        exposure_us=60.0,
    )
