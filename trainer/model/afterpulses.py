"""Afterpulses in training: what the clicks before add to the chance of each, in the mean, in torch.

The twin of pans.runtime.detector.Afterpulses on tensors. Fixed patterns are trained with the memory of all words: clicks stay independent,
as the estimators ask, each with its right chance; how clicks depend on each other is left out, and `pans evaluate` has it.
In an automaton every state has the memory of all walks that reach it, mean and variance.
The gradient is that of a memory that stays as it is. Growing looks at a level without memory; all that follows has it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pans.runtime.detector import Afterpulses, afterpulses_of
from pans.runtime.detector.afterpulses import SMALL_RATIO
from pans.runtime.instrument.profile import Profile

ROUNDS = 3  # the last one with gradients; those before find the memory with which objects come
_SURE, _LEAST = 1 - 1e-12, 1e-30


def trained_through(profile: Profile, exposure_us: float) -> Afterpulses | None:
    """Return the afterpulses that a training goes through: those with a time constant, of one detector after pattern after pattern."""
    if profile.detector.afterpulse_time_us is None or profile.mode == "parallel":
        return None
    return afterpulses_of(profile, exposure_us)


def _sight(afterpulses: Afterpulses, memory: Tensor) -> tuple[Tensor, Tensor]:
    """`Afterpulses.sight` of `memory` (2, ...), and q times variance over mean."""
    ratio = afterpulses.seen * memory[1] / memory[0].clamp(min=_LEAST)
    wide = ratio.clamp(min=SMALL_RATIO)
    shape = torch.where(ratio > SMALL_RATIO, torch.log1p(wide) / wide, 1 - ratio / 2)
    return afterpulses.seen * memory[0] * shape, ratio


def after(afterpulses: Afterpulses, mean: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
    """Return the memory (2, ...) after a silent exposure, and after a click: as `Afterpulses.after`, of a time constant above 0."""
    to_x, of_m, spread_m, spread_x, *pause, _, kept, _ = afterpulses.steps
    x, variance = memory
    found, varied = mean / (1 + afterpulses.dead * mean), mean / (1 + afterpulses.dead * mean) ** 3
    sight, ratio = _sight(afterpulses, memory)
    left = kept / (1 + ratio)
    silent_x, silent_v = x * left, variance * left**2
    chance = -torch.expm1(-(mean + sight)).clamp(max=-_LEAST)
    more_x = of_m * found + x * (to_x - left)
    more_v = spread_m * varied + spread_x * x + variance * (to_x**2 - left**2)
    clicked_x = silent_x + more_x / chance
    squares = silent_v + silent_x**2 + (more_v + more_x * (2 * silent_x + more_x)) / chance
    behind = []
    for one, spread in ((silent_x, silent_v), (clicked_x, (squares - clicked_x**2).clamp(min=0))):
        behind.append(_through(pause, (found, varied), torch.stack([one, spread])))
    return behind[0], behind[1]


def _through(flow: Sequence[float], filled: tuple[Tensor, Tensor], memory: Tensor) -> Tensor:
    """The memory after a time of whose clicks nothing is known, by `Afterpulses.flow`; `filled`: detections and their variance."""
    (to_x, of_m, spread_m, spread_x), (found, varied) = flow, filled
    return torch.stack(
        [to_x * memory[0] + of_m * found, to_x**2 * memory[1] + spread_m * varied + spread_x * memory[0]]
    )


def with_mean_memory(p: Tensor, afterpulses: Afterpulses | None) -> Tensor:
    """Return the chances of clicks (n, d_f) with the mean memory of the patterns before, from `p`, those without; dtype of `p`."""
    if afterpulses is None:
        return p
    first = p.double()
    mean = -torch.log1p(-first.clamp(max=_SURE))
    begins = torch.zeros(2, 1, dtype=torch.float64, device=p.device)
    for number in range(ROUNDS):
        with torch.set_grad_enabled(torch.is_grad_enabled() and number == ROUNDS - 1):
            memory, found = begins.expand(2, len(p)), []
            for i in range(p.shape[1]):
                found.append(first[:, i] - (1 - first[:, i]) * torch.expm1(-_sight(afterpulses, memory)[0]))
                fewer = 1 + afterpulses.dead * mean[:, i]
                filled = mean[:, i] / fewer, mean[:, i] / fewer**3
                memory = _through(afterpulses.steps[4:8], filled, _through(afterpulses.steps[:4], filled, memory))
            x, square = memory[0].detach().mean(), (memory[1] + memory[0] ** 2).detach().mean()
            begins = torch.stack([x, (square - x**2).clamp(min=0)])[:, None]
    return torch.stack(found, dim=1).to(p.dtype)


class MeanMemory:
    """The memory of the nodes of a level as an automaton is passed: sums of mean and mean square, (2, nodes, objects), times chances."""

    def __init__(self, afterpulses: Afterpulses, root: Tensor) -> None:
        self.afterpulses, self._sums = afterpulses, torch.zeros(2, *root.shape, dtype=root.dtype)

    def go_on(
        self, alpha: Tensor, chances: tuple[Tensor, ...], falls: tuple[Tensor, ...], successors: Tensor, n_nodes: int
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Leave a level's states of chance `alpha`: silence and how fast it falls with light, with memory from those without."""
        x, squares = self._sums[:, : len(alpha)] / alpha.clamp(min=_LEAST)
        memory = torch.stack([x, (squares - x**2).clamp(min=0)])
        kept = torch.exp(-_sight(self.afterpulses, memory)[0])
        silent, fall = chances[0] * kept, falls[0] * kept
        mean = -torch.log(chances[0].clamp(min=_LEAST))
        sums = torch.zeros(2, n_nodes, alpha.shape[1], dtype=alpha.dtype)
        for part, to, (x, variance) in zip(
            (alpha * silent, alpha * (1 - silent)), successors, after(self.afterpulses, mean, memory)
        ):
            sums[0].index_add_(0, to, part * x)
            sums[1].index_add_(0, to, part * (variance + x**2))
        self._sums = sums
        return (silent,), (fall,)
