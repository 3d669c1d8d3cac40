"""Photon detection as a stochastic layer: the click law in torch, afterpulses, sampled clicks, and all click words.

Shapes: n objects, d_f patterns; tensors in, tensors out, all differentiable in the photoelectrons. `sample_clicks` passes gradients
straight through (the estimators are in estimators.py); the click law behind it damps them: for a plain Poisson detector
dL/dlambda = dL/da * slope * exp(-slope * lambda) (paper, appendix on gradient estimation).

Afterpulses are those of `instrument/detector`, in the mean: fixed patterns are trained with the memory of all words, so that clicks stay
independent, each with its right chance; how clicks depend on each other is left out, and `pans evaluate` has it. In an automaton every
state has the memory of all walks that reach it, mean and variance. The gradient is that of a memory that stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from pans.instrument.click_law import ClickLaw, CountLaw, survival_coefficients
from pans.instrument.detector import INTERVALS, SMALL_RATIO, STEP, Afterpulses, DeadTime, afterpulses_of, counted_table
from pans.instrument.profile import Profile

_MU_MAX = 100.0  # beyond it no detector of a profile stays dark, and high powers of mu leave float64
_NEGLIGIBLE = 1e-13  # chance of missing that many photoelectrons, below which the term is left out
ROUNDS = 3  # the last one with gradients; those before find the memory with which objects come
_SURE, _LEAST = 1 - 1e-12, 1e-30


Law = ClickLaw | Callable[[Tensor], Tensor]  # a user's own: photoelectrons (float64) -> p, differentiable


def click_probability(photoelectrons: Tensor, law: Law | CountLaw, slope: float = 1.0) -> Tensor:
    """Return p (same shape, dtype of the input) for `photoelectrons` per exposure; `slope` scales the light only.

    For a `ClickLaw` the same as `pans.instrument.click_law.click_probability`, in float64 inside and differentiable; any other law
    is called with the photoelectrons in float64. ValueError for a law of photon numbers, which have chances (readings.py).
    """
    if isinstance(law, CountLaw):
        raise ValueError(f"a law of {law.outcomes} photon numbers, allowed: of a click or none")
    if not isinstance(law, ClickLaw):
        return law(photoelectrons.double() * slope).to(photoelectrons.dtype)
    mu, _ = counted_mean((photoelectrons.double() * slope + law.dark_per_exposure).clamp(max=_MU_MAX), law.dead_time)
    kept = kept_coefficients(law)
    if kept == [1.0]:
        return (-torch.expm1(-mu)).to(photoelectrons.dtype)
    survival = torch.zeros_like(mu)
    for coefficient in reversed(kept):
        survival = survival * mu + coefficient
    return (1.0 - torch.exp(-mu) * survival).to(photoelectrons.dtype)


def kept_coefficients(law: ClickLaw, negligible: float = _NEGLIGIBLE) -> list[float]:
    """Return the c_k of `1 - p = exp(-mu) sum_k c_k mu^k` with c_k k! above `negligible`; [1.0] is the plain Poisson law."""
    coefficients = survival_coefficients(law).tolist()
    return [c for k, c in enumerate(coefficients) if c * math.factorial(k) > negligible]


def counted_mean(mean: Tensor, dead_time: DeadTime) -> tuple[Tensor, Tensor]:
    """Return what dead time leaves of `mean`, and the derivative by it: both of its shape and dtype, the first differentiable.

    The same as `pans.instrument.detector.dead_time.counted_mean`.
    """
    if not dead_time.reach:
        return mean, torch.ones_like(mean)
    table = torch.tensor(counted_table(dead_time), dtype=mean.dtype, device=mean.device)
    place = (torch.log1p(mean) / STEP).clamp(max=INTERVALS)
    left = place.detach().long().clamp(max=INTERVALS - 1)
    rise = table[left + 1] - table[left]
    ratio = table[left] + rise * (place - left)
    return mean * ratio, ratio + rise / STEP * mean / (1 + mean)


def with_crosstalk(p: Tensor, kernel: tuple[float, ...]) -> Tensor:
    """Return the chances of clicks (n, d_f) with crosstalk of neighbouring patterns, from `p`, those without.

    The same as `pans.instrument.detector.with_crosstalk`: right for each click; that clicks then depend on each other is left out.
    """
    spared = torch.ones_like(p)
    for distance, chance in enumerate(kernel[: p.shape[1] - 1], 1):
        below, above = 1 - chance * p[:, :-distance], 1 - chance * p[:, distance:]
        spared = spared * pad(below, (distance, 0), value=1.0) * pad(above, (0, distance), value=1.0)
    return p + (1 - p) * (1 - spared) if kernel else p


class _StraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(_ctx: Any, p: Tensor, uniform: Tensor) -> Tensor:
        return (uniform < p).to(p.dtype)

    @staticmethod
    def backward(_ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None


def sample_clicks(p: Tensor, generator: torch.Generator) -> Tensor:
    """Return Bernoulli clicks (0.0 or 1.0, shape of `p`); backward, the gradient of a click is passed on to its p."""
    uniform = torch.rand(p.shape, generator=generator, dtype=torch.float64)  # 24 bits of float32 would bias rare clicks
    clicks: Tensor = _StraightThrough.apply(p, uniform)
    return clicks


def word_probabilities(p: Tensor) -> Tensor:
    """Return P(word | object), (n, 2**d_f), from click probabilities (n, d_f); bit i of the word is pattern i."""
    words = torch.ones(len(p), 1, dtype=p.dtype)
    for i in range(p.shape[1]):  # pattern i goes above the bits that are there
        click = p[:, i : i + 1]
        words = torch.cat([words * (1 - click), words * click], dim=1)
    return words


def click_words(n_features: int) -> Tensor:
    """Return all click words as rows of 0.0 and 1.0, float32 (2**d_f, d_f), in the order of `word_probabilities`."""
    index = torch.arange(1 << n_features)[:, None] >> torch.arange(n_features)
    return (index & 1).float()


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

    def step(
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
