"""The automaton while it is trained: levels of states, their successors, and the class counts of its leaves.

Owns the exact forward pass (the probability of every node, given an object), the exact gradient of the expected loss, and the matrix
products in reduced precision that make both quick. A level has states; an outcome (no click, click; 0, 1, 2+ photons; or the clicks of
several channels) of a state leads to a node of the next level; nodes are that level's states first, then its leaves. Nodes of the last
level are all leaves.

Tensors stand as (states, objects): rows are moved whole along the edges. For a state s of a level, with alpha its probability, q that
of no click and beta the expected loss from there on:

    alpha'(n) = sum over the edges (s, k) into n of alpha(s) q_k(s)
    beta(s) = sum_k q_k(s) beta'(successor_k(s)) + price * light(s)
    d loss / d light(s) = alpha(s) * (sum_k q_k'(s) beta'(successor_k(s)) + price)

The logarithm of a leaf's posterior is its loss; the class counts behind it are running means, whose own gradient vanishes at the
optimum (envelope theorem). Decisions, the largest counts, are constant but where two are equal; a loss that counts wrong ones has
a gradient all the same, as it is the probability of the leaves that changes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from pans.runtime.detector import Afterpulses
from pans.trainer.model.afterpulses import MeanMemory
from pans.trainer.model.concentration import concentration_slope

from .light import Light
from .outcomes import Law, by_row, by_state, channels_of, clicks_of, mean_reading, readings, slope_of

WRONG = 2.2  # nats, of a wrong decision: about the odds of ten classes, so that both parts of the loss are of one size
COUNT_FLOOR = 1e-3  # objects of every class in every leaf, before any was seen


@dataclass(slots=True)
class Level:
    """States of one exposure: what they show, and `successors` (outcomes, states), nodes of the next level."""

    light: Light
    successors: Tensor

    @property
    def n_states(self) -> int:
        """Number of states."""
        return self.successors.shape[1]


@dataclass(slots=True)
class Machine:
    """An automaton: `levels`, and for the nodes behind each of them `counts`, the class counts of the leaves (leaves, classes)."""

    levels: list[Level]
    counts: list[Tensor]

    def n_nodes(self, level: int) -> int:
        """Return the number of nodes behind exposure `level`."""
        states = self.levels[level + 1].n_states if level + 1 < len(self.levels) else 0
        return states + len(self.counts[level])

    def parameters(self) -> list[Tensor]:
        """Return what an optimiser changes, each tensor once."""
        found: dict[int, Tensor] = {}
        for level in self.levels:
            found.update((id(tensor), tensor) for tensor in level.light.parameters())
        return list(found.values())


@dataclass(frozen=True, slots=True)
class Sight:
    """How light meets objects: transmission = floor + gain * grey; the law of one exposure; the type of the matrix products.

    With `afterpulses` a state clicks with the mean memory of the walks that reach it.
    With `dark_pixels` grey values have one more column, the light that dark pixels bring where a full one has 1 (model/imaging.py).
    """

    law: Law
    gain: float
    floor: float = 0.0
    products: torch.dtype = torch.float32
    dark_pixels: bool = False
    afterpulses: Afterpulses | None = None

    def exact(self) -> Sight:
        """Return the same in float64 and without memory."""
        return replace(self, products=torch.float64, afterpulses=None)

    @property
    def sums(self) -> torch.dtype:
        """The type of everything but the products: float32, or wider where these are."""
        return torch.promote_types(self.products, torch.float32)

    def light(self, mask: Tensor, grey: Tensor, full: Tensor | None = None) -> Tensor:
        """Return mask @ transmission, (states, objects), of grey values `grey` (objects, pixels) in the type of the products.

        `full` (states, 1) is what a full pixel has in the mask; None: as much as the brightest one.
        """
        if self.dark_pixels:
            mask = torch.cat([mask, mask.amax(dim=1, keepdim=True) if full is None else full], dim=1)
        brought = (mask.to(self.products) @ grey.T).to(self.sums).mul_(self.gain)
        if self.floor:
            brought += self.floor * mask.sum(dim=1, keepdim=True)
        return brought

    def mask_slope(self, slope: Tensor, grey: Tensor, light: Light | None = None) -> Tensor:
        """Return the gradient of the mask (states, pixels) from that of the light, (states, objects).

        With `light` that of what a full pixel has is in it; without, it is the sum of the transmission of `grey`, weighted by `slope`.
        """
        result = (slope.to(self.products) @ grey).to(slope.dtype).mul_(self.gain)
        if self.floor:
            result += self.floor * slope.sum(dim=1, keepdim=True)
        if self.dark_pixels:
            of_full, result = result[:, -1:], result[:, :-1].contiguous()
            if light is not None:
                result = light.add_full(result, of_full)
        return result


@dataclass(slots=True)
class Step:
    """One level of a pass: probability of the states, light by rows, chances of all outcomes but the last, and how fast these fall.

    `whole` is the light of a state, all its channels together; `numbers` are the clicks of each outcome.
    """

    alpha: Tensor
    light: Tensor
    whole: Tensor
    chances: tuple[Tensor, ...]
    falls: tuple[Tensor, ...]
    numbers: tuple[int, ...]

    @property
    def dark(self) -> Tensor:
        """Probability of no click: of the outcome 0."""
        return self.chances[0]

    def clicks(self) -> Tensor:
        """Return the expected clicks of every object: photons counted, where they are."""
        return (self.alpha * mean_reading(self.chances, self.numbers)).sum(dim=0)


@dataclass(slots=True)
class Pass:
    """A forward pass of some objects: its steps and, behind every level, the probability of the leaves (leaves, objects)."""

    steps: list[Step] = field(default_factory=list)
    leaves: list[Tensor] = field(default_factory=list)

    def photons(self) -> Tensor:
        """Return the expected photoelectrons of every object."""
        return torch.stack([(step.alpha * step.whole).sum(dim=0) for step in self.steps]).sum(dim=0)

    def clicks(self) -> Tensor:
        """Return the expected clicks of every object: photons counted, where they are."""
        return torch.stack([step.clicks() for step in self.steps]).sum(dim=0)


def brought(light: Light, sight: Sight, grey: Tensor) -> Tensor:
    """Return the light (rows, objects) that the patterns of `light` bring from objects of `grey`."""
    mask, scale = light.shown()
    result = sight.light(mask, grey, light.full(mask) if sight.dark_pixels else None)
    return result if scale is None else result.mul_(scale)


def children(alpha: Tensor, chances: tuple[Tensor, ...], successors: Tensor, n_nodes: int) -> Tensor:
    """Return the probability of the nodes behind states of probability `alpha`, (nodes, objects).

    `chances` are those of all outcomes but the last, which takes what remains.
    """
    nodes = torch.zeros(n_nodes, alpha.shape[1], dtype=alpha.dtype)
    rest = alpha
    for chance, after in zip(chances, successors):
        part = alpha * chance
        nodes.index_add_(0, after, part)
        rest = torch.sub(rest, part, out=part)
    if len(chances) > 1:
        rest.clamp_(min=0)  # a difference of several numbers rounds to either side of 0
    return nodes.index_add_(0, successors[-1], rest)


def forward(machine: Machine, sight: Sight, grey: Tensor) -> Pass:
    """Return the pass of the objects `grey` (objects, pixels) through `machine`."""
    result, numbers, channels = Pass(), clicks_of(sight.law), channels_of(sight.law)
    nodes = torch.ones(1, len(grey), dtype=sight.sums)
    memory = None if sight.afterpulses is None else MeanMemory(sight.afterpulses, nodes)
    for number, level in enumerate(machine.levels):
        alpha = nodes[: level.n_states]
        if number:
            result.leaves.append(nodes[level.n_states :])
        light = brought(level.light, sight, grey)
        chances, falls = readings(light, sight.law)
        if memory is not None:
            chances, falls = memory.go_on(alpha, chances, falls, level.successors, machine.n_nodes(number))
        result.steps.append(Step(alpha, light, by_state(light, channels), chances, falls, numbers))
        nodes = children(alpha, chances, level.successors, machine.n_nodes(number))
    result.leaves.append(nodes)
    return result


def leaf_losses(counts: Tensor, one_hot: Tensor) -> Tensor:
    """Return -log of the posterior of the true class in every leaf, (leaves, objects); `one_hot` is (classes, objects)."""
    return -torch.log(counts / counts.sum(dim=1, keepdim=True)) @ one_hot


@dataclass(frozen=True, slots=True)
class Aim:
    """What training makes small, the mean of loss + price * photons + exposure_price * exposures.

    Prices are in nats, of a photoelectron and of an exposure (saved where a walk ends early). Of the loss `decide` is the part that
    counts wrong decisions, `WRONG` nats each; the rest is the log loss. `spread` times the mean over exposures of how concentrated
    the light is (model/concentration.py) is added.
    """

    price: float
    exposure_price: float = 0.0
    decide: float = 0.0
    spread: float = 0.0

    def at_leaves(self, counts: Tensor, one_hot: Tensor) -> Tensor:
        """Return the loss of the objects in every leaf of these class counts, (leaves, objects)."""
        if not self.decide:
            return leaf_losses(counts, one_hot)
        table = -(1.0 - self.decide) * torch.log(counts / counts.sum(dim=1, keepdim=True)) + self.decide * WRONG
        decided = counts.argmax(dim=1, keepdim=True)
        table.scatter_add_(1, decided, torch.full_like(table[:, :1], -self.decide * WRONG))
        return table @ one_hot


def backward(machine: Machine, sight: Sight, grey: Tensor, one_hot: Tensor, passed: Pass, aim: Aim) -> None:
    """Set the gradients of what `aim` makes small over the objects of `passed`; they replace those that were there."""
    for tensor in machine.parameters():
        tensor.grad = None
    share, channels = 1.0 / len(grey), channels_of(sight.law)
    beta = aim.at_leaves(machine.counts[-1], one_hot)
    for number in range(len(machine.levels) - 1, -1, -1):
        level, step = machine.levels[number], passed.steps[number]
        after_last = beta[level.successors[-1]]
        gains = [beta[after].sub_(after_last) for after in level.successors[:-1]]  # what they cost more than the last
        slope = slope_of(step.falls, gains, sight.law)
        slope.neg_().add_(aim.price).mul_(by_row(step.alpha, channels)).mul_(share)
        mask_slope = sight.mask_slope(slope, grey, level.light)
        scale = level.light.scale()
        light_slope = None if scale is None else slope.mul_(step.light).sum(dim=1, keepdim=True)
        mask_slope = mask_slope if scale is None else mask_slope.mul_(scale)
        if aim.spread:
            mass = step.alpha.sum(dim=1, keepdim=True).mul_(aim.spread * share / len(machine.levels))
            mask_slope.addcmul_(by_row(mass, channels), concentration_slope(level.light.shown()[0]))
        level.light.take(mask_slope, light_slope)
        beta = gains[0].mul_(step.chances[0])
        for chance, gain in zip(step.chances[1:], gains[1:]):
            beta.addcmul_(chance, gain)
        beta.add_(after_last).add_(step.whole, alpha=aim.price)
        if aim.exposure_price:
            beta += aim.exposure_price
        if number and len(machine.counts[number - 1]):
            beta = torch.cat([beta, aim.at_leaves(machine.counts[number - 1], one_hot)])
