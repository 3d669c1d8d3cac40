"""Encoders: from an object's transmission to the photoelectrons of every exposure.

Owns the trainable light and its physical limits (no negative light, a brightest pixel, whole levels); never detects.
`ActiveIllumination` is the paper's active scheme: patterns are squared weights.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

KAIMING_A = 1.2  # paper, appendix on the training procedure


class ActiveIllumination(nn.Module):
    """Patterns (d_f, pixels) = weight**2, in photoelectrons per exposure and unit transmission.

    `top_limits` are the least and most photoelectrons that the brightest level may give: the projector's peak times the
    exposures that the profile allows. With `levels` set, the forward pass shows whole levels, and the gradient passes the
    rounding straight through; the photoelectrons of the top level are then trained too.
    """

    def __init__(
        self,
        n_features: int,
        n_pixels: int,
        top_limits: tuple[float, float],
        generator: torch.Generator,
        light: float = 1.0,
    ) -> None:
        super().__init__()
        bound = math.sqrt(light * 6 / ((1 + KAIMING_A**2) * n_pixels))  # Kaiming uniform, times the wanted light
        self.weight = nn.Parameter((torch.rand(n_features, n_pixels, generator=generator) * 2 - 1) * bound)
        self.log_top = nn.Parameter(torch.tensor(math.log(top_limits[1])))
        self.top_limits = top_limits
        self.levels: int | None = None

    def start_quantising(self, levels: int) -> None:
        """Show whole levels from now on; the top level starts at the brightest pixel, within its limits."""
        with torch.no_grad():
            brightest = (self.weight**2).max().clamp(*self.top_limits)
            self.log_top.copy_(brightest.log())
        self.levels = levels

    def top(self) -> Tensor:
        """Photoelectrons of the brightest level, inside its limits."""
        low, high = self.top_limits
        return self.log_top.exp().clamp(low, high)

    def dim_to_top(self) -> None:
        """Take brighter pixels back to the brightest level: beyond it no gradient would ever make them darker again."""
        with torch.no_grad():
            bound = math.sqrt(self.top_limits[1] if self.levels is None else float(self.top()))
            self.weight.clamp_(-bound, bound)

    def patterns(self) -> Tensor:
        """Return the patterns as they are shown, (d_f, pixels)."""
        light = self.weight**2
        if self.levels is None:
            return light.clamp(max=self.top_limits[1])
        step = self.top() / (self.levels - 1)
        level = (light / step).clamp(max=self.levels - 1)
        return (level + (level.round() - level).detach()) * step

    def forward(self, transmission: Tensor) -> Tensor:
        """Return photoelectrons (n, d_f) of objects with `transmission` (n, pixels)."""
        photoelectrons: Tensor = transmission @ self.patterns().T
        return photoelectrons
