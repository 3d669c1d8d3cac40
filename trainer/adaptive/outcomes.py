"""What one exposure can tell, with the light that reaches the detector as argument: no click or a click, or a number of photons.

Owns the probability of every outcome and its slope, as fast as training needs it; the laws themselves are those of `runtime.instrument`
(click_law.py, count_law.py). Tensors in, tensors out, of any one shape; float32 in training, float64 where figures are compared. The last
outcome is what remains: its probability is 1 less the others', its slope minus theirs.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pans.runtime.instrument.click_law import ClickLaw, survival_coefficients
from pans.runtime.instrument.count_law import CountLaw, outcome_weights
from pans.trainer.model.detection import counted_mean

MEAN_MAX = 100.0  # beyond it no detector of a profile stays dark, and high powers of the mean leave float32
NEGLIGIBLE = 1e-8  # c_k k!: the chance to miss that many photoelectrons, below which the term is left out

Law = ClickLaw | CountLaw
Readings = tuple[
    tuple[Tensor, ...], tuple[Tensor, ...]
]  # chances of all outcomes but the last, and how fast each falls


def readings(light: Tensor, law: Law) -> Readings:
    """Return the chances of all outcomes but the last, and how fast each of them falls with `light` (photoelectrons).

    The fall is -d/d(light): negative where an outcome becomes more probable. Under a click law both are those of `no_click`.
    """
    if isinstance(law, ClickLaw):
        dark, fall = no_click(light, law)
        return (dark,), (fall,)
    mean = light + law.dark_per_exposure if law.dark_per_exposure else light
    return _plain(mean, law) if law.is_plain else _noisy(mean, law)


def mean_reading(chances: tuple[Tensor, ...]) -> Tensor:
    """Return the mean outcome, a number of clicks or photons, from the chances of all outcomes but the last."""
    last = len(chances)
    mean = 1 - chances[0] if last == 1 else last * (1 - chances[0])
    for outcome, chance in enumerate(chances[1:], 1):
        mean -= (last - outcome) * chance
    return mean


def kept_coefficients(law: ClickLaw) -> tuple[float, ...]:
    """Return the c_k of `1 - p = exp(-mu) sum_k c_k mu^k` that count in float32; (1.0,) is the plain Poisson law."""
    kept, factorial = [], 1.0
    for k, coefficient in enumerate(survival_coefficients(law).tolist()):
        factorial *= max(1, k)
        if coefficient * factorial > NEGLIGIBLE:
            kept.append(coefficient)
    return tuple(kept)


def no_click(light: Tensor, law: ClickLaw) -> tuple[Tensor, Tensor]:
    """Return the probability of no click, and how fast it falls with `light` (photoelectrons): both of the shape of `light`.

    The fall is -d/d(light), which is the slope of the click probability. With the plain law and no dead time both are the same tensor.
    """
    coefficients = kept_coefficients(law)
    blinded = law.dead_time.reach > 0
    if coefficients == (1.0,) and not blinded:
        dark = torch.exp(-(light + law.dark_per_exposure)) if law.dark_per_exposure else torch.exp(-light)
        return dark, dark
    mean, slope = counted_mean((light + law.dark_per_exposure).clamp(max=MEAN_MAX), law.dead_time)
    missed = torch.zeros_like(mean)
    change = torch.zeros_like(mean)
    for coefficient in reversed(coefficients):  # Horner, of the polynomial and of its derivative
        change = change * mean + missed
        missed = missed * mean + coefficient
    empty = torch.exp(-mean)
    fall = empty * (missed - change)
    return empty * missed, fall * slope if blinded else fall


def _plain(mean: Tensor, law: CountLaw) -> Readings:
    """Without read noise: p_k = exp(-mean) mean^k / k!, which falls by p_k - p_(k-1)."""
    chances = [torch.exp(-mean)]
    falls = [chances[0]]
    for k in range(1, law.outcomes - 1):
        chances.append(chances[-1] * mean if k == 1 else (chances[-1] * mean).mul_(1.0 / k))
        falls.append(chances[-1] - chances[-2])
    return tuple(chances), tuple(falls)


def _noisy(mean: Tensor, law: CountLaw) -> Readings:
    """With read noise: polynomials in the mean, each coefficient of a chance 0 or above, so that no chance loses digits."""
    mean = mean.clamp(max=MEAN_MAX)
    weights = outcome_weights(law)
    empty = torch.exp(-mean)
    chances, falls = [], []
    for row in weights[:-1].tolist():
        kept = [weight if weight > NEGLIGIBLE else 0.0 for weight in row]
        while len(kept) > 1 and not kept[-1]:
            kept.pop()
        drops = [here - after for here, after in zip(kept, [*kept[1:], 0.0])]
        chances.append(_polynomial(mean, kept).mul_(empty))
        falls.append(_polynomial(mean, drops).mul_(empty))
    return tuple(chances), tuple(falls)


def _polynomial(mean: Tensor, weights: list[float]) -> Tensor:
    """Return sum_k weights_k mean^k / k!."""
    total = torch.full_like(mean, weights[-1] / math.factorial(len(weights) - 1))
    for k in range(len(weights) - 2, -1, -1):
        total.mul_(mean).add_(weights[k] / math.factorial(k))
    return total
