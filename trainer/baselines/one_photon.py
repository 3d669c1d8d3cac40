"""The most that one photon tells of an image through passive optics that lose nothing: a bound that needs no training.

Owns the minimum-error measurement of one photon in the field of an object, its certificate, and the decision from several such photons;
never deals out light. numpy only. A photon in the field x, |x| = 1, leaves lossless optics at a detector of class c with probability
x' E_c x, where the E_c are positive and sum to 1: every choice of W with W'W = 1 and of detectors per class is of this form, and no optics
and no decision give more (Helstrom 1976). The E_c that decide most objects right are found by the iteration of Jezek, Rehacek and
Fiurasek (Phys. Rev. A 65, 060301, 2002); the dual problem (Yuen, Kennedy and Lax 1975) gives a bound that holds however far it has come.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from .common import F64, I64

ITERATIONS = 100
EMPTY = 1e-15  # of the largest eigenvalue: fields in which no class has any light
PHOTONS_MAX = 8  # 24 310 ways to spread them over ten classes


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """`operators` (classes, size, size) and the share of decisions that are right of one photon; `bound`: no measurement has more."""

    operators: F64
    right: float
    bound: float


def fields_of(images: NDArray[np.uint8], amplitude: float) -> F64:
    """Return fields of unit power, float64 (n, pixels), of amplitude grey**`amplitude`; ValueError where an image is black."""
    fields = (images.reshape(len(images), -1) / 255.0) ** amplitude
    power = np.linalg.norm(fields, axis=1, keepdims=True)
    if not power.all():
        raise ValueError(f"{np.count_nonzero(power == 0)} images are black: no photon comes from them")
    return np.asarray(fields / power)


def class_moments(fields: F64, labels: I64, n_classes: int) -> F64:
    """Return the sum of x x' over the objects of each class, over the number of all objects: (classes, size, size)."""
    return np.stack([fields[labels == label].T @ fields[labels == label] / len(fields) for label in range(n_classes)])


def minimum_error(moments: F64, iterations: int = ITERATIONS) -> Measurement:
    """Return the measurement of one photon that decides most often right; `moments` as of `class_moments`.

    The bound is the dual's: for K + e 1, made as large as every moment by the smallest e, the trace.
    """
    classes, size = moments.shape[:2]
    operators = np.stack([np.eye(size) / classes] * classes)
    for _ in range(iterations):
        improved = moments @ operators @ moments
        values, vectors = np.linalg.eigh(improved.sum(axis=0))
        lit = values > EMPTY * values[-1]
        root = (vectors[:, lit] / np.sqrt(values[lit])) @ vectors[:, lit].T
        operators = root @ improved @ root
    reached = (moments @ operators).sum(axis=0)
    dual = 0.5 * (reached + reached.T)
    missing = max(0.0, *(float(np.linalg.eigvalsh(moment - dual)[-1]) for moment in moments))
    return Measurement(operators, float(np.trace(reached)), float(np.trace(dual)) + size * missing)


def class_chances(measurement: Measurement, fields: F64) -> F64:
    """Return the chance of each class's detectors for one photon of each object, float64 (n, classes); rows sum to 1 at most."""
    return np.stack([((fields @ operator) * fields).sum(axis=1) for operator in measurement.operators], axis=1)


def several(chances: F64, labels: I64, fitted: F64, fitted_labels: I64, photons: int) -> F64:
    """Return each object's share of right decisions from `photons` photons, one after the other through the same measurement.

    `chances` (n, classes) of the objects judged, `fitted` those of the objects from which the decision of every outcome is taken, the
    most probable class. Exact: all ways to spread the photons over the classes are gone through.
    """
    n_classes = chances.shape[1]
    if not 1 <= photons <= PHOTONS_MAX:
        raise ValueError(f"{photons} photons, allowed: 1 to {PHOTONS_MAX}")
    words = np.array(
        [np.bincount(one, minlength=n_classes) for one in combinations_with_replacement(range(n_classes), photons)]
    )
    ways = np.array(
        [math.factorial(photons) / math.prod(math.factorial(count) for count in word) for word in words.tolist()]
    )

    def outcomes(of: F64) -> F64:
        return np.asarray(ways * np.exp(np.log(of.clip(min=1e-300)) @ words.T))

    seen = outcomes(fitted)
    decided = np.stack([seen[fitted_labels == label].sum(axis=0) for label in range(n_classes)]).argmax(axis=0)
    return np.asarray((outcomes(chances) * (decided == labels[:, None])).sum(axis=1))
