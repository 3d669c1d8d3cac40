"""Networks of the baselines and their one training loop.

Owns the AlexNet-style frame classifier of the paper's appendix on direct imaging, the two-layer head for measured features,
and `fit`; never deals out light and never scores. `fit` trains in place; `decider` returns a function from readouts to labels.

Everything random comes from `seed`; the global generator of torch is left as it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

import pans.trainer.device  # noqa: F401  # before a convolution: it sets what torch needs on this processor

from .common import F32, I64, Decide, Measurement, Report, silent

CHUNK = 1000  # readouts per pass where no gradient is needed
FRAME_SIDE = 28  # pixels; larger frames are reduced to about this by the first layer's stride
RATE = 2e-3
CONV_KERNEL, CONV_CHANNELS = 15, ((1, 32), (32, 64))  # of the convolutional back end: before and after each layer

Inputs = Callable[[Tensor, torch.Generator], Tensor]  # (which objects, random numbers) -> what the network sees


class FrameNet(nn.Module):
    """Five convolutions and two dense layers (AlexNet's plan, sized for small grey frames): (n, height * width) -> scores.

    `normalise` "frame" gives every frame mean 0 and variance 1, so that its exposure does not matter; "given" divides by
    `spread` alone, which keeps what the number of photons tells.
    """

    def __init__(self, shape: tuple[int, int], n_classes: int, spread: float | None = None) -> None:
        super().__init__()
        self.shape, self.spread = shape, spread
        stride = max(1, round(max(shape) / FRAME_SIDE))
        self.features = nn.Sequential(
            *_convolution(1, 16, 2 * stride + 3, stride),
            nn.MaxPool2d(2, ceil_mode=True),
            *_convolution(16, 32, 3),
            nn.MaxPool2d(2, ceil_mode=True),
            *_convolution(32, 48, 3),
            *_convolution(48, 48, 3),
            *_convolution(48, 32, 3),
            nn.AdaptiveAvgPool2d(4),
            nn.Flatten(),
        )
        self.classifier = nn.Sequential(nn.Dropout(0.25), nn.Linear(512, 128), nn.ReLU(), nn.Linear(128, n_classes))

    def forward(self, frames: Tensor) -> Tensor:
        """Return scores (n, classes) of frames (n, height * width)."""
        if self.spread is None:
            mean = frames.mean(dim=1, keepdim=True)
            deviation = frames.std(dim=1, keepdim=True, unbiased=False)
            frames = (frames - mean) / deviation.clamp(min=1e-3)  # a frame without photons stays 0
        else:
            frames = frames / self.spread
        scores: Tensor = self.classifier(self.features(frames.reshape(-1, 1, *self.shape)))
        return scores


def _convolution(before: int, after: int, kernel: int, stride: int = 1) -> tuple[nn.Module, ...]:
    layer = nn.Conv2d(before, after, kernel, stride, kernel // 2, bias=False)
    return layer, nn.BatchNorm2d(after), nn.ReLU()


@dataclass(frozen=True, slots=True)
class EpochOfFit:
    """Means over the objects of one epoch, while the network learnt from them."""

    loss: float
    accuracy: float


Watch = Callable[[EpochOfFit, Decide], None]


def feature_net(n_features: int, n_classes: int, n_hidden: int = 512) -> nn.Module:
    """Return the paper's digital back end behind continuous features: batch normalisation, one hidden layer, scores."""
    hidden = nn.Linear(n_features, n_hidden)
    return nn.Sequential(nn.BatchNorm1d(n_features), hidden, nn.ReLU(), nn.Linear(n_hidden, n_classes))


def feature_conv_net(n_features: int, n_classes: int, n_hidden: int = 512) -> nn.Module:
    """Return the back end with two convolutions along the features before its hidden layer, kernel 15 as in the paper's comparison."""
    length = -(-n_features // 4)  # each convolution rounds half the length up
    convolutions = (nn.Conv1d(a, b, CONV_KERNEL, stride=2, padding=CONV_KERNEL // 2) for a, b in CONV_CHANNELS)
    hidden = nn.Linear(CONV_CHANNELS[-1][1] * length, n_hidden)
    layers = [layer for convolution in convolutions for layer in (convolution, nn.ReLU())]
    first = (nn.BatchNorm1d(n_features), nn.Unflatten(1, (1, n_features)))
    return nn.Sequential(*first, *layers, nn.Flatten(), hidden, nn.ReLU(), nn.Linear(n_hidden, n_classes))


def seeded(make: Callable[[], nn.Module], seed: int) -> nn.Module:
    """Return `make()` with its initial values drawn from `seed`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


def fit(
    net: nn.Module,
    inputs: Inputs,
    labels: Tensor,
    *,
    epochs: int,
    seed: int,
    batch: int = 256,
    rates: dict[str, float] | None = None,
    report: Report = silent,
    watch: Callable[[EpochOfFit], None] = lambda _: None,
) -> None:
    """Train `net` on fresh `inputs` of every batch by cross-entropy, Adam and one cycle of the learning rate.

    `rates` gives parameters whose name begins with a key a peak rate of their own; the others have `RATE`. `watch` is called after
    every epoch, with `net` as for use.
    """
    generator = torch.Generator().manual_seed(seed)
    of_rate = _by_rate(net, rates or {})
    peaks = list(of_rate)
    optimiser = torch.optim.Adam([{"params": parameters} for parameters in of_rate.values()])
    n_batches = max(1, len(labels) // batch)
    step, steps = 0, epochs * n_batches
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)  # dropout
        for _ in range(epochs):
            net.train()
            sums = torch.zeros(2)  # of the loss and of right decisions
            order = torch.randperm(len(labels), generator=generator)
            for which in order.tensor_split(n_batches):
                for group, peak in zip(optimiser.param_groups, peaks):
                    group["lr"] = peak * _one_cycle(step / steps)
                scores = net(inputs(which, generator))
                loss = nn.functional.cross_entropy(scores, labels[which])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                right = (scores.argmax(dim=1) == labels[which]).sum()
                sums += torch.stack([loss.detach() * len(which), right])
                step += 1
                if step % 20 == 0 or step == steps:
                    report(f"loss {float(loss.detach()):.3f}", step / steps)
            net.eval()
            watch(EpochOfFit(*(sums / len(labels)).tolist()))


def _by_rate(net: nn.Module, rates: dict[str, float]) -> dict[float, list[nn.Parameter]]:
    of_rate: dict[float, list[nn.Parameter]] = {}
    for name, parameter in net.named_parameters():
        own = [rate for start, rate in rates.items() if name.startswith(start)]
        of_rate.setdefault(own[0] if own else RATE, []).append(parameter)
    return of_rate


def _one_cycle(progress: float) -> float:
    rising = progress < 0.2
    at = progress / 0.2 if rising else (progress - 0.2) / 0.8
    return 0.5 - 0.5 * math.cos(math.pi * at) if rising else 0.5 + 0.5 * math.cos(math.pi * at)


def poisson(photoelectrons: Tensor, detector: str, generator: torch.Generator, dark: float = 0.0) -> Tensor:
    """Return readouts as `common.detect` does, from torch's generator."""
    counts = torch.poisson(photoelectrons + dark, generator=generator)
    return (counts > 0).to(counts.dtype) if detector == "binary" else counts


def shown(measurement: Measurement, photons: float, detector: str | None = None, dark: float = 0.0) -> Inputs:
    """Return what a network sees of training objects: fresh readouts of `detector` every time, or without one their expectation."""

    def inputs(which: Tensor, generator: torch.Generator) -> Tensor:
        light = torch.from_numpy(measurement.photoelectrons(measurement.train[which.numpy()], photons))
        return light if detector is None else poisson(light, detector, generator, dark)

    return inputs


def fitted(
    net: nn.Module,
    measurement: Measurement,
    inputs: Inputs,
    *,
    seed: int,
    epochs: int,
    report: Report,
    watch: Watch = lambda _epoch, _decide: None,
) -> Decide:
    """Train `net` on `inputs` of the training objects and return its decision; `watch` is told it after every epoch."""
    decide, labels = decider(net), torch.from_numpy(measurement.train_labels)
    fit(net, inputs, labels, epochs=epochs, seed=seed, report=report, watch=lambda epoch: watch(epoch, decide))
    return decide


def decider(net: Callable[[Tensor], Tensor]) -> Decide:
    """Return a trained network as a function from readouts (n, m) to labels (n,)."""

    def decide(readouts: F32) -> I64:
        with torch.no_grad():
            parts = [net(part).argmax(dim=1) for part in torch.from_numpy(readouts).split(CHUNK)]
        labels: I64 = torch.cat(parts).numpy().astype(np.int64)
        return labels

    return decide
