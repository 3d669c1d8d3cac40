"""Changes of an image that leave its class as it is: turns, sizes, shifts, bends and mirrors, for trainings on few images.

Owns the kinds of change and how images are changed by them; which of them suit a task is chosen in the package choose. What comes in from
outside repeats the edge. The sizes of distort.py are fixed and small, for sets of tens of thousands of images; these are any.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from .distort import displacements
from .registry import IMAGES_MAX_BYTES, Objects, Task

CHUNK = 2000  # images changed together


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
    rows = (
        along * turn.cos(),
        -along * tall * turn.sin(),
        move_x,
        across * turn.sin() / tall,
        across * turn.cos(),
        move_y,
    )
    grid = affine_grid(torch.stack(rows, dim=1).unflatten(1, (2, 3)), [n, 1, height, width], align_corners=False)
    if how.bend:
        grid = grid + displacements(random, n, (height, width), how.bend)
    shown = torch.from_numpy(images.astype(np.float32)).unsqueeze(1)
    moved = grid_sample(shown, grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]
    return moved.round().clamp(0, 255).to(torch.uint8).numpy()


def enlarged(task: Task, variation: Variation, wanted: int, kept: int, seed: int) -> Task:
    """Return `task` with changed copies of all but its last `kept` training objects before the objects as they are.

    About `wanted` training objects in all, as far as they fit into memory; the held-out objects are the same, and `sha256` is another, so
    that a checkpoint tells both apart. A task of pictures, or one
    whose images come from something behind them, is returned as it is.
    """
    images, labels = task.train.images, task.train.labels
    n = len(labels) - kept
    wanted = min(wanted, IMAGES_MAX_BYTES // max(1, images[0].nbytes))
    copies = max(0, round(wanted / n) - 1)
    if variation == Variation() or not copies or task.target == "image" or task.train.behind is not None:
        return task
    drawn = [varied(images[:n], variation, [seed, number]) for number in range(copies)]
    train = Objects(np.concatenate([*drawn, images]), np.concatenate([np.tile(labels[:n], copies), labels]))
    named = f"{task.sha256} {wanted} {kept} {seed} {variation!r}"
    return replace(task, train=train, kept=kept, sha256=hashlib.sha256(named.encode()).hexdigest())
