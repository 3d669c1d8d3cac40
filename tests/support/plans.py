"""Small plans for tests, made by hand so that they do not depend on a profile."""

from dataclasses import replace

import numpy as np

from pans.bundle.automaton import Automaton
from pans.decide.plan.plan import NO_SHOT, Plan
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN


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


def walk_plan(automaton: Automaton, walks: int, dark: int = 1, drive: str = "device") -> Plan:
    """`walks` cycles per object, each of `dark` dark slots, one of them in the middle of the walk, and the walk's."""
    patterns = [ADAPTIVE_PATTERN] * automaton.n_slots
    for place in ([0, automaton.n_slots // 2, 0])[:dark]:
        patterns.insert(place, DARK_PATTERN)
    slots = np.array(patterns, np.uint16)
    return replace(
        shot_major(len(patterns), walks, dark_first=False),
        n_patterns=4,
        slot_pattern=slots,
        slot_shot=np.where(slots == DARK_PATTERN, NO_SHOT, 0).astype(np.uint16),
        slot_offset_ticks=np.arange(len(slots), dtype=np.int64) * 100,
        cycle_ticks=100 * len(slots),
        automaton=automaton,
        drive=drive,
    )


def walked(plan: Plan, n_cycles: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """(stamp, click) of every exposure of `n_cycles` cycles, as a device without a fault reports them."""
    automaton = plan.automaton
    found = []
    for _ in range(n_cycles):
        node = 0
        for planned in plan.slot_pattern.tolist():
            bit, lit = int(rng.integers(plan.largest + 1)), planned == ADAPTIVE_PATTERN and node < automaton.n_states
            found.append((node if lit else DARK_PATTERN, bit))
            node = int(automaton.successors[node][bit]) if lit else node
    return found
