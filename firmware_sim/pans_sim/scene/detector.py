"""From click probabilities to clicks: the detector's memory and its random numbers, in numpy.

The number drawn for an exposure depends on (seed, exposure, channel) alone, so that blocks, batches and threads change nothing; the click
of the exposure before is an argument. The compiled twin is detector_kernels.py.

Sources: afterpulsing 1 - (1 - p)(1 - p_ap * previous); the generator mixes counters with the finaliser of Steele, Lea and Flood,
"Fast splittable pseudorandom number generators" (2014).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .detector_model import (
    CHANNEL_STEP,
    CLICK_STREAM,
    GOLDEN,
    LOWER_CROSSTALK_STREAM,
    MASK,
    MIX_1,
    MIX_2,
    UPPER_CROSSTALK_STREAM,
    DetectorModel,
    mix_int,
    stream_key,
)

KERNEL_EXPOSURES = 256  # from here on the compiled loop pays
FEW = 8  # numbers, of which each takes Python less time than numpy takes to begin


def uniform_numbers(
    seed: int, first_exposure: int, n_exposures: int, n_channels: int, stream: int = CLICK_STREAM
) -> NDArray[np.float64]:
    """Return float64 (n_exposures, n_channels) in [0, 1) of 53 bits, each a function of (seed, stream, exposure, channel)."""
    key = stream_key(seed, stream)
    if n_exposures * n_channels <= FEW:
        rows = range(first_exposure, first_exposure + n_exposures)
        return np.array([_row(key, exposure, n_channels) for exposure in rows]).reshape(n_exposures, n_channels)
    exposures = np.arange(n_exposures, dtype=np.uint64) + np.uint64(first_exposure & MASK)
    state = _mix(exposures * np.uint64(GOLDEN) + np.uint64(key))
    steps = np.arange(1, n_channels + 1, dtype=np.uint64) * np.uint64(CHANNEL_STEP)
    words = _mix(state[:, None] + steps[None, :])
    words >>= np.uint64(11)
    return words.astype(np.float64) * 2.0**-53


def _row(key: int, exposure: int, n_channels: int) -> list[float]:
    """The numbers of one exposure."""
    state = mix_int((exposure - 1) * GOLDEN + key)
    return [(mix_int(state + n * CHANNEL_STEP - GOLDEN) >> 11) * 2.0**-53 for n in range(1, n_channels + 1)]


def sample_clicks(
    model: DetectorModel,
    probability: NDArray[np.float64],
    seed: int,
    first_exposure: int,
    previous: NDArray[np.uint8],
    memory: NDArray[np.float64] | None = None,
) -> NDArray[np.uint8]:
    """Draw clicks, uint8 (n_exposures, n_channels) of 0 or 1; `probability` has the same shape.

    `first_exposure` counts over the detector's whole life. `previous` is uint8 (n_channels,): the clicks of the exposure
    before, which only afterpulsing looks at. Where the model remembers more, `memory` float64 (n_channels,) takes its place: the carriers
    in traps before the first exposure, which become those after the last one.
    """
    if model.remembers:
        from .detector_kernels import remembered_words

        n_exposures, n_channels = probability.shape
        words = np.zeros((n_exposures, -(-n_channels // 8)), np.uint8)
        traps = np.zeros(n_channels) if memory is None else memory
        remembered_words(model, probability, np.arange(n_exposures), seed, first_exposure, traps, words)
        return np.unpackbits(words, axis=1, bitorder="little", count=n_channels)
    if model.afterpulse_probability and model.crosstalk_probability and len(probability) >= KERNEL_EXPOSURES:
        # The two effects feed each other: only a loop over exposures draws them, here a compiled one with the same bits.
        from .detector_kernels import sample_words  # numba is loaded only for profiles that declare both

        n_exposures, n_channels = probability.shape
        words = np.zeros((n_exposures, -(-n_channels // 8)), np.uint8)
        sample_words(model, probability, np.arange(n_exposures), seed, first_exposure, previous.copy(), words)
        return np.unpackbits(words, axis=1, bitorder="little", count=n_channels)
    numbers = uniform_numbers(seed, first_exposure, *probability.shape)
    primary = numbers < probability
    if not model.afterpulse_probability and not model.crosstalk_probability:
        return primary.view(np.uint8)
    # One number serves both thresholds: below p it clicks anyway, below p' only after a click.
    primed = numbers < 1.0 - (1.0 - probability) * (1.0 - model.afterpulse_probability)
    if not model.crosstalk_probability:
        return _after(primary, primed, previous).view(np.uint8)
    return _after_and_across(model, primary, primed, previous, seed, first_exposure)


def _after(primary: NDArray[np.bool_], primed: NDArray[np.bool_], previous: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Solve click[t] = primary[t] or (primed[t] and click[t-1]) without a loop over t.

    A click stands at t when the latest primary click came no earlier than the latest exposure that was not primed.
    """
    n_exposures = len(primary)
    index = np.arange(1, n_exposures + 1)[:, None]
    latest_primary = np.maximum.accumulate(np.where(primary, index, 0), axis=0)
    latest_break = np.maximum.accumulate(np.where(primed, 0, index), axis=0)
    carried = (latest_primary > 0) | (previous[None, :] > 0)
    return carried & (latest_primary >= latest_break)


def _after_and_across(
    model: DetectorModel,
    primary: NDArray[np.bool_],
    primed: NDArray[np.bool_],
    previous: NDArray[np.uint8],
    seed: int,
    first_exposure: int,
) -> NDArray[np.uint8]:
    """Add first-generation crosstalk: a click fires each neighbour with p_ct; every click primes an afterpulse."""
    n_exposures, n_channels = primary.shape
    p_ct = model.crosstalk_probability
    from_below = uniform_numbers(seed, first_exposure, n_exposures, n_channels, LOWER_CROSSTALK_STREAM) < p_ct
    from_above = uniform_numbers(seed, first_exposure, n_exposures, n_channels, UPPER_CROSSTALK_STREAM) < p_ct
    if not model.afterpulse_probability:
        return _across(primary, from_below, from_above).view(np.uint8)
    clicks = np.empty_like(primary)
    last = previous > 0
    for t in range(n_exposures):  # the two effects feed each other: no closed form
        own = primary[t] | (primed[t] & last)
        clicks[t] = last = _across(own, from_below[t], from_above[t])
    return clicks.view(np.uint8)


def _across(own: NDArray[np.bool_], from_below: NDArray[np.bool_], from_above: NDArray[np.bool_]) -> NDArray[np.bool_]:
    clicks = own.copy()
    clicks[..., 1:] |= own[..., :-1] & from_below[..., 1:]
    clicks[..., :-1] |= own[..., 1:] & from_above[..., :-1]
    return clicks


def _mix(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The splitmix64 finaliser, in place."""
    words ^= words >> np.uint64(30)
    words *= np.uint64(MIX_1)
    words ^= words >> np.uint64(27)
    words *= np.uint64(MIX_2)
    words ^= words >> np.uint64(31)
    return words
