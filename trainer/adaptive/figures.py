"""What an automaton does on some objects, as exact sums: accuracy, loss, clicks, photons, illumination, exposures; who reaches what.

Owns the pass without gradient over given objects; decisions are those of the machine's class counts. Also what a
training reports of itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from .grow import sum_of
from .machine import Machine, Sight, forward
from .objects import Block
from .outcomes import by_state, channels_of


@dataclass(frozen=True, slots=True)
class Figures:
    """Means over the objects; `loss` in nats, `illumination` in photoelectrons of a clear object."""

    loss: float
    accuracy: float
    clicks: float
    photons: float
    illumination: float
    exposures: float


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a training is: `done` of `steps`, and what the present stage measured on the objects that it fits."""

    stage: str
    done: int
    steps: int
    loss: float
    accuracy: float
    clicks: float
    photons: float
    price: float


def figures(machine: Machine, sight: Sight, blocks: list[Block]) -> Figures:
    """Return the exact expectation over the objects in `blocks`, decisions by the machine's class counts."""
    sums, n = torch.zeros(6, dtype=torch.float64), sum(len(block) for block in blocks)
    with torch.no_grad():
        posteriors = [counts / counts.sum(dim=1, keepdim=True) for counts in machine.counts]
        whole = []
        for level in machine.levels:
            mask, scale = level.light.shown()
            shown = mask.sum(dim=1, keepdim=True) if scale is None else mask.sum(dim=1, keepdim=True) * scale
            whole.append(by_state(shown, channels_of(sight.law)).squeeze(1))
        for block in blocks:
            passed = forward(machine, sight, block.grey)
            loss = right = 0.0
            for leaves, posterior in zip(passed.leaves, posteriors):
                if not len(leaves):
                    continue
                arrived = (leaves @ block.one_hot.T).double()
                loss -= float((arrived * posterior.double().log()).sum())
                right += float(arrived.gather(1, posterior.argmax(dim=1, keepdim=True)).sum())
            illumination = sum(float(step.alpha.sum(dim=1) @ light) for step, light in zip(passed.steps, whole))
            exposures = sum(float(step.alpha.sum()) for step in passed.steps)
            sums += torch.tensor(
                [loss, right, passed.clicks().sum(), passed.photons().sum(), illumination, exposures],
                dtype=torch.float64,
            )
    return Figures(*(sums / n).tolist())


def masses(machine: Machine, sight: Sight, blocks: list[Block]) -> list[torch.Tensor]:
    """Return how often every state is reached by the objects in `blocks`, (states,) per level."""
    with torch.no_grad():
        passes = [forward(machine, sight, block.grey) for block in blocks]
        levels = range(len(machine.levels))
        return [sum_of(passed.steps[level].alpha.sum(dim=1) for passed in passes) for level in levels]


def mean_objects(machine: Machine, sight: Sight, blocks: list[Block]) -> Iterator[torch.Tensor]:
    """Yield level by level the mean transmission of the objects that reach a state, (states, pixels)."""
    passes = [forward(machine, sight, block.grey) for block in blocks]
    for level in range(len(machine.levels)):
        alphas = [passed.steps[level].alpha for passed in passes]
        sums = sum_of(sight.mask_slope(alpha, block.grey) for alpha, block in zip(alphas, blocks))
        yield sums / sum_of(alpha.sum(dim=1, keepdim=True) for alpha in alphas).clamp(min=1e-9)
