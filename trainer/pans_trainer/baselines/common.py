"""Baselines, the common ground: how N photons are dealt out, how they are detected, and how a result is counted.

Readouts are float32 (n, m): m pixels of a frame, or m = d_f patterns. Two conventions of "N photons" (`brightness`), both SIMULATED:

- **source**: one source for all objects; N is the mean over the test objects, bright objects give more (the paper's
  appendix on direct imaging, and `photons` everywhere in this project). How bright an object is then tells about it.
- **object**: the source follows the object, so that every object gives N photons in expectation.

Two detectors: `counting` (Poisson counts: ideal shot noise) and `binary` (a click when at least one photon came).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.bundle.sensor import incident_intensity
from pans_trainer.evaluate.accuracy import Trials as Trials
from pans_trainer.evaluate.information import cooled_surprise
from pans_trainer.tasks.registry import Task

BRIGHTNESS = ("source", "object")
DETECTORS = ("counting", "binary")
_BLOCK = 4096  # objects per piece of work, fewer if they are large
_BLOCK_NUMBERS = 1 << 23  # pixels of all objects of a block: 32 MiB of float32
_GRAY_MAX = np.float32(255)

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Decide = Callable[[F32], NDArray[np.floating[Any]]]  # readouts (n, m) -> log posteriors (n, classes) but for a constant
Report = Callable[[str, float], None]  # what is being done, and which part of it is done (0 to 1)


def silent(_what: str, _done: float) -> None:
    """A `Report` for nobody."""


def named(what: str, report: Report) -> Report:
    """Return a `Report` that passes on its words with `what` before it."""
    return lambda words, done: report(f"{what}, {words}", done)


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Linear measurements of all objects of a task at unit light: rows (objects, m), times `unit`, are sums of transmission.

    `full` (m,) is what an object of transmission 1 everywhere would give: the sum of each pattern.
    """

    train: NDArray[Any]
    train_labels: I64
    test: NDArray[Any]
    test_labels: I64
    n_classes: int
    full: F32
    unit: float
    brightness: str
    image_shape: tuple[int, int] | None  # of a frame; None when the m values are no picture
    mean: float  # what the mean test object gives at unit light
    sends: bool = True  # False: the light is the scene's own, nothing is sent

    def photoelectrons(self, rows: NDArray[Any], photons: float, floor: float = 0.0) -> F32:
        """Return expected photoelectrons, float32 (n, m), of `rows` at `photons` per object; `floor` lifts every transmission.

        Dark objects stay dark: they give no light in either convention.
        """
        light = rows.astype(np.float32)
        light *= np.float32(self.unit)
        if floor:
            light += np.float32(floor) * self.full
        light *= np.float32(self._scale(light, photons))
        return light

    def sent(self, rows: NDArray[Any], photons: float) -> F64:
        """Return the sum of all pattern intensities for each of `rows` at `photons`, in photoelectrons per unit transmission, (n,).

        0 of a scene whose light is its own.
        """
        if not self.sends:
            return np.zeros(len(rows))
        scale = self._scale(rows.astype(np.float32) * np.float32(self.unit), photons)
        return np.broadcast_to(np.ravel(scale), len(rows)) * self.full.sum(dtype=np.float64)

    def illumination(self, photons: float) -> float:
        """Return `sent` averaged over the test objects."""
        return float(self.sent(self.test, photons).mean())

    def _scale(self, light: F32, photons: float) -> Any:
        if self.brightness == "source":
            return photons / self.mean
        sums = light.sum(axis=1, keepdims=True, dtype=np.float64)
        return np.divide(photons, sums, out=np.zeros_like(sums), where=sums > 0)


@dataclass(frozen=True, slots=True)
class Light:
    """How much light a decision has on average: `amount` photoelectrons, detected (`photons`) or sent (`illumination`)."""

    of: str
    amount: float

    def photons(self, measurement: Measurement) -> float:
        """Return the photoelectrons detected of the mean test object, where nothing depends on what was detected."""
        return self.amount if self.of == "photons" else self.amount / measurement.illumination(1.0)


def measure(task: Task, patterns: NDArray[np.floating] | None, brightness: str = "source") -> Measurement:
    """Measure all objects of `task` by `patterns` (d_f, pixels, at least 0), or pixel by pixel without them (direct imaging)."""
    n_pixels, shape = math.prod(task.image_shape), task.image_shape if patterns is None else None
    if not task.test.images.any():
        raise ValueError(f"the test objects of {task.name} are black: no light can reach the detector")
    flat: list[NDArray[Any]] = [part.images.reshape(len(part), n_pixels) for part in (task.train, task.test)]
    train, test = flat
    full, unit = np.ones(n_pixels, np.float32), 1.0
    sends = sends_light(task)
    if not sends:  # a camera sees the intensity of a field, not its amplitude
        if patterns is not None:
            raise ValueError(f"{task.name} is light that reaches us: it takes no patterns, only a direct image")
        lit = (incident_intensity(part.images, task.light, task.optics) for part in (task.train, task.test))
        train, test = (images.reshape(-1, n_pixels) for images in lit)
        full *= np.float32(test.mean())  # so that a floor is a part of the mean light
    elif patterns is None:
        unit = 1 / 255
    else:
        if patterns.ndim != 2 or patterns.shape[1] != n_pixels or not (patterns >= 0).all() or not patterns.any():
            raise ValueError(f"patterns are {patterns.shape}, allowed: (d_f, {n_pixels}), at least 0 and not all 0")
        weights = patterns.astype(np.float32).T
        train, test = (_features(images, weights) for images in (train, test))
        full = weights.sum(axis=0)
    labels, n_classes = (task.train.labels, task.test.labels), len(task.classes)
    mean = float(test.sum(dtype=np.float64)) * unit / len(test)
    return Measurement(train, labels[0], test, labels[1], n_classes, full, unit, brightness, shape, mean, sends)


def sends_light(task: Task) -> bool:
    """Return whether the objects of `task` are lit by us, and not by light of their own."""
    return task.light == "transmission" and task.optics == "none"


def _features(images: NDArray[np.uint8], weights: F32) -> F32:
    out = np.empty((len(images), weights.shape[1]), np.float32)
    for rows in blocks(len(images), images.shape[1]):
        out[rows] = (images[rows].astype(np.float32) / _GRAY_MAX) @ weights
    return out


def blocks(n: int, m: int) -> Iterator[slice]:
    """Pieces of `n` rows of `m` numbers that fit into memory."""
    step = max(1, min(_BLOCK, _BLOCK_NUMBERS // m))
    return (slice(start, start + step) for start in range(0, n, step))


# ---- detection ----


def detect(photoelectrons: F32, detector: str, rng: np.random.Generator, dark: float = 0.0) -> F32:
    """Return one readout per value: Poisson counts, or whether there was any; `dark` photoelectrons are added to each."""
    readouts = np.empty(photoelectrons.shape, np.float32)
    for rows in blocks(len(readouts), math.prod(readouts.shape[1:])):
        counts = rng.poisson(photoelectrons[rows].astype(np.float64) + dark)
        readouts[rows] = counts > 0 if detector == "binary" else counts
    return readouts


# ---- the score ----


def run_trials(
    measurement: Measurement,
    photons: float,
    detector: str,
    decide: Decide,
    *,
    trials: int,
    seed: int,
    dark: float = 0.0,
) -> Trials:
    """Detect every test object `trials` times at `photons` per object and let `decide` judge."""
    light = measurement.photoelectrons(measurement.test, photons)
    rng = np.random.default_rng([seed, 1])
    right = np.empty((trials, len(light)), bool)
    clicks, surprise, labels = np.zeros(len(light)), np.zeros(len(light)), measurement.test_labels
    for trial in range(trials):
        readouts = detect(light, detector, rng, dark)
        clicks += (readouts > 0).sum(axis=1)
        scores = decide(readouts)
        right[trial] = scores.argmax(axis=1) == labels
        surprise += cooled_surprise(scores, labels)[0] / trials
    light_of_object, illumination = light.sum(axis=1, dtype=np.float64), measurement.illumination(photons)
    return Trials(right, clicks / trials, light_of_object, illumination, labels, surprise)
