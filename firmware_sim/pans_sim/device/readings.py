"""What a detector reads of an exposure: clicks of one detector, of several that are read at once, or photon numbers.

Light and an exposure's number in, readings out, for single exposures and for walks of an automaton in compiled loops. What is drawn
depends on the seed and the exposure alone. `Clicks` and `Numbers` are readers, as walking.py asks for them. Nothing here asks the host's
law for a probability, but for the light that MARK expects, so that host and device test each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import njit
from pans.instrument.click_law import count_chances, counting
from pans.protocol.wire import DARK_PATTERN
from pans_sim.scene.detector import sample_clicks
from pans_sim.scene.detector_kernels import GOLDEN_WORD, SHIFT_11, STEP_WORD, click_thresholds, mix
from pans_sim.scene.detector_model import CLICK_STREAM, DetectorModel, first_click_probability, stream_key
from pans_sim.scene.program import States

from .walking import Walked

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U64 = NDArray[np.uint64]
NOISE_STREAMS, SOURCE_STREAMS = (48, 49), (50, 51)  # two uniform numbers make a normal one
MAX_THRESHOLDS = 1 << 22  # of states times objects that are kept, twice each: 64 MiB
_U = np.uint64
_MANY = 500.0  # photoelectrons, at which no reading is below the highest edge, 14.5
_UNIT = 2.0**-53
GAIN, ADDED, ALIVE, SHIFT, N_CONDITIONS = range(5)


@njit(cache=True, nogil=True)
def follow(limits, successors, adaptive, key, first, begin, stamps, readings):  # type: ignore[no-untyped-def]
    """Follow a walk through slots of one cycle by clicks; return the node that it stands in then.

    limits uint64 (2, states + 1, channels): what a number must be below to click, without and with a click before, the last state the
    dark; successors int64 (states, 2**channels); adaptive bool (n,): which slots show states; `first`: the number of the first exposure
    in the detector's life; begin: the node, and the reading before; stamps uint16 (n,) and readings uint8 (n,) are set, bit k: channel k.
    """
    node, before = begin
    n_states = successors.shape[0]
    for i in range(stamps.shape[0]):
        lit = adaptive[i] and node < n_states
        row = node if lit else n_states
        drawn, reading = mix(_U(first + i) * GOLDEN_WORD + key), 0
        for channel in range(limits.shape[2]):
            limit = limits[before >> channel & 1, row, channel]
            if mix(drawn + _U(channel + 1) * STEP_WORD) >> SHIFT_11 < limit:
                reading |= 1 << channel
        readings[i] = before = reading
        stamps[i] = node if lit else DARK_PATTERN
        if lit:
            node = successors[node, reading]
    return node


def expected_light(chances: F64, light: F64, successors: NDArray[np.int64]) -> float:
    """The light of a walk in expectation, the exposure before it read as 0.

    chances float64 (2, outcomes, states): of each reading, after a reading of 0 and after another; light float64 (states,) of an exposure;
    successors int64 (states, outcomes).
    """
    return float(_add_light(chances, light, successors, np.zeros((2, len(successors)))))


@njit(cache=True, nogil=True)
def _add_light(chances, light, successors, reached):  # type: ignore[no-untyped-def]
    """As `expected_light`; `reached` is zeros (2, states): a kernel that allocates takes long to load."""
    n_states = successors.shape[0]
    reached[0, 0] = 1.0
    total = 0.0
    for state in range(n_states):
        total += (reached[0, state] + reached[1, state]) * light[state]
        for before in range(2):
            for outcome in range(successors.shape[1]):
                target = successors[state, outcome]
                if target < n_states:
                    reached[min(outcome, 1), target] += reached[before, state] * chances[before, outcome, state]
    return total


class NumberDetector(NamedTuple):
    """A detector that reads numbers: read noise and fluctuation of the source, float64 (2,); edges float64 (largest,); keys uint64 (5,)."""

    noise: F64
    edges: F64
    keys: U64


def number_detector(model: DetectorModel, largest: int, seed: int) -> NumberDetector:
    """Return the detector of `model`; the first edge is its threshold, the others lie halfway between whole numbers."""
    streams = (CLICK_STREAM, *NOISE_STREAMS, *SOURCE_STREAMS)
    return NumberDetector(
        np.array([model.law.read_noise_e, model.fluctuation]),
        np.array([model.law.threshold_e, *(number + 0.5 for number in range(1, largest))]),
        np.array([stream_key(seed, stream) for stream in streams], np.uint64),
    )


@njit(cache=True, nogil=True)
def read_number(exposure, light, conditions, detector):  # type: ignore[no-untyped-def]
    """Expose once: `light` photoelectrons expected, conditions float64 (N_CONDITIONS,); return the number that is read."""
    noise, edges, keys = detector
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _uniform(exposure, key):  # type: ignore[no-untyped-def]
    return np.float64(mix(mix(_U(exposure) * GOLDEN_WORD + key) + STEP_WORD) >> SHIFT_11) * _UNIT


@njit(cache=True, nogil=True)
def _normal(exposure, radius_key, angle_key):  # type: ignore[no-untyped-def]
    """A standard normal number (Box and Muller, 1958)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - _uniform(exposure, radius_key)))
    return radius * math.cos(2.0 * math.pi * _uniform(exposure, angle_key))


@njit(cache=True, nogil=True)
def follow_numbers(first, node, light, walk, conditions, detector, stamps, numbers):  # type: ignore[no-untyped-def]
    """As `follow`, by photon numbers.

    light float64 (states + 1,), the last one that of the dark; walk: successors int64 (states, outcomes) and adaptive bool (n,);
    conditions float64 (n, N_CONDITIONS).
    """
    successors, adaptive = walk
    n_states = successors.shape[0]
    for i in range(stamps.size):
        lit = adaptive[i] and node < n_states
        number = read_number(first + i, light[node if lit else n_states], conditions[i], detector)
        numbers[i] = number
        stamps[i] = node if lit else DARK_PATTERN
        if lit:
            node = successors[node, number]
    return node


@njit(cache=True, nogil=True)
def read_each(first, light, conditions, detector, numbers):  # type: ignore[no-untyped-def]
    """Expose once for each of light float64 (n,) from exposure `first` of the detector's life on; numbers uint8 (n,) are set."""
    for i in range(light.size):
        numbers[i] = read_number(first + i, light[i], conditions[i], detector)


def click_chances(model: DetectorModel, light: F64) -> F64:
    """Return the chances of a click, float64 (2, ...), after an exposure without and with a click; light: photoelectrons expected.

    Without what traps remember: see `Walked.changing`.
    """
    probability = first_click_probability(model, light)
    primed = probability
    if model.afterpulse_probability and not model.trap_time:
        primed = 1.0 - (1.0 - probability) * (1.0 - model.afterpulse_probability)
    return np.stack([probability, primed])


def click_key(seed: int) -> np.uint64:
    """Return the key of the clicks' random numbers."""
    return _U(stream_key(seed, CLICK_STREAM))


def warm_up(outcomes: int = 2, channels: int = 1) -> None:
    """Compile or load the loops for readings of so many outcomes: ARM must not wait for a compiler."""
    successors, adaptive = np.ones((1, outcomes), np.int64), np.ones(1, np.bool_)
    stamps, readings = np.zeros(1, np.uint16), np.zeros((1, 1), np.uint8)[:, 0]
    if outcomes == 1 << channels:
        follow(np.zeros((2, 2, channels), np.uint64), successors, adaptive, _U(0), 0, (0, 0), stamps, readings)
    else:
        detector = NumberDetector(np.zeros(2), np.array([0.5, 1.5]), np.zeros(5, np.uint64))
        conditions = np.zeros((1, N_CONDITIONS))
        read_each(0, np.zeros(1), conditions, detector, readings)
        follow_numbers(0, 0, np.zeros(2), (successors, adaptive), conditions, detector, stamps, readings)
    expected_light(np.zeros((2, outcomes, 1)), np.zeros(1), successors)


class Clicks:
    """Reads clicks, of several detectors as a number: bit k is that of detector k, which sees pattern k of a state."""

    def __init__(self, walked: Walked, channels: int = 1) -> None:
        self.largest, self._walked, self._places = (1 << channels) - 1, walked, np.arange(channels)
        self.at_once = not (walked.changing or (channels > 1 and walked.model.afterpulse_probability))
        self._kept: dict[int, U64] = {}  # thresholds by object of the scene

    def light(self, exposure: int, pattern: int, share: float) -> F64:
        """Show `pattern` and those after it for `share` of an exposure: photoelectrons float64 (channels,), without what changes."""
        if self._walked.sample is not None:
            return np.array([self._walked.photoelectrons(exposure, pattern, share)])
        return np.asarray(self._walked.light.of(self._walked.object_of(exposure))[pattern + self._places] * share)

    def read(self, first: int, light: F64, before: U8) -> U8:
        """Draw exposures from `first` on, light float64 (n, channels); return uint8 (n, 1). `before`: the reading of the one before."""
        walked, readings = self._walked, np.zeros((len(light), 1), np.uint8)
        for place, row in enumerate(light):
            exposure, clicks = first + place, (before[0] >> self._places & 1).astype(np.uint8)
            if walked.changes:
                seconds = walked.exposures.seconds(walked.exposures.begins(exposure, 1))
                exposure_s = walked.exposures.exposure_ticks / walked.exposures.tick_hz
                probability = walked.changes.probability(walked.model, row[None, :], seconds, exposure_s)
            else:
                probability = first_click_probability(walked.model, row[None, :])
            number = walked.first_draw + exposure
            clicks = sample_clicks(walked.model, probability, walked.seed, number, clicks, walked.carriers)[0]
            readings[place] = int(clicks.astype(np.int64) @ (1 << self._places))
            before = readings[place]
        return readings

    def prepare(self, number: int, states: States) -> bool:
        """Make the thresholds of object `number` of the scene; whether there was any to make."""
        if not self.at_once or number in self._kept:
            return False
        self._thresholds(number, states)
        return True

    def follow(
        self, first: int, node: int, states: States, adaptive: NDArray[np.bool_], before: U8, stamps: U16, readings: U8
    ) -> int:
        """Follow a walk through slots of one cycle; return where it stands then. stamps (n,) and readings (n,) are set."""
        limits = self._thresholds(self._walked.object_of(first), states)
        number, key = self._walked.first_draw + first, click_key(self._walked.seed)
        return int(follow(limits, states.successors, adaptive, key, number, (node, int(before[0])), stamps, readings))

    def expected_light(self, number: int, states: States) -> float:
        """The light of a walk on object `number` of the scene in expectation."""
        light = self._of_states(number, states)
        click = click_chances(self._walked.model, light)
        chances = np.ones((2, 1, len(light)))
        for channel in range(light.shape[1]):
            of_channel = click[:, None, :, channel]
            chances = np.concatenate([chances * (1.0 - of_channel), chances * of_channel], axis=1)
        return expected_light(chances, light.sum(axis=1), states.successors)

    def _of_states(self, number: int, states: States) -> F64:
        """Photoelectrons of an exposure in each state, float64 (states, channels)."""
        rows = states.pattern[:, None] + self._places
        return np.asarray(self._walked.light.of(number)[rows] * states.light[:, None])

    def _thresholds(self, number: int, states: States) -> U64:
        kept = self._kept.get(number)
        if kept is None:
            light = np.concatenate([self._of_states(number, states), np.zeros((1, len(self._places)))])
            kept = click_thresholds(click_chances(self._walked.model, light))
            if len(self._kept) * kept.size > MAX_THRESHOLDS:
                self._kept.clear()
            self._kept[number] = kept
        return kept


class Numbers:
    """Reads photon numbers up to `largest`: that many photons, or more."""

    def __init__(self, walked: Walked, largest: int) -> None:
        self.largest, self._walked, self.at_once = largest, walked, walked.sample is None
        self._detector = number_detector(walked.model, largest, walked.seed)

    def light(self, exposure: int, pattern: int, share: float) -> F64:
        """See Clicks."""
        return np.array([self._walked.photoelectrons(exposure, pattern, share)])

    def read(self, first: int, light: F64, before: U8) -> U8:
        """See Clicks; what was read before changes nothing."""
        readings, number = np.zeros((len(light), 1), np.uint8), self._walked.first_draw + first
        read_each(number, light[:, 0], self._conditions(first, len(light)), self._detector, readings[:, 0])
        return readings

    def prepare(self, number: int, states: States) -> bool:
        """Nothing: a walk needs no more than the light of its states."""
        return False

    def follow(
        self, first: int, node: int, states: States, adaptive: NDArray[np.bool_], before: U8, stamps: U16, readings: U8
    ) -> int:
        """See Clicks."""
        walked, conditions = self._walked, self._conditions(first, len(stamps))
        light = np.append(walked.light.of(walked.object_of(first))[states.pattern] * states.light, 0.0)
        walk = states.successors, adaptive
        return int(
            follow_numbers(walked.first_draw + first, node, light, walk, conditions, self._detector, stamps, readings)
        )

    def expected_light(self, number: int, states: States) -> float:
        """See Clicks; the chances of each number are those of the host's law, over the fluctuation of the source."""
        light, model = np.asarray(self._walked.light.of(number)[states.pattern] * states.light), self._walked.model
        law = counting(model.law, self.largest + 1)
        nodes, weights = np.polynomial.hermite_e.hermegauss(9 if model.fluctuation else 1)
        factors = np.maximum(1.0 + model.fluctuation * nodes, 0.0)
        found = [
            weight * count_chances(law, light * factor) for factor, weight in zip(factors, weights / weights.sum())
        ]
        chances = np.sum(found, axis=0)
        return expected_light(np.stack([chances, chances]), light, states.successors)

    def _conditions(self, first: int, count: int) -> F64:
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
