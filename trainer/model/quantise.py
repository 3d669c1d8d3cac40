"""From real patterns to whole projector levels, with a bound on what that changes.

Owns the rounding and its error bound; never trains. All patterns of a set share one scale, because they share one
exposure. numpy only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import Profile

DARK_MAX = 0.05  # dark counts per exposure that training accepts where the profile allows shorter exposures


@dataclass(frozen=True, slots=True, eq=False)
class Quantised:
    """Levels (d_f, pixels) and their scale; `error_bound` (d_f,) is the most that any object's photoelectrons can change."""

    levels: NDArray[np.uint16]
    photons_per_level: float
    error_bound: NDArray[np.float64]

    def patterns(self) -> NDArray[np.float64]:
        """Return the patterns that are shown, in photoelectrons per exposure and unit transmission."""
        return self.levels.astype(np.float64) * self.photons_per_level


def quantise(patterns: NDArray[np.floating], levels: int, top: float | None = None) -> Quantised:
    """Round `patterns` (d_f, pixels, photoelectrons) to `levels` levels, of which the brightest gives `top` photoelectrons.

    `top` is the brightest pixel unless given; brighter pixels are clipped to it. For transmissions in [0, 1] the
    photoelectrons of pattern i change by at most `error_bound[i]`, the larger of the light added and the light taken away.
    """
    exact = np.asarray(patterns, dtype=np.float64)
    if exact.ndim != 2 or not np.isfinite(exact).all() or exact.min() < 0:
        raise UsageError(f"patterns are {exact.shape}, allowed: (d_f, pixels), finite and at least 0")
    brightest = float(exact.max()) if top is None else float(top)
    if not 0 < brightest < math.inf or levels < 2:
        raise UsageError(f"brightest level {brightest:g} of {levels}, allowed: above 0, and 2 levels or more")
    step = brightest / (levels - 1)
    rounded = np.clip(np.rint(exact / step), 0, levels - 1).astype(np.uint16)
    change = rounded * step - exact
    bound = np.maximum(np.maximum(change, 0).sum(axis=1), np.maximum(-change, 0).sum(axis=1))
    return Quantised(rounded, step, bound)


def top_limits(profile: Profile) -> tuple[float, float]:
    """Return the least and most photoelectrons of the brightest pixel in one exposure on `profile`.

    They follow from the exposures that the profile allows, less those in which more than `DARK_MAX` dark counts fall: one
    bright pixel would otherwise buy its light with dark counts in every pattern.
    """
    exposure = profile.exposure
    dark_hz = profile.detector.dark_rate_hz
    longest_us = exposure.max_us if dark_hz == 0 else min(exposure.max_us, DARK_MAX / dark_hz * 1e6)
    peak_hz = profile.projector.peak_photoelectrons_hz
    return peak_hz * exposure.min_us * 1e-6, peak_hz * max(longest_us, exposure.min_us) * 1e-6


def exposure_us_of(profile: Profile, top: float) -> float:
    """Return the exposure in microseconds in which the brightest pixel gives `top` photoelectrons."""
    return top / profile.projector.peak_photoelectrons_hz * 1e6
