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
from .nets import Watch, feature_conv_net, feature_net, fitted, seeded, shown

FAMILIES = ("binary", "hadamard", "gaussian", "binning")
EPOCHS = 10

F64 = NDArray[np.float64]


def patterns(family: str, n_features: int, shape: tuple[int, int], seed: int) -> F64:
    """Return fixed patterns, 0 or more, float64 (d_f, pixels).

    `binary`: every pixel by a fair coin. `hadamard`: two-dimensional Walsh functions, coarsest first, -1 shown as dark; the
    first one is light everywhere. Sides that are no power of two are cut from the next larger pattern. `gaussian`: the absolute
    values of normal numbers, as light has no sign. `binning`: each pattern lights one block of a grid of d_f blocks, as square as d_f
    has divisors; blocks differ by a pixel where the sides cannot be divided.
    """
    if n_features < 1:
        raise ValueError(f"features is {n_features}, allowed: 1 or more")
    height, width = shape
    if family == "binary":
        return np.random.default_rng([seed, 3]).integers(0, 2, (n_features, height * width)).astype(np.float64)
    if family == "gaussian":
        return np.abs(np.random.default_rng([seed, 5]).standard_normal((n_features, height * width)))
    if family == "binning":
        return _bins(n_features, shape)
    if family != "hadamard":
        raise ValueError(f"patterns are {family!r}, allowed: {', '.join(FAMILIES)}")
    rows, columns = walsh(height), walsh(width)
    order = sorted(((u, v) for u in range(len(rows)) for v in range(len(columns))), key=lambda uv: (sum(uv), uv))
    if n_features > len(order):
        raise ValueError(f"features is {n_features}, allowed for Walsh patterns of {height} x {width}: {len(order)}")
    signs = [np.outer(rows[u, :height], columns[v, :width]).ravel() for u, v in order[:n_features]]
    return (np.array(signs) + 1) / 2


def _bins(n_features: int, shape: tuple[int, int]) -> F64:
    """Indicators of the blocks, rows first."""
    height, width = shape
    down = max((n for n in range(1, n_features + 1) if n_features % n == 0 and n * n <= n_features), default=1)
    across = n_features // down
    if down > height or across > width:
        raise ValueError(f"features is {n_features}: a grid of {down} x {across} blocks in {height} x {width} pixels")
    row = np.arange(height) * down // height
    column = np.arange(width) * across // width
    block = (row[:, None] * across + column[None, :]).ravel()
    return (block == np.arange(n_features)[:, None]).astype(np.float64)


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
    convolutions: bool = False,
    report: Report = silent,
    watch: Watch = lambda _epoch, _decide: None,
) -> Callable[[float, str], Decide]:
    """Return (photons, detector) -> decision, by one feature network that was trained on noiseless features.

    With `convolutions` there are two along the patterns before its hidden layer.

    Counts are divided by the exposure, clicks by their mean over that of the clean features: the network then sees features
    of the size that it knows. `watch` is called after every epoch, with what the network decides then on noiseless features.
    """
    told, inputs = named("network on clean features", report), shown(measurement, 1.0)
    decide = fitted(
        _net(measurement, seed, convolutions), measurement, inputs, seed=seed, epochs=epochs, report=told, watch=watch
    )
    return lambda photons, detector: lambda readouts: decide(readouts / size(measurement, photons, detector))


def size(measurement: Measurement, photons: float, detector: str) -> np.float32:
    """Return the mean readout at `photons`, relative to the mean feature at one photon per object (training objects)."""
    light = measurement.photoelectrons(measurement.train, 1.0)
    if detector == "counting":
        return np.float32(photons)
    return np.float32(-np.expm1(-light * np.float32(photons)).mean(dtype=np.float64) / light.mean(dtype=np.float64))


def _net(measurement: Measurement, seed: int, convolutions: bool = False) -> torch.nn.Module:
    made = feature_conv_net if convolutions else feature_net
    return seeded(lambda: made(measurement.train.shape[1], measurement.n_classes), seed)
