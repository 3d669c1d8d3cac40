"""What a registration estimates, as one vector: geometry, sharpness, light, and a flat field of few numbers.

Owns the order, units, search range and wanted precision of the parameters, the polynomials of the flat field, and the way between the
vector and an `Imaging`; never computes light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.imaging import Imaging

F64 = NDArray[np.float64]
Shape = tuple[int, int]


class Parameter(NamedTuple):
    """A number that is estimated: its name, unit, the range in which it is looked for, and the precision that is worth as much as
    0.05 px of shift: what moves light by as much, 10 pixels off the centre.
    """

    name: str
    unit: str
    low: float
    high: float
    worth: float


GEOMETRY = (
    Parameter("right_px", "px", -3.0, 3.0, 0.05),
    Parameter("down_px", "px", -3.0, 3.0, 0.05),
    Parameter("rotation_deg", "degrees", -5.0, 5.0, 0.05),
    Parameter("scale", "", 0.94, 1.06, 0.01),
    Parameter("psf_px", "px", 0.002, 2.0, 0.1),
)
GAIN = Parameter("gain", "", 0.02, 50.0, 0.05)
BLACK = Parameter("black", "", -0.002, 0.1, 0.001)
FLAT_NAMES = ("flat_x", "flat_y", "flat_xx", "flat_xy", "flat_yy")
FLAT = tuple(Parameter(name, "", -0.5, 0.5, 0.1) for name in FLAT_NAMES)
NO_FLAT = (0.0,) * len(FLAT)
LIGHT = (GAIN, BLACK, *FLAT)
PARAMETERS = (*GEOMETRY, *LIGHT)
DARK = len(
    PARAMETERS
)  # where the vector holds the dark photoelectrons of an exposure, a nuisance: calibrations measure it
N_GEOMETRY = len(GEOMETRY)
PSF_SEEN_FROM = 0.15  # px: the light changes with the square of less, and an interval in px begins at 0


def flat_basis(shape: Shape) -> F64:
    """Return the polynomials of the flat field, float64 (5, pixels): x, y, x^2, x y, y^2 over -1..1 of the grid, each of mean 0.

    The squares are Legendre's, (3 x^2 - 1) / 2, less their mean.
    """
    y, x = np.meshgrid(_marks(shape[0]), _marks(shape[1]), indexing="ij")
    terms = np.stack([x, y, (3 * x * x - 1) / 2, x * y, (3 * y * y - 1) / 2]).reshape(len(FLAT), -1)
    return np.asarray(terms - terms.mean(axis=1, keepdims=True))


def _marks(size: int) -> F64:
    return (np.arange(size, dtype=np.float64) - (size - 1) / 2) / max((size - 1) / 2, 1.0)


@dataclass(frozen=True, slots=True)
class Vector:
    """The parameters' values in the order of `PARAMETERS`, then the dark photoelectrons of an exposure."""

    values: F64

    def imaging(self, shape: Shape) -> Imaging:
        """Return the facts as an `Imaging` of the grid `shape`; a black level below 0 is 0, a flat field below 0 is refused."""
        geometry = dict(zip((one.name for one in GEOMETRY), self.values.tolist()))
        black, coefficients = max(0.0, float(self.values[6])), self.values[7:DARK]
        flat = (1.0 + coefficients @ flat_basis(shape)).reshape(shape) if coefficients.any() else None
        return Imaging(**geometry, black=black, gain=float(self.values[5]), flat=flat)


def vector_of(imaging: Imaging, flat: ArrayLike = NO_FLAT, dark: float = 0.0) -> F64:
    """Return the vector of the facts in `imaging`, but for its flat field, which is given by its coefficients."""
    facts = imaging.numbers()
    geometry = [facts[one.name] for one in GEOMETRY]
    return np.array([*geometry, facts["gain"], facts["black"], *np.asarray(flat, np.float64), dark])


def worths() -> F64:
    """Return what each of `PARAMETERS` is worth knowing to, float64 (12,)."""
    return np.array([one.worth for one in PARAMETERS])


def at_edge(values: F64) -> list[str]:
    """Return what of the values lies at an end of its range, in words."""
    return [
        f"{one.name} {value:.4g}, looked for from {one.low:g} to {one.high:g}"
        for one, value in zip(PARAMETERS, values.tolist())
        if not (one.low < value < one.high or (one.name == "psf_px" and value <= one.low)) or not math.isfinite(value)
    ]
