"""Samples that bleach: what a pattern still brings where the light before it has left fewer emitters.

The law is first-order photobleaching. A pixel that has received the
dose D gives exp(-D / D0) of its first signal, as every absorbed photon kills its emitter with the same chance (Eggeling et al., Anal.
Chem. 70, 2651, 1998; of uneven light: Berglund, J. Chem. Phys. 121, 2899, 2004). A dose is illumination: the
photoelectrons that a pixel of full transmission would give, as `illumination` counts them.

While a pattern is shown, its own light bleaches too. A pixel lit by P in that exposure gives
`P exp(-D / D0) (1 - exp(-P / D0)) / (P / D0)`, the mean over the exposure.

This is the mean over many emitters. Of M emitters in the light of an exposure, how many are left is random: the chance of a click is then
lower, by about lambda^2 s (1 - s) exp(-lambda s) / (2 M) where s of the signal lambda is left. At one photoelectron per exposure and
D0 = 4 that is 0.024 for 3 emitters, 0.0075 for 10, 0.0025 for 30 and 0.0008 for 100.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import Range

DOSE = Range(1e-9, 1e15)  # D0 in photoelectrons of illumination on one pixel
MIXED = "mixed"

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bleaching:
    """`dose` is D0, after which 1/e of a pixel's signal is left; infinite: nothing bleaches.

    `mixed`: emitters wander over the whole field between exposures, so that each receives the mean dose of all pixels. Otherwise they
    stay where they are, and bleach where they are lit.
    """

    dose: float = math.inf
    mixed: bool = False

    def __post_init__(self) -> None:
        if self.dose != math.inf:
            DOSE.checked(self.dose, "bleaching dose")

    @property
    def is_none(self) -> bool:
        """Whether nothing bleaches."""
        return self.dose == math.inf

    def words(self) -> str:
        """Return the law in words."""
        if self.is_none:
            return "no bleaching"
        return f"1/e after {self.dose:g} photoelectrons per pixel" + (", emitters mixed" if self.mixed else "")

    def spelled(self) -> str:
        """Return the law as `--bleach` spells it; `bleaching_of` reads it back."""
        return "" if self.is_none else f"{self.dose!r}" + (f":{MIXED}" if self.mixed else "")

    def doses(self, light: F64) -> F64:
        """Return the dose of each exposure over D0, float64 (exposures, pixels), or (exposures, 1) where emitters mix.

        `light` (exposures, pixels) is the illumination of each pixel.
        """
        received = light.mean(axis=-1, keepdims=True) if self.mixed else light
        return np.asarray(received / self.dose, np.float64)


NO_BLEACHING = Bleaching()


def mean_left(dose: NDArray[Any]) -> F64:
    """Return the mean over an exposure of what is left, (1 - exp(-x)) / x of its `dose` x over D0 (any shape); 1 at 0."""
    x = np.asarray(dose, np.float64)
    return np.divide(-np.expm1(-x), x, out=np.ones_like(x), where=x > 0)


def bleached(law: Bleaching, light: NDArray[Any]) -> F64:
    """Return patterns as they act when they are shown in this order, float64 (exposures, pixels): signal = bleached(...) @ transmission.

    `light` (exposures, pixels) is what each pixel would receive, at least 0; exposures of an object, from its first one on.
    """
    shown = np.asarray(light, np.float64)
    if law.is_none:
        return shown.copy()
    dose = law.doses(shown)
    before = np.cumsum(dose, axis=0)
    before = np.concatenate([np.zeros((1, dose.shape[1])), before[:-1]])
    return np.asarray(shown * np.exp(-before) * mean_left(dose))


def bleaching_of(text: str) -> Bleaching:
    """Return the law that `--bleach` states: D0, or D0:mixed; ValueError for anything else.

    >>> bleaching_of("40:mixed").words()
    '1/e after 40 photoelectrons per pixel, emitters mixed'
    """
    number, _, kind = text.partition(":")
    try:
        dose = float(number)
    except ValueError:
        dose = math.nan
    if kind not in ("", MIXED) or text.endswith(":") or not math.isfinite(dose):
        raise ValueError(f"bleaching is {text[:40]!r}, allowed: D0, or D0:{MIXED}, such as 40 or 40:{MIXED}")
    return Bleaching(dose, kind == MIXED)
