"""Patterns that are trained, but not by photon-aware training: conventional end-to-end (`e2e`) and feature-specific imaging (`fsi`).

End-to-end optimisation on expected values, as in computational imaging before PANS (paper, appendix on conventional end-to-end
optimisation); the front end (squared weights) and back end (512 hidden units) are those of PANS. A model is tested at every photon level
by scaling all its light (the paper's eta), the readouts scaled back.

- `qat`: quantisation-aware training: detected values pass a `bits`-bit quantiser, patterns one of `PATTERN_BITS`, with
  straight-through gradients. The paper names the technique and no numbers; 4 and 5 bits are those of Wang et al. 2022.
- `plain`: no quantiser.

Feature-specific imaging: masks trained with a network on photon counts, through Poisson noise, anew for each photon level.

- `deep`: after DeepFSI (Lu and Velten, arXiv 2508.01981). From its abstract: masks that begin as principal components are "unfrozen" and
  learnt together with the network under Poisson noise; one single-pixel measurement per mask. Assumed here, as nothing else was at hand:
  masks are intensities (positive and negative parts of a component are masks of their own, learnt as squares), the budget is shared freely
  among the masks and held exactly on average, and the gradient passes a Poisson number as lambda + sqrt(lambda) x noise does.
- `pca`: the same with the masks frozen, conventional feature-specific imaging.
- `stopping`: as `deep`, but all masks are displayed in turn, dim, again and again. The network sees the counts so far and how much light
  there was, and a decision falls as soon as little doubt is left (stopping.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from pans_trainer.options import BaselineOptions
from pans_trainer.tasks.registry import Task

from .common import Decide, Light, Measurement, Report, Trials, measure, named, silent
from .networks import Inputs, decider, feature_net, fit, seeded, size
from .stopping import held_back, of_network, stopping

EPOCHS = 15
ACTIVATION_BITS = 4
PATTERN_BITS = 5
PATTERN_RATE = 1e-2
MASK_RATE = 1e-2
SPREAD = 6.0  # masks that stop are trained for exposures up to so many times less and more than the mean
START_LIGHT = 0.03  # of a mask's largest value, on all its pixels: the square of 0 has no gradient
_LEAST = 0.05  # photoelectrons, below which the gradient of the noise's spread is cut: it grows as 1 / lambda

F64 = NDArray[np.float64]


class EndToEnd(nn.Module):
    """Squared weights as patterns, a quantiser in the place of the detector, and the feature network behind it."""

    def __init__(self, n_features: int, n_pixels: int, n_classes: int, bits: int | None) -> None:
        super().__init__()
        self.weight = nn.Parameter((torch.rand(n_features, n_pixels) * 2 - 1) * math.sqrt(6 / n_pixels))
        self.head = feature_net(n_features, n_classes)
        self.bits = bits
        self.full_scale: Tensor
        self.register_buffer("full_scale", torch.zeros(n_features))  # of the quantiser: the largest values of late

    def patterns(self) -> Tensor:
        """Return the patterns (d_f, pixels), at least 0."""
        light = self.weight**2
        return light if self.bits is None else quantised(light, light.detach().max(), PATTERN_BITS)

    def forward(self, transmission: Tensor) -> Tensor:
        """Return scores (n, classes) of objects (n, pixels): expected values, no photon is ever drawn."""
        values = transmission @ self.patterns().T
        if self.training:
            with torch.no_grad():
                self.full_scale.copy_(torch.maximum(0.99 * self.full_scale, values.max(dim=0).values))
        return self.scores(values)

    def scores(self, values: Tensor) -> Tensor:
        """Return scores (n, classes) of detected values (n, d_f) of the size that objects at full light give."""
        if self.bits is not None:
            values = quantised(values, self.full_scale, self.bits)
        scores: Tensor = self.head(values)
        return scores


def quantised(values: Tensor, full_scale: Tensor, bits: int) -> Tensor:
    """Return `values` clipped to 0 ... `full_scale` and rounded to 2**bits levels; the gradient passes the rounding."""
    step = (full_scale / (2**bits - 1)).clamp(min=1e-12)
    clipped = torch.minimum(values.clamp(min=0), full_scale)
    return clipped + (torch.round(clipped / step) * step - clipped).detach()


def train_conventionally(
    task: Task,
    n_features: int,
    *,
    seed: int,
    bits: int | None = ACTIVATION_BITS,
    epochs: int = EPOCHS,
    report: Report = silent,
) -> EndToEnd:
    """Return patterns and head trained together on the expected values of the training objects of `task`."""
    n_pixels = math.prod(task.image_shape)
    model = seeded(lambda: EndToEnd(n_features, n_pixels, len(task.classes), bits), seed)
    images, rates = task.train.images.reshape(len(task.train), n_pixels), {"weight": PATTERN_RATE, "head": 1e-3}
    labels, progress = task.train.labels, named("end-to-end", report)
    fit(model, transmissions(images), labels, epochs=epochs, seed=seed, batch=512, rates=rates, report=progress)
    return model


def patterns_measured(
    model: EndToEnd, task: Task, brightness: str
) -> tuple[Measurement, Callable[[float, str], Decide]]:
    """Return the measurement by the model's patterns, and (photons, detector) -> decision of its head on scaled readouts."""
    with torch.no_grad():
        shown: NDArray[np.float32] = model.patterns().numpy()
    measurement = measure(task, shown, brightness)
    to_labels = decider(model.scores)
    # the head knows features of the objects at full transmission, not at one photon per object
    known = measurement.train.mean(dtype=np.float64) / measurement.photoelectrons(measurement.train, 1.0).mean(
        dtype=np.float64
    )

    def at(photons: float, detector: str) -> Decide:
        factor = np.float32(known) / size(measurement, photons, detector)
        return lambda readouts: to_labels(readouts * factor)

    return measurement, at


def principal_masks(images: NDArray[np.uint8], n_masks: int) -> F64:
    """Return masks (n_masks, pixels), at least 0: positive and negative parts of the first principal components of images (n, pixels).

    The parts come in the order of their components' variance, each with its largest value 1; empty parts are passed over.
    """
    x = images.astype(np.float32) / np.float32(255)
    x -= x.mean(axis=0)
    _, vectors = np.linalg.eigh((x.T @ x).astype(np.float64))
    parts: list[F64] = []
    for vector in vectors.T[::-1]:
        parts += [part for part in (np.maximum(vector, 0), np.maximum(-vector, 0)) if part.max() > 1e-9]
        if len(parts) >= n_masks:
            return np.array([part / part.max() for part in parts[:n_masks]])
    raise ValueError(f"features is {n_masks}, allowed: at most {len(parts)} for {images.shape[1]} pixels")


class FeatureSpecific(nn.Module):
    """Masks, a Poisson detector behind each, and the network that sees the counts."""

    mean_image: Tensor

    def __init__(
        self, masks: F64, mean_image: NDArray[np.float32], n_classes: int, options: BaselineOptions, level: Light
    ) -> None:
        super().__init__()
        frozen = options.method == "pca"
        start = torch.from_numpy(np.sqrt(masks if frozen else masks + START_LIGHT).astype(np.float32))
        self.weight = nn.Parameter(start, requires_grad=not frozen)
        self.register_buffer("mean_image", torch.from_numpy(mean_image))
        self.stops = options.method == "stopping"
        self.head = feature_net(2 * len(masks) + 1 if self.stops else len(masks), n_classes)
        self.options, self.level = options, level

    def masks(self) -> Tensor:
        """Return the masks (features, pixels), scaled to the photons of the mean training object, or to the illumination."""
        light = self.weight**2
        given = light.sum(dim=0) @ self.mean_image if self.level.of == "photons" else light.sum()
        return light * (self.level.amount / given.clamp(min=1e-12))

    def forward(self, transmission: Tensor) -> Tensor:
        """Return scores (n, classes) of fresh counts of objects (n, pixels); random numbers are those of torch's own generator."""
        light = transmission @ self.masks().T
        if self.stops:
            exposure = SPREAD ** (2 * torch.rand(len(light), 1) - 1)
            return self.after(noisy(light * exposure), exposure)
        scores: Tensor = self.head(noisy(light + self.options.dark, self.options.detector))
        return scores

    def after(self, counts: Tensor, exposure: Tensor) -> Tensor:
        """Return scores (n, classes) of counts after `exposure` (n, 1), 1 at the level that the masks are trained for."""
        scores: Tensor = self.head(torch.cat([counts, counts / exposure.sqrt(), exposure.log()], dim=1))
        return scores


def noisy(expected: Tensor, detector: str = "counting") -> Tensor:
    """Return Poisson numbers of mean `expected` (or with a `binary` detector whether there was one) that carry its gradient.

    Counts carry it as lambda + sqrt(lambda) x noise does, the noise held fixed; clicks as their mean does.
    """
    with torch.no_grad():
        counts = torch.poisson(expected)
    if detector == "binary":
        mean = -torch.expm1(-expected)
        return mean + ((counts > 0).to(mean.dtype) - mean).detach()
    root = expected.clamp(min=_LEAST).sqrt()
    carried = expected + root * ((counts - expected) / root).detach()
    return carried + (counts - carried).detach()  # the value is the number itself, whatever was rounded or cut


def train_masks(task: Task, options: BaselineOptions, level: Light, report: Report = silent) -> FeatureSpecific:
    """Return masks and network trained on fresh counts of the training objects of `task` at `level`."""
    n_pixels = math.prod(task.image_shape)
    images = task.train.images.reshape(len(task.train), n_pixels)
    mean_image = (images.mean(axis=0) / 255).astype(np.float32)
    masks = principal_masks(images, options.features)
    model = seeded(lambda: FeatureSpecific(masks, mean_image, len(task.classes), options, level), options.seed)
    progress = named(f"{options.features} masks at {level.amount:g} {level.of}", report)
    labels, epochs, rates = task.train.labels, options.epochs or EPOCHS, {"weight": MASK_RATE}
    fit(model, transmissions(images), labels, epochs=epochs, seed=options.seed, rates=rates, report=progress)
    return model


def transmissions(images: NDArray[np.uint8]) -> Inputs:
    """Return what a network sees of objects without a detector before it: their transmission."""
    return lambda which, _generator: torch.from_numpy(images[which.numpy()].astype(np.float32)) / 255


def masks_measured(model: FeatureSpecific, task: Task, brightness: str) -> tuple[Measurement, Decide]:
    """Return the measurement by the model's masks, and the decision of its network on counts."""
    with torch.no_grad():
        shown: NDArray[np.float32] = model.masks().numpy()
    to_scores: Callable[[Tensor], Tensor] = model.head
    return measure(task, shown, brightness), decider(to_scores)


def masks_that_stop(
    task: Task, options: BaselineOptions, levels: Iterable[Light], report: Report = silent
) -> Iterator[tuple[Light, dict[str, Any], Trials]]:
    """Yield for every level that can be reached what masks trained for it decide on the test objects, as `stopping.stopping` does."""
    kept = len(task.train) - held_back(len(task.train))
    for level in levels:
        model = train_masks(replace(task, train=task.train.first(kept)), options, level, report)
        measurement, _ = masks_measured(model, task, options.brightness)
        middle = level.photons(measurement)
        network = of_network(partial(_log_chances, model, middle), options.features, middle / SPREAD, middle * SPREAD)
        yield from stopping(measurement, [level], network, seed=options.seed, trials=options.trials or 1, report=report)


def _log_chances(model: FeatureSpecific, middle: float, counts: NDArray[np.float32], exposure: float) -> F64:
    with torch.no_grad():
        scores = model.after(torch.from_numpy(counts), torch.full((len(counts), 1), exposure / middle))
        return torch.log_softmax(scores.double(), dim=1).numpy()
