"""What a detector that counts photons reads: under fixed patterns, states that the host names, and a walk that the device follows.

Also the clicks of several detectors that are read at once as a number: bit k is that of detector k, which sees pattern k of a state.

Owns the way from light to a number: Poisson photoelectrons by inversion, Gaussian read noise, edges. It draws what happens and never asks
the host's law of counts (runtime/instrument/click_law.py) for a probability, so that each is a test of the other; that law is used for what
MARK expects alone. The number drawn depends on seed and exposure only: both ways of driving give the same numbers for the same patterns.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.firmware_sim.program import Program, States
from pans.firmware_sim.scene.detector_kernels import GOLDEN_WORD, SHIFT_11, STEP_WORD, click_thresholds, mix
from pans.firmware_sim.scene.detector_model import CLICK_STREAM, DetectorModel, first_click_probability, stream_key
from pans.runtime.instrument.click_law import count_chances, counting
from pans.runtime.wire.inner import inner
from pans.runtime.wire.messages import DARK_PATTERN

from . import walk_kernels
from .states import ShowList
from .walking import Followed, Walked

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
NOISE_STREAMS, SOURCE_STREAMS = (48, 49), (50, 51)  # two uniform numbers make a normal one
_U = np.uint64
_MANY = 500.0  # photoelectrons, at which no reading is below the highest edge, 14.5
_UNIT = 2.0**-53
MOST_AHEAD = 1024  # exposures of a plan that are drawn at once: an object may stay for as many as the host likes
GAIN, ADDED, ALIVE, SHIFT, N_CONDITIONS = range(5)


class Reader(NamedTuple):
    """A detector that reads numbers: read noise and fluctuation of the source, float64 (2,); edges float64 (largest,); keys uint64 (5,)."""

    noise: F64
    edges: F64
    keys: NDArray[np.uint64]

    @property
    def largest(self) -> int:
        """The largest number it tells: that many photons, or more."""
        return len(self.edges)


def reader_of(model: DetectorModel, largest: int, seed: int) -> Reader:
    """Return the detector of `model`; the first edge is its threshold, the others lie halfway between whole numbers."""
    streams = (CLICK_STREAM, *NOISE_STREAMS, *SOURCE_STREAMS)
    return Reader(
        np.array([model.law.read_noise_e, model.fluctuation]),
        np.array([model.law.threshold_e, *(number + 0.5 for number in range(1, largest))]),
        np.array([stream_key(seed, stream) for stream in streams], np.uint64),
    )


@inner
def read_number(exposure, light, conditions, reader):  # type: ignore[no-untyped-def]
    """Expose once: `light` photoelectrons expected, conditions float64 (N_CONDITIONS,); return the number that is read."""
    noise, edges, keys = reader
    if conditions[ALIVE] == 0:
        return 0
    mean = light * conditions[GAIN]
    if noise[1] > 0:
        mean *= max(0.0, 1.0 + noise[1] * _normal(exposure, keys[3], keys[4]))
    charge = _photons(mean + conditions[ADDED], _uniform(exposure, keys[0]))
    if noise[0] > 0:
        charge += noise[0] * _normal(exposure, keys[1], keys[2])
    charge -= conditions[SHIFT]
    number = 0
    while number < edges.size and charge >= edges[number]:
        number += 1
    return number


@inner
def _photons(mean, uniform):  # type: ignore[no-untyped-def]
    """A Poisson number by inversion, a float."""
    if mean > _MANY:
        return _MANY
    chance, number = math.exp(-mean), 0
    reached = chance
    while uniform >= reached and number < _MANY:
        number += 1
        chance *= mean / number
        reached += chance
    return float(number)


@inner
def _uniform(exposure, key):  # type: ignore[no-untyped-def]
    return np.float64(mix(mix(_U(exposure) * GOLDEN_WORD + key) + STEP_WORD) >> SHIFT_11) * _UNIT


@inner
def _normal(exposure, radius_key, angle_key):  # type: ignore[no-untyped-def]
    """A standard normal number (Box and Muller, 1958)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - _uniform(exposure, radius_key)))
    return radius * math.cos(2.0 * math.pi * _uniform(exposure, angle_key))


@njit(cache=True, nogil=True)
def read_each(first, light, conditions, reader, numbers):  # type: ignore[no-untyped-def]
    """Expose once for each of light float64 (n,) from exposure `first` of the detector's life on; numbers uint8 (n,) are set."""
    for i in range(light.size):
        numbers[i] = read_number(first + i, light[i], conditions[i], reader)


@njit(cache=True, nogil=True)
def follow_counts(first, node, light, successors, adaptive, conditions, reader, stamps, numbers):  # type: ignore[no-untyped-def]
    """Follow a walk through slots of one cycle from `node` on; return the node that it stands in then.

    light float64 (states + 1,): the last one is that of the dark; successors int64 (states, outcomes); adaptive bool (n,): which slots show
    states; conditions float64 (n, N_CONDITIONS); stamps uint16 (n,) and numbers uint8 (n,) are set.
    """
    n_states = successors.shape[0]
    for i in range(stamps.size):
        lit = adaptive[i] and node < n_states
        number = read_number(first + i, light[node if lit else n_states], conditions[i], reader)
        numbers[i] = number
        stamps[i] = node if lit else DARK_PATTERN
        if lit:
            node = successors[node, number]
    return node


@njit(cache=True, nogil=True)
def expected_light(chances, light, successors):  # type: ignore[no-untyped-def]
    """The light of a walk in expectation.

    chances float64 (outcomes, states), light float64 (states,), successors int64 (states, outcomes).
    """
    n_states = successors.shape[0]
    reached = np.zeros(n_states)
    reached[0] = 1.0
    total = 0.0
    for state in range(n_states):
        total += reached[state] * light[state]
        for outcome in range(successors.shape[1]):
            target = successors[state, outcome]
            if target < n_states:
                reached[target] += reached[state] * chances[outcome, state]
    return total


def warm_up(channels: int = 0) -> None:
    """Compile or load the loops, those of several `channels` where they are: ARM must not wait for a compiler."""
    if channels:
        walk_kernels.warm_up_words(channels)
        expected_light(np.zeros((3, 1)), np.zeros(1), np.ones((1, 3), np.int64))
        return
    reader = Reader(np.zeros(2), np.array([0.5, 1.5]), np.zeros(5, np.uint64))
    numbers, successors = np.zeros((1, 1), np.uint8)[:, 0], np.ones((1, 3), np.int64)
    read_each(0, np.zeros(1), np.zeros((1, N_CONDITIONS)), reader, numbers)
    follow_counts(
        0, 0, np.zeros(2), successors, np.ones(1, np.bool_), np.zeros((1, N_CONDITIONS)), reader, np.zeros(1, np.uint16), numbers
    )  # fmt: skip
    expected_light(np.zeros((3, 1)), np.zeros(1), successors)


def _chances(model: DetectorModel, outcomes: int, light: F64) -> F64:
    """The chances of each number, float64 (outcomes, n), for light float64 (n,), over the fluctuation of the source."""
    law = counting(model.law, outcomes)
    if not model.fluctuation:
        return count_chances(law, light)
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    factors = np.maximum(1.0 + model.fluctuation * nodes, 0.0)
    found = [weight * count_chances(law, light * factor) for factor, weight in zip(factors, weights / weights.sum())]
    return np.asarray(np.sum(found, axis=0))


class Counted:
    """What all three kinds of exposures share: the detector and what changes with time."""

    def __init__(self, walked: Walked, largest: int) -> None:
        self.largest = largest
        self._walked, self.reader = walked, reader_of(walked.model, largest, walked.seed)

    def read(self, first: int, light: F64, numbers: U8) -> None:
        """Expose once for each of `light`; numbers uint8 (n, 1) are set."""
        walked = self._walked
        read_each(walked.first_draw + first, light, self.conditions(first, len(light)), self.reader, numbers[:, 0])

    def conditions(self, first: int, count: int) -> F64:
        """Gain of the light, photoelectrons beside it, whether the detector lives, and by how much readings are lower; float64.

        The shape is (count, N_CONDITIONS); asked for in the order of exposures.
        """
        walked = self._walked
        conditions = np.ones((count, N_CONDITIONS))
        conditions[:, ADDED], conditions[:, SHIFT] = walked.model.law.dark_per_exposure, 0.0
        if walked.changes:
            seconds = walked.exposures.seconds(walked.exposures.begins(first, count))
            exposure_s = walked.exposures.exposure_ticks / walked.exposures.tick_hz
            conditions[:, GAIN] = walked.changes.efficiency(seconds)
            dark = walked.changes.means(walked.model, np.zeros((count, 1)), seconds, exposure_s)
            conditions[:, ADDED], conditions[:, ALIVE] = dark[:, 0], walked.changes.alive(seconds)[:, 0]
            conditions[:, SHIFT] = walked.changes.shifts_e(seconds)[:, 0]
        return conditions


class CountedPlan(Counted):
    """The exposures of a plan whose patterns are fixed; see `walking.SlotSource`."""

    def __init__(self, walked: Walked, largest: int) -> None:
        super().__init__(walked, largest)
        self.ahead = min(walked.program.n_slots * walked.program.cycles_per_object, MOST_AHEAD)

    def prepare(self, exposure: int) -> bool:
        """Nothing."""
        return False

    def expected_photoelectrons(self, number: int) -> float:
        """The photoelectrons of one exposure of every pattern on object `number` of the scene; NaN of one that bleaches."""
        return math.nan if self._walked.sample is not None else float(self._walked.light.of(number).sum())

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        numbers, light = np.zeros((count, 1), np.uint8), np.zeros(count)
        program: Program = self._walked.program
        shown = program.patterns[np.arange(first, first + count) % program.n_slots]
        for place in np.flatnonzero(shown != DARK_PATTERN).tolist():
            light[place] = self._walked.photoelectrons(first + place, int(shown[place]), 1.0)
        self.read(first, light, numbers)
        return shown, numbers


class CountedShows(Counted):
    """The exposures that the host names one by one; one without a name is dark."""

    ahead = 0

    def __init__(self, walked: Walked, shows: ShowList, largest: int) -> None:
        super().__init__(walked, largest)
        self._shows = shows

    def prepare(self, exposure: int) -> bool:
        """Nothing: what is shown is not known."""
        return False

    def expected_photoelectrons(self, number: int) -> float:
        """Not known: only the host knows the automaton."""
        return math.nan

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        stamps, light = np.full(count, DARK_PATTERN, np.uint16), np.zeros(count)
        for place, exposure in enumerate(range(first, first + count)):
            shown = self._shows.take(exposure)
            if shown is not None:
                stamps[place] = shown.state
                light[place] = self._walked.photoelectrons(exposure, shown.pattern, shown.light)
        numbers = np.zeros((count, 1), np.uint8)
        self.read(first, light, numbers)
        return stamps, numbers


class CountedWalk(Followed):
    """The photon numbers of an automaton that the device follows."""

    def __init__(self, walked: Walked, states: States) -> None:
        super().__init__(walked, states, at_once=walked.sample is None)
        self.largest = states.successors.shape[1] - 1
        self._counted = Counted(walked, self.largest)

    def prepare(self, exposure: int) -> bool:
        """Nothing: a walk needs no more than the light of its states."""
        return False

    def _at_once(self, first: int, slot: int, stamps: U16, readings: U8, before: U8) -> None:
        walked, counted = self._walked, self._counted
        self._state = follow_counts(
            walked.first_draw + first, self._state, np.append(self._light(walked.object_of(first)), 0.0),
            self._states.successors, self._adaptive[slot : slot + len(stamps)], counted.conditions(first, len(stamps)),
            counted.reader, stamps, readings[:, 0],
        )  # fmt: skip

    def _expose(self, exposure: int, lit: bool, before: U8) -> U8:
        number = np.zeros((1, 1), np.uint8)
        self._counted.read(exposure, np.array([self._light_now(exposure, lit)]), number)
        return number[0]

    def _walk_light(self, light: F64) -> float:
        return float(
            expected_light(_chances(self._walked.model, self.largest + 1, light), light, self._states.successors)
        )


class _AtOnce:
    """What exposures of several detectors share: the light of their patterns, and their clicks as a number."""

    def __init__(self, walked: Walked, channels: int) -> None:
        self._walked, self.places = walked, np.arange(channels)

    def light(self, exposure: int, pattern: int, share: float) -> F64:
        """Photoelectrons, float64 (channels,), of an exposure that shows `pattern` and those after it."""
        return np.asarray(self._walked.light.of(self._walked.object_of(exposure))[pattern + self.places] * share)

    def click(self, exposure: int, light: F64, before: U8) -> U8:
        """Draw one exposure, uint8 (1,), as `before` of the exposure before."""
        clicks = self._walked.click(exposure, light, (before[0] >> self.places & 1).astype(np.uint8))
        return np.array([int(clicks.astype(np.int64) @ (1 << self.places))], np.uint8)


class ShowsAtOnce:
    """The exposures of several detectors that the host names one by one; one without a name is dark."""

    ahead = 0

    def __init__(self, walked: Walked, shows: ShowList, channels: int) -> None:
        self._at_once, self._shows, self.largest = _AtOnce(walked, channels), shows, (1 << channels) - 1

    def prepare(self, exposure: int) -> bool:
        """Nothing: what is shown is not known."""
        return False

    def expected_photoelectrons(self, number: int) -> float:
        """Not known: only the host knows the automaton."""
        return math.nan

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        stamps, numbers = np.full(count, DARK_PATTERN, np.uint16), np.zeros((count, 1), np.uint8)
        for place, exposure in enumerate(range(first, first + count)):
            shown, light = self._shows.take(exposure), np.zeros(len(self._at_once.places))
            if shown is not None:
                stamps[place] = shown.state
                light = self._at_once.light(exposure, shown.pattern, shown.light)
            numbers[place] = before = self._at_once.click(exposure, light, before)
        return stamps, numbers


class WalkAtOnce(Followed):
    """The clicks of several detectors under an automaton that the device follows."""

    def __init__(self, walked: Walked, states: States, channels: int) -> None:
        super().__init__(walked, states, at_once=not (walked.changing or walked.model.afterpulse_probability))
        self._channels, self._draws, self.largest = channels, _AtOnce(walked, channels), (1 << channels) - 1
        self._kept: tuple[int, NDArray[np.uint64]] | None = None  # thresholds of the object before the detectors

    def prepare(self, exposure: int) -> bool:
        """Nothing: a walk needs no more than the light of its states."""
        return False

    def _light(self, number: int) -> F64:
        """Photoelectrons of an exposure in each state, float64 (states, channels)."""
        rows = self._states.pattern[:, None] + self._draws.places
        return np.asarray(self._walked.light.of(number)[rows] * self._states.light[:, None])

    def _at_once(self, first: int, slot: int, stamps: U16, readings: U8, before: U8) -> None:
        walked = self._walked
        number = walked.object_of(first)
        if self._kept is None or self._kept[0] != number:
            light = np.concatenate([self._light(number), np.zeros((1, self._channels))])
            self._kept = number, click_thresholds(first_click_probability(walked.model, light))
        self._state = walk_kernels.follow_words(
            self._kept[1], self._states.successors, self._adaptive[slot : slot + len(stamps)],
            walk_kernels.key_of(walked.seed), walked.first_draw + first, self._state, stamps, readings[:, 0],
        )  # fmt: skip

    def _expose(self, exposure: int, lit: bool, before: U8) -> U8:
        light = np.zeros(self._channels)
        if lit:
            state = self._state
            light = self._draws.light(exposure, int(self._states.pattern[state]), float(self._states.light[state]))
        return self._draws.click(exposure, light, before)

    def _walk_light(self, light: F64) -> float:
        click = first_click_probability(self._walked.model, light)
        chances = np.ones((1, len(click)))
        for of_channel in click.T:
            chances = np.concatenate([chances * (1.0 - of_channel), chances * of_channel])
        return float(expected_light(chances, light.sum(axis=1), self._states.successors))
