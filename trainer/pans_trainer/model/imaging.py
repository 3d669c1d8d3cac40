"""Objects through drawn optics: what the pattern grid meets of every training object on tables that differ within a tolerance.

Objects are parted at random into groups, each seen through optics of its own. Light from dark pattern pixels is linear in the object and
in the light of a full pixel: it stands in one more column beside the pixels, which meets the brightest level of a pattern. Also what
bleaching leaves of patterns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pans.instrument.optics import Bleaching, Imaging, Tolerance, operator

OPTICS_STREAM = 0x0971C5  # with the seed, so that no other draw is repeated
GROUP = 500  # objects seen through the same optics
SMALL_DOSE = 1e-3  # over D0, below which the third term of the series is the last that float32 holds
GROUPS_MIN = 40  # of few objects, so that they meet more than a handful of draws


@dataclass(frozen=True, slots=True)
class DrawnOptics:
    """A tolerance and the shape of the grid; `number` in the methods counts the draws: the same number gives the same optics."""

    tolerance: Tolerance
    shape: tuple[int, int]
    seed: int

    def through(self, transmission: Tensor, number: int) -> Tensor:
        """Return objects (n, pixels) as drawn optics show them, (n, pixels + 1): the last column is the light of dark pixels.

        Both for a gain of all light and of (1 - black) of a pattern, as `pans.instrument.optics.levelled` has it.
        """
        random = np.random.default_rng([OPTICS_STREAM, self.seed, number % (1 << 63)])
        n = len(transmission)
        size = max(1, min(GROUP, n // GROUPS_MIN))
        order = torch.from_numpy(random.permutation(n))
        result = torch.empty(n, transmission.shape[1] + 1, dtype=transmission.dtype)
        for group in order.split(size):
            result[group] = through(self.tolerance.draw(random), transmission[group], self.shape)
        return result


def through(imaging: Imaging, transmission: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return objects (n, pixels) as `imaging` shows them, (n, pixels + 1); see `DrawnOptics.through`."""
    seen = transmission
    if not imaging.in_place:
        seen = transmission @ torch.from_numpy(operator(imaging, shape)).to(transmission.dtype).T
    if imaging.flat is not None:
        seen = seen * torch.from_numpy(imaging.flat.copy()).flatten().to(seen.dtype)
    seen = imaging.gain * seen
    return torch.cat([(1.0 - imaging.black) * seen, imaging.black * seen.sum(dim=1, keepdim=True)], dim=1)


def bleached_patterns(law: Bleaching, light: Tensor) -> Tensor:
    """Return patterns as they act on samples that bleach, (d_f, pixels): as `pans.instrument.optics.bleached`, and differentiable."""
    received = light.mean(dim=1, keepdim=True) if law.mixed else light
    dose = received / law.dose
    left = torch.exp(dose - torch.cumsum(dose, dim=0))  # before each exposure
    small = dose < SMALL_DOSE
    safe = torch.where(small, torch.ones_like(dose), dose)
    mean = torch.where(small, 1 - dose / 2 + dose**2 / 6, -torch.expm1(-safe) / safe)
    return light * left * mean
