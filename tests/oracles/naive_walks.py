"""Walks of an automaton as plain loops over exposures, from the definition: the oracle of firmware_sim/pans_sim/device/walking.py."""

import math
from collections.abc import Callable

from naive_detector import number

DARK, ADAPTIVE = 0xFFFF, 0xFFFE


def exposures(
    states: list[tuple[int, float, int, int]],
    slots: list[int],
    light: Callable[[int, int], float],
    dark: float,
    p_ap: float,
    seed: int,
    count: int,
) -> tuple[list[int], list[int]]:
    """Stamps and clicks of `count` exposures from the first on.

    `states` are pattern, part of the exposure that is lit, and successors; `slots` what a cycle shows; `light(cycle, pattern)` the
    photoelectrons of a whole exposure, `dark` those of the dark; a click follows another one with probability `p_ap` at least.
    """
    stamps, clicks = [], []
    node = before = 0
    for exposure in range(count):
        cycle, slot = divmod(exposure, len(slots))
        if slot == 0:
            node = 0
        mean, stamp = dark, DARK
        if slots[slot] == ADAPTIVE and node < len(states):
            pattern, lit, *_ = states[node]
            mean, stamp = dark + lit * light(cycle, pattern), node
        p = 1 - math.exp(-mean)
        if before:
            p = 1 - (1 - p) * (1 - p_ap)
        before = int(number(seed, exposure, 0, 0) < p)
        if stamp != DARK:
            node = states[node][2 + before]
        stamps.append(stamp)
        clicks.append(before)
    return stamps, clicks


def expected_light(
    states: list[tuple[int, float, int, int]], light: Callable[[int], float], dark: float, p_ap: float
) -> float:
    """Photoelectrons of a walk in expectation, by going through every walk; a click makes the next one likelier by `p_ap`."""

    def beyond(node: int, before: int) -> float:
        if node >= len(states):
            return 0.0
        pattern, lit, unclicked, clicked = states[node]
        mean = lit * light(pattern)
        miss = math.exp(-mean - dark) * (1 - p_ap if before else 1)
        return mean + miss * beyond(unclicked, 0) + (1 - miss) * beyond(clicked, 1)

    return beyond(0, 0)
