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
from .machine import COUNT_FLOOR, Aim, Machine, Sight, Spent, backward, forward
from .objects import Block

COUNT_SHARE = 0.02  # of a step in the running class counts
PRICE_MIN, PRICE_MAX = 1e-6, 10.0
SENT = "illumination"
AT_CAP = 0.999  # of a cap is sent where it binds


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
    illumination: float
    price: float  # nats per photoelectron detected
    sent_price: float  # and sent


def figures(machine: Machine, sight: Sight, blocks: list[Block]) -> Figures:
    """Return the exact expectation over the objects in `blocks`, decisions by the machine's class counts."""
    sums, n = torch.zeros(6, dtype=torch.float64), sum(len(block) for block in blocks)
    with torch.no_grad():
        posteriors = [counts / counts.sum(dim=1, keepdim=True) for counts in machine.counts]
        for block in blocks:
            passed = forward(machine, sight, block.grey)
            loss = right = 0.0
            for leaves, posterior in zip(passed.leaves, posteriors):
                if not len(leaves):
                    continue
                arrived = (leaves @ block.one_hot.T).double()
                loss -= float((arrived * posterior.double().log()).sum())
                right += float(arrived.gather(1, posterior.argmax(dim=1, keepdim=True)).sum())
            exposures = sum(float(step.alpha.sum()) for step in passed.steps)
            sums += torch.tensor(
                [loss, right, passed.clicks().sum(), passed.photons().sum(), passed.illumination().sum(), exposures],
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
    """Price of a photoelectron, in nats; it follows what is spent of a `budget` of `kind`: a field of `Spent`."""

    kind: str
    value: float
    budget: float
    rate: float = 0.05  # of the logarithm, per step and relative excess
    most: float = 0.02  # change of the logarithm in one step

    def excess(self, spent: Spent | Figures, part: float = 1.0) -> float:
        """Return how many times that `part` of the budget was spent."""
        return float(getattr(spent, self.kind)) / (self.budget * part) if part else 0.0

    def follow(self, spent: Spent) -> None:
        """Raise the price where more was spent than the budget allows, else lower it."""
        change = self.rate * (self.excess(spent) - 1)
        wanted = self.value * math.exp(min(self.most, max(-self.most, change)))
        self.value = min(PRICE_MAX, max(PRICE_MIN, wanted))


@dataclass(slots=True)
class Prices:
    """The prices of one training, of each budget one: of light detected (photons or clicks), of light sent, or of both."""

    all: list[Price]

    @property
    def detected(self) -> float:
        """Nats per photoelectron detected."""
        return sum((price.value for price in self.all if price.kind != SENT), 0.0)

    @property
    def sent(self) -> float:
        """Nats per photoelectron sent."""
        return sum((price.value for price in self.all if price.kind == SENT), 0.0)

    def aim(self, exposure_price: float = 0.0, decide: float = 0.0, spread: float = 0.0) -> Aim:
        """Return what training makes small at these prices; see Aim."""
        return Aim(self.detected, self.sent, exposure_price, decide, spread)

    def excess(self, spent: Spent | Figures) -> float:
        """Return how many times the budget was spent, the one of which most was."""
        return max(price.excess(spent) for price in self.all)

    def drop_sent(self) -> None:
        """Leave out the price of light sent, where the cap holds it."""
        self.all = [price for price in self.all if price.kind != SENT]

    def follow(self, spent: Spent) -> None:
        """Let each price follow its budget."""
        for price in self.all:
            price.follow(spent)


def even_lights(machine: Machine) -> list[torch.Tensor]:
    """Return the logarithms of what the levels send whose states send the same light."""
    return [level.light.log_light for level in machine.levels if level.light.even and level.light.log_light is not None]


def hold_cap(machine: Machine, cap: float, brighten: bool = False) -> None:
    """Dim all levels alike until a whole walk sends no more than `cap`; or `brighten` them until it sends as much."""
    lights = even_lights(machine)
    total = float(torch.cat(lights).double().exp().sum()) if lights else 0.0
    if total > cap or (brighten and lights):
        for log_light in lights:
            log_light += math.log(cap / total)


def along_cap(machine: Machine, cap: float) -> None:
    """Leave of the gradients what shares the light out among the levels, where more would be sent than `cap`: that of a softmax."""
    lights = even_lights(machine)
    sent = torch.cat(lights).exp() if lights else torch.zeros(1)
    wanted = sum(float(light.grad.sum()) for light in lights if light.grad is not None)
    if wanted < 0 and float(sent.sum()) > AT_CAP * cap:
        for log_light, share in zip(lights, sent / sent.sum()):
            assert log_light.grad is not None
            log_light.grad -= wanted * share


class Tuning:
    """A machine and its optimiser; `epoch` passes once over blocks of objects. The rate falls to 0 over `steps` steps."""

    def __init__(self, machine: Machine, sight: Sight, prices: Prices, rate: float, steps: int) -> None:
        self.machine, self.sight, self.prices, self.rate, self.steps = machine, sight, prices, rate, steps
        self.exposure_price = self.decide = self.spread = 0.0  # see Aim; they may change from epoch to epoch
        self.cap = math.inf  # of what a walk sends
        self.done = 0
        self.optimiser = torch.optim.Adam(machine.parameters(), lr=rate, fused=True)

    def epoch(self, blocks: list[Block]) -> list[float]:
        """Pass over `blocks` once; return the means over their objects of loss, accuracy and the fields of `Spent`."""
        sums, n = torch.zeros(5, dtype=torch.float64), sum(len(block) for block in blocks)
        for block in blocks:
            sums += self.step(block, n)
        found: list[float] = (sums / n).tolist()
        return found

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs to continue."""
        return {"optimiser": self.optimiser.state_dict(), "done": self.done}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`, of a tuning of the same machine."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.done = state["done"]

    def step(self, block: Block, n: int) -> torch.Tensor:
        """One step of Adam; returns the sums over the block: loss, right decisions, what is spent."""
        machine = self.machine
        with torch.no_grad():
            passed = forward(machine, self.sight, block.grey)
            aim = self.prices.aim(self.exposure_price, self.decide, self.spread)
            backward(machine, self.sight, block.grey, block.one_hot, passed, aim)
            along_cap(machine, self.cap)
            for group in self.optimiser.param_groups:
                group["lr"] = self.rate * max(0.0, 1 - self.done / self.steps) + 1e-5
            self.optimiser.step()
            hold_cap(machine, self.cap)
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
            spent = [float(each.sum()) for each in (passed.clicks(), passed.photons(), passed.illumination())]
            self.prices.follow(Spent(*(each / len(block) for each in spent)))
        return torch.tensor([loss, right, *spent], dtype=torch.float64)
