"""Float patterns -> device levels: one linear scale for all patterns of a bundle, the error stated.

Owns the rounding and nothing else: which patterns are good is the trainer's matter, whether a device can show them core/plan.py's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True, eq=False)
class QuantisedPatterns:
    """Levels and their scale; errors are in photoelectrons per exposure per unit transmission."""

    pattern_levels: NDArray[np.uint16]  # (d_f, pixels)
    photons_per_level: float
    error_max: float  # of one pixel; never above photons_per_level / 2 where no pixel was clipped
    error_bound: NDArray[np.float64]  # (d_f,): the most that any object's photoelectrons can change
    illumination_wanted: float  # sum of all intensities before rounding
    illumination: float  # and after
    pixels_lost: int  # lit before rounding, dark after

    def patterns(self) -> NDArray[np.float64]:
        """Return the patterns that are shown, in photoelectrons per exposure and unit transmission."""
        return self.pattern_levels.astype(np.float64) * self.photons_per_level


def quantise_patterns(patterns: ArrayLike, levels: int, top: float | None = None) -> QuantisedPatterns:
    """Round patterns, finite and >= 0, (d_f, pixels), to levels 0..levels-1 of which the highest gives `top` photoelectrons.

    `top` is the brightest pixel unless given; brighter pixels are clipped to it. `photons_per_level` is `top` over (levels - 1);
    every pixel goes to the nearest level (halves to even). For transmissions in [0, 1] the photoelectrons of pattern i change by at
    most `error_bound[i]`, the larger of the light added and the light taken away.
    """
    wanted = np.asarray(patterns)
    if wanted.ndim != 2 or wanted.size == 0 or not np.issubdtype(wanted.dtype, np.floating):
        raise ValueError(f"patterns are {wanted.dtype} {wanted.shape}, allowed: floats (d_f, pixels)")
    if not 2 <= levels <= 65536:
        raise ValueError(f"levels is {levels}, allowed: 2 to 65536")
    wanted = wanted.astype(np.float64)
    bad = ~np.isfinite(wanted) | (wanted < 0)
    if bad.any():
        row, column = (int(n) for n in np.argwhere(bad)[0])
        value = wanted[row, column]
        raise ValueError(f"pattern {row} has {value} at pixel {column}, allowed: finite photons, 0 or more")
    scale = (float(wanted.max()) if top is None else float(top)) / (levels - 1)
    if not 0 < scale < np.inf:
        raise ValueError("no pattern has any light, allowed: at least one pixel above 0")
    rounded = np.clip(np.rint(wanted / scale), 0, levels - 1)
    change = rounded * scale - wanted
    return QuantisedPatterns(
        pattern_levels=rounded.astype(np.uint16),
        photons_per_level=scale,
        error_max=float(np.abs(change).max()),
        error_bound=np.maximum(np.maximum(change, 0).sum(axis=1), np.maximum(-change, 0).sum(axis=1)),
        illumination_wanted=float(wanted.sum()),
        illumination=float(rounded.sum()) * scale,
        pixels_lost=int(((wanted > 0) & (rounded == 0)).sum()),
    )
