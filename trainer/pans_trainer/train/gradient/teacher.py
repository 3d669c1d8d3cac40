"""Soft targets: what an ordinary network, which sees every image without noise, thinks of each training object; and their file.

An automaton that is trained on these probabilities learns from every object how alike the classes are (distillation: Hinton, Vinyals and
Dean 2015, arXiv:1503.02531). Objects held back are never shown to the network, test objects neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import npz_bytes, read_arrays, replace_file
from pans_trainer.device import here, product_dtype
from pans_trainer.tasks.changes import SIDE_MIN_PX, distorted
from pans_trainer.tasks.registry import Objects

F32 = NDArray[np.float32]
CHANNELS = (24, 48, 96)  # of the three stages, two convolutions each
SIDE_PX = 28  # larger images are shrunk by the first convolution to about this
BATCH, CHUNK = 250, 1000
RATE, DECAY, DROPOUT = 4e-3, 1e-2, 0.2
DISTORTION = 0.5  # of the sizes in tasks/changes.py
STREAM = 0x7EAC  # with the seed, so that no other draw is repeated
FILE_FIELDS = ("task", "fitted", "epochs", "targets")
FILE_MAX_BYTES = 1 << 28
SUM_TOLERANCE = 1e-3  # float32 rows


@dataclass(frozen=True, slots=True)
class Taught:
    """Which answers are asked for: of the first `fitted` training objects of the data `task` (sha256), after `epochs` of training."""

    task: str
    fitted: int
    epochs: int


def soft_targets(
    objects: Objects, n_classes: int, epochs: int, report: Callable[[int, float], None] = lambda _, __: None
) -> F32:
    """Return the class probabilities of every one of `objects`, float32 (objects, classes), by a network trained on them.

    It is trained on distorted versions that change from epoch to epoch, so that it knows few objects by heart; `report` takes the epoch
    and the mean loss. The same objects give the same answers on one machine and one thread; torch's global generator stays as it was.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(STREAM)
        shape = (int(objects.images.shape[1]), int(objects.images.shape[2]))
        network = _network(shape, n_classes)
        _fit(network, objects, epochs, report)
    return _answers(network, objects.images)


def _network(shape: tuple[int, int], n_classes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    before, stride = 1, max(1, round(max(shape) / SIDE_PX))
    for number, channels in enumerate(CHANNELS):
        if number:
            layers.append(nn.MaxPool2d(2, ceil_mode=True))
        layers += _convolution(before, channels, stride if number == 0 else 1) + _convolution(channels, channels)
        before = channels
    layers += [nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Dropout(DROPOUT), nn.Linear(before, n_classes)]
    return nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def _convolution(before: int, after: int, stride: int = 1) -> list[nn.Module]:
    return [nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]


def _fit(network: nn.Sequential, objects: Objects, epochs: int, report: Callable[[int, float], None]) -> None:
    n, labels = len(objects), here(torch.from_numpy(objects.labels))
    steps = epochs * -(-n // BATCH)
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    rates = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=max(2, steps))
    for epoch in range(epochs):
        # distorted anew in each epoch; images too small for it stay as they are
        small, total = min(objects.images.shape[1:]) < SIDE_MIN_PX, 0.0
        images = objects.images if small else distorted(objects.images, [STREAM, epoch], DISTORTION)
        for which in np.array_split(np.random.default_rng([STREAM, epoch]).permutation(n), -(-n // BATCH)):
            loss = nn.functional.cross_entropy(_scores(network, images[which]), labels[which])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            rates.step()
            total += float(loss.detach()) * len(which)
        report(epoch, total / n)


def _scores(network: nn.Module, images: NDArray[np.uint8]) -> Tensor:
    """Scores of images (n, height, width), in the type of training's products, as float32 (n, classes)."""
    shown = here(torch.from_numpy(images.copy())).float().unsqueeze(1).div_(255.0)
    shown = shown.contiguous(memory_format=torch.channels_last)
    with torch.autocast(shown.device.type, torch.bfloat16, enabled=product_dtype() == torch.bfloat16):
        scores: Tensor = network(shown)
    return scores.float()


@torch.no_grad()
def _answers(network: nn.Module, images: NDArray[np.uint8]) -> F32:
    network.eval()
    parts = [_scores(network, images[first : first + CHUNK]).softmax(dim=1) for first in range(0, len(images), CHUNK)]
    return np.asarray(torch.cat(parts).cpu().numpy(), np.float32)


# ---- the file ----


def write_targets(path: Path, targets: F32, taught: Taught) -> None:
    """Write `targets` to `path` (.npz), whole or not at all."""
    replace_file(path, npz_bytes(**asdict(taught), targets=targets))


def read_targets(path: Path, taught: Taught, n_classes: int) -> F32:
    """Return the targets in `path`, float32 (objects, classes); UsageError if they are of other objects, DamagedFileError if unfit."""
    try:
        arrays = read_arrays(path, FILE_FIELDS, FILE_MAX_BYTES)
        task, fitted, epochs, targets = (arrays[name] for name in FILE_FIELDS)
        found = Taught(str(task), int(fitted), int(epochs))
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedFileError(f"{path}: no soft targets: {error}", remedy="remove it to make them anew") from error
    if found != taught:
        raise UsageError(f"{path} holds {found}, wanted: {taught}", remedy="name another file, and they are made anew")
    shape = (taught.fitted, n_classes)
    fine = targets.shape == shape and targets.dtype == np.float32 and bool(np.isfinite(targets).all())
    if not fine or (targets < 0).any() or (abs(targets.sum(axis=1) - 1.0) > SUM_TOLERANCE).any():
        wanted = f"float32 {shape}, each row probabilities that sum to 1"
        what = f"{path}: targets are {targets.dtype} {targets.shape}, allowed: {wanted}"
        raise DamagedFileError(what, remedy="remove it to make them anew")
    return np.asarray(targets, np.float32)
