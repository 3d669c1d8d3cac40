"""Float patterns -> device levels: one linear scale for all patterns of a bundle, the error stated.

Owns the rounding and nothing else: which patterns are good is the trainer's matter, whether a device can show them plan.py's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.errors import UsageError


@dataclass(frozen=True, slots=True, eq=False)
class QuantisedPatterns:
    """Levels and their scale; errors are in photoelectrons per exposure per unit transmission."""

    pattern_levels: NDArray[np.uint16]  # (d_f, pixels)
    photons_per_level: float
    error_max: float  # of one pixel; never above photons_per_level / 2
    illumination_wanted: float  # sum of all intensities before rounding
    illumination: float  # and after
    pixels_lost: int  # lit before rounding, dark after


def quantise_patterns(patterns: ArrayLike, levels: int) -> QuantisedPatterns:
    """Round patterns, finite and >= 0, (d_f, pixels), to levels 0..levels-1 with the brightest pixel at the top level.

    `photons_per_level` is the brightest pixel over (levels - 1); every pixel goes to the nearest level (halves to even).
    """
    wanted = np.asarray(patterns)
    if wanted.ndim != 2 or wanted.size == 0 or not np.issubdtype(wanted.dtype, np.floating):
        raise UsageError(f"patterns are {wanted.dtype} {wanted.shape}, allowed: floats (d_f, pixels)")
    if not 2 <= levels <= 65536:
        raise UsageError(f"levels is {levels}, allowed: 2 to 65536")
    wanted = wanted.astype(np.float64)
    bad = ~np.isfinite(wanted) | (wanted < 0)
    if bad.any():
        row, column = (int(n) for n in np.argwhere(bad)[0])
        value = wanted[row, column]
        raise UsageError(f"pattern {row} has {value} at pixel {column}, allowed: finite photons, 0 or more")
    scale = float(wanted.max()) / (levels - 1)
    if not scale > 0:
        raise UsageError("no pattern has any light, allowed: at least one pixel above 0")
    rounded = np.rint(wanted / scale)
    return QuantisedPatterns(
        pattern_levels=rounded.astype(np.uint16),
        photons_per_level=scale,
        error_max=float(np.abs(rounded * scale - wanted).max()),
        illumination_wanted=float(wanted.sum()),
        illumination=float(rounded.sum()) * scale,
        pixels_lost=int(((wanted > 0) & (rounded == 0)).sum()),
    )
