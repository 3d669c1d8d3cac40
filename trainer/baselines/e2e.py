"""Conventional end-to-end optimisation: trained patterns, but no photons in training.

Owns the training of patterns and head on expected values, as in computational imaging before PANS (paper, appendix on
conventional end-to-end optimisation); detection and score are those of common.py. The same front end (squared weights) and
back end (512 hidden units) as PANS. SIMULATED.

- `qat`: quantisation-aware training: detected values pass a `bits`-bit quantiser, patterns one of `PATTERN_BITS`, with
  straight-through gradients. The paper names the technique and no numbers; 4 and 5 bits are those of Wang et al. 2022.
- `plain`: no quantiser.

A trained model is tested at every photon level by scaling all its light (the paper's eta), the readouts scaled back.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from pans.trainer.tasks.registry import Task

from .common import Decide, Measurement, Report, measure, named, silent
from .compressive import size
from .nets import decider, feature_net, fit, seeded

EPOCHS = 15
ACTIVATION_BITS = 4
PATTERN_BITS = 5
PATTERN_RATE = 1e-2


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
    if n_features < 1 or (bits is not None and not 1 <= bits <= 16):
        raise ValueError(f"features is {n_features}, bits is {bits}; allowed: from 1, 1 to 16")
    n_pixels = math.prod(task.image_shape)
    model = seeded(lambda: EndToEnd(n_features, n_pixels, len(task.classes), bits), seed)
    assert isinstance(model, EndToEnd)
    images = task.train.images.reshape(len(task.train), n_pixels)

    def objects(which: Tensor, _generator: torch.Generator) -> Tensor:
        return torch.from_numpy(images[which.numpy()].astype(np.float32)) / 255

    labels = torch.from_numpy(task.train.labels)
    rates = {"weight": PATTERN_RATE, "head": 1e-3}
    fit(model, objects, labels, epochs=epochs, seed=seed, batch=512, rates=rates, report=named("end-to-end", report))
    return model


def measured_by(model: EndToEnd, task: Task, brightness: str) -> tuple[Measurement, Callable[[float, str], Decide]]:
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
