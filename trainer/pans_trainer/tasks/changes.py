"""Changes of training images that leave the class as it is: moves by whole pixels, small distortions, and variations of any size.

`distorted` has the fixed, small sizes for sets of tens of thousands of images; `varied` takes any (`Variation`), for few images.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample, interpolate

from .registry import IMAGES_MAX_BYTES, Objects, Task

DISTORT_STREAM = 0xD157  # with the seed, so that no other draw is repeated
SIDE_MIN_PX = 8
TURN_RAD = math.radians(8.0)  # each uniform between minus and plus that much:
STRETCH = 0.08
SHEAR = 0.08
SHIFT = 0.018  # of the side
DISPLACEMENT = 0.021  # of the side, standard deviation at the knots
KNOTS = 5  # per side, of the random displacement
CHUNK = 2000  # images changed together

Imaged = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
SHIFT_STREAM = 0x5417  # with the seed, so that no other draw is repeated


def with_copies(objects: Objects, kept: int, copies: int, seed: int, imaged: Imaged | None = None) -> Objects:
    """Return `copies` distorted copies of all but the last `kept` objects, then the objects as they are.

    `imaged` says how an image is made of what lies behind it, which is then what is distorted; without it nothing lies behind.
    ValueError for images too small to be distorted, or more than fit.
    """
    if not copies:
        return objects
    source = objects.images if imaged is None else objects.pictures
    _check(source, copies)
    n = len(objects) - kept
    drawn = [distorted(source[:n], [DISTORT_STREAM, seed, number]) for number in range(copies)]
    images = drawn if imaged is None else [imaged(pictures) for pictures in drawn]
    behind = None if imaged is None else np.concatenate([*drawn, source])
    labels = np.concatenate([np.tile(objects.labels[:n], copies), objects.labels])
    return Objects(np.concatenate([*images, objects.images]), labels, behind)


def _check(images: NDArray[np.uint8], copies: int) -> None:
    height, width = images.shape[1:]
    if min(height, width) < SIDE_MIN_PX:
        what = f"images of {height} x {width} pixels cannot be distorted into copies, allowed: {SIDE_MIN_PX} per side and more"
        raise ValueError(what)
    if images.nbytes * (copies + 1) > IMAGES_MAX_BYTES:
        what = f"{copies} copies of {images.nbytes >> 20} MiB of images, allowed: {IMAGES_MAX_BYTES >> 20} MiB in all"
        raise ValueError(what)


def distorted(images: NDArray[np.uint8], seed: list[int], strength: float = 1.0) -> NDArray[np.uint8]:
    """Return every image (n, height, width) distorted in its own way; `strength` scales the sizes, of the displacement its square."""
    random = np.random.default_rng(seed)
    parts = [_distorted(images[first : first + CHUNK], random, strength) for first in range(0, len(images), CHUNK)]
    return np.concatenate(parts)


def _distorted(images: NDArray[np.uint8], random: np.random.Generator, strength: float) -> NDArray[np.uint8]:
    n, height, width = images.shape
    turn, along, across, shear, x, y = (
        torch.from_numpy((strength * random.uniform(-most, most, (n,))).astype(np.float32))
        for most in (TURN_RAD, STRETCH, STRETCH, SHEAR, 2 * SHIFT, 2 * SHIFT)  # the grid runs from -1 to 1
    )
    rows = (1 + along) * turn.cos(), shear - turn.sin(), x, turn.sin(), (1 + across) * turn.cos(), y
    return _seen(images, rows, strength**2 * displacements(random, n, (height, width), DISPLACEMENT))


def _seen(images: NDArray[np.uint8], rows: tuple[Tensor, ...], bent: Tensor | None) -> NDArray[np.uint8]:
    """The images on an affine grid, its six numbers (n,) each, with displacements added."""
    n, height, width = images.shape
    grid = affine_grid(torch.stack(rows, dim=1).unflatten(1, (2, 3)), [n, 1, height, width], align_corners=False)
    shown = torch.from_numpy(images.astype(np.float32)).unsqueeze(1)
    grid = grid if bent is None else grid + bent
    moved = grid_sample(shown, grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]
    return moved.round().clamp(0, 255).to(torch.uint8).numpy()


def displacements(random: np.random.Generator, n: int, shape: tuple[int, int], size: float) -> Tensor:
    """Return smooth random displacements for a sampling grid that runs from -1 to 1, (n, height, width, 2); `size` of the side."""
    knots = torch.from_numpy(random.standard_normal((n, 2, KNOTS, KNOTS), dtype=np.float32)) * (2 * size)
    return interpolate(knots, size=shape, mode="bicubic", align_corners=True).permute(0, 2, 3, 1)


def shifted(objects: Objects, along_px: int, across_px: int, seed: int) -> Objects:
    """Return `objects` moved by whole pixels, uniform in -along_px..along_px along the rows and -across_px..across_px across them."""
    if not (along_px or across_px):
        return objects
    random = np.random.default_rng([SHIFT_STREAM, seed])
    along = random.integers(-along_px, along_px + 1, len(objects))
    across = random.integers(-across_px, across_px + 1, len(objects))
    n, height, width = objects.images.shape
    y, x = np.arange(height) - across[:, None], np.arange(width) - along[:, None]  # where a pixel was before
    inside = ((y >= 0) & (y < height))[:, :, None] & ((x >= 0) & (x < width))[:, None, :]
    which, y, x = np.arange(n)[:, None, None], y.clip(0, height - 1)[:, :, None], x.clip(0, width - 1)[:, None, :]
    return Objects(objects.images[which, y, x] * inside, objects.labels)


@dataclass(frozen=True, slots=True)
class Variation:
    """Sizes of change, each drawn uniformly between minus and plus that much, anew for every image; 0 or False: none of that kind."""

    turn_deg: float = 0.0
    shift: float = 0.0  # of the side, along and across
    size: float = 0.0  # of the logarithm of the magnification
    stretch: float = 0.0  # of the logarithm of width over height
    bend: float = 0.0  # of the side: standard deviation of a smooth random displacement
    mirror_x: bool = False  # left and right exchanged in half of the images
    mirror_y: bool = False  # and top and bottom

    def __str__(self) -> str:
        words = {
            "turn_deg": f"turned by up to {self.turn_deg:g} degrees",
            "shift": f"moved by up to {100 * self.shift:g} % of the side",
            "size": f"resized by up to {100 * self.size:g} %",
            "stretch": f"stretched by up to {100 * self.stretch:g} %",
            "bend": f"bent by about {100 * self.bend:g} % of the side",
            "mirror_x": "mirrored left to right",
            "mirror_y": "mirrored top to bottom",
        }
        return ", ".join(words[name] for name in (field.name for field in fields(self)) if getattr(self, name))


def varied(images: NDArray[np.uint8], variation: Variation, seed: list[int]) -> NDArray[np.uint8]:
    """Return every image (n, height, width) changed in its own way; the same for the same seed."""
    random = np.random.default_rng(seed)
    parts = [_varied(images[first : first + CHUNK], variation, random) for first in range(0, len(images), CHUNK)]
    return np.concatenate(parts)


def _varied(images: NDArray[np.uint8], how: Variation, random: np.random.Generator) -> NDArray[np.uint8]:
    n, height, width = images.shape

    def drawn(most: float) -> Tensor:
        return torch.from_numpy(random.uniform(-most, most, (n,)).astype(np.float32))

    turn, size, stretch = drawn(math.radians(how.turn_deg)), drawn(how.size), drawn(how.stretch) / 2
    move_x, move_y = drawn(2 * how.shift), drawn(2 * how.shift)  # the grid runs from -1 to 1
    mirrors = [torch.sign(drawn(1.0)) if on else torch.ones(n) for on in (how.mirror_x, how.mirror_y)]
    along, across = (mirror * torch.exp(size + more) for mirror, more in zip(mirrors, (stretch, -stretch)))
    tall = height / width  # a turn is one of pixels, not of the grid
    first = along * turn.cos(), -along * tall * turn.sin(), move_x
    second = across * turn.sin() / tall, across * turn.cos(), move_y
    return _seen(images, (*first, *second), displacements(random, n, (height, width), how.bend) if how.bend else None)


def enlarged(task: Task, variation: Variation, wanted: int, kept: int, seed: int, *, equal: bool = False) -> Task:
    """Return `task` with changed copies of all but its last `kept` training objects before the objects as they are.

    About `wanted` training objects in all, as far as they fit into memory; with `equal` as many of every class, for which those
    kept are repeated too. The held-out objects are the same, and `sha256` is another, so that a checkpoint tells both apart. A task of
    pictures, or one whose images come from something behind them, is returned as it is.
    """
    images, labels = task.train.images, task.train.labels
    if task.target == "image" or task.train.behind is not None or (variation == Variation() and not equal):
        return task
    n, most = len(labels) - kept, IMAGES_MAX_BYTES // max(1, images[0].nbytes)
    counts = np.bincount(labels[:n], minlength=len(task.classes))
    totals = (
        np.full(len(counts), max(min(wanted, most) // len(counts), counts.max())) if equal else counts * wanted // n
    )
    if variation == Variation():
        totals = np.full(len(counts), counts.max())
    copied = _repeated(labels[:n], np.minimum(totals, most // len(counts)) - counts)
    if not (len(copied) or equal):
        return task
    drawn = varied(images[copied], variation, [seed]) if len(copied) else images[:0]
    back = np.bincount(labels[n:], minlength=len(counts))
    again = n + _repeated(labels[n:], back.max() - back) if equal else copied[:0]
    which = np.concatenate([np.arange(len(labels)), again])
    train = Objects(np.concatenate([drawn, images[which]]), np.concatenate([labels[copied], labels[which]]))
    named = f"{task.sha256} {wanted} {kept} {seed} {variation!r} {equal}"
    return replace(task, train=train, kept=kept + len(again), sha256=hashlib.sha256(named.encode()).hexdigest())


def _repeated(labels: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places of `labels`, `wanted` (classes,) of each class, all of them in turn; none of a class that is not there."""
    members = (np.flatnonzero(labels == label) for label in range(len(wanted)))
    return np.concatenate([np.resize(one, max(0, int(n)) if len(one) else 0) for one, n in zip(members, wanted)])
