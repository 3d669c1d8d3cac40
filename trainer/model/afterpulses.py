"""Afterpulses in training: what the clicks before add to the chance of each, in the mean, in torch.

Owns the twin of pans.runtime.detector.Afterpulses on tensors. Fixed patterns are trained with the mean memory: clicks stay independent, as
the estimators ask, each with its right chance in the mean; how clicks depend on each other is left out, and `pans evaluate` has it.
In an automaton every state has the mean memory of the walks that reach it: exact where one walk leads there, else their mean for all.
The gradient is that of a memory that stays as it is. Growing looks at a level without memory; all that follows has it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pans.runtime.detector import Afterpulses, afterpulses_of
from pans.runtime.instrument.profile import Profile

ROUNDS = 3  # the last one with gradients; those before find the memory with which objects come
_SURE, _LEAST = 1 - 1e-12, 1e-30


def trained_through(profile: Profile, exposure_us: float) -> Afterpulses | None:
    """Return the afterpulses that a training goes through: those with a time constant, of one detector after pattern after pattern."""
    if profile.detector.afterpulse_time_us is None or profile.mode == "parallel":
        return None
    return afterpulses_of(profile, exposure_us)


def after(afterpulses: Afterpulses, mean: Tensor, memory: Tensor, clicks: Tensor) -> Tensor:
    """Return the memory after an exposure: as `Afterpulses.after`, of a time constant above 0, and differentiable."""
    _, per_mean, per_memory, in_pause = afterpulses.steps
    chance = -torch.expm1(-(mean + memory))
    gain = (per_mean * mean + per_memory * memory) / chance.clamp(min=1e-30)
    return afterpulses.decay * memory + in_pause * mean + clicks * gain


def with_mean_memory(p: Tensor, afterpulses: Afterpulses | None) -> Tensor:
    """Return the chances of clicks (n, d_f) with the mean memory of the patterns before, from `p`, those without; dtype of `p`."""
    if afterpulses is None:
        return p
    first = p.double()
    mean = -torch.log1p(-first.clamp(max=_SURE))
    begins = torch.zeros((), dtype=torch.float64, device=p.device)
    for number in range(ROUNDS):
        with torch.set_grad_enabled(torch.is_grad_enabled() and number == ROUNDS - 1):
            memory, found = begins.expand(len(p)), []
            for i in range(p.shape[1]):
                click = first[:, i] - (1 - first[:, i]) * torch.expm1(-memory)
                memory = after(afterpulses, mean[:, i], memory, click)
                found.append(click)
            begins = memory.detach().mean()
    return torch.stack(found, dim=1).to(p.dtype)


class MeanMemory:
    """The memory of the nodes of a level as an automaton is passed: sums over the walks there, (nodes, objects), times their chances."""

    def __init__(self, afterpulses: Afterpulses, root: Tensor) -> None:
        self.afterpulses, self._sums = afterpulses, torch.zeros_like(root)

    def go_on(
        self, alpha: Tensor, chances: tuple[Tensor, ...], falls: tuple[Tensor, ...], successors: Tensor, n_nodes: int
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Leave a level's states of chance `alpha`: silence and how fast it falls with light, with memory from those without."""
        memory = self._sums[: len(alpha)] / alpha.clamp(min=_LEAST)
        kept = torch.exp(-memory)
        silent, fall = chances[0] * kept, falls[0] * kept
        mean = -torch.log(chances[0].clamp(min=_LEAST))
        sums = torch.zeros(n_nodes, alpha.shape[1], dtype=alpha.dtype)
        for clicked, to in enumerate(successors):
            part = alpha * (1 - silent if clicked else silent)
            left = after(self.afterpulses, mean, memory, torch.full_like(mean, float(clicked)))
            sums.index_add_(0, to, part * left)
        self._sums = sums
        return (silent,), (fall,)
