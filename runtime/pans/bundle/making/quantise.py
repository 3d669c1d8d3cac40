"""Float patterns in, device levels out: one linear scale for all patterns of a bundle, the error stated.

Every pixel goes to its nearest level, or its error is passed to the next pixels, so that neighbourhoods keep their light (R. W. Floyd and
L. Steinberg, "An adaptive algorithm for spatial grey scale", Proc. SID 17, 75, 1976; here in alternating directions).
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


# Rounding keeps the shape better at many levels, error diffusion the light at few: on float patterns of Fashion-MNIST it decided better
# at 2 and 4 levels, and as well at more (docs/measurements/index.md).
DITHER_LEVELS_MAX = 8


def quantise_patterns(
    patterns: ArrayLike, levels: int, top: float | None = None, *, dither: tuple[int, int] | None = None
) -> QuantisedPatterns:
    """Round patterns, finite and >= 0, (d_f, pixels), to levels 0..levels-1 of which the highest gives `top` photoelectrons.

    `top` is the brightest pixel unless given (with `dither`: `dithered_top`); brighter pixels are clipped to it. Every pixel goes to the
    nearest level, halves to even. With `dither`, the rows and columns of a pattern, the error of each pixel is carried on to its
    neighbours. ValueError for patterns that are no light. For transmissions in [0, 1] the photoelectrons of pattern i change by at most
    `error_bound[i]`.
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
    if dither is not None and dither[0] * dither[1] != wanted.shape[1]:
        raise ValueError(f"patterns have {wanted.shape[1]} pixels, their shape is given as {dither[0]} x {dither[1]}")
    if top is None:
        top = float(wanted.max()) if dither is None else dithered_top(wanted.reshape(-1, *dither), levels)
    scale = float(top) / (levels - 1)
    if not 0 < scale < np.inf:
        raise ValueError("no pattern has any light, allowed: at least one pixel above 0")
    if dither is None:
        rounded = np.clip(np.rint(wanted / scale), 0, levels - 1)
    else:
        rounded = diffused((wanted / scale).reshape(-1, *dither), levels).reshape(wanted.shape)
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


def dithered_top(wanted: NDArray[np.float64], levels: int) -> float:
    """Return the brightest level (photoelectrons) with which error diffusion keeps neighbourhoods of `wanted` best, (n, rows, columns).

    One pixel that outshines all others would else leave them one level or none. Tried are the brightest pixel and its halves down to
    1/512, compared by the mean squared error after a blur over 3 x 3 pixels.
    """
    brightest = float(wanted.max())
    tops = [brightest * 0.5**halves for halves in range(10)] if brightest > 0 else [brightest]

    def error(top: float) -> float:
        shown = diffused(wanted * ((levels - 1) / top), levels) * (top / (levels - 1))
        return float((_blurred(shown - wanted) ** 2).sum())

    return min(tops, key=error) if brightest > 0 else brightest


def _blurred(images: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over 3 x 3 pixels, with nothing beyond the edge."""
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)))
    rows = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    return np.asarray(rows[:, :, :-2] + rows[:, :, 1:-1] + rows[:, :, 2:])


def diffused(wanted: NDArray[np.float64], levels: int) -> NDArray[np.float64]:
    """Return whole levels (n, rows, columns) of `wanted`, in levels, by error diffusion; rows run to the right and to the left in turn.

    Of each error 7/16 go to the next pixel, 3/16, 5/16 and 1/16 to those before, below and after in the next row, light above the highest
    level too. What leaves the image is lost.
    """
    n, rows, columns = wanted.shape
    shown = np.empty_like(wanted)
    below = np.zeros((n, columns + 2))
    for row in range(rows):
        now, below = wanted[:, row] + below[:, 1:-1], np.zeros((n, columns + 2))
        step = 1 if row % 2 == 0 else -1
        ahead = np.zeros(n)
        for column in range(columns)[::step]:
            value = now[:, column] + ahead
            shown[:, row, column] = np.clip(np.rint(value), 0, levels - 1)
            error = value - shown[:, row, column]
            ahead = error * (7 / 16)
            below[:, column + 1 - step] += error * (3 / 16)
            below[:, column + 1] += error * (5 / 16)
            below[:, column + 1 + step] += error * (1 / 16)
    return shown
