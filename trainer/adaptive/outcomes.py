"""What one exposure can tell: no click or a click, with the light that reaches the detector as argument.

Owns the probability of staying dark and its slope, as fast as training needs it; the law itself is `runtime.instrument.click_law`'s.
Tensors in, tensors out, of any one shape; float32 in training, float64 where figures are compared.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pans.runtime.instrument.click_law import ClickLaw, survival_coefficients
from pans.trainer.model.detection import counted_mean

MEAN_MAX = 100.0  # beyond it no detector of a profile stays dark, and high powers of the mean leave float32
NEGLIGIBLE = 1e-8  # c_k k!: the chance to miss that many photoelectrons, below which the term is left out


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
