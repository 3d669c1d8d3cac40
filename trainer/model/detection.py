"""Photon detection as a stochastic layer: the click law in torch, sampled clicks, and exact enumeration of click words.

Owns the physics between light and clicks during training, and its gradients; never the patterns before it and never the
head behind it. Shapes: n objects, d_f patterns; tensors in, tensors out, all differentiable in the photoelectrons.

`sample_clicks` passes gradients straight through (the estimators are in estimators.py); the click law behind it damps them: for
a plain Poisson detector dL/dlambda = dL/da * slope * exp(-slope * lambda) (paper, appendix on gradient estimation).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from pans.runtime.instrument.click_law import ClickLaw, survival_coefficients
from pans.runtime.instrument.count_law import CountLaw
from pans.runtime.instrument.dead_time import INTERVALS, STEP, DeadTime, counted_table

_MU_MAX = 100.0  # beyond it no detector of a profile stays dark, and high powers of mu leave float64
_NEGLIGIBLE = 1e-13  # chance of missing that many photoelectrons, below which the term is left out


@dataclass(frozen=True, slots=True)
class ThermalLaw:
    """Thermal light in `modes` modes: P(no click) = (1 + lambda / modes)**-modes; dark counts are Poisson (Mandel and Wolf, 14.9).

    One mode bunches most: at equal light it clicks least. Many modes are a plain Poisson detector.
    """

    modes: float = 1.0
    dark_per_exposure: float = 0.0

    def __call__(self, photoelectrons: Tensor) -> Tensor:
        """Return p for photoelectrons in float64."""
        log_dark = -self.modes * torch.log1p(photoelectrons / self.modes) - self.dark_per_exposure
        return -torch.expm1(log_dark)


Law = ClickLaw | Callable[[Tensor], Tensor]  # a user's own: photoelectrons (float64) -> p, differentiable


def click_probability(photoelectrons: Tensor, law: Law | CountLaw, slope: float = 1.0) -> Tensor:
    """Return p (same shape, dtype of the input) for `photoelectrons` per exposure; `slope` scales the light only.

    For a `ClickLaw` the same as `pans.runtime.instrument.click_law.click_probability`, in float64 inside and differentiable; any other law
    is called with the photoelectrons in float64. ValueError for a law of photon numbers, which have chances (readings.py).
    """
    if isinstance(law, CountLaw):
        raise ValueError(f"a law of {law.outcomes} photon numbers, allowed: of a click or none")
    if not isinstance(law, ClickLaw):
        return law(photoelectrons.double() * slope).to(photoelectrons.dtype)
    mu, _ = counted_mean((photoelectrons.double() * slope + law.dark_per_exposure).clamp(max=_MU_MAX), law.dead_time)
    coefficients = survival_coefficients(law).tolist()
    kept = [c for k, c in enumerate(coefficients) if c * math.factorial(k) > _NEGLIGIBLE]
    if kept == [1.0]:
        return (-torch.expm1(-mu)).to(photoelectrons.dtype)
    survival = torch.zeros_like(mu)
    for coefficient in reversed(kept):
        survival = survival * mu + coefficient
    return (1.0 - torch.exp(-mu) * survival).to(photoelectrons.dtype)


def counted_mean(mean: Tensor, dead_time: DeadTime) -> tuple[Tensor, Tensor]:
    """Return what dead time leaves of `mean`, and the derivative by it: both of its shape and dtype, the first differentiable.

    The same as `pans.runtime.instrument.dead_time.counted_mean` and `counted_slope`.
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

    The same as `pans.runtime.detector.crosstalk.with_crosstalk`: right for each click; that clicks then depend on each other is left out.
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
