"""Encoders: from what an object shows to the photoelectrons of every exposure or detector.

Called with `(x, floor)` an encoder gives photoelectrons (n, d_f) of objects x (n, inputs).

- `ActiveIllumination`: the paper's active scheme. Patterns are squared weights; x is transmission.
- `CoherentField`: the paper's passive scheme. x is a field, real or complex; light = |W x|**2, W real as in the paper, or complex.
- `IncoherentIntensity`: x is an intensity; light = W x with W at least 0.

The paper's passive W is unconstrained: it may create photons. With `conserving`, W's largest singular value (coherent) or its column
sums (incoherent) are at most 1, so that the detectors together receive no more than the object gave.

`concentration` is a penalty for optics that are not perfect. Of a pattern P of n pixels it is log(n sum P**2 / (sum P)**2): the brightness
that its light has on average, over the mean brightness of all pixels. Bright spots miss the pixel that they were made for where the image
is off, and light that leaks through dark pixels of the projector is a part of the brightest one's.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from pans.instrument.optics import NO_BLEACHING, bleaching_of
from pans.instrument.profile import Profile
from pans_trainer.options import Options

from .exposure import top_limits
from .imaging import bleached_patterns

AT_TOP = 1e-5  # relative distance at which a pixel is as bright as the top level: some steps of float32
KAIMING_A = 1.2  # paper, appendix on the training procedure
FAINT = 1e-12  # squared light of a pattern without any


class ActiveIllumination(nn.Module):
    """Patterns (d_f, pixels) = weight**2, in photoelectrons per exposure and unit transmission.

    `top_limits` are the least and most photoelectrons that the brightest level may give: the projector's peak times the
    exposures that the profile allows. With `levels` set, the forward pass shows whole levels, and the gradient passes the
    rounding straight through; the photoelectrons of the top level are then trained too.

    Transmissions may have one more column, the light that dark pixels bring where a full one gives 1 (imaging.py). The top level is
    dimmed by what it leaks; with `pulled` the pixels that stand at it raise it by what they lack, from its lower limit too.
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
        self.weight = nn.Parameter(_kaiming((n_features, n_pixels), generator, light))
        self.log_top = nn.Parameter(torch.tensor(math.log(top_limits[1])))
        self.top_limits = top_limits
        self.levels: int | None = None
        self.pulled = False
        self.bleaching = NO_BLEACHING  # what the patterns do to the objects, shown in their order

    def start_quantising(self, levels: int) -> None:
        """Show whole levels from now on; the top level starts at the brightest pixel, within its limits."""
        with torch.no_grad():
            brightest = (self.weight**2).max().clamp(*self.top_limits)
            self.log_top.copy_(brightest.log())
        self.levels = levels

    def top(self) -> Tensor:
        """Photoelectrons of the brightest level, inside its limits."""
        top = self.log_top.exp()
        inside = top.clamp(*self.top_limits)
        return top + (inside - top).detach() if self.pulled else inside

    def dim_to_top(self) -> None:
        """Take brighter pixels back to the brightest level: beyond it no gradient would ever make them darker again."""
        with torch.no_grad():
            if self.pulled:  # at a limit, from which the next gradient may bring it back
                self.log_top.clamp_(*(math.log(limit) for limit in self.top_limits))
            bound = math.sqrt(self.top_limits[1] if self.levels is None else float(self.top()))
            self.weight.clamp_(-bound, bound)

    def lower_top(self) -> None:
        """Bring the top level down to the brightest pixel where it stands above: a longer exposure than needed wastes time."""
        with torch.no_grad():
            brightest = (self.weight**2).max().clamp(*self.top_limits)
            if self.levels is not None and brightest < self.top() * (1 - 0.5 / (self.levels - 1)):
                self.log_top.copy_(brightest.log())

    def patterns(self) -> Tensor:
        """Return the patterns as they are shown, (d_f, pixels)."""
        light = self.weight**2
        if self.levels is None:
            return light.clamp(max=self.top_limits[1])
        top = self.top()
        step = top / (self.levels - 1)
        level = (light / step).clamp(max=self.levels - 1)
        shown: Tensor = (level + (level.round() - level).detach()) * step
        if self.pulled:
            at_top = light.detach() >= (1 - AT_TOP) * top.detach()
            shown = shown + at_top * (top - top.detach())
        return shown

    def forward(self, transmission: Tensor, floor: float = 0.0) -> Tensor:
        """Return photoelectrons (n, d_f) of objects with `transmission` (n, pixels), black lifted to `floor`."""
        patterns = self.patterns()
        if not self.bleaching.is_none:
            patterns = bleached_patterns(self.bleaching, patterns)
        if transmission.shape[1] > patterns.shape[1]:
            # a full pixel of the shortest exposure may be brighter than any that the patterns need; dark ones leak a part of it
            full = patterns.max().clamp(min=self.top_limits[0]) if self.levels is None else self.top()
            patterns = torch.cat([patterns, full.expand(len(patterns), 1)], dim=1)
        photoelectrons: Tensor = (1 - floor) * (transmission @ patterns.T) + floor * patterns.sum(dim=1)
        return photoelectrons

    def illumination(self) -> Tensor:
        """Return the sum of all pattern intensities."""
        return self.patterns().sum()

    def brightest(self) -> float:
        """Return the photoelectrons of the brightest pixel, or of the top level once there are levels."""
        with torch.no_grad():
            return float(self.patterns().max() if self.levels is None else self.top())


class _Passive(nn.Module):
    """What passive encoders share: random weights (d_f, inputs), or `parts` of them; no projector, no light of their own."""

    levels = None  # nothing to quantise: no projector

    def __init__(
        self,
        n_features: int,
        n_inputs: int,
        generator: torch.Generator,
        *,
        light: float = 1.0,
        conserving: bool = False,
        parts: tuple[int, ...] = (),
    ) -> None:
        super().__init__()
        self.conserving = conserving
        self.weight = nn.Parameter(_kaiming((*parts, n_features, n_inputs), generator, light))

    def illumination(self) -> Tensor:
        """Return 0: a passive encoder sends no light."""
        return torch.zeros(())


class CoherentField(_Passive):
    """Transmission matrix W (d_f, inputs) for fields: light = |W x|**2. `complex_field` makes W complex."""

    def __init__(
        self, n_features: int, n_inputs: int, generator: torch.Generator, *, complex_field: bool = False, **shared: Any
    ) -> None:
        super().__init__(n_features, n_inputs, generator, parts=(2 if complex_field else 1,), **shared)

    def matrix(self) -> Tensor:
        """Return W, complex64 or float32; scaled down to a largest singular value of 1 where light is conserved."""
        matrix = self.weight[0] if len(self.weight) == 1 else torch.complex(self.weight[0], self.weight[1])
        if self.conserving:
            matrix = matrix / torch.linalg.matrix_norm(matrix, ord=2).clamp(min=1.0)
        return matrix

    def forward(self, field: Tensor, floor: float = 0.0) -> Tensor:
        """Return photoelectrons (n, d_f) of fields (n, inputs), float32 or complex64; there is no floor."""
        matrix = self.matrix()
        if field.is_complex() or matrix.is_complex():
            dtype = torch.promote_types(field.dtype, matrix.dtype)
            out = field.to(dtype) @ matrix.to(dtype).T
            return out.real.square() + out.imag.square()
        return (field @ matrix.T).square()


class IncoherentIntensity(_Passive):
    """Transmission matrix W >= 0 (d_f, inputs) for intensities, W = weight**2."""

    def matrix(self) -> Tensor:
        """Return W; where light is conserved, columns that sum to more than 1 are scaled down to 1."""
        matrix = self.weight**2
        return matrix / matrix.sum(dim=0).clamp(min=1.0) if self.conserving else matrix

    def forward(self, intensity: Tensor, floor: float = 0.0) -> Tensor:
        """Return photoelectrons (n, d_f) of intensities (n, inputs); there is no floor."""
        photoelectrons: Tensor = intensity @ self.matrix().T
        return photoelectrons


def _kaiming(shape: tuple[int, ...], generator: torch.Generator, light: float) -> Tensor:
    """Kaiming uniform (He et al. 2015) by the last axis, so wide that the squares give `light` times the paper's light."""
    bound = math.sqrt(light * 6 / ((1 + KAIMING_A**2) * shape[-1]))
    return (torch.rand(shape, generator=generator) * 2 - 1) * bound


Encoder = ActiveIllumination | CoherentField | IncoherentIntensity


def new_encoder(n_inputs: int, profile: Profile, options: Options, random: torch.Generator) -> Encoder:
    """Return the untrained encoder that `options` ask for."""
    if options.encoder == "active":
        encoder = ActiveIllumination(options.features, n_inputs, top_limits(profile), random, options.light)
        encoder.bleaching = NO_BLEACHING if options.bleach is None else bleaching_of(options.bleach)
        return encoder
    shape = options.features, n_inputs
    passive: dict[str, Any] = {"light": options.light, "conserving": options.conserving}
    if options.encoder == "incoherent":
        return IncoherentIntensity(*shape, random, **passive)
    return CoherentField(*shape, random, complex_field=options.complex_field, **passive)


def concentration(patterns: Tensor) -> Tensor:
    """Return the mean over patterns (patterns, pixels), none below 0, of the logarithm of their concentration."""
    squares, whole = patterns.square().sum(dim=1), patterns.sum(dim=1).square()
    return torch.log(patterns.shape[1] * squares.clamp(min=FAINT) / whole.clamp(min=FAINT)).mean()


def concentration_slope(patterns: Tensor) -> Tensor:
    """Return the gradient of each pattern's logarithm of concentration, (patterns, pixels): 2 P / sum P**2 - 2 / sum P."""
    squares, whole = patterns.square().sum(dim=1, keepdim=True), patterns.sum(dim=1, keepdim=True)
    return 2 * patterns / squares.clamp(min=FAINT) - 2 / whole.clamp(min=FAINT**0.5)
