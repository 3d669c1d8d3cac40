"""Few patterns for many states: one-bit patterns are grouped, and the states of a group show one pattern, each with its own brightness.

Owns the grouping (k-means on the parameters of the pixels, weighted by how often a state is reached) and the pool that takes the place of
the states' own patterns; the pool is trained on like any other parameters.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .light import BRIGHTNESS_MIN, Bits
from .machine import Machine

ROUNDS = 12  # of k-means
LEAN_MAX = 1.0  # what a pixel counts at most, so that a few pixels do not decide


def share_patterns(
    machine: Machine, wanted: int, masses: list[Tensor], mean_object: Tensor, random: torch.Generator
) -> None:
    """Let all states of `machine` show at most `wanted` patterns; `masses` (states,) per level say how often a state is reached.

    The light on `mean_object` (pixels,) stays as it was. Nothing happens where there are no more states than that.
    """
    lights = [level.light for level in machine.levels]
    bits = [light for light in lights if isinstance(light, Bits)]
    leans = torch.cat([light.own() for light in bits])
    if len(bits) < len(lights) or len(leans) <= wanted:
        return
    weights = torch.cat(masses).clamp(min=1e-9)
    group = k_means(leans.clamp(-LEAN_MAX, LEAN_MAX), weights, wanted, random)
    pool = torch.zeros(wanted, leans.shape[1]).index_add_(0, group, leans * weights.unsqueeze(1))
    pool = pool / torch.zeros(wanted).index_add_(0, group, weights).clamp(min=1e-30).unsqueeze(1)
    first = 0
    for light in bits:
        before = light.shown()[0] @ mean_object
        light.rows, light.lean = group[first : first + len(light.log_light)], pool
        first += len(light.rows)
        after = (light.shown()[0] @ mean_object).clamp(min=BRIGHTNESS_MIN)
        if len(light.log_light) == len(light.rows):
            light.log_light += (before.clamp(min=BRIGHTNESS_MIN) / after).log().unsqueeze(1)
        light.settle()


def k_means(points: Tensor, weights: Tensor, wanted: int, random: torch.Generator) -> Tensor:
    """Return the group 0..wanted-1 of every point (n, dimensions), int64 (n,), by Lloyd's rounds from heavy points drawn at random."""
    centres = points[torch.multinomial(weights, wanted, generator=random)]
    group = torch.zeros(len(points), dtype=torch.int64)
    for _ in range(ROUNDS):
        distance = centres.square().sum(dim=1) - 2 * points @ centres.T
        least, group = distance.min(dim=1)
        mass = torch.zeros(wanted).index_add_(0, group, weights)
        sums = torch.zeros_like(centres).index_add_(0, group, points * weights.unsqueeze(1))
        centres = torch.where(mass.unsqueeze(1) > 0, sums / mass.clamp(min=1e-30).unsqueeze(1), centres)
        empty = (mass == 0).nonzero().flatten()
        if len(empty):  # they go to the points that are served worst
            error = (least + points.square().sum(dim=1)) * weights
            centres[empty] = points[error.topk(len(empty)).indices]
    return group
