"""The compiled kernels of the simulated detector: many clicks, packed as a parallel instrument sends them.

Every bit is the one that `detector.sample_clicks` draws. What the profile does not declare is in no loop: dead time, read noise and dark
counts are in the probability already, afterpulsing looks one exposure back, crosstalk draws two more numbers for neighbours of a click.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import njit
from pans.instrument.click_law import ClickLaw

from .detector_model import (
    CHANNEL_STEP,
    CLICK_STREAM,
    FURTHER_STREAM,
    GOLDEN,
    LOWER_CROSSTALK_STREAM,
    MIX_1,
    MIX_2,
    TRAP_STREAM,
    UPPER_CROSSTALK_STREAM,
    DetectorModel,
    stream_key,
)

_U = np.uint64
GOLDEN_WORD, STEP_WORD = _U(GOLDEN), _U(CHANNEL_STEP)
_M1, _M2 = _U(MIX_1), _U(MIX_2)
SHIFT_11, _S27, _S30, _S31 = _U(11), _U(27), _U(30), _U(31)


@njit(cache=True, nogil=True)
def mix(word):  # type: ignore[no-untyped-def]
    word = (word ^ (word >> _S30)) * _M1
    word = (word ^ (word >> _S27)) * _M2
    return word ^ (word >> _S31)


@njit(cache=True, nogil=True)
def plain_words(thresholds, row_of, key, first, words):  # type: ignore[no-untyped-def]
    """Draw clicks without memory: thresholds uint64 (rows, channels), row_of int64 (n,), words uint8 (n, bytes), bit c is channel c."""
    n_channels = thresholds.shape[1]
    for t in range(row_of.size):
        row = row_of[t]
        state = mix(_U(t + first) * GOLDEN_WORD + key)
        step = _U(0)
        for p in range(words.shape[1]):
            byte = _U(0)
            for c in range(8 * p, min(8 * p + 8, n_channels)):
                step += STEP_WORD
                byte |= _U((mix(state + step) >> SHIFT_11) < thresholds[row, c]) << _U(c & 7)
            words[t, p] = byte


@njit(cache=True, nogil=True)
def memory_words(thresholds, primed, row_of, keys, first, crosstalk, previous, words):  # type: ignore[no-untyped-def]
    """As `plain_words`, with afterpulsing (primed uint64 (rows, channels): thresholds after a click) and crosstalk (a threshold; 0: none).

    keys uint64 (3,) of the three streams; previous uint8 (2, channels): row 0 is the exposure before, and afterwards the last one.
    """
    n_channels = thresholds.shape[1]
    for t in range(row_of.size):
        row, exposure = row_of[t], _U(t + first)
        state = mix(exposure * GOLDEN_WORD + keys[0])
        step = _U(0)
        for c in range(n_channels):
            step += STEP_WORD
            threshold = primed[row, c] if previous[0, c] else thresholds[row, c]
            previous[1, c] = (mix(state + step) >> SHIFT_11) < threshold
        for c in range(n_channels):
            previous[0, c] = previous[1, c]
        if crosstalk:
            below, above = mix(exposure * GOLDEN_WORD + keys[1]), mix(exposure * GOLDEN_WORD + keys[2])
            for c in range(n_channels):
                if previous[1, c]:
                    if c + 1 < n_channels and (mix(below + _U(c + 2) * STEP_WORD) >> SHIFT_11) < crosstalk:
                        previous[0, c + 1] = 1
                    if c > 0 and (mix(above + _U(c) * STEP_WORD) >> SHIFT_11) < crosstalk:
                        previous[0, c - 1] = 1
        for p in range(words.shape[1]):
            byte = 0
            for c in range(8 * p, min(8 * p + 8, n_channels)):
                byte |= previous[0, c] << (c & 7)
            words[t, p] = byte


@njit(cache=True, nogil=True)
def register_words(thresholds, primed, row_of, keys, first, crosstalk, previous, words):  # type: ignore[no-untyped-def]
    """As `memory_words`, for at most 64 channels: the clicks of an exposure stand in one register, and no click costs next to nothing."""
    n_channels = thresholds.shape[1]
    last = _U(0)
    for c in range(n_channels):
        last |= _U(previous[0, c]) << _U(c)
    for t in range(row_of.size):
        row, exposure = row_of[t], _U(t + first)
        state = mix(exposure * GOLDEN_WORD + keys[0])
        own, step = _U(0), _U(0)
        for c in range(n_channels):
            step += STEP_WORD
            own |= _U(
                (mix(state + step) >> SHIFT_11) < (primed if last >> _U(c) & _U(1) else thresholds)[row, c]
            ) << _U(c)
        last = own
        if crosstalk and own:
            below, above = mix(exposure * GOLDEN_WORD + keys[1]), mix(exposure * GOLDEN_WORD + keys[2])
            for c in range(n_channels):
                if own >> _U(c) & _U(1):
                    if c + 1 < n_channels and (mix(below + _U(c + 2) * STEP_WORD) >> SHIFT_11) < crosstalk:
                        last |= _U(1) << _U(c + 1)
                    if c > 0 and (mix(above + _U(c) * STEP_WORD) >> SHIFT_11) < crosstalk:
                        last |= _U(1) << _U(c - 1)
        for p in range(words.shape[1]):
            words[t, p] = last >> _U(8 * p) & _U(0xFF)
    for c in range(n_channels):
        previous[0, c] = last >> _U(c) & _U(1)


@njit(cache=True, nogil=True)
def _next_detection(light, traps, tau, begin, end, needed):  # type: ignore[no-untyped-def]
    """When the hazard light + traps/tau exp(-(t - begin)/tau), integrated from `begin`, reaches `needed`; `end` or later: not before it."""
    if light * (end - begin) + traps * -np.expm1(-(end - begin) / tau) <= needed:
        return end
    low, high = begin, end
    for _ in range(40):
        middle = 0.5 * (low + high)
        if light * (middle - begin) + traps * -np.expm1(-(middle - begin) / tau) < needed:
            low = middle
        else:
            high = middle
    return high


@njit(cache=True, nogil=True)
def _filled(light, traps, carriers, tau, duration, word, needed):  # type: ignore[no-untyped-def]
    """Carriers in traps after `duration` in which the detector is on, detection by detection.

    `needed` is the integrated hazard of the first detection; those of the others are drawn from `word`.
    """
    now = 0.0
    while True:
        then = _next_detection(light, traps, tau, now, duration, needed)
        traps *= np.exp(-(then - now) / tau)
        if then >= duration:
            return traps
        now, traps = then, traps + carriers
        word += GOLDEN_WORD
        needed = -np.log1p(-np.float64(mix(word) >> SHIFT_11) * 2.0**-53)


@njit(cache=True, nogil=True)
def trap_words(light, row_of, keys, first, traps, crosstalk, carriers, words):  # type: ignore[no-untyped-def]
    """Draw clicks of a detector that remembers: light float64 (rows, channels) is -log of the chance of silence without traps.

    keys uint64 (2 + 2 * reach,): of clicks, of traps, and of crosstalk from below and above by 1, 2, ...; crosstalk uint64 (reach,) their
    thresholds; traps (a of a detection, tau, pause, on in the pause: 1); carriers float64 (channels,) in traps, before and afterwards.
    """
    each, tau, pause = traps[0], traps[1], traps[2]
    n_channels, reach = light.shape[1], crosstalk.size
    own, clicks = np.zeros(n_channels, np.bool_), np.zeros(n_channels, np.bool_)
    seen = -np.expm1(-1.0 / tau) if tau > 0.0 else 1.0
    for t in range(row_of.size):
        row, exposure = row_of[t], _U(t + first)
        state, of_traps = mix(exposure * GOLDEN_WORD + keys[0]), mix(exposure * GOLDEN_WORD + keys[1])
        for c in range(n_channels):
            step = _U(c + 1) * STEP_WORD
            needed = -np.log1p(-np.float64(mix(state + step) >> SHIFT_11) * 2.0**-53)
            own[c] = clicks[c] = needed < light[row, c] + seen * carriers[c]
            if tau <= 0.0:
                carriers[c] = each if own[c] else 0.0
            elif own[c]:
                carriers[c] = _filled(light[row, c], carriers[c], each, tau, 1.0, mix(of_traps + step), needed)
            else:
                carriers[c] *= np.exp(-1.0 / tau)
        for c in range(n_channels):
            if own[c]:
                for d in range(1, reach + 1):
                    for up in range(2):
                        other = c - d if up else c + d
                        if 0 <= other < n_channels and not clicks[other]:
                            number = mix(mix(exposure * GOLDEN_WORD + keys[2 * d + up]) + _U(other + 1) * STEP_WORD)
                            if number >> SHIFT_11 < crosstalk[d - 1]:
                                clicks[other] = True  # in the middle of the exposure, for the traps
                                carriers[other] += each * (np.exp(-0.5 / tau) if tau > 0.0 else 1.0)
        if tau > 0.0 and pause > 0.0:
            for c in range(n_channels):
                if traps[3] > 0.0:
                    word = mix(of_traps + _U(c + 1) * STEP_WORD) ^ keys[0]
                    needed = -np.log1p(-np.float64(mix(word) >> SHIFT_11) * 2.0**-53)
                    carriers[c] = _filled(light[row, c], carriers[c], each, tau, pause, word, needed)
                else:
                    carriers[c] *= np.exp(-pause / tau)
        for p in range(words.shape[1]):
            byte = 0
            for c in range(8 * p, min(8 * p + 8, n_channels)):
                byte |= int(clicks[c]) << (c & 7)
            words[t, p] = byte


def remembered_words(
    model: DetectorModel,
    probability: NDArray[np.float64],
    row_of: NDArray[np.int64],
    seed: int,
    first_exposure: int,
    carriers: NDArray[np.float64],
    words: NDArray[np.uint8],
) -> None:
    """As `sample_words`, of a model that remembers; `carriers` float64 (channels,) in traps are set to those after the last exposure."""
    light = -np.log1p(-np.minimum(probability, 1.0 - 2.0**-53))
    kernel = (model.crosstalk_probability, *model.crosstalk_further)
    streams = (CLICK_STREAM, TRAP_STREAM, LOWER_CROSSTALK_STREAM, UPPER_CROSSTALK_STREAM)
    further = range(FURTHER_STREAM, FURTHER_STREAM + 2 * max(0, len(kernel) - 1))
    keys = np.array([stream_key(seed, stream) for stream in (*streams, *further)], np.uint64)
    traps = np.array(
        [-math.log1p(-model.afterpulse_probability), model.trap_time, model.pause, float(model.on_in_pause)]
    )
    n_bytes = -(-probability.shape[1] // 8)
    words[:, n_bytes:] = 0
    trap_words(
        light, row_of, keys, first_exposure, traps, click_thresholds(np.array(kernel)), carriers, words[:, :n_bytes]
    )


def click_thresholds(probability: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return the whole numbers below which a 53-bit number is a click: exactly `number * 2**-53 < probability`."""
    return np.ceil(probability * 2.0**53).astype(np.uint64)


def sample_words(
    model: DetectorModel,
    probability: NDArray[np.float64],
    row_of: NDArray[np.int64],
    seed: int,
    first_exposure: int,
    previous: NDArray[np.uint8],
    words: NDArray[np.uint8],
) -> None:
    """Draw the clicks of exposures `first_exposure`... into `words`, uint8 (n, bytes of a word), cleared first.

    Exposure t has the probabilities `probability[row_of[t]]`, float64 (rows, channels). `previous` is uint8 (channels,), the clicks of the
    exposure before, and is set to the last ones. The bits are those of `detector.sample_clicks`.
    """
    n_bytes = -(-probability.shape[1] // 8)
    words[:, n_bytes:] = 0
    used = words[:, :n_bytes]
    thresholds = click_thresholds(probability)
    keys = [stream_key(seed, stream) for stream in (CLICK_STREAM, LOWER_CROSSTALK_STREAM, UPPER_CROSSTALK_STREAM)]
    if not model.afterpulse_probability and not model.crosstalk_probability:
        plain_words(thresholds, row_of, _U(keys[0]), first_exposure, used)
        if len(used):
            previous[:] = np.unpackbits(used[-1], bitorder="little", count=len(previous))
        return
    primed = click_thresholds(1.0 - (1.0 - probability) * (1.0 - model.afterpulse_probability))
    crosstalk = click_thresholds(np.array(model.crosstalk_probability))
    both = np.stack([previous, previous])
    draw = register_words if probability.shape[1] <= 64 else memory_words
    draw(thresholds, primed, row_of, np.array(keys, np.uint64), first_exposure, _U(crosstalk), both, used)
    previous[:] = both[0]


def warm_up() -> None:
    """Compile or load what `sample_words` needs."""
    plain, primed = DetectorModel(ClickLaw()), DetectorModel(ClickLaw(), afterpulse_probability=0.5)
    for effects, n in ((plain, 1), (primed, 1), (primed, 65)):
        words = np.zeros((1, -(-n // 8)), np.uint8)
        sample_words(effects, np.zeros((1, n)), np.zeros(1, np.int64), 0, 0, np.zeros(n, np.uint8), words)
