"""Tuning all levels of an automaton at once by the exact gradient, with the price of light found from the budget.

Also `figures`: what an automaton does on some objects, as exact sums without gradient, by the machine's class counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch

from .grow import sum_of
from .machine import COUNT_FLOOR, Aim, Machine, Sight, backward, forward
from .objects import Block
from .outcomes import by_state, channels_of

COUNT_SHARE = 0.02  # of a step in the running class counts
PRICE_MIN, PRICE_MAX = 1e-6, 10.0


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
            mask, scale = level.light.displayed()
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


@dataclass(slots=True)
class Price:
    """Price of a photoelectron, in nats; with a `budget` it follows what is spent: photons, or clicks where `of_clicks`."""

    value: float
    budget: float | None = None
    of_clicks: bool = False
    rate: float = 0.05  # of the logarithm, per step and relative excess
    most: float = 0.02  # change of the logarithm in one step

    def excess(self, spent: tuple[float, float], part: float) -> float:
        """Return how many times that `part` of the budget was spent, of (photons, clicks); 0 where there is no budget or part."""
        return spent[self.of_clicks] / (self.budget * part) if self.budget and part else 0.0

    def follow(self, spent: float) -> None:
        """Raise the price where more was spent than the budget allows, else lower it."""
        if self.budget is not None:
            change = self.rate * (spent / self.budget - 1)
            wanted = self.value * math.exp(min(self.most, max(-self.most, change)))
            self.value = min(PRICE_MAX, max(PRICE_MIN, wanted))


class Tuning:
    """A machine and its optimiser; `epoch` passes once over blocks of objects. The rate falls to 0 over `steps` steps."""

    def __init__(self, machine: Machine, sight: Sight, price: Price, rate: float, steps: int) -> None:
        self.machine, self.sight, self.price, self.rate, self.steps = machine, sight, price, rate, steps
        self.exposure_price = self.decide = self.spread = 0.0  # see Aim; they may change from epoch to epoch
        self.done = 0
        self.optimiser = torch.optim.Adam(machine.parameters(), lr=rate, fused=True)

    def epoch(self, blocks: list[Block]) -> tuple[float, float, float, float]:
        """Pass over `blocks` once; return the means over their objects of loss, accuracy, clicks and photons."""
        sums, n = torch.zeros(4, dtype=torch.float64), sum(len(block) for block in blocks)
        for block in blocks:
            sums += self.step(block, n)
        loss, accuracy, clicks, photons = (sums / n).tolist()
        return loss, accuracy, clicks, photons

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs to continue."""
        return {"optimiser": self.optimiser.state_dict(), "done": self.done}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`, of a tuning of the same machine."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.done = state["done"]

    def step(self, block: Block, n: int) -> torch.Tensor:
        """One step of Adam; returns the sums over the block: loss, right decisions, clicks, photons."""
        machine = self.machine
        with torch.no_grad():
            passed = forward(machine, self.sight, block.grey)
            aim = Aim(self.price.value, self.exposure_price, self.decide, self.spread)
            backward(machine, self.sight, block.grey, block.one_hot, passed, aim)
            for group in self.optimiser.param_groups:
                group["lr"] = self.rate * max(0.0, 1 - self.done / self.steps) + 1e-5
            self.optimiser.step()
            for level in machine.levels:
                level.light.settle()
            self.done += 1
            loss = right = 0.0
            for number, leaves in enumerate(passed.leaves):
                if not len(leaves):
                    continue
                counts = machine.counts[number]
                arrived = leaves @ block.one_hot.T
                loss -= float((arrived * torch.log(counts / counts.sum(dim=1, keepdim=True))).sum())
                right += float(arrived.gather(1, counts.argmax(dim=1, keepdim=True)).sum())
                counts.mul_(1 - COUNT_SHARE).add_(arrived, alpha=COUNT_SHARE * n / len(block)).add_(
                    COUNT_SHARE * COUNT_FLOOR
                )
            clicks, photons = float(passed.clicks().sum()), float(passed.photons().sum())
            self.price.follow((clicks if self.price.of_clicks else photons) / len(block))
        return torch.tensor([loss, right, clicks, photons], dtype=torch.float64)
