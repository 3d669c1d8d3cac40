"""Direct imaging: a frame of the object under uniform light, one readout per pixel.

Owns the networks that decide from a frame; the light, the detector and the score are those of common.py. Each way is a
function from a photon level to a decision `readouts -> labels`. SIMULATED, ideal shot noise unless dark counts are asked for.

- `bayes` (bayes.py): the exact Poisson likelihood, averaged over all training objects. Knows the noise;
  the strong one at few photons.
- `cnn`: an AlexNet-style network trained on noisy frames of the very photon level. Knows the noise; strong at many photons.
- `clean-cnn`: the same network trained on noiseless frames (the paper's baseline, which cannot know what noise looks like).
"""

from __future__ import annotations

import math

import numpy as np
import torch

from .common import Decide, Measurement, Report, named, silent
from .nets import FrameNet, fitted, seeded, shown

EPOCHS = 5


def aware_cnn(
    measurement: Measurement,
    photons: float,
    detector: str,
    *,
    seed: int,
    dark: float = 0.0,
    epochs: int = EPOCHS,
    report: Report = silent,
) -> Decide:
    """Return the frame network trained on fresh noisy frames at this photon level."""
    light = measurement.photoelectrons(measurement.train[:: max(1, len(measurement.train) // 1000)], photons) + dark
    square = light + light**2 if detector == "counting" else -np.expm1(-light)
    spread = math.sqrt(float(square.mean()))
    net, told = _frame_net(measurement, seed, spread), named(f"noise-aware CNN at {photons:g} photons", report)
    return fitted(net, measurement, shown(measurement, photons, detector, dark), seed=seed, epochs=epochs, report=told)


def clean_cnn(measurement: Measurement, *, seed: int, epochs: int = EPOCHS, report: Report = silent) -> Decide:
    """Return the frame network trained on noiseless frames; one network serves all photon levels."""
    net, told = _frame_net(measurement, seed, None), named("CNN on clean frames", report)
    return fitted(net, measurement, shown(measurement, 1e6), seed=seed, epochs=epochs, report=told)


def _frame_net(measurement: Measurement, seed: int, spread: float | None) -> torch.nn.Module:
    assert measurement.image_shape is not None, "direct imaging measures frames"
    shape, n_classes = measurement.image_shape, measurement.n_classes
    return seeded(lambda: FrameNet(shape, n_classes, spread), seed)
