"""How bright the top level of the patterns may be on a profile, and the exposure that gives it.

All patterns of a set share one scale, because they share one exposure; the rounding is `pans.bundle.making.quantise`'s.
"""

from __future__ import annotations

from pans.instrument.profile import Profile

DARK_MAX = 0.05  # dark counts per exposure that training accepts where the profile allows shorter exposures


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
