"""What a registration estimates, as one vector (geometry, sharpness, light, a flat field), in; expected light and its slopes out.

All pure functions of arrays. The optics are imaging's, the law of clicks instrument's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.calibrate.estimate import CountModel
from pans.instrument.optics import Imaging, seen

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
FLAT = tuple(Parameter(f"flat_{term}", "", -0.5, 0.5, 0.1) for term in ("x", "y", "xx", "xy", "yy"))
LIGHT = (Parameter("gain", "", 0.02, 50.0, 0.05), Parameter("black", "", -0.002, 0.1, 0.001))
PARAMETERS = (*GEOMETRY, *LIGHT, *FLAT)
WORTHS: F64 = np.array([one.worth for one in PARAMETERS])
DARK = len(PARAMETERS)  # place in the vector of the dark photoelectrons of an exposure, a nuisance
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


def imaging_of(vector: F64, shape: Shape) -> Imaging:
    """Return the vector as an `Imaging` of the grid `shape`; a black level below 0 is 0, a flat field below 0 is refused."""
    geometry = dict(zip((one.name for one in GEOMETRY), vector.tolist()))
    black, coefficients = max(0.0, float(vector[6])), vector[7:DARK]
    flat = (1.0 + coefficients @ flat_basis(shape)).reshape(shape) if coefficients.any() else None
    return Imaging(**geometry, black=black, gain=float(vector[5]), flat=flat)


def vector_of(imaging: Imaging, flat: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0), dark: float = 0.0) -> F64:
    """Return the vector of the facts in `imaging`, but for its flat field, which is given by its coefficients."""
    facts = imaging.numbers()
    geometry = [facts[one.name] for one in GEOMETRY]
    return np.array([*geometry, facts["gain"], facts["black"], *np.asarray(flat, np.float64), dark])


STEPS = np.array([1e-4, 1e-4, 1e-3, 1e-5, 1e-4])  # of the differences, in px, degrees, 1 and px
LEAST_MEAN = 1e-9  # photoelectrons per exposure: less cannot be told from none


@dataclass(frozen=True, slots=True)
class Bench:
    """What is known beforehand: the target's transmission (pixels,) on the grid `shape`, the photoelectrons of one level per exposure
    as the profile states them, the number of levels, and the detector's law.
    """

    target: F64
    shape: Shape
    photons_per_level: float
    levels: int
    model: CountModel

    def appearance(self, geometry: F64) -> F64:
        """Return the target as the grid meets it, float64 (pixels,), under right, down, rotation, scale, psf."""
        facts = dict(zip((one.name for one in GEOMETRY), geometry.tolist()))
        return seen(Imaging(**facts), self.target[None, :], self.shape)[0]

    def appearances(self, geometry: F64) -> F64:
        """Return the target as it is met, and its derivatives by the five numbers, float64 (6, pixels), central differences."""
        rows = [self.appearance(geometry)]
        for index, step in enumerate(STEPS):
            ahead, behind = geometry.copy(), geometry.copy()
            ahead[index] += step
            behind[index] -= step
            rows.append((self.appearance(ahead) - self.appearance(behind)) / (2 * step))
        return np.array(rows)

    def means(self, vector: F64, patterns: F64) -> F64:
        """Return photoelectrons per exposure, dark counts included, float64 (patterns,)."""
        met = (1.0 + vector[7:DARK] @ flat_basis(self.shape)) * self.appearance(vector[:N_GEOMETRY])
        gain, black = vector[5] * self.photons_per_level, vector[6]
        light = gain * (black * (self.levels - 1) * met.sum() + (1 - black) * (patterns @ met))
        return np.maximum(light + vector[DARK], LEAST_MEAN)

    def slopes(self, vector: F64, patterns: F64) -> tuple[F64, F64]:
        """Return the means (patterns,) and their derivatives (patterns, 13) by the vector's numbers."""
        basis, shown = flat_basis(self.shape), self.appearances(vector[:N_GEOMETRY])
        flat = 1.0 + vector[7:DARK] @ basis
        gain, black, peak = vector[5] * self.photons_per_level, vector[6], self.levels - 1
        fields = np.vstack([flat * shown, basis * shown[0]])  # appearance, five derivatives, five polynomials
        lit, whole = patterns @ fields.T, fields.sum(axis=1)
        light = gain * (black * peak * whole + (1 - black) * lit)
        slopes = np.empty((len(patterns), DARK + 1))
        slopes[:, :N_GEOMETRY] = light[:, 1:6]
        slopes[:, 5] = light[:, 0] / vector[5]
        slopes[:, 6] = gain * (peak * whole[0] - lit[:, 0])
        slopes[:, 7:DARK] = light[:, 6:]
        slopes[:, DARK] = 1.0
        return np.maximum(light[:, 0] + vector[DARK], LEAST_MEAN), slopes


def information_per_exposure(bench: Bench, vector: F64, patterns: F64) -> tuple[F64, F64]:
    """Return the click probability (patterns,) and g (patterns, 13): one exposure tells the matrix g g^T of the vector."""
    means, slopes = bench.slopes(vector, patterns)
    log_miss = bench.model.log_miss(means)
    clicks = -np.expm1(log_miss)
    # d log(miss) / d mean, times the root of the information on log(miss), exp(log_miss) / p
    weight = -bench.model.log_miss_slope(means) * np.sqrt(np.exp(log_miss) / clicks)
    return clicks, weight[:, None] * slopes
