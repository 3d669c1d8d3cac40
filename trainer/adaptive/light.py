"""The patterns of one level as parameters: grey, in whole projector levels, or one bit with a brightness per state.

Owns the way from parameters to what is shown, and the way back of the gradient. Of several channels a state has as many rows of pixels
(`parts`), one after the other, and one brightness. What is shown is `scale * mask`: `mask` (states,
pixels) goes into the matrix products, `scale` (states, 1) does not. Grey patterns are squares, so that no light is negative; levels
and bits pass the gradient straight through their rounding (levels) or as a smooth step would (bits).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .outcomes import by_row, by_state

BIT_CUT = 0.2  # a pixel is lit that had more than this part of the brightest one
BRIGHTNESS_MIN, BRIGHTNESS_MAX = 1e-6, 1e6  # photoelectrons of a lit pixel


@dataclass(slots=True)
class Grey:
    """Patterns root**2, (rows, pixels), photoelectrons per exposure and unit transmission, at most `top` per pixel.

    With `levels`, what is shown is rounded to multiples of top / (levels - 1).
    """

    root: Tensor
    top: float = math.inf
    levels: int = 0

    def parameters(self) -> list[Tensor]:
        """Return what an optimiser changes."""
        return [self.root]

    def shown(self) -> tuple[Tensor, Tensor | None]:
        """Return (mask, scale); no scale stands for 1."""
        light, scale = self.root.square(), self.scale()
        if scale is not None:
            light = light.div_(scale).round_().clamp_(max=self.levels - 1)
        return light, scale

    def scale(self) -> Tensor | None:
        """Return the scale alone."""
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

    def take(self, slope: Tensor, _: Tensor | None) -> None:
        """Set the gradients from that of the mask times the scale; `slope` is used up."""
        factor = 2.0 * (self.levels - 1) / self.top if self.levels else 2.0
        self.root.grad = slope.mul_(self.root).mul_(factor)

    def settle(self) -> None:
        """Take brighter pixels back to the top after a step: no gradient would ever darken them."""
        if self.top < math.inf:
            bound = math.sqrt(self.top)
            self.root.clamp_(-bound, bound)


@dataclass(slots=True)
class Bits:
    """Patterns of one bit, lit where `lean` is above 0, and the photoelectrons of their lit pixels: exp(`log_light`), (states, 1).

    With one brightness for all, `log_light` is one tensor (1, 1) that all levels share. The brightness stays from `bottom` to `top`.
    With `rows` (states,), `lean` is a pool (patterns, pixels) that all levels share, and a state shows the pattern of its row.
    With `parts` above 1, `lean` has as many rows of pixels for each state.
    """

    lean: Tensor
    log_light: Tensor
    bottom: float = BRIGHTNESS_MIN
    top: float = BRIGHTNESS_MAX
    rows: Tensor | None = None
    parts: int = 1

    def parameters(self) -> list[Tensor]:
        """Return what an optimiser changes."""
        return [self.lean, self.log_light]

    def own(self) -> Tensor:
        """Return the pixels' parameters of every state, (states, pixels)."""
        return self.lean if self.rows is None else self.lean[self.rows]

    def shown(self) -> tuple[Tensor, Tensor]:
        """Return (mask, scale)."""
        lean = self.own()
        return torch.gt(lean, 0, out=torch.empty_like(lean)), self.scale()

    def brightness(self) -> Tensor:
        """Return the photoelectrons of a lit pixel of every state, (states, 1)."""
        return self.log_light.exp().expand(len(self.lean) // self.parts if self.rows is None else len(self.rows), 1)

    def scale(self) -> Tensor:
        """Return the brightness of every row of pixels, (rows, 1)."""
        return by_row(self.brightness(), self.parts)

    def full(self, mask: Tensor) -> Tensor:
        """Return what a full pixel has in `mask`, (states, 1): 1."""
        return torch.ones(len(mask), 1, dtype=mask.dtype)

    def add_full(self, slope: Tensor, of_full: Tensor) -> Tensor:
        """Return `slope`: what a full pixel has does not depend on the parameters."""
        return slope

    def take(self, slope: Tensor, light_slope: Tensor | None) -> None:
        """Set the gradients from those of the mask (times the scale) and of the logarithm of the scale; `slope` is used up.

        The gradient of a bit is 1 / (1 + 2 lean**2)**2, which is near that of sigmoid(4 lean) and takes an eighth of the time.
        """
        bend = torch.square(self.own()).mul_(2.0).add_(1.0).square_()
        gradient = torch.div(slope, bend, out=bend)
        if self.rows is not None:
            before = torch.zeros_like(self.lean) if self.lean.grad is None else self.lean.grad
            gradient = before.index_add_(0, self.rows, gradient)
        self.lean.grad = gradient
        assert light_slope is not None
        light_slope = by_state(light_slope, self.parts)
        if len(self.log_light) != len(light_slope) or self.log_light.grad is not None:  # one for all: a sum
            light_slope = light_slope.sum(dim=0, keepdim=True)
            light_slope = light_slope if self.log_light.grad is None else self.log_light.grad + light_slope
        self.log_light.grad = light_slope

    def settle(self) -> None:
        """Keep the brightness inside its limits."""
        self.log_light.clamp_(math.log(self.bottom), math.log(self.top))


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
    common = torch.maximum(
        common, 1e-3 + least.log().unflatten(0, (-1, parts)).amax(dim=1)
    )  # else no part could be as bright
    values, order = grey.sort(dim=1, descending=True)
    lit = (mean_object.gather(1, order).cumsum(dim=1) * by_row(common.exp(), parts) < wanted).sum(dim=1, keepdim=True)
    last = values.gather(1, lit.clamp(max=grey.shape[1] - 1))  # the darkest pixel that is lit
    lean = (grey - 0.999 * last) / values[:, :1].clamp(min=1e-30)
    return Bits(lean, common, top=top, parts=parts)
