"""The family of changes that `pans tune` tries on all patterns at once: moved, turned, magnified, bent a little, brighter.

Owns the parameters, their first and last steps, and the patterns that they make; never measures. Patterns are moved as the object appears
moved: where the numbers are those of the table (runtime.imaging), the changed patterns meet the object as the trained ones would have on a
perfect table.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle import Bundle
from pans.runtime.bundle.facts import frozen
from pans.runtime.imaging import Imaging, seen


@dataclass(frozen=True, slots=True)
class Move:
    """How all patterns differ from the trained ones; nothing by default. `brightness` is of the light, by a longer exposure.

    The last four bend the grid smoothly, each by so many pixels at the edge of the patterns: with x and y from -1 to 1, stretch moves by
    (x, -y), shear by (y, x), the keystones by (x y, 0) and (0, x y).
    """

    right_px: float = 0.0
    down_px: float = 0.0
    rotation_deg: float = 0.0
    scale: float = 1.0
    brightness: float = 1.0
    stretch_px: float = 0.0
    shear_px: float = 0.0
    keystone_right_px: float = 0.0
    keystone_down_px: float = 0.0

    def by(self, name: str, step: float) -> Move:
        """Return the move with `name` changed by `step`; a factor is multiplied by 1 + step, or divided by 1 - step."""
        value = getattr(self, name)
        if name in _FACTORS:
            return replace(self, **{name: value * (1 + step) if step > 0 else value / (1 - step)})
        return replace(self, **{name: value + step})

    def words(self) -> str:
        """Return what differs, in words."""
        said = [f"{name} {value:.3g}" for name, value in asdict(self).items() if value != getattr(STILL, name)]
        return ", ".join(said) or "nothing"


_FACTORS = ("scale", "brightness")
BENDS = ("stretch_px", "shear_px", "keystone_right_px", "keystone_down_px")
STILL = Move()
# The first step is what an adjusted table is off by; the last one costs less than a thousand objects can tell.
FIRST_STEP = {"right_px": 1.0, "down_px": 1.0, "rotation_deg": 2.0, "scale": 0.04, "brightness": 0.2} | dict.fromkeys(
    BENDS, 1.0
)
LAST_STEP = {"right_px": 0.25, "down_px": 0.25, "rotation_deg": 0.5, "scale": 0.01, "brightness": 0.05} | dict.fromkeys(
    BENDS, 0.5
)


def moved(bundle: Bundle, move: Move) -> Bundle:
    """Return `bundle` with its patterns changed, on the projector's levels; golden vectors and back end as they are."""
    levels = bundle.pattern_levels
    if replace(move, brightness=1.0) != STILL:
        imaging = Imaging(move.right_px, move.down_px, move.rotation_deg, move.scale)
        wide = _bent(seen(imaging, levels.astype(np.float64), bundle.image_shape), move, bundle.image_shape)
        levels = _binary(wide) if bundle.levels == 2 else _rounded(wide, bundle.levels)
    return replace(
        bundle,
        pattern_levels=frozen(levels),
        photons_per_level=bundle.photons_per_level * move.brightness,
        expected=None if move != STILL else bundle.expected,
    )


def _bent(wide: NDArray[np.float64], move: Move, shape: tuple[int, int]) -> NDArray[np.float64]:
    """The patterns (n, pixels) moved by the four bends, between pixels by bilinear interpolation; nothing comes from outside."""
    if not any(getattr(move, name) for name in BENDS):
        return wide
    rows, columns = shape
    down, right = np.mgrid[0:rows, 0:columns].astype(np.float64)
    y, x = 2 * down / max(1, rows - 1) - 1, 2 * right / max(1, columns - 1) - 1
    right = right - (move.stretch_px * x + move.shear_px * y + move.keystone_right_px * x * y)
    down = down - (-move.stretch_px * y + move.shear_px * x + move.keystone_down_px * x * y)
    padded = np.pad(wide.reshape(-1, rows, columns), ((0, 0), (1, 1), (1, 1)))
    right, down = (right + 1).clip(0, columns + 1), (down + 1).clip(0, rows + 1)
    column, row = np.minimum(right.astype(int), columns), np.minimum(down.astype(int), rows)
    along, below = right - column, down - row
    upper = padded[:, row, column] * (1 - along) + padded[:, row, column + 1] * along
    lower = padded[:, row + 1, column] * (1 - along) + padded[:, row + 1, column + 1] * along
    return np.asarray(upper * (1 - below) + lower * below).reshape(len(wide), -1)


def _rounded(wide: NDArray[np.float64], levels: int) -> NDArray[np.uint16]:
    return np.rint(wide).clip(0, levels - 1).astype(np.uint16)


def _binary(wide: NDArray[np.float64]) -> NDArray[np.uint16]:
    """The brightest pixels of each pattern, as many as keep its light."""
    lit = np.rint(wide.sum(axis=1)).astype(np.int64)
    rank = np.argsort(np.argsort(-wide, axis=1, kind="stable"), axis=1, kind="stable")
    return ((rank < lit[:, None]) & (wide > 0)).astype(np.uint16)
