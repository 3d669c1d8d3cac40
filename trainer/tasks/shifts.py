"""Objects out of place: every training image moved a little, as one that passes by is when its window is not quite the right one.

Owns the random shifts, one per image and the same for the same seed; never touches the held-out objects. What moves out is lost, what
moves in is black.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .registry import Objects

SHIFT_STREAM = 0x5417  # beside the seed, so that no other draw is repeated


def shifted(objects: Objects, along_px: int, across_px: int, seed: int) -> Objects:
    """Return `objects` moved by whole pixels, uniform in -along_px..along_px along the rows and -across_px..across_px across them."""
    if not (along_px or across_px):
        return objects
    random = np.random.default_rng([SHIFT_STREAM, seed])
    along = random.integers(-along_px, along_px + 1, len(objects))
    across = random.integers(-across_px, across_px + 1, len(objects))
    images = np.zeros_like(objects.images)
    for image, source, x, y in zip(images, objects.images, along.tolist(), across.tolist()):
        _move(source, image, x, y)
    return Objects(images, objects.labels)


def _move(source: NDArray[np.uint8], image: NDArray[np.uint8], x: int, y: int) -> None:
    height, width = source.shape
    if abs(x) < width and abs(y) < height:
        image[max(0, y) : height + min(0, y), max(0, x) : width + min(0, x)] = source[
            max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)
        ]
