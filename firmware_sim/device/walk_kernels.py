"""The compiled loops of an automaton that the simulated device follows.

Owns the loops and the whole-number thresholds that they compare with; every bit is the one that `scene.detector.sample_clicks` draws.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.firmware_sim.scene.detector_kernels import GOLDEN_WORD, SHIFT_11, STEP_WORD, click_thresholds, mix
from pans.firmware_sim.scene.detector_model import CLICK_STREAM, DetectorModel, first_click_probability, stream_key
from pans.runtime.wire.messages import DARK_PATTERN

_U = np.uint64


@njit(cache=True, nogil=True)
def follow(limits, successors, adaptive, key, first, begin, stamps, clicks):  # type: ignore[no-untyped-def]
    """Follow a walk through slots of one cycle; return the node that it stands in then.

    limits uint64 (2, states + 1): see `thresholds`; successors int64 (states, 2); adaptive bool (n,): which slots show states; `first`: the
    number of the first exposure in the detector's life; begin: the node, and the click of the exposure before; stamps uint16 (n,) and
    clicks uint8 (n,) are set.
    """
    node, click = begin
    n_states = successors.shape[0]
    for i in range(stamps.shape[0]):
        lit = adaptive[i] and node < n_states
        limit = limits[click, node if lit else n_states]
        number = mix(mix(_U(first + i) * GOLDEN_WORD + key) + STEP_WORD) >> SHIFT_11
        click = 1 if number < limit else 0
        clicks[i] = click
        stamps[i] = node if lit else DARK_PATTERN
        if lit:
            node = successors[node, click]
    return node


@njit(cache=True, nogil=True)
def follow_words(limits, successors, adaptive, key, first, node, stamps, words):  # type: ignore[no-untyped-def]
    """As `follow`, of several detectors that are read at once; a word's bit k is the click of detector k.

    limits uint64 (states + 1, channels): what a number must be below to click; successors int64 (states, 2**channels).
    """
    n_states = successors.shape[0]
    for i in range(stamps.shape[0]):
        lit = adaptive[i] and node < n_states
        row = node if lit else n_states
        drawn = mix(_U(first + i) * GOLDEN_WORD + key)
        word = 0
        for channel in range(limits.shape[1]):
            if mix(drawn + _U(channel + 1) * STEP_WORD) >> SHIFT_11 < limits[row, channel]:
                word |= 1 << channel
        words[i] = word
        stamps[i] = node if lit else DARK_PATTERN
        if lit:
            node = successors[node, word]
    return node


@njit(cache=True, nogil=True)
def expected_light(probability, light, successors):  # type: ignore[no-untyped-def]
    """The light of a walk in expectation, the exposure before it without a click.

    probability float64 (2, states): of a click in each after an exposure without and with one; light float64 (states,) of an exposure in
    each; successors int64 (states, 2).
    """
    n_states = successors.shape[0]
    reached = np.zeros((2, n_states))
    reached[0, 0] = 1.0
    total = 0.0
    for state in range(n_states):
        total += (reached[0, state] + reached[1, state]) * light[state]
        dark, clicked = successors[state, 0], successors[state, 1]
        for before in range(2):
            if dark < n_states:
                reached[0, dark] += reached[before, state] * (1.0 - probability[before, state])
            if clicked < n_states:
                reached[1, clicked] += reached[before, state] * probability[before, state]
    return total


def chances(model: DetectorModel, light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the chances of a click, float64 (2, n), after an exposure without and with a click; light float64 (n,): photoelectrons.

    Without what traps remember: see `Walked.changing`.
    """
    probability = first_click_probability(model, light)
    primed = probability
    if model.afterpulse_probability and not model.trap_time:
        primed = 1.0 - (1.0 - probability) * (1.0 - model.afterpulse_probability)
    return np.stack([probability, primed])


def thresholds(model: DetectorModel, light: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return the whole numbers below which a 53-bit number is a click, uint64 (2, n), after an exposure without and with a click.

    light float64 (n,): photoelectrons expected.
    """
    return click_thresholds(chances(model, light))


def key_of(seed: int) -> np.uint64:
    """Return the key of the clicks' random numbers."""
    return _U(stream_key(seed, CLICK_STREAM))


def warm_up() -> None:
    """Compile or load the loops."""
    limits, successors = np.zeros((2, 2), np.uint64), np.ones((1, 2), np.int64)
    follow(
        limits,
        successors,
        np.ones(1, np.bool_),
        _U(0),
        0,
        (0, 0),
        np.zeros(1, np.uint16),
        np.zeros((1, 1), np.uint8)[:, 0],
    )
    expected_light(np.zeros((2, 1)), np.zeros(1), successors)


def warm_up_words(channels: int) -> None:
    """Compile or load the loop of several detectors."""
    limits, successors = np.zeros((2, channels), np.uint64), np.ones((1, 1 << channels), np.int64)
    no_slots = np.zeros(0, np.bool_), np.zeros(0, np.uint16), np.zeros((0, 1), np.uint8)[:, 0]
    follow_words(limits, successors, no_slots[0], _U(0), 0, 0, no_slots[1], no_slots[2])
