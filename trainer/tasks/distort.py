"""More training objects than there are: distorted copies of each, against learning the training images by heart.

Owns the distortions: small turns, stretches, shears and shifts of the whole image, and a smooth random displacement of its parts, all
drawn anew per copy and the same for the same seed. Never touches the objects that choose among restarts, nor held-out ones. What comes
in from outside repeats the edge.

(LeCun, Bottou, Bengio and Haffner 1998, and Simard, Steinkraus and Platt 2003, trained on distorted digits; sizes here are ours.)
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample, interpolate

from .registry import IMAGES_MAX_BYTES, Objects

DISTORT_STREAM = 0xD157  # beside the seed, so that no other draw is repeated
SIDE_MIN_PX = 8
TURN_RAD = math.radians(8.0)  # each uniform between minus and plus that much:
STRETCH = 0.08
SHEAR = 0.08
SHIFT = 0.018  # of the side
DISPLACEMENT = 0.021  # of the side, standard deviation at the knots
KNOTS = 5  # per side, of the random displacement
CHUNK = 2000

Imaged = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]


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
        raise ValueError(
            f"images of {height} x {width} pixels cannot be distorted into copies, allowed: {SIDE_MIN_PX} per side and more"
        )
    if images.nbytes * (copies + 1) > IMAGES_MAX_BYTES:
        raise ValueError(
            f"{copies} copies of {images.nbytes >> 20} MiB of images, allowed: {IMAGES_MAX_BYTES >> 20} MiB in all"
        )


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
    grid = affine_grid(torch.stack(rows, dim=1).unflatten(1, (2, 3)), [n, 1, height, width], align_corners=False)
    grid = grid + strength**2 * displacements(random, n, (height, width), DISPLACEMENT)
    shown = torch.from_numpy(images.astype(np.float32)).unsqueeze(1)
    moved = grid_sample(shown, grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]
    return moved.round().clamp(0, 255).to(torch.uint8).numpy()


def displacements(random: np.random.Generator, n: int, shape: tuple[int, int], size: float) -> Tensor:
    """Return smooth random displacements for a sampling grid that runs from -1 to 1, (n, height, width, 2); `size` of the side."""
    knots = torch.from_numpy(random.standard_normal((n, 2, KNOTS, KNOTS), dtype=np.float32)) * (2 * size)
    return interpolate(knots, size=shape, mode="bicubic", align_corners=True).permute(0, 2, 3, 1)
