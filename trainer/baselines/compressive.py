"""Compressive sensing: fixed patterns that know nothing of the task, and a classifier on the measured features.

Owns the pattern families and the feature classifiers; light, detector and score are those of common.py. Without
reconstruction: the classifier sees the d_f readouts (paper, appendix on fixed optical transformations). SIMULATED.

- `mlp`: the paper's back end trained on noisy readouts of the very photon level.
- `clean-mlp`: the same trained on noiseless features and shown noisy ones (the paper's baseline).
- `bayes` (bayes.py): the exact posterior over the training objects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .common import Decide, Measurement, Report, named, silent
from .nets import Watch, feature_net, fitted, seeded, shown

FAMILIES = ("binary", "hadamard")
EPOCHS = 10

F64 = NDArray[np.float64]


def patterns(family: str, n_features: int, shape: tuple[int, int], seed: int) -> F64:
    """Return fixed patterns of 0 and 1, float64 (d_f, pixels).

    `binary`: every pixel by a fair coin. `hadamard`: two-dimensional Walsh functions, coarsest first, -1 shown as dark; the
    first one is light everywhere. Sides that are no power of two are cut from the next larger pattern.
    """
    if n_features < 1:
        raise ValueError(f"features is {n_features}, allowed: 1 or more")
    height, width = shape
    if family == "binary":
        return np.random.default_rng([seed, 3]).integers(0, 2, (n_features, height * width)).astype(np.float64)
    if family != "hadamard":
        raise ValueError(f"patterns are {family!r}, allowed: {', '.join(FAMILIES)}")
    rows, columns = walsh(height), walsh(width)
    order = sorted(((u, v) for u in range(len(rows)) for v in range(len(columns))), key=lambda uv: (sum(uv), uv))
    if n_features > len(order):
        raise ValueError(f"features is {n_features}, allowed for Walsh patterns of {height} x {width}: {len(order)}")
    signs = [np.outer(rows[u, :height], columns[v, :width]).ravel() for u, v in order[:n_features]]
    return (np.array(signs) + 1) / 2


def walsh(n: int) -> F64:
    """Return all Walsh functions (-1 and 1) of the power of two from `n` up, by their number of sign changes."""
    matrix: NDArray[Any] = np.ones((1, 1))
    while len(matrix) < n:
        matrix = np.kron(matrix, [[1, 1], [1, -1]])
    changes = (np.diff(matrix, axis=1) != 0).sum(axis=1)
    return matrix[np.argsort(changes)]


def aware_mlp(
    measurement: Measurement,
    photons: float,
    detector: str,
    *,
    seed: int,
    dark: float = 0.0,
    epochs: int = EPOCHS,
    report: Report = silent,
) -> Decide:
    """Return the feature network trained on fresh readouts at this photon level."""
    told = named(f"noise-aware MLP at {photons:g} photons", report)
    inputs = shown(measurement, photons, detector, dark)
    return fitted(_net(measurement, seed), measurement, inputs, seed=seed, epochs=epochs, report=told)


def clean_mlp(
    measurement: Measurement,
    *,
    seed: int,
    epochs: int = EPOCHS,
    report: Report = silent,
    watch: Watch = lambda _epoch, _decide: None,
) -> Callable[[float, str], Decide]:
    """Return (photons, detector) -> decision, by one feature network that was trained on noiseless features.

    Counts are divided by the exposure, clicks by their mean over that of the clean features: the network then sees features
    of the size that it knows. `watch` is called after every epoch, with what the network decides then on noiseless features.
    """
    told, inputs = named("MLP on clean features", report), shown(measurement, 1.0)
    decide = fitted(_net(measurement, seed), measurement, inputs, seed=seed, epochs=epochs, report=told, watch=watch)
    return lambda photons, detector: lambda readouts: decide(readouts / size(measurement, photons, detector))


def size(measurement: Measurement, photons: float, detector: str) -> np.float32:
    """Return the mean readout at `photons`, relative to the mean feature at one photon per object (training objects)."""
    light = measurement.photoelectrons(measurement.train, 1.0)
    if detector == "counting":
        return np.float32(photons)
    return np.float32(-np.expm1(-light * np.float32(photons)).mean(dtype=np.float64) / light.mean(dtype=np.float64))


def _net(measurement: Measurement, seed: int) -> torch.nn.Module:
    return seeded(lambda: feature_net(measurement.train.shape[1], measurement.n_classes), seed)
