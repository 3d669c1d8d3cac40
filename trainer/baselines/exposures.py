"""One network for frames of every exposure: it sees counts and exposure, and is trained through photon noise. SIMULATED, ideal shot noise.

Readouts are float32 (n, pixels + 1): the counts of a frame, then its exposure in photons of the mean test object.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

import pans.trainer.device  # noqa: F401  # before a convolution: it sets what torch needs on this processor
from pans.trainer.tasks.changes import SIDE_MIN_PX, distorted

from .common import F32, F64, Measurement, Report, named, silent
from .networks import CHUNK, FRAME_SIDE, Inputs, convolution, fit, seeded

SHORTEST, LONGEST = 3.0, 600.0  # exposures that it is trained for, uniform in the logarithm
EPOCHS = {"fashion-mnist": 60}  # 12 minutes of one core; 30 are 0.2 to 0.9 points worse on images held back
OTHER_EPOCHS = 12
STRENGTHS = {"mnist": 1.0}  # of the distortions of training images
OTHER_STRENGTH = 0.3
PEAK_RATE = 4e-3
CHANNELS = (20, 32, 48)
DISTORT_STREAM = 0xE590


class ExposureNet(nn.Module):
    """Three convolutions and two dense layers on counts, the exposure added to what the first convolution gives."""

    def __init__(self, shape: tuple[int, int], n_classes: int) -> None:
        super().__init__()
        self.shape, (first, second, third) = shape, CHANNELS
        stride = 2 * max(1, round(max(shape) / FRAME_SIDE))
        self.enter = nn.Conv2d(2, first, stride + 3, stride, (stride + 3) // 2, bias=False)
        self.exposure = nn.Linear(2, first)
        self.features = nn.Sequential(
            nn.BatchNorm2d(first),
            nn.ReLU(),
            *convolution(first, second, 3, 2),
            *convolution(second, third, 3),
            nn.AdaptiveAvgPool2d(7),  # 28 x 28 pixels arrive as 7 x 7
            nn.Flatten(),
        )
        self.head = nn.Sequential(nn.Linear(49 * third, 192), nn.ReLU(), nn.Dropout(0.15), nn.Linear(192, n_classes))

    def forward(self, readouts: Tensor) -> Tensor:
        """Return scores (n, classes)."""
        counts, exposure = readouts[:, :-1].reshape(-1, 1, *self.shape), readouts[:, -1]
        level = exposure.log() / 3 - 1
        seen = torch.cat([counts.sqrt(), counts * (12 / (exposure + 12)).view(-1, 1, 1, 1)], dim=1)
        known = self.exposure(torch.stack([level, level**2], dim=1))
        scores: Tensor = self.head(self.features(self.enter(seen) + known[:, :, None, None]))
        return scores


def exposure_net(
    measurement: Measurement, fitted: int, name: str, *, seed: int, epochs: int | None = None, report: Report = silent
) -> ExposureNet:
    """Return the network trained on the first `fitted` training objects, on fresh frames of fresh exposures.

    Images are distorted a little where they are images of transmission and large enough; how much depends on the `name` of the task.
    """
    shape = measurement.image_shape
    assert shape is not None, "direct imaging measures frames"
    net = seeded(lambda: ExposureNet(shape, measurement.n_classes), seed)
    net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a fifth less time
    fit(
        net,
        _frames(measurement, shape, STRENGTHS.get(name, OTHER_STRENGTH), seed),
        measurement.train_labels[:fitted],
        epochs=epochs or EPOCHS.get(name, OTHER_EPOCHS),
        seed=seed,
        rates={"": PEAK_RATE},
        report=named("network of all exposures", report),
    )
    return net


def _frames(measurement: Measurement, shape: tuple[int, int], strength: float, seed: int) -> Inputs:
    can_distort = measurement.train.dtype == np.uint8 and min(shape) >= SIDE_MIN_PX

    def inputs(which: Tensor, generator: torch.Generator) -> Tensor:
        rows = measurement.train[which.numpy()]
        if can_distort:
            drawn = int(torch.randint(1 << 62, (), generator=generator))
            rows = distorted(rows.reshape(-1, *shape), [DISTORT_STREAM, seed, drawn], strength).reshape(rows.shape)
        at = torch.rand(len(rows), 1, generator=generator)
        exposure = SHORTEST * torch.exp(at * math.log(LONGEST / SHORTEST))
        light = torch.from_numpy(measurement.photoelectrons(rows, 1.0)) * exposure
        return torch.cat([torch.poisson(light, generator=generator), exposure], dim=1)

    return inputs


def log_chances(net: ExposureNet, counts: F32, exposure: float) -> F64:
    """Return log P(class | counts, exposure), float64 (n, classes), of frames (n, pixels)."""
    with torch.no_grad():
        parts = [
            torch.log_softmax(net(nn.functional.pad(part, (0, 1), value=exposure)), dim=1)
            for part in torch.from_numpy(counts).split(CHUNK)
        ]
    return torch.cat(parts).numpy().astype(np.float64)
