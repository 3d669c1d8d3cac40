"""Shifted pictures under static patterns: the light sums of every picture at every whole-pixel shift, once per pattern set.

Owns the tables and the loops that make them; never knows about time (cells.py). All sums are whole numbers (level times grey step) and so
exact. Between whole-pixel shifts light is linear in the shift, since pixels are boxes: what cells.py interpolates is exact too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.runtime.errors import ConfigError
from pans.runtime.profile import Profile

from .optics import grey_steps, photons_per_level
from .scene import Scene

MAX_TABLE_BYTES = 1 << 29
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

    `background` is the transmission of the field where no picture stands. ConfigError when the patterns are of another size or the table
    would be larger than MAX_TABLE_BYTES.
    """
    n_patterns, n_pixels = levels.shape
    n, height, width = scene.images.shape
    if n_pixels != height * width:
        raise ConfigError(
            f"patterns have {n_pixels} pixels, the cells of {scene.name!r} have {height * width} ({height} x {width})",
            remedy="choose cells of the same image shape",
        )
    _check_size(scene, n_patterns, offset_px)
    grey, white = grey_steps(profile)
    totals = levels.sum(axis=1, dtype=np.float64)
    if totals.max() * white > _U32_MAX:
        raise ConfigError(
            f"a pattern's levels sum to {totals.max():.0f}: with {white} grey steps the table holds at most {_U32_MAX // white}",
            remedy="fewer levels, or darker patterns",
        )
    shape = (n, 2 * offset_px + 1, 2 * width + 1, n_patterns)
    sums = np.zeros(shape, np.uint32)
    lit = _lit_pixels(levels, width)
    for image in range(n):
        picture = grey[scene.images[image]].astype(np.uint32)
        _shift_sums(_reversed_rows(picture, offset_px), *lit, offset_px, sums[image])
    behind = np.zeros((1, *shape[1:]), np.uint32)
    _shift_sums(_reversed_rows(np.ones((height, width), np.uint32), offset_px), *lit, offset_px, behind[0])
    unit, t_min = photons_per_level(profile, exposure_us), profile.min_transmission
    return ShiftTable(
        sums,
        behind[0].astype(np.float64),
        unit * (1.0 - t_min) / white,
        unit * (1.0 - t_min) * background,
        unit * (t_min + (1.0 - t_min) * background) * totals,
        unit * totals,
    )


def _check_size(scene: Scene, n_patterns: int, offset_px: int) -> None:
    n, _, width = scene.images.shape
    n_bytes = 4 * n * (2 * offset_px + 1) * (2 * width + 1) * n_patterns
    if n_bytes > MAX_TABLE_BYTES:
        raise ConfigError(
            f"{n} pictures x {2 * offset_px + 1} offsets x {2 * width + 1} shifts x {n_patterns} patterns need {n_bytes >> 20} MiB,"
            f" the simulator's table holds {MAX_TABLE_BYTES >> 20} MiB",
            remedy=f"at most {n * MAX_TABLE_BYTES // n_bytes} pictures, or a smaller offset_px",
        )


def _lit_pixels(levels: NDArray[np.uint16], width: int) -> tuple[NDArray[np.int64], ...]:
    """Pattern, row, column and level of every pixel that is not dark, four int64 arrays."""
    pattern, pixel = np.nonzero(levels)
    return pattern, pixel // width, pixel % width, levels[pattern, pixel].astype(np.int64)


def _reversed_rows(picture: NDArray[np.uint32], offset_px: int) -> NDArray[np.uint32]:
    """The picture's rows backwards between 2 * width zeros on each side, and empty rows for the offsets: a shift reads one slice."""
    height, width = picture.shape
    padded = np.zeros((height + 2 * offset_px, 5 * width), np.uint32)
    padded[offset_px : offset_px + height, 2 * width : 3 * width] = picture[:, ::-1]
    return padded


def warm_up() -> None:
    """Compile or load the kernel."""
    ints = np.zeros(1, np.int64)
    _shift_sums(np.zeros((1, 5), np.uint32), ints, ints, ints, ints, 0, np.zeros((1, 3, 1), np.uint32))


@njit(cache=True, nogil=True)
def _shift_sums(padded, patterns, rows, columns, levels, offset_px, out):  # type: ignore[no-untyped-def]
    """Sum level times grey over the lit pixels: out uint32 (offsets, shifts, patterns) for one picture, padded as `_reversed_rows`.

    At shift s the field's column x shows the picture's column x - s, which stands backwards at 3 * width - 1 - (x - s).
    """
    width = padded.shape[1] // 5
    n_shifts = out.shape[1]
    line = np.zeros(n_shifts, np.uint32)
    for o in range(out.shape[0]):
        i = 0
        while i < patterns.size:
            pattern = patterns[i]
            line[:] = 0
            while i < patterns.size and patterns[i] == pattern:
                # offset o - offset_px downwards: the field's row y shows the picture's row y - (o - offset_px)
                row = padded[rows[i] - o + 2 * offset_px]
                first = 3 * width - 1 - columns[i] - width
                level = np.uint32(levels[i])
                for s in range(n_shifts):
                    line[s] += level * row[first + s]
                i += 1
            for s in range(n_shifts):
                out[o, s, pattern] = line[s]
