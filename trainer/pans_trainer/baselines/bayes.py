"""The exact posterior over the training objects: the strongest decision that few photons allow, for any linear measurement.

The world is taken to hold just the training objects, each as likely: exact for the noise, and for the objects as good as the training set
stands for them. At many photons it is a nearest neighbour, and networks do better.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import njit

from .common import F32, F64, I64, Decide, Measurement, Report, blocks, detect, silent

FLOORS = (1e-3, 5e-3, 2e-2)  # of full transmission, among which a part of the training objects chooses
VALIDATION_OBJECTS = 1000
_CHUNK = 2048  # readouts per matrix product: 32 MiB of log-likelihoods at a time


def log_weights(photoelectrons: F32, detector: str) -> tuple[F32, F32]:
    """Return (w, b) with log P(readout | object) = readout @ w + b + what does not depend on the object.

    Counting: w = log(lambda), b = -sum(lambda). Binary: log(p / (1 - p)) = log(expm1(lambda)), and sum(log(1 - p)) is
    again -sum(lambda). Where there is no light, w is -inf and any photon rules the object out: lift it by a floor.
    """
    total = photoelectrons.sum(axis=1, dtype=np.float64)
    with np.errstate(divide="ignore"):
        if detector == "counting":
            return np.log(photoelectrons), -total.astype(np.float32)
        # log(expm1(x)) = x + log(1 - exp(-x)): does not overflow
        return photoelectrons + np.log(-np.expm1(-photoelectrons)), -total.astype(np.float32)


def log_joint(
    measurement: Measurement,
    readouts: F32,
    photons: float,
    detector: str,
    *,
    floor: float = FLOORS[0],
    dark: float = 0.0,
    left_out: NDArray[np.bool_] | None = None,
    report: Report = silent,
) -> F64:
    """Return log sum P(readout | object) / objects over the training objects of every class, float64 (n, classes).

    Exact under the model that the world holds just these objects, up to a term that all classes share: the arg max is the
    Bayes decision, the softmax its posterior. `floor` or `dark` is above 0; `left_out` (training objects,) are no part of the mixture.
    """
    labels = measurement.train_labels if left_out is None else np.where(left_out, -1, measurement.train_labels)
    # log weights are taken relative to a typical object: smaller numbers, fewer lost digits in float32
    typical = measurement.photoelectrons(measurement.train[::50], photons, floor).mean(axis=0, keepdims=True) + dark
    reference = log_weights(typical.astype(np.float32), detector)[0]
    out = np.full((len(readouts), measurement.n_classes), -np.inf)
    done, total = 0, int((labels >= 0).sum())
    for label in range(measurement.n_classes):
        members = np.flatnonzero(labels == label)
        for block in blocks(len(members), readouts.shape[1]):
            rows = measurement.train[members[block]]
            light = measurement.photoelectrons(rows, photons, floor)
            light += np.float32(dark)
            weights, offsets = log_weights(light, detector)
            weights -= reference
            for first in range(0, len(readouts), _CHUNK):
                likelihood = products(readouts[first : first + _CHUNK], weights)
                likelihood += offsets
                of_class = out[first : first + _CHUNK, label]
                np.logaddexp(of_class, _log_sum_exp(likelihood), out=of_class)
            done += len(rows)
            report("posterior over the training objects", done / total)
    return out - math.log(total)


def products(readouts: F32, weights: F32) -> F32:
    """Return readouts @ weights.T; where few readouts are not 0, as at few photons, only those are gone through."""
    present = readouts != 0
    if 16 * np.count_nonzero(present) > readouts.size:
        return readouts @ weights.T
    out = np.zeros((len(readouts), len(weights)), np.float32)
    ends = np.cumsum(present.sum(axis=1))
    _add_present(ends, np.nonzero(present)[1], readouts[present], np.ascontiguousarray(weights.T), out)
    return out


@njit(cache=True, nogil=True)
def _add_present(ends: I64, places: I64, values: F32, columns: F32, out: F32) -> None:
    """Add values[k] * columns[places[k]] to row i of `out` for all k from ends[i - 1] to ends[i]."""
    k = 0
    for i in range(len(ends)):
        row = out[i]
        while k < ends[i]:
            value, column = values[k], columns[places[k]]
            for j in range(len(row)):
                row[j] += value * column[j]
            k += 1


def _log_sum_exp(rows: F32) -> F64:
    """Along the last axis; `rows` is overwritten."""
    top = rows.max(axis=1, keepdims=True)
    rows -= top
    np.exp(rows, out=rows)
    sums: F64 = np.log(rows.sum(axis=1, dtype=np.float64)) + top[:, 0]
    return sums


def choose_floor(
    measurement: Measurement, photons: float, detector: str, rng: np.random.Generator, *, dark: float = 0.0
) -> float:
    """Return the one of `FLOORS` that decides best on training objects left out of the mixture; the test objects stay unseen."""
    n = len(measurement.train_labels)
    left_out = np.zeros(n, bool)
    left_out[rng.permutation(n)[: min(VALIDATION_OBJECTS, n // 5)]] = True
    light = measurement.photoelectrons(measurement.train[left_out], photons)
    readouts = detect(light, detector, rng, dark)
    wanted = measurement.train_labels[left_out]
    right = []
    for floor in FLOORS:
        joint = log_joint(measurement, readouts, photons, detector, floor=floor, dark=dark, left_out=left_out)
        right.append(int((joint.argmax(axis=1) == wanted).sum()))
    return FLOORS[int(np.argmax(right))]


def bayes(
    measurement: Measurement,
    photons: float,
    detector: str,
    *,
    seed: int,
    dark: float = 0.0,
    floor: float | None = None,
    report: Report = silent,
) -> tuple[Decide, float]:
    """Return the Bayes decision of the mixture of all training objects, and its floor (by default chosen on left-out ones).

    For frames and for measured features alike: nothing decides better as far as the training objects stand for the world.
    """
    if floor is None:
        rng = np.random.default_rng([seed, 2])
        floor = choose_floor(measurement, photons, detector, rng, dark=dark)

    return lambda readouts: log_joint(
        measurement, readouts, photons, detector, floor=floor, dark=dark, report=report
    ), floor
