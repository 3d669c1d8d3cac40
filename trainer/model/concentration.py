"""How concentrated the light of a pattern is: a penalty for sensors that must bear a table which is not perfect.

Owns the measure and its gradient. Of a pattern P of n pixels it is log(n sum P**2 / (sum P)**2): the brightness that its light has on
average, over the mean brightness of all pixels. A pattern that lights k pixels alike has log(n / k), a uniform one 0; how bright
it is does not matter. Bright spots leave the object pixel that they were made for where the image is off, and light that leaks through dark
pixels of the projector is a part of the brightest one's.
"""

from __future__ import annotations

import torch
from torch import Tensor

FAINT = 1e-12  # squared light of a pattern without any


def concentration(patterns: Tensor) -> Tensor:
    """Return the mean over patterns (patterns, pixels), none below 0, of the logarithm of their concentration."""
    return concentrations(patterns).mean()


def concentrations(patterns: Tensor) -> Tensor:
    """Return the logarithm of the concentration of every pattern, (patterns,)."""
    squares, whole = patterns.square().sum(dim=1), patterns.sum(dim=1).square()
    return torch.log(patterns.shape[1] * squares.clamp(min=FAINT) / whole.clamp(min=FAINT))


def concentration_slope(patterns: Tensor) -> Tensor:
    """Return the gradient of each pattern's logarithm of concentration, (patterns, pixels): 2 P / sum P**2 - 2 / sum P."""
    squares, whole = patterns.square().sum(dim=1, keepdim=True), patterns.sum(dim=1, keepdim=True)
    return 2 * patterns / squares.clamp(min=FAINT) - 2 / whole.clamp(min=FAINT**0.5)
