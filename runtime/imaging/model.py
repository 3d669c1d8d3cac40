"""The facts of one optical table: how the object appears on the grid of pattern pixels.

Owns the ranges of these facts; the light that follows from them is computed elsewhere (sampling.py, patterns.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.runtime.ranges import Range, demand

SHIFT_PX = Range(-1e4, 1e4)
ROTATION_DEG = Range(-360.0, 360.0)
SCALE = Range(0.1, 10.0)
PSF_PX = Range(0.0, 1e3)
BLACK = Range(0.0, 1.0)
GAIN = Range(0.0, 1e6)
FLAT_MEAN_TOLERANCE = 1e-6
FLAT_PIXELS_MAX = 1 << 22

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Imaging:
    """How an object appears on the pattern grid; lengths are object pixels. ValueError for what is out of range.

    The object is magnified by `scale` and turned counter-clockwise, as seen on screen, by `rotation_deg` about the centre of the grid,
    moved by (`right_px`, `down_px`), and blurred by a Gaussian of standard deviation `psf_px`. `flat` is the light of every pattern
    pixel over the mean of all, float64 (rows, columns) of mean 1. `black` is the light of a dark pattern pixel over that of a full
    one. `gain` multiplies all light.
    """

    right_px: float = 0.0
    down_px: float = 0.0
    rotation_deg: float = 0.0
    scale: float = 1.0
    psf_px: float = 0.0
    black: float = 0.0
    gain: float = 1.0
    flat: F64 | None = None

    def __post_init__(self) -> None:
        for name, allowed in _RANGES.items():
            allowed.checked(getattr(self, name), name)
        demand(self.gain > 0, "gain is 0, allowed: above 0")
        demand(self.black < 1, "black is 1, allowed: below 1 (a dark pixel would be as bright as a full one)")
        if self.flat is not None:
            object.__setattr__(self, "flat", checked_flat(self.flat))

    @property
    def in_place(self) -> bool:
        """Whether the object meets the pattern grid pixel by pixel, without blur."""
        return not (self.right_px or self.down_px or self.rotation_deg or self.psf_px) and self.scale == 1.0

    @property
    def is_identity(self) -> bool:
        """Whether nothing differs from perfect optics."""
        return self.in_place and self.black == 0.0 and self.gain == 1.0 and self.flat is None

    def words(self) -> str:
        """Return the facts that differ from perfect optics, in words."""
        if self.is_identity:
            return "perfect optics"
        said = [f"{name} {value:g}" for name, value in self.numbers().items() if value != getattr(IDENTITY, name)]
        return ", ".join([*said, *(["flat field"] if self.flat is not None else [])])

    def numbers(self) -> dict[str, float]:
        """Return every fact but the flat field, by name."""
        return {name: float(getattr(self, name)) for name in _RANGES}


def checked_flat(flat: F64) -> F64:
    """Return a read-only float64 copy of a flat field (rows, columns); ValueError unless finite, at least 0 and of mean 1."""
    field = np.array(flat, np.float64)
    demand(field.ndim == 2 and 0 < field.size <= FLAT_PIXELS_MAX, f"flat is {field.shape}, allowed: (rows, columns)")
    demand(
        bool(np.isfinite(field).all() and (field >= 0).all()),
        "flat holds numbers below 0 or not finite, allowed: 0 and above",
    )
    mean = float(field.mean())
    demand(abs(mean - 1) <= FLAT_MEAN_TOLERANCE, f"flat has the mean {mean:.9g}, allowed: 1")
    field.flags.writeable = False
    return field


_RANGES = {
    "right_px": SHIFT_PX,
    "down_px": SHIFT_PX,
    "rotation_deg": ROTATION_DEG,
    "scale": SCALE,
    "psf_px": PSF_PX,
    "black": BLACK,
    "gain": GAIN,
}
IDENTITY = Imaging()
