"""Shifted pictures under static patterns: the light sums of every picture at every whole-pixel shift, once per pattern set.

All sums are whole numbers (level times grey step) and so exact. Between whole-pixel shifts light is linear in the shift, since pixels are
boxes: what cells.py interpolates is exact too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.instrument.profile import Profile

from .optics import grey_steps, photons_per_level
from .still import Scene

MAX_TABLE_BYTES = 1 << 27
_PICTURES_AT_A_TIME = 64
_U32_MAX = (1 << 32) - 1


class ShiftTable(NamedTuple):
    """sums (images, offsets, 2 * width + 1, patterns), uint32: level times grey step where the picture stands; shift s at index s + width.

    open_levels float64 (offsets, 2 * width + 1, patterns): the levels behind the picture's rectangle. photons(levels) =
    scale * level for full transmission; a picture's step adds scale_step * sum. empty and full float64 (patterns,): the photoelectrons of
    the empty field, and of full transmission everywhere, which nothing exceeds.
    """

    sums: NDArray[np.uint32]
    open_levels: NDArray[np.float64]
    scale_step: float
    scale_open: float
    empty: NDArray[np.float64]
    full: NDArray[np.float64]

    @property
    def width(self) -> int:
        """Pixels of the field, and of a picture, across the flow."""
        return int(self.sums.shape[2] // 2)


def shift_table(
    profile: Profile, scene: Scene, levels: NDArray[np.uint16], exposure_us: float, offset_px: int, background: float
) -> ShiftTable:
    """Tabulate `scene`'s pictures under `levels`, uint16 (patterns, pixels), at vertical offsets -offset_px..offset_px.

    `background` is the transmission of the field where no picture stands. ValueError when the patterns are of another size or the table
    would be larger than MAX_TABLE_BYTES.
    """
    n_patterns, n_pixels = levels.shape
    n, height, width = scene.images.shape
    if n_pixels != height * width:
        raise ValueError(
            f"patterns have {n_pixels} pixels, the cells of {scene.name!r} have {height * width} ({height} x {width})"
        )
    _check_size(scene, n_patterns, offset_px)
    grey, white = grey_steps(profile)
    totals = levels.sum(axis=1, dtype=np.float64)
    if totals.max() * white > _U32_MAX:
        raise ValueError(
            f"a pattern's levels sum to {totals.max():.0f}: with {white} grey steps the table holds at most {_U32_MAX // white}"
        )
    shape = (n, 2 * offset_px + 1, 2 * width + 1, n_patterns)
    sums = np.empty(shape, np.uint32)
    patterns = levels.reshape(n_patterns, height, width)
    for first in range(0, n, _PICTURES_AT_A_TIME):
        part = slice(first, first + _PICTURES_AT_A_TIME)
        sums[part] = _correlations(grey[scene.images[part]], patterns, offset_px)
    behind = _correlations(np.ones((1, height, width)), patterns, offset_px)
    unit, t_min = photons_per_level(profile, exposure_us), profile.min_transmission
    return ShiftTable(
        sums,
        behind[0],
        unit * (1.0 - t_min) / white,
        unit * (1.0 - t_min) * background,
        unit * (t_min + (1.0 - t_min) * background) * totals,
        unit * totals,
    )


def _check_size(scene: Scene, n_patterns: int, offset_px: int) -> None:
    n, _, width = scene.images.shape
    n_bytes = 4 * n * (2 * offset_px + 1) * (2 * width + 1) * n_patterns
    if n_bytes > MAX_TABLE_BYTES:
        raise ValueError(
            f"{n} pictures x {2 * offset_px + 1} offsets x {2 * width + 1} shifts x {n_patterns} patterns need {n_bytes >> 20} MiB,"
            f" the simulator's table holds {MAX_TABLE_BYTES >> 20} MiB"
            f" (at most {n * MAX_TABLE_BYTES // n_bytes} pictures, or a smaller offset_px)"
        )


def _correlations(pictures: NDArray[np.float64], patterns: NDArray[np.uint16], offset_px: int) -> NDArray[np.float64]:
    """Sums of level times grey, whole numbers in float64 (n, offsets, 2 * width + 1, patterns), of float64 pictures (n, height, width).

    Rows are correlated by Fourier transforms, and rounded: a sum below 2^32 errs by less than 1e-4 before, so that the result is exact.
    At offset o the picture stands o pixels lower, at shift s it stands s pixels to the right.
    """
    n, height, width = pictures.shape
    length = 2 * width  # shifts -width + 1 .. width - 1 do not wrap around
    light = np.fft.rfft(patterns, length, axis=2).transpose(2, 1, 0)  # (frequencies, rows, patterns)
    # (frequencies, n, rows)
    passed = np.ascontiguousarray(np.fft.rfft(pictures, length, axis=2).conj().transpose(2, 0, 1))
    sums = np.zeros((n, 2 * offset_px + 1, 2 * width + 1, len(patterns)))
    for index, down in enumerate(range(-offset_px, offset_px + 1)):
        field, picture = slice(max(down, 0), height + min(down, 0)), slice(max(-down, 0), height + min(-down, 0))
        found = np.fft.irfft(passed[:, :, picture] @ np.ascontiguousarray(light[:, field]), length, axis=0)
        order = np.arange(-width + 1, width) % length
        sums[:, index, 1:-1] = np.rint(found[order].transpose(1, 0, 2))
    return sums
