"""Expected light of patterns on a known target, and how it changes with every parameter.

Owns the derivatives; the optics are imaging's, the law of clicks instrument's. All pure functions of arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.runtime.imaging import Imaging, seen
from pans.runtime.instrument.estimate import CountModel

from .parameters import DARK, GEOMETRY, N_GEOMETRY, Shape, flat_basis

F64 = NDArray[np.float64]
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

    def means(self, vector: F64, patterns: F64, met: F64 | None = None) -> F64:
        """Return photoelectrons per exposure, dark counts included, float64 (patterns,); `met` is the target's appearance if known."""
        met = self.appearance(vector[:N_GEOMETRY]) if met is None else met
        light = self._light(vector, patterns, (1.0 + vector[7:DARK] @ flat_basis(self.shape)) * met)
        return np.maximum(light + vector[DARK], LEAST_MEAN)

    def _light(self, vector: F64, patterns: F64, met: F64) -> F64:
        gain, black = vector[5] * self.photons_per_level, vector[6]
        return np.asarray(gain * (black * (self.levels - 1) * met.sum() + (1 - black) * (patterns @ met)))

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
