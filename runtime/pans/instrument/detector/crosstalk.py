"""Crosstalk: what clicks of neighbouring channels add to the clicks of one exposure.

A channel that clicks by itself (light, dark counts, afterpulses) fires each channel at distance d with the chance c_d, once in an exposure
whatever the number of its detections; a click that crosstalk made fires no other (first generation). Given the own clicks, channels are
independent, so that everything here is exact: the chance of a click, 1 - (1 - p) times the product of 1 - c_d p over the neighbours, and
the chances of whole words. Clicks of one exposure then depend on each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.instrument.profile import Profile

F64 = NDArray[np.float64]
Kernel = tuple[float, ...]  # chances c_1, c_2, ...; empty without crosstalk
_ROUNDS = 60  # of a fixed point whose error falls by the sum of the chances each time


def crosstalk_of(profile: Profile) -> Kernel:
    """Return the chances of crosstalk by distance where all channels are read in the same exposures (parallel mode), else none."""
    detector = profile.detector
    kernel = (detector.crosstalk_probability, *detector.crosstalk_further)
    return kernel if profile.mode == "parallel" and any(kernel) else ()


def spared_by_neighbours(own: F64, kernel: Kernel) -> F64:
    """Return log of the chance that no neighbour fires a channel, (..., channels), from the chances of `own` clicks."""
    found = np.zeros(own.shape)
    for distance, chance in _distances(kernel, own.shape[-1]):
        for to, by in _neighbours(distance):
            found[..., to] += np.log1p(-chance * own[..., by])
    return found


def with_crosstalk(own: F64, kernel: Kernel) -> F64:
    """Return the chances of a click, float64 (..., channels), from `own`, those without crosstalk."""
    return np.asarray(own + (1 - own) * -np.expm1(spared_by_neighbours(own, kernel)))


def without_crosstalk(chances: F64, kernel: Kernel) -> F64:
    """Return the own chances behind `chances` (..., channels): what `with_crosstalk` was given."""
    own = chances
    for _ in range(_ROUNDS if kernel else 0):
        own = np.clip(1 - (1 - chances) / np.exp(spared_by_neighbours(own, kernel)), 0.0, 1.0)
    return np.asarray(own)


def fired(own: NDArray[np.bool_], kernel: Kernel, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw the clicks, bool (..., channels), of exposures whose `own` clicks are known."""
    clicks = own.copy()
    for distance, chance in _distances(kernel, own.shape[-1]):
        for to, by in _neighbours(distance):
            clicks[..., to] |= own[..., by] & (rng.random(own[..., by].shape) < chance)
    return clicks


def seen_from_own(values: F64, n_channels: int, kernel: Kernel) -> F64:
    """Return the mean of `values` (2**n_channels, m), one row for every word of clicks, given each word of own clicks; its shape.

    Bit i of a word is channel i. Channel after channel its click is summed over, so that the work grows as the number of words.
    """
    reach = min(len(kernel), n_channels - 1)
    # axis n - 1 - i is channel i of the word, axis 2 n - 1 - i the same of the own word, of length 1 until it matters
    found = values.reshape(*[2] * n_channels, *[1] * n_channels, -1)
    for channel in range(n_channels):
        spared = np.ones([1] * (2 * n_channels + 1))
        for other in range(max(0, channel - reach), min(n_channels, channel + reach + 1)):
            chance = 1.0 if other == channel else kernel[abs(other - channel) - 1]
            shape = [1] * (2 * n_channels + 1)
            shape[2 * n_channels - 1 - other] = 2
            spared = spared * np.array([1.0, 1.0 - chance]).reshape(shape)
        axis = n_channels - 1 - channel
        silent, clicked = (np.take(found, [bit], axis) for bit in (0, 1))
        found = silent * spared + clicked * (1 - spared)
    return np.ascontiguousarray(
        np.broadcast_to(found, [1] * n_channels + [2] * n_channels + [values.shape[1]])
    ).reshape(values.shape)


def _distances(kernel: Kernel, n_channels: int) -> list[tuple[int, float]]:
    return list(enumerate(kernel[: n_channels - 1], 1))


def _neighbours(distance: int) -> tuple[tuple[slice, slice], ...]:
    """Which channels are fired, and by which, to either side."""
    upper, lower = slice(distance, None), slice(None, -distance)
    return (upper, lower), (lower, upper)
