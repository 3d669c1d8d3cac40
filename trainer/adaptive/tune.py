"""Tuning all levels of an automaton at once by the exact gradient, with the price of light found from the budget.

Owns the loop over epochs and blocks, the learning rate, the running class counts of the leaves and the price; what is tuned (grey
levels, one bit) is the machine's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from .machine import COUNT_FLOOR, Aim, Machine, Sight, backward, forward
from .objects import Block

COUNT_SHARE = 0.02  # of a step in the running class counts
PRICE_MIN, PRICE_MAX = 1e-6, 10.0


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


@dataclass(frozen=True, slots=True)
class TuneReport:
    """Means over an epoch of the objects that were fitted."""

    epoch: int
    loss: float
    accuracy: float
    clicks: float
    photons: float
    price: float


class Tuning:
    """A machine and its optimiser; `epoch` passes once over blocks of objects. The rate falls to 0 over `steps` steps."""

    def __init__(self, machine: Machine, sight: Sight, price: Price, rate: float, steps: int) -> None:
        self.machine, self.sight, self.price, self.rate, self.steps = machine, sight, price, rate, steps
        self.exposure_price = self.decide = self.spread = 0.0  # see Aim; they may change from epoch to epoch
        self.done = self.epochs = 0
        self.optimiser = torch.optim.Adam(machine.parameters(), lr=rate, fused=True)

    def epoch(self, blocks: list[Block]) -> TuneReport:
        """Pass over `blocks` once."""
        sums, n = torch.zeros(4, dtype=torch.float64), sum(len(block) for block in blocks)
        for block in blocks:
            sums += self.step(block, n)
        self.epochs += 1
        loss, accuracy, clicks, photons = (sums / n).tolist()
        return TuneReport(self.epochs, loss, accuracy, clicks, photons, self.price.value)

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs to go on."""
        return {"optimiser": self.optimiser.state_dict(), "done": self.done, "epochs": self.epochs}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`, of a tuning of the same machine."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.done, self.epochs = state["done"], state["epochs"]

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
