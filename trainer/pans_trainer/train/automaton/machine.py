"""The automaton while it is trained: levels of states with their patterns and successors, and the class counts of its leaves.

`forward` gives the probability of every node for every object, `backward` the exact gradient of the expected loss. An outcome (no click,
click; 0, 1, 2+ photons; or the clicks of several channels) of a state leads to a node of the next level; nodes are that level's states
first, then its leaves. Nodes of the last level are all leaves.

Tensors stand as (states, objects): rows are moved whole along the edges. For a state s of a level, with alpha its probability, q that
of no click and beta the expected loss from there on:

    alpha'(n) = sum over the edges (s, k) into n of alpha(s) q_k(s)
    beta(s) = sum_k q_k(s) beta'(successor_k(s)) + price * light(s) + sent_price * sent(s)
    d loss / d light(s) = alpha(s) * (sum_k q_k'(s) beta'(successor_k(s)) + price)

light(s) is what the object lets through and the detector finds; sent(s), the sum of what is shown, has no object in it.

The logarithm of a leaf's posterior is its loss; the class counts behind it are running means, whose own gradient vanishes at the
optimum (envelope theorem). A loss that counts wrong decisions has a gradient too: the probability of the leaves changes.

Patterns are grey (`Grey`) or of one bit with a brightness (`Bits`); what is displayed is `scale * mask`. Of several channels a state has
as many rows of pixels (`parts`) and one brightness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.base.errors import UsageError
from pans.bundle.sensor import Bundle
from pans.instrument.detector import Afterpulses
from pans_trainer.device import here
from pans_trainer.model.detection import MeanMemory
from pans_trainer.model.encoders import concentration_slope

from .outcomes import Law, by_row, by_state, channels_of, clicks_of, mean_reading, readings, slope_of

BIT_CUT = 0.2  # a pixel is lit that had more than this part of the brightest one
BRIGHTNESS_MIN, BRIGHTNESS_MAX = 1e-6, 1e6  # photoelectrons of a lit pixel
WRONG = 2.2  # nats, of a wrong decision: about the odds of ten classes, so that both parts of the loss are of one size
COUNT_FLOOR = 1e-3  # objects of every class in every leaf, before any was seen
EDGE = 1e-3  # of a pixel that was just lit, or just not, for want of light
LEAN = 0.3  # of a pixel that is lit or not, where a bundle says no more: a hundred steps at the usual rate turn it


@dataclass(slots=True)
class Grey:
    """Patterns root**2, (rows, pixels), photoelectrons per exposure and unit transmission, at most `top` per pixel.

    With `levels`, what is shown is rounded to multiples of top / (levels - 1). With `log_light` (1, 1) every state sends its exponential:
    root**2 says how it is shared among the pixels.
    """

    root: Tensor
    top: float = math.inf
    levels: int = 0
    log_light: Tensor | None = None

    @property
    def even(self) -> bool:
        """Whether every state sends the same light."""
        return self.log_light is not None

    def parameters(self) -> list[Tensor]:
        """Return what an optimiser changes."""
        return [self.root] if self.log_light is None else [self.root, self.log_light]

    def displayed(self) -> tuple[Tensor, Tensor | None]:
        """Return (mask, scale); no scale stands for 1."""
        light, scale = self.root.square(), self.scale()
        if self.levels and scale is not None:
            light = light.div_(scale).round_().clamp_(max=self.levels - 1)
        return light, scale

    def scale(self) -> Tensor | None:
        """Return the scale alone."""
        if self.log_light is not None:
            return self.log_light.exp() / self.root.square().sum(dim=1, keepdim=True)
        return torch.full((len(self.root), 1), self.top / (self.levels - 1)) if self.levels else None

    def full(self, mask: Tensor) -> Tensor:
        """Return what a full pixel has in `mask`, (states, 1): the top level, before there are levels the brightest pixel."""
        if self.levels:
            return torch.full((len(mask), 1), float(self.levels - 1), dtype=mask.dtype)
        return mask.amax(dim=1, keepdim=True)

    def add_full(self, slope: Tensor, of_full: Tensor) -> Tensor:
        """Return the gradient of the mask with that of `full` (states, 1) added; `slope` is used up."""
        if self.levels:
            return slope
        return slope.scatter_add_(1, self.root.abs().argmax(dim=1, keepdim=True), of_full)

    def set_gradients(self, slope: Tensor, light_slope: Tensor | None) -> None:
        """Set the gradients from that of the mask times the scale; `slope` is used up."""
        if self.log_light is not None:
            assert light_slope is not None
            slope -= light_slope / self.root.square().sum(dim=1, keepdim=True)
            self.log_light.grad = light_slope.sum(dim=0, keepdim=True)
        factor = 2.0 * (self.levels - 1) / self.top if self.levels else 2.0
        self.root.grad = slope.mul_(self.root).mul_(factor)

    def settle(self) -> None:
        """Take brighter pixels back to the top after a step: no gradient would ever darken them."""
        if self.top < math.inf and not self.even:  # else bits are made that light more pixels
            bound = math.sqrt(self.top)
            self.root.clamp_(-bound, bound)


@dataclass(slots=True)
class Bits:
    """Patterns of one bit, lit where `lean` is above 0, and the photoelectrons of their lit pixels: exp(`log_light`), (states, 1).

    With one brightness for all, `log_light` is one tensor (1, 1) that all levels share. The brightness stays from `bottom` to `top`.
    With `rows` (states,), `lean` is a pool (patterns, pixels) that all levels share, and a state shows the pattern of its row.
    With `parts` above 1, `lean` has as many rows of pixels for each state.
    `even`: every state sends exp(`log_light`), (1, 1), whichever pixels it lights; its brightness is that over their number.
    """

    lean: Tensor
    log_light: Tensor
    bottom: float = BRIGHTNESS_MIN
    top: float = BRIGHTNESS_MAX
    rows: Tensor | None = None
    parts: int = 1
    even: bool = False

    def parameters(self) -> list[Tensor]:
        """Return what an optimiser changes."""
        return [self.lean, self.log_light]

    def own(self) -> Tensor:
        """Return the pixels' parameters of every state, (states, pixels)."""
        return self.lean if self.rows is None else self.lean[self.rows]

    def displayed(self) -> tuple[Tensor, Tensor]:
        """Return (mask, scale)."""
        lean = self.own()
        return torch.gt(lean, 0, out=torch.empty_like(lean)), self.scale()

    def brightness(self) -> Tensor:
        """Return the photoelectrons of a lit pixel of every state, (states, 1)."""
        light = self.log_light.exp() / self.lit().clamp(min=1) if self.even else self.log_light.exp()
        return light.expand(len(self.lean) // self.parts if self.rows is None else len(self.rows), 1)

    def lit(self) -> Tensor:
        """Return how many pixels every state lights, (states, 1)."""
        return torch.gt(self.own(), 0).sum(dim=1, keepdim=True).to(self.lean.dtype)

    def scale(self) -> Tensor:
        """Return the brightness of every row of pixels, (rows, 1)."""
        return by_row(self.brightness(), self.parts)

    def full(self, mask: Tensor) -> Tensor:
        """Return what a full pixel has in `mask`, (states, 1): 1."""
        return torch.ones(len(mask), 1, dtype=mask.dtype)

    def add_full(self, slope: Tensor, of_full: Tensor) -> Tensor:
        """Return `slope`: what a full pixel has does not depend on the parameters."""
        return slope

    def set_gradients(self, slope: Tensor, light_slope: Tensor | None) -> None:
        """Set the gradients from those of the mask (times the scale) and of the logarithm of the scale; `slope` is used up.

        The gradient of a bit is 1 / (1 + 2 lean**2)**2, which is near that of sigmoid(4 lean) and takes an eighth of the time.
        """
        assert light_slope is not None
        light_slope = by_state(light_slope, self.parts)
        if self.even:  # one more pixel takes light from all others
            slope -= light_slope / self.lit()
        bend = torch.square(self.own()).mul_(2.0).add_(1.0).square_()
        gradient = torch.div(slope, bend, out=bend)
        if self.rows is not None:
            before = torch.zeros_like(self.lean) if self.lean.grad is None else self.lean.grad
            gradient = before.index_add_(0, self.rows, gradient)
        self.lean.grad = gradient
        if len(self.log_light) != len(light_slope) or self.log_light.grad is not None:  # one for all: a sum
            light_slope = light_slope.sum(dim=0, keepdim=True)
            light_slope = light_slope if self.log_light.grad is None else self.log_light.grad + light_slope
        self.log_light.grad = light_slope

    def settle(self) -> None:
        """Keep the brightness inside its limits; where states send the same light, by lighting more pixels or fewer."""
        if not self.even:
            self.log_light.clamp_(math.log(self.bottom), math.log(self.top))
            return
        n_pixels = self.lean.shape[1]
        self.log_light.clamp_(math.log(self.bottom), math.log(self.top * n_pixels))
        light = float(self.log_light.exp())
        least, most = math.ceil(light / self.top), math.floor(light / self.bottom)
        self.light_up(self.lit().clamp(min(max(1, least), n_pixels), max(1, most)))

    def light_up(self, wanted: Tensor) -> None:
        """Let every state light so many pixels, (states, 1): those that lean to it most."""
        for state in (self.lit() != wanted).flatten().nonzero().flatten().tolist():
            lean, number = self.lean[state], int(wanted[state])
            order = lean.argsort(descending=True)
            lean[order[:number]] = lean[order[:number]].clamp(min=EDGE)
            lean[order[number:]] = lean[order[number:]].clamp(max=-EDGE)


Light = Grey | Bits


def as_bits(grey: Tensor, mean_object: Tensor, top: float = BRIGHTNESS_MAX, parts: int = 1) -> Bits:
    """Return one-bit patterns made from grey ones, which give the same light on the state's mean object; all (rows, pixels).

    Lit are pixels above a part of the brightest one; more are, where the brightness would else exceed `top`. The `parts` of a state
    have one brightness, the mean of what each alone would have, by its light, or more; so many of their brightest pixels are lit that
    each brings its light.
    """
    if parts > 1:
        return _parts_as_bits(grey, mean_object, as_bits(grey, mean_object, top).log_light, top, parts)
    brightest = grey.amax(dim=1, keepdim=True).clamp(min=1e-30)
    wanted = (grey * mean_object).sum(dim=1, keepdim=True)
    values, order = grey.sort(dim=1, descending=True)
    too_few = mean_object.gather(1, order).cumsum(dim=1) < wanted / top  # so many of the brightest pixels
    last = values.gather(1, too_few.sum(dim=1, keepdim=True).clamp(max=grey.shape[1] - 1))
    lean = (grey - torch.minimum(BIT_CUT * brightest, 0.999 * last)) / brightest
    brought = ((lean > 0) * mean_object).sum(dim=1, keepdim=True).clamp(min=1e-9)
    return Bits(lean, (wanted / brought).clamp(min=BRIGHTNESS_MIN).log(), top=top)


def _parts_as_bits(grey: Tensor, mean_object: Tensor, log_light: Tensor, top: float, parts: int) -> Bits:
    """As `as_bits`, with the brightness of each part alone, the exponential of `log_light` (rows, 1)."""
    wanted = (grey * mean_object).sum(dim=1, keepdim=True)
    common = by_state(wanted * log_light, parts) / by_state(wanted, parts).clamp(min=1e-30)
    least = (wanted / ((grey > 0) * mean_object).sum(dim=1, keepdim=True).clamp(min=1e-9)).clamp(min=BRIGHTNESS_MIN)
    # else no part could be as bright
    common = torch.maximum(common, 1e-3 + least.log().unflatten(0, (-1, parts)).amax(dim=1))
    values, order = grey.sort(dim=1, descending=True)
    lit = (mean_object.gather(1, order).cumsum(dim=1) * by_row(common.exp(), parts) < wanted).sum(dim=1, keepdim=True)
    last = values.gather(1, lit.clamp(max=grey.shape[1] - 1))  # the darkest pixel that is lit
    lean = (grey - 0.999 * last) / values[:, :1].clamp(min=1e-30)
    return Bits(lean, common, top=top, parts=parts)


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
    With `fades` below infinity objects bleach as a whole: 1/e of their light is left after so much illumination. The dose of a state is
    the largest over the walks to it; where the states of a level send the same light, it is that of every walk.
    """

    law: Law
    gain: float
    floor: float = 0.0
    products: torch.dtype = torch.float32
    dark_pixels: bool = False
    afterpulses: Afterpulses | None = None
    fades: float = math.inf

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

    `whole` is the light of a state, all its channels together, and `sent` (rows, 1) what each row of pixels sends. `left` (states, 1) is
    what bleaching leaves of it.
    """

    alpha: Tensor
    light: Tensor
    whole: Tensor
    sent: Tensor
    chances: tuple[Tensor, ...]
    falls: tuple[Tensor, ...]
    left: Tensor | None = None


@dataclass(slots=True)
class Pass:
    """A forward pass of some objects: its steps and, behind every level, the probability of the leaves (leaves, objects).

    `numbers` are the clicks of each outcome, or the photons counted.
    """

    numbers: tuple[int, ...]
    steps: list[Step] = field(default_factory=list)
    leaves: list[Tensor] = field(default_factory=list)

    def photons(self) -> Tensor:
        """Return the expected photoelectrons of every object."""
        return torch.stack([(step.alpha * step.whole).sum(dim=0) for step in self.steps]).sum(dim=0)

    def illumination(self) -> Tensor:
        """Return the expected light sent to every object, in photoelectrons of a clear one."""
        sent = [(step.alpha * by_state(step.sent, len(step.sent) // len(step.alpha))).sum(dim=0) for step in self.steps]
        return torch.stack(sent).sum(dim=0)

    def clicks(self) -> Tensor:
        """Return the expected clicks of every object: photons counted, where they are."""
        counted = [(step.alpha * mean_reading(step.chances, self.numbers)).sum(dim=0) for step in self.steps]
        return torch.stack(counted).sum(dim=0)


def brought(light: Light, sight: Sight, grey: Tensor) -> tuple[Tensor, Tensor]:
    """Return the light (rows, objects) that the patterns of `light` bring from objects of `grey`, and what they send, (rows, 1)."""
    mask, scale = light.displayed()
    result = sight.light(mask, grey, light.full(mask) if sight.dark_pixels else None)
    return result if scale is None else result.mul_(scale), _sent(mask, scale)


def sent_by(light: Light) -> Tensor:
    """Return the light that the patterns of `light` send, (rows, 1)."""
    return _sent(*light.displayed())


def _sent(mask: Tensor, scale: Tensor | None) -> Tensor:
    sent = mask.sum(dim=1, keepdim=True)
    return sent if scale is None else sent * scale


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


def left_of(dose: Tensor, sent: Tensor, fades: float) -> Tensor:
    """Return what bleaching leaves of the light of states, (states, 1), which send `sent` after `dose`; see Sight."""
    own = (sent / fades).clamp(min=1e-30)
    return torch.exp(-dose.clamp(min=0) / fades) * -torch.expm1(-own) / own


def doses_behind(doses: Tensor, successors: Tensor, n_nodes: int) -> Tensor:
    """Return the largest dose over the walks to every node, (nodes, 1), from those behind the states (states, 1) before; -inf for none."""
    nodes = torch.full((n_nodes, 1), -math.inf, dtype=doses.dtype)
    edges = doses.expand(len(successors), *doses.shape).flatten(0, 1)
    return nodes.scatter_reduce_(0, successors.reshape(-1, 1), edges, "amax")


def forward(machine: Machine, sight: Sight, grey: Tensor) -> Pass:
    """Return the pass of the objects `grey` (objects, pixels) through `machine`."""
    result, channels = Pass(clicks_of(sight.law)), channels_of(sight.law)
    nodes = torch.ones(1, len(grey), dtype=sight.sums)
    memory = None if sight.afterpulses is None else MeanMemory(sight.afterpulses, nodes)
    dose, left = torch.zeros(1, 1, dtype=torch.float64), None  # before each state
    for number, level in enumerate(machine.levels):
        alpha = nodes[: level.n_states]
        if number:
            result.leaves.append(nodes[level.n_states :])
        light, sent = brought(level.light, sight, grey)
        if sight.fades < math.inf:
            dose = dose[: level.n_states]
            left = left_of(dose, sent.double(), sight.fades).to(light.dtype)
            light, dose = light.mul_(left), doses_behind(dose + sent, level.successors, machine.n_nodes(number))
        chances, falls = readings(light, sight.law)
        if memory is not None:
            chances, falls = memory.step(alpha, chances, falls, level.successors, machine.n_nodes(number))
        result.steps.append(Step(alpha, light, by_state(light, channels), sent, chances, falls, left))
        nodes = children(alpha, chances, level.successors, machine.n_nodes(number))
    result.leaves.append(nodes)
    return result


def leaf_losses(counts: Tensor, one_hot: Tensor) -> Tensor:
    """Return -log of the posterior of the true class in every leaf, (leaves, objects); `one_hot` is (classes, objects)."""
    return -torch.log(counts / counts.sum(dim=1, keepdim=True)) @ one_hot


class Spent(NamedTuple):
    """What a decision takes: clicks or photons counted, photoelectrons detected, and photoelectrons sent, those of a clear object."""

    clicks: float = 0.0
    photons: float = 0.0
    illumination: float = 0.0


@dataclass(frozen=True, slots=True)
class Aim:
    """What training makes small, the mean of loss + price * photons + sent_price * illumination + exposure_price * exposures.

    Prices are in nats, of a photoelectron detected or sent, and of an exposure (saved where a walk ends early). `decide` is the part of the
    loss that counts wrong decisions, `WRONG` nats each; the rest is the log loss. `spread` times the mean over exposures of how
    concentrated the light is (model/encoders.py) is added.
    """

    price: float
    sent_price: float = 0.0
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
    faded = 0.0  # what later levels lose by one more photoelectron sent
    for number in range(len(machine.levels) - 1, -1, -1):
        level, step = machine.levels[number], passed.steps[number]
        after_last = beta[level.successors[-1]]
        gains = [beta[after].sub_(after_last) for after in level.successors[:-1]]  # what they cost more than the last
        slope = slope_of(step.falls, gains, sight.law)
        slope.neg_().add_(aim.price).mul_(by_row(step.alpha, channels)).mul_(share)
        mask_slope = sight.mask_slope(slope, grey, level.light)
        scale = level.light.scale()
        light_slope = None if scale is None else slope.mul_(step.light).sum(dim=1, keepdim=True)
        if step.left is not None:
            assert light_slope is not None
            mask_slope, detected = mask_slope.mul_(step.left), float(light_slope.sum())
        if aim.sent_price:
            cost = by_row(step.alpha.sum(dim=1, keepdim=True), channels).to(slope.dtype).mul_(share * aim.sent_price)
            mask_slope += cost
            if light_slope is not None:
                light_slope += cost * step.sent
        mask_slope = mask_slope if scale is None else mask_slope.mul_(scale)
        if aim.spread:
            mass = step.alpha.sum(dim=1, keepdim=True).mul_(aim.spread * share / len(machine.levels))
            mask_slope.addcmul_(by_row(mass, channels), concentration_slope(level.light.displayed()[0]))
        level.light.set_gradients(mask_slope, light_slope)
        if step.left is not None:
            faded = _add_fading(level.light, step, detected, faded, sight.fades)
        beta = gains[0].mul_(step.chances[0])
        for chance, gain in zip(step.chances[1:], gains[1:]):
            beta.addcmul_(chance, gain)
        beta.add_(after_last).add_(step.whole, alpha=aim.price)
        beta += aim.exposure_price + aim.sent_price * by_state(step.sent, channels)
        if number and len(machine.counts[number - 1]):
            beta = torch.cat([beta, aim.at_leaves(machine.counts[number - 1], one_hot)])


def _add_fading(light: Light, step: Step, detected: float, faded: float, fades: float) -> float:
    """Add what one more photoelectron of an even level bleaches: its own light by `detected`, that of later levels by `faded`.

    Both are gradients by the logarithm of what is left; returns those of this level and the later ones together.
    """
    assert light.log_light is not None
    assert light.log_light.grad is not None
    own = float(step.sent.max()) / fades
    light.log_light.grad += detected * (own / math.expm1(own) - 1) - own * faded
    return faded + detected


def machine_state(machine: Machine) -> dict[str, Any]:
    """Return `machine` as nested lists and dicts of tensors and numbers."""
    levels = []
    for level in machine.levels:
        light = {name: getattr(level.light, name) for name in level.light.__slots__}
        levels.append({"successors": level.successors, "light": light})
    return {"counts": list(machine.counts), "levels": levels}


def machine_from(state: dict[str, Any]) -> Machine:
    """Return the machine of `machine_state`; a tensor that several levels shared is one tensor again."""
    shared: dict[int, Tensor] = {}

    def once(value: Any) -> Any:  # torch.load keeps what was one storage one
        return shared.setdefault(value.data_ptr(), here(value)) if isinstance(value, Tensor) else value

    levels = []
    for level in state["levels"]:
        light = {name: once(value) for name, value in level["light"].items()}
        levels.append(Level((Grey if "root" in light else Bits)(**light), here(level["successors"])))
    return Machine(levels, [here(counts) for counts in state["counts"]])


def machine_of(bundle: Bundle) -> Machine:
    """Return the machine of an automaton's bundle, one bit and a brightness per state; a leaf counts one object, by its posterior.

    UsageError for a bundle without an automaton or with grey patterns.
    """
    automaton = bundle.automaton
    if automaton is None:
        raise UsageError(f"{bundle.name} holds no automaton", remedy="start from one of --encoder automaton")
    levels, counts = [], []
    for number in range(automaton.n_slots):
        own, after = (np.flatnonzero(automaton.depth == depth) for depth in (number, number + 1))
        edges = automaton.successors[own].astype(np.int64)
        leaves = np.unique(edges[edges >= automaton.n_states])
        nodes = np.concatenate([after, leaves])  # rising, as leaves are numbered after all states
        successors = np.ascontiguousarray(np.searchsorted(nodes, edges).T)
        levels.append(Level(_bits_of(bundle, own), here(torch.from_numpy(successors))))
        counts.append(here(torch.from_numpy(automaton.posteriors[leaves])))
    return Machine(levels, counts)


def _bits_of(bundle: Bundle, states: NDArray[np.int64]) -> Bits:
    assert bundle.automaton is not None
    parts, n_pixels = bundle.automaton.channels, bundle.n_pixels
    shown = bundle.pattern_levels[bundle.automaton.rows[states]].astype(np.int64).reshape(len(states), -1)
    lit, most = shown > 0, shown.max(axis=1, keepdims=True)
    if (lit & (shown != most)).any():
        what = f"{bundle.name} has grey patterns, a training starts from patterns of one bit and a brightness"
        raise UsageError(what, remedy="start from an automaton trained without --grey")
    part = bundle.automaton.dwell[states, None] / bundle.automaton.dwell_steps
    brightness = np.maximum(BRIGHTNESS_MIN, most * bundle.photons_per_level * part)
    lean = torch.from_numpy(np.where(lit, LEAN, -LEAN).astype(np.float32).reshape(-1, n_pixels))
    return Bits(here(lean), here(torch.from_numpy(np.log(brightness).astype(np.float32))), parts=parts)
