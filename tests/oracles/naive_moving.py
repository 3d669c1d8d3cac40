"""Slow oracles for moving scenes: the field drawn as an image at many moments of an exposure, pixel by pixel, in plain numpy."""

import numpy as np


def shifted(image: np.ndarray, right: float, down: int, outside: float) -> np.ndarray:
    """`image` float (height, width) moved by `right` (a fraction mixes two whole shifts) and `down`; what is uncovered shows `outside`."""
    whole = int(np.floor(right))
    mixed = right - whole
    return (1 - mixed) * _moved(image, whole, down, outside) + mixed * _moved(image, whole + 1, down, outside)


def _moved(image: np.ndarray, right: int, down: int, outside: float) -> np.ndarray:
    height, width = image.shape
    field = np.full((height, width), outside)
    for y in range(height):
        for x in range(width):
            if 0 <= y - down < height and 0 <= x - right < width:
                field[y, x] = image[y - down, x - right]
    return field


def mean_light(levels: np.ndarray, field_at, start: float, stop: float, steps: int) -> np.ndarray:  # type: ignore[no-untyped-def]
    """The mean over start..stop of the sum of level times transmission, float (patterns,); `field_at(t)` is the field (height, width)."""
    moments = start + (np.arange(steps) + 0.5) / steps * (stop - start)
    return np.mean([levels @ field_at(moment).ravel() for moment in moments], axis=0)


def tape_field(bits: list[int], place: float, bars: int, pixels_per_bar: int) -> np.ndarray:
    """Transmission (bars * pixels_per_bar,) of box pixels when the window begins `place` bars after the tape's bar 0."""
    field = np.zeros(bars * pixels_per_bar)
    fine = 50
    for u in range(len(field)):
        for k in range(fine):  # the mean over the pixel's box
            bar = int(np.floor(place + (u + (k + 0.5) / fine) / pixels_per_bar))
            field[u] += bits[bar] / fine
    return field
