"""From photoelectrons to clicks: the detector's law, its memory and its random numbers.

Owns the click probability with the effects that the profile declares, and a counter-based generator: the number drawn
for an exposure depends on (seed, exposure, channel) alone, so that blocks, batches and threads change nothing. Never keeps
state: the click of the exposure before is an argument. What is not declared costs nothing.

Sources: thresholded Poisson law and qCMOS threshold in pans.runtime.clicks; afterpulsing 1 - (1 - p)(1 - p_ap * previous);
non-paralysable dead time n / (1 + n tau); the generator mixes counters with the finaliser of Steele, Lea and Flood,
"Fast splittable pseudorandom number generators" (2014).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pans.runtime.instrument.click_law import ClickLaw, click_law, click_probability
from pans.runtime.instrument.profile import Profile

DEAD_TIME_MATTERS = 1e-3  # of the exposure: below it, saturation is lost in a permille of lambda
GOLDEN = 0x9E3779B97F4A7C15
CHANNEL_STEP = 0xD1342543DE82EF95
_MASK = (1 << 64) - 1
KERNEL_EXPOSURES = 256  # from here on the compiled loop pays
CLICK_STREAM, LOWER_CROSSTALK_STREAM, UPPER_CROSSTALK_STREAM = 0, 1, 2


@dataclass(frozen=True, slots=True)
class DetectorModel:
    """What turns lambda into clicks at one exposure time; zeros switch an effect off."""

    law: ClickLaw
    dead_fraction: float = 0.0
    afterpulse_probability: float = 0.0
    crosstalk_probability: float = 0.0


def detector_model(profile: Profile, exposure_us: float) -> DetectorModel:
    """Collect the profile's effects for this exposure: dead time where it matters, crosstalk where there are neighbours."""
    detector = profile.detector
    dead_fraction = detector.dead_time_ns * 1e-3 / exposure_us
    return DetectorModel(
        law=click_law(profile, exposure_us),
        dead_fraction=dead_fraction if dead_fraction > DEAD_TIME_MATTERS else 0.0,
        afterpulse_probability=detector.afterpulse_probability,
        crosstalk_probability=detector.crosstalk_probability if profile.mode == "parallel" else 0.0,
    )


def first_click_probability(model: DetectorModel, photoelectrons: NDArray[np.float64]) -> NDArray[np.float64]:
    """Click probability before memory effects, float64 of the shape of `photoelectrons` (lambda, without dark counts)."""
    if not model.dead_fraction:
        return click_probability(model.law, photoelectrons)
    mean = photoelectrons + model.law.dark_per_exposure
    counted = mean / (1.0 + mean * model.dead_fraction)
    return click_probability(replace(model.law, dark_per_exposure=0.0), counted)


@lru_cache(maxsize=64)
def stream_key(seed: int, stream: int) -> int:
    """Return the 64-bit key of one stream of random numbers."""
    return _mix_int(_mix_int(seed & _MASK) ^ _mix_int(stream + 1))


def uniform_numbers(
    seed: int, first_exposure: int, n_exposures: int, n_channels: int, stream: int = CLICK_STREAM
) -> NDArray[np.float64]:
    """Return float64 (n_exposures, n_channels) in [0, 1) of 53 bits, each a function of (seed, stream, exposure, channel)."""
    key = stream_key(seed, stream)
    exposures = np.arange(n_exposures, dtype=np.uint64) + np.uint64(first_exposure & _MASK)
    state = _mix(exposures * np.uint64(GOLDEN) + np.uint64(key))
    steps = np.arange(1, n_channels + 1, dtype=np.uint64) * np.uint64(CHANNEL_STEP)
    words = _mix(state[:, None] + steps[None, :])
    words >>= np.uint64(11)
    return words.astype(np.float64) * 2.0**-53


def sample_clicks(
    model: DetectorModel,
    probability: NDArray[np.float64],
    seed: int,
    first_exposure: int,
    previous: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Draw clicks, uint8 (n_exposures, n_channels) of 0 or 1; `probability` has the same shape.

    `first_exposure` counts over the detector's whole life. `previous` is uint8 (n_channels,): the clicks of the exposure
    before, which only afterpulsing looks at.
    """
    if model.afterpulse_probability and model.crosstalk_probability and len(probability) >= KERNEL_EXPOSURES:
        return _by_kernel(model, probability, seed, first_exposure, previous)
    numbers = uniform_numbers(seed, first_exposure, *probability.shape)
    primary = numbers < probability
    if not model.afterpulse_probability and not model.crosstalk_probability:
        return primary.view(np.uint8)
    # One number serves both thresholds: below p it clicks anyway, below p' only after a click.
    primed = numbers < 1.0 - (1.0 - probability) * (1.0 - model.afterpulse_probability)
    if not model.crosstalk_probability:
        return _after(primary, primed, previous).view(np.uint8)
    return _after_and_across(model, primary, primed, previous, seed, first_exposure)


def _by_kernel(
    model: DetectorModel,
    probability: NDArray[np.float64],
    seed: int,
    first_exposure: int,
    previous: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Afterpulsing and crosstalk feed each other, so that only a loop over exposures draws them: a compiled one, the same bits."""
    from .detector_kernels import sample_words  # numba is loaded only for profiles that declare both

    n_exposures, n_channels = probability.shape
    words = np.zeros((n_exposures, -(-n_channels // 8)), np.uint8)
    sample_words(model, probability, np.arange(n_exposures), seed, first_exposure, previous.copy(), words)
    return np.unpackbits(words, axis=1, bitorder="little", count=n_channels)


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
    words *= np.uint64(0xBF58476D1CE4E5B9)
    words ^= words >> np.uint64(27)
    words *= np.uint64(0x94D049BB133111EB)
    words ^= words >> np.uint64(31)
    return words


def _mix_int(word: int) -> int:
    word = (word + GOLDEN) & _MASK
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & _MASK
    return word ^ (word >> 31)
