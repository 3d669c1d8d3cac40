"""Networks of the baselines, their one training loop, and the fixed patterns behind which they decide. SIMULATED, ideal shot noise.

- direct imaging, `cnn`: an AlexNet-style network trained on noisy frames of the very photon level, strong at many photons; `clean-cnn`: the
  same trained on noiseless frames (the paper's baseline).
- compressive sensing, `mlp`: patterns that know nothing of the task, the paper's back end on noisy readouts of the very level, without
  reconstruction; `clean-mlp`: the same trained on noiseless features (the paper's baseline).
- hadamard: pairs of 12 x 12 Hadamard patterns and a network on the differences of their counts, after Kanwal et al., arXiv 2603.12036.
  Assumed here, as only the abstract and summaries were at hand: every pattern is followed by its inverse (330 000 patterns/s for 1200
  digits/s leave 275 per digit, about two for each of 144), patterns come from the coarsest on, H12 is Paley's.

- direct imaging, `stopping`: one network for frames of every exposure. It sees the counts of a frame, and as the last of (n, pixels + 1)
  readouts its exposure in photons of the mean test object.

Everything random comes from `seed`; the global generator of torch is left as it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import pans_trainer.device  # noqa: F401  # before a convolution: it sets what torch needs on this processor
from pans_trainer.tasks.changes import SIDE_MIN_PX, distorted

from .common import F32, F64, I64, Decide, Measurement, Report, named, silent

CHUNK = 1000  # readouts per pass where no gradient is needed
FRAME_SIDE = 28  # pixels; larger frames are reduced to about this by the first layer's stride
RATE = 2e-3
CONV_KERNEL, CONV_CHANNELS = 15, ((1, 32), (32, 64))  # of the convolutional back end: before and after each layer

Net = TypeVar("Net", bound=nn.Module)
Inputs = Callable[[Tensor, torch.Generator], Tensor]  # (which objects, random numbers) -> what the network sees
FAMILIES = ("binary", "hadamard", "gaussian", "binning")
EPOCHS = {"cnn": 5, "clean-cnn": 5, "mlp": 10, "clean-mlp": 10, "differences": 10, "counts": 10}
WORDS = {"cnn": "noise-aware CNN", "mlp": "noise-aware MLP"} | dict.fromkeys(
    ("differences", "counts"), "Hadamard pairs"
)

SHORTEST, LONGEST = 3.0, 600.0  # exposures of the network of all exposures, uniform in the logarithm
# of that network: 12 minutes of one core; 30 are 0.2 to 0.9 points worse on images held back
EPOCHS_OF_TASK = {"fashion-mnist": 60}
OTHER_EPOCHS = 12
STRENGTHS = {"mnist": 1.0}  # of the distortions of its training images
OTHER_STRENGTH = 0.3
PEAK_RATE = 4e-3
CHANNELS = (20, 32, 48)
DISTORT_STREAM = 0xE590
FIELDS = 12  # along each side


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
            *convolution(1, 16, 2 * stride + 3, stride),
            nn.MaxPool2d(2, ceil_mode=True),
            *convolution(16, 32, 3),
            nn.MaxPool2d(2, ceil_mode=True),
            *convolution(32, 48, 3),
            *convolution(48, 48, 3),
            *convolution(48, 32, 3),
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


def convolution(before: int, after: int, kernel: int, stride: int = 1) -> tuple[nn.Module, ...]:
    """Return a convolution that keeps the size but for its stride, batch normalisation and ReLU."""
    layer = nn.Conv2d(before, after, kernel, stride, kernel // 2, bias=False)
    return layer, nn.BatchNorm2d(after), nn.ReLU()


# loss and accuracy, means over an epoch while it learnt, and the network now
Watch = Callable[[float, float, Decide], None]


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


def seeded(make: Callable[[], Net], seed: int) -> Net:
    """Return `make()` with its initial values drawn from `seed`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


def fit(
    net: nn.Module,
    inputs: Inputs,
    labels: I64,
    *,
    epochs: int,
    seed: int,
    batch: int = 256,
    rates: dict[str, float] | None = None,
    report: Report = silent,
    watch: Watch = lambda _loss, _accuracy, _decide: None,
) -> None:
    """Train `net` on fresh `inputs` of every batch by cross-entropy, Adam and one cycle of the learning rate.

    `rates` gives parameters whose name begins with a key a peak rate of their own; the others have `RATE`. `watch` is called after
    every epoch, with `net` as for use.
    """
    generator, wanted = torch.Generator().manual_seed(seed), torch.from_numpy(labels)
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
                loss = nn.functional.cross_entropy(scores, wanted[which])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                right = (scores.argmax(dim=1) == wanted[which]).sum()
                sums += torch.stack([loss.detach() * len(which), right])
                step += 1
                if step % 20 == 0 or step == steps:
                    report(f"loss {float(loss.detach()):.3f}", step / steps)
            net.eval()
            loss_mean, accuracy = (sums / len(labels)).tolist()
            watch(loss_mean, accuracy, decider(net))


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
    watch: Watch = lambda _loss, _accuracy, _decide: None,
) -> Decide:
    """Train `net` on `inputs` of the training objects and return its decision; `watch` gets it after every epoch."""
    fit(net, inputs, measurement.train_labels, epochs=epochs, seed=seed, report=report, watch=watch)
    return decider(net)


def decider(net: Callable[[Tensor], Tensor]) -> Decide:
    """Return a trained network as a function from readouts (n, m) to scores (n, classes)."""

    def decide(readouts: F32) -> F32:
        with torch.no_grad():
            scores: F32 = torch.cat([net(part) for part in torch.from_numpy(readouts).split(CHUNK)]).numpy()
        return scores

    return decide


def patterns(family: str, n_features: int, shape: tuple[int, int], seed: int) -> F64:
    """Return fixed patterns, 0 or more, float64 (d_f, pixels).

    `binary`: every pixel by a fair coin. `hadamard`: two-dimensional Walsh functions, coarsest first, -1 shown as dark; the
    first one is light everywhere. Sides that are no power of two are cut from the next larger pattern. `gaussian`: the absolute
    values of normal numbers, as light has no sign. `binning`: each pattern lights one block of a grid of d_f blocks, as square as d_f
    has divisors; blocks differ by a pixel where the sides cannot be divided.
    """
    height, width = shape
    if family == "binary":
        return np.random.default_rng([seed, 3]).integers(0, 2, (n_features, height * width)).astype(np.float64)
    if family == "gaussian":
        return np.abs(np.random.default_rng([seed, 5]).standard_normal((n_features, height * width)))
    if family == "binning":
        return _bins(n_features, shape)
    if family != "hadamard":
        raise ValueError(f"patterns are {family!r}, allowed: {', '.join(FAMILIES)}")
    return _products(walsh(height), walsh(width), np.arange(height), np.arange(width), n_features)


def _products(of_rows: F64, of_columns: F64, down: I64, across: I64, count: int) -> F64:
    """The coarsest products of two sets of signs as patterns, -1 dark; pixels take the signs at the places `down` and `across`."""
    changes = [(np.diff(signs, axis=1) != 0).sum(axis=1) for signs in (of_rows, of_columns)]
    every = ((u, v) for u in range(len(of_rows)) for v in range(len(of_columns)))
    order = sorted(every, key=lambda uv: (changes[0][uv[0]] + changes[1][uv[1]], uv))
    if count > len(order):
        raise ValueError(f"features is {count}, allowed on {len(down)} x {len(across)} pixels: {len(order)}")
    signs = [np.outer(of_rows[u, down], of_columns[v, across]).ravel() for u, v in order[:count]]
    return np.array(signs) / 2 + 0.5


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


def aware_net(
    method: str,
    measurement: Measurement,
    photons: float,
    detector: str,
    *,
    seed: int,
    dark: float = 0.0,
    epochs: int | None = None,
    report: Report = silent,
) -> Decide:
    """Return the network of `method` (cnn, mlp, differences, counts), trained on fresh readouts at this photon level."""
    n, n_classes = measurement.train.shape[1], measurement.n_classes
    if method == "cnn":
        light = measurement.photoelectrons(measurement.train[:: max(1, len(measurement.train) // 1000)], photons) + dark
        square = light + light**2 if detector == "counting" else -np.expm1(-light)
        net = _frame_net(measurement, seed, math.sqrt(float(square.mean())))
    elif method == "differences":
        net = seeded(lambda: Differences(n // 2, n_classes), seed)
    else:
        net = seeded(lambda: feature_net(n, n_classes), seed)
    progress = named(f"{WORDS[method]} at {photons:g} photons", report)
    inputs = shown(measurement, photons, detector, dark)
    return fitted(net, measurement, inputs, seed=seed, epochs=epochs or EPOCHS[method], report=progress)


def clean_cnn(measurement: Measurement, *, seed: int, epochs: int | None = None, report: Report = silent) -> Decide:
    """Return the frame network trained on noiseless frames; one network serves all photon levels."""
    net, progress = _frame_net(measurement, seed, None), named("CNN on clean frames", report)
    epochs = epochs or EPOCHS["clean-cnn"]
    return fitted(net, measurement, shown(measurement, 1e6), seed=seed, epochs=epochs, report=progress)


def _frame_net(measurement: Measurement, seed: int, spread: float | None) -> nn.Module:
    shape = measurement.image_shape
    assert shape is not None, "direct imaging measures frames"
    return seeded(lambda: FrameNet(shape, measurement.n_classes, spread), seed)


def clean_mlp(
    measurement: Measurement,
    *,
    seed: int,
    epochs: int = EPOCHS["clean-mlp"],
    convolutions: bool = False,
    report: Report = silent,
    watch: Watch = lambda _loss, _accuracy, _decide: None,
) -> Callable[[float, str], Decide]:
    """Return (photons, detector) -> decision, by one feature network that was trained on noiseless features.

    With `convolutions` there are two along the patterns before its hidden layer.

    Counts are divided by the exposure, clicks by their mean over that of the clean features: the network then sees features
    of the size that it knows. `watch` is called after every epoch, with what the network decides then on noiseless features.
    """
    progress, inputs = named("network on clean features", report), shown(measurement, 1.0)
    made, n = feature_conv_net if convolutions else feature_net, measurement.train.shape[1]
    net = seeded(lambda: made(n, measurement.n_classes), seed)
    decide = fitted(net, measurement, inputs, seed=seed, epochs=epochs, report=progress, watch=watch)
    return lambda photons, detector: lambda readouts: decide(readouts / size(measurement, photons, detector))


def size(measurement: Measurement, photons: float, detector: str) -> np.float32:
    """Return the mean readout at `photons`, relative to the mean feature at one photon per object (training objects)."""
    light = measurement.photoelectrons(measurement.train, 1.0)
    if detector == "counting":
        return np.float32(photons)
    return np.float32(-np.expm1(-light * np.float32(photons)).mean(dtype=np.float64) / light.mean(dtype=np.float64))


def hadamard_12() -> F64:
    """Return Paley's Hadamard matrix of order 12 (-1 and 1), rows by their number of sign changes, the constant one first."""
    squares = {k * k % 11 for k in range(1, 11)}
    character = [0] + [1 if k in squares else -1 for k in range(1, 11)]
    skew = np.zeros((12, 12))
    skew[0, 1:], skew[1:, 0] = 1, -1
    for i in range(11):
        for j in range(11):
            skew[i + 1, j + 1] = character[(j - i) % 11]
    matrix = skew + np.eye(12)
    matrix = matrix * matrix[0]  # the first row all 1
    changes = (np.diff(matrix, axis=1) != 0).sum(axis=1)
    return matrix[np.argsort(changes, kind="stable")]


def pairs(n_pairs: int, shape: tuple[int, int]) -> F64:
    """Return patterns of 0 and 1, float64 (2 x n_pairs, pixels): the coarsest Hadamard patterns, and then their inverses.

    A field covers the pixels whose row and column, times 12 / side and rounded down, are its own.
    """
    signs, (down, across) = hadamard_12(), (np.arange(side) * FIELDS // side for side in shape)
    positive = _products(signs, signs, down, across, n_pairs)
    return np.concatenate([positive, 1 - positive])


class Differences(nn.Module):
    """The feature network behind the differences of pairs: counts (n, 2 x pairs) -> scores."""

    def __init__(self, n_pairs: int, n_classes: int) -> None:
        super().__init__()
        self.n_pairs = n_pairs
        self.head = feature_net(n_pairs, n_classes)

    def forward(self, counts: Tensor) -> Tensor:
        """Return scores (n, classes)."""
        scores: Tensor = self.head(counts[:, : self.n_pairs] - counts[:, self.n_pairs :])
        return scores


# ---- frames of every exposure ----


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
        epochs=epochs or EPOCHS_OF_TASK.get(name, OTHER_EPOCHS),
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
