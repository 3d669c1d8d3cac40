"""The known target of a registration: the built-in one, or a user's picture, checked.

The built-in target is 6 x 6 cells of black and clear, which pixels represent exactly: 48 edges between cells, as many upright as level, and
of 20 000 random ones of that kind the one whose autocorrelation has the lowest side lobes within two cells (0.25 of the peak), so that no
shift looks like another.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import UsageError
from pans.base.files import read_grey, scene_arrays

CELLS = ("#.#..#", "##.#..", "..#..#", "..#...", "..#..#", "##.###")
SIDE = 28
BUILT_IN = "built-in"
LEAST_SIDE, MOST_PIXELS = 14, 4096  # fewer than two pixels per cell blur; beyond, optics' matrices take too much memory
TARGET_BYTES = 1 << 24
LEAST_SPREAD = 0.05  # standard deviation of the transmission, below which a picture is hardly a target

U8 = NDArray[np.uint8]


def built_in_target(side: int = SIDE) -> U8:
    """Return the built-in target, uint8 (side, side), 255 clear and 0 black, with a black margin."""
    if side < LEAST_SIDE or side * side > MOST_PIXELS:
        raise ValueError(f"side must be from {LEAST_SIDE} to {int(MOST_PIXELS**0.5)}, found {side}")
    cells = np.array([[255 * (mark == "#") for mark in row] for row in CELLS], np.uint8)
    width = max(1, (side * 7 // 8) // len(CELLS))
    inner = np.kron(cells, np.ones((width, width), np.uint8))
    target = np.zeros((side, side), np.uint8)
    first = (side - len(inner)) // 2
    target[first : first + len(inner), first : first + len(inner)] = inner
    return target


def read_target(path: Path) -> U8:
    """Return the picture in `path`, uint8 (rows, columns): a picture file (Pillow), or the first of `images` in a scene (.npz).

    UsageError for a file that is neither, for too few or too many pixels, and for a picture without contrast.
    """
    is_scene = path.suffix == ".npz"
    picture = scene_arrays(path, TARGET_BYTES)["images"][0] if is_scene else read_grey(path, MOST_PIXELS)
    return _checked(picture, str(path))


def _checked(picture: U8, where: str) -> U8:
    rows, columns = picture.shape
    if min(rows, columns) < LEAST_SIDE or rows * columns > MOST_PIXELS:
        raise UsageError(
            f"{where}: {columns} x {rows} pixels, allowed: at least {LEAST_SIDE} a side, at most {MOST_PIXELS} in all",
            remedy="one pixel of the target is one pixel of the patterns",
        )
    spread = float(picture.std()) / 255
    if spread < LEAST_SPREAD:
        raise UsageError(
            f"{where}: the standard deviation of its transmission is {spread:.3g}, needed at least {LEAST_SPREAD:g}",
            remedy="use a target with black and clear parts",
        )
    return np.ascontiguousarray(picture)


def target_sha256(target: U8) -> str:
    """Return the SHA-256 of a target's size and pixels."""
    size = f"{target.shape[0]}x{target.shape[1]}:".encode()
    return hashlib.sha256(size + np.ascontiguousarray(target).tobytes()).hexdigest()
