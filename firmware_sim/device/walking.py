"""What an automaton's exposures show and whether they click: followed by the device, or named by the host.

Owns the light of states and the walk from click to click; never knows messages or time beyond the exposure's number. It shares no code with
the host's check of the walks, so that each is a test of the other. The number drawn for an exposure depends on the seed and the
exposure alone: both ways of driving give the same clicks for the same patterns.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.program import Program, States
from pans.firmware_sim.scene.changes import Changes
from pans.firmware_sim.scene.detector import sample_clicks
from pans.firmware_sim.scene.detector_model import DetectorModel, first_click_probability
from pans.firmware_sim.scene.drawing import ClickSource
from pans.firmware_sim.scene.exposure_times import Exposures
from pans.firmware_sim.scene.optics import expected_photoelectrons
from pans.firmware_sim.scene.still import Scene
from pans.runtime.instrument.profile import Profile
from pans.runtime.wire.messages import ADAPTIVE_PATTERN, DARK_PATTERN, NO_OBJECT

from .bleached import Sample
from .states import ShowList

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U64 = NDArray[np.uint64]
BATCH_EXPOSURES = 1 << 14  # of a plan with fixed patterns, drawn at a time
BLOCK_ENTRIES = 1 << 20  # objects times patterns that are computed at a time
MAX_BLOCKS = 4  # and how many of those are kept: 32 MiB of float64
OBJECTS_AHEAD = 3  # whose thresholds are made where there is time
MAX_THRESHOLDS = 1 << 22  # of states times objects that are kept, twice each: 64 MiB


class SlotSource(Protocol):
    """The exposures of a sequential run, asked for in their order, `ahead` of them at a time where they are known."""

    ahead: int
    largest: int  # number that an exposure can have: 1 of clicks

    def prepare(self, exposure: int) -> bool:
        """Do a piece of work of a fraction of a millisecond that `exposure` or those after it will need; whether there was any."""

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """Return what is stamped, uint16 (count,), and clicks or numbers, uint8 (count, 1), of exposures from `first` on.

        before uint8 (1,): the click of the one before.
        """


class PlanSource:
    """The exposures of a plan whose patterns are fixed."""

    ahead, largest = BATCH_EXPOSURES, 1

    def __init__(self, program: Program, source: ClickSource) -> None:
        self._patterns, self._source = program.patterns, source

    def prepare(self, exposure: int) -> bool:
        """Nothing."""
        return False

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        slots = np.arange(first, first + count) % len(self._patterns)
        return self._patterns[slots], self._source.clicks(first, count, before)


class PatternLight:
    """The photoelectrons of every pattern on an object, computed for some objects at a time, when the first of them is asked for."""

    def __init__(self, profile: Profile, scene: Scene, levels: NDArray[np.uint16], exposure_us: float) -> None:
        self._profile, self._scene, self._levels, self._exposure_us = profile, scene, levels, exposure_us
        self._at_a_time = max(1, min(scene.n_objects, BLOCK_ENTRIES // len(levels)))
        self._blocks: dict[int, F64] = {}
        for block in range(
            min(MAX_BLOCKS, -(-scene.n_objects // self._at_a_time))
        ):  # a patternset that does not fit raises here
            self._block(block)

    def of(self, number: int) -> F64:
        """Return float64 (patterns,) of object `number` of the scene, one exposure each with the light on all the time."""
        block, row = divmod(number, self._at_a_time)
        return np.asarray(self._block(block)[row])

    def fresh_sample(self) -> Sample | None:
        """Return the sample that one run's walks bleach; None where nothing bleaches."""
        if self._scene.bleaching.is_none:
            return None
        return Sample(self._profile, self._scene, self._levels, self._exposure_us)

    def _block(self, number: int) -> F64:
        found = self._blocks.get(number)
        if found is None:
            part = slice(number * self._at_a_time, (number + 1) * self._at_a_time)
            scene = replace(self._scene, images=self._scene.images[part], labels=self._scene.labels[part])
            found = expected_photoelectrons(self._profile, scene, self._levels, self._exposure_us)
            if len(self._blocks) >= MAX_BLOCKS:
                del self._blocks[next(iter(self._blocks))]
            self._blocks[number] = found
        return found


@dataclass(frozen=True, slots=True)
class Walked:
    """What every exposure of an automaton's run depends on; `first_draw` exposures were drawn in earlier runs."""

    program: Program
    light: PatternLight
    n_objects: int
    exposures: Exposures
    changes: Changes
    model: DetectorModel
    seed: int
    first_draw: int
    sample: Sample | None = None  # that the walks bleach
    carriers: F64 = field(default_factory=lambda: np.zeros(1))  # in the detector's traps, in the order of exposures

    @property
    def changing(self) -> bool:
        """Whether a state's chance of a click is not always the same, so that exposures are gone through one by one."""
        return bool(self.changes) or self.sample is not None or self.model.remembers

    def photoelectrons(self, exposure: int, pattern: int, share: float) -> float:
        """Show `pattern` for `share` of `exposure`: the photoelectrons expected, without what changes with time."""
        if self.sample is None:
            return float(self.light.of(self.object_of(exposure))[pattern]) * share
        visit = exposure // self.program.n_slots // self.program.cycles_per_object
        return self.sample.photoelectrons(visit, pattern, share)

    def object_of(self, exposure: int) -> int:
        """The number in the scene of the object before the detector."""
        cycle = exposure // self.program.n_slots
        return cycle // self.program.cycles_per_object % NO_OBJECT % self.n_objects

    def click(self, exposure: int, photoelectrons: float | F64, before: U8) -> U8:
        """Draw one exposure with `photoelectrons` expected: uint8 (1,), as `before` of the exposure before.

        Of several detectors that are read at once float64 (channels,), and uint8 (channels,).
        """
        light = np.atleast_1d(np.asarray(photoelectrons, np.float64))[None, :]
        if self.changes:
            seconds = self.exposures.seconds(self.exposures.begins(exposure, 1))
            probability = self.changes.probability(
                self.model, light, seconds, self.exposures.exposure_ticks / self.exposures.tick_hz
            )
        else:
            probability = first_click_probability(self.model, light)
        return sample_clicks(self.model, probability, self.seed, self.first_draw + exposure, before, self.carriers)[0]


class ShownSource:
    """The exposures that the host names one by one; one without a name is dark."""

    ahead, largest = 0, 1

    def __init__(self, walked: Walked, shows: ShowList) -> None:
        self._walked, self._shows = walked, shows

    def prepare(self, exposure: int) -> bool:
        """Nothing: what is shown is not known."""
        return False

    def expected_photoelectrons(self, number: int) -> float:
        """Not known: only the host knows the automaton."""
        return math.nan

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        stamps, clicks = np.full(count, DARK_PATTERN, np.uint16), np.zeros((count, 1), np.uint8)
        for place, exposure in enumerate(range(first, first + count)):
            shown, light = self._shows.take(exposure), 0.0
            if shown is not None:
                stamps[place] = shown.state
                light = self._walked.photoelectrons(exposure, shown.pattern, shown.light)
            clicks[place] = before = self._walked.click(exposure, light, before)
        return stamps, clicks


class Followed(ABC):
    """The exposures of an automaton that the device follows, of clicks or of photon numbers."""

    def __init__(self, walked: Walked, states: States, *, at_once: bool) -> None:
        """`at_once`: exposures of a cycle depend on nothing but the walk, so that they can be followed together."""
        self._walked, self._states = walked, states
        self._adaptive = walked.program.patterns == ADAPTIVE_PATTERN
        self._state = 0
        self._expected: dict[int, float] = {}  # by object of the scene
        self.ahead = walked.program.n_slots if at_once else 0

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        stamps, readings = np.full(count, DARK_PATTERN, np.uint16), np.zeros((count, 1), np.uint8)
        n_slots, at = self._walked.program.n_slots, 0
        while at < count:
            slot = (first + at) % n_slots
            if slot == 0:
                self._state = 0
            part = slice(at, at + min(n_slots - slot, count - at))
            follow = self._at_once if self.ahead else self._one_by_one
            follow(first + at, slot, stamps[part], readings[part], before)
            before, at = readings[part.stop - 1], part.stop
        return stamps, readings

    def expected_photoelectrons(self, number: int) -> float:
        """The photoelectrons that a walk on object `number` of the scene brings, in expectation and without what changes.

        NaN of one that bleaches: that depends on the walk.
        """
        if self._walked.sample is not None:
            return math.nan
        found = self._expected.get(number)
        if found is None:
            found = self._expected[number] = self._walk_light(self._light(number))
        return found

    def _light(self, number: int) -> F64:
        """Photoelectrons of an exposure in each state, float64 (states,)."""
        return np.asarray(self._walked.light.of(number)[self._states.pattern] * self._states.light)

    def _one_by_one(self, first: int, slot: int, stamps: U16, readings: U8, before: U8) -> None:
        """Follow the walk where the detector changes with time, or the object with its dose."""
        states = self._states
        for place, adaptive in enumerate(self._adaptive[slot : slot + len(stamps)].tolist()):
            lit = adaptive and self._state < len(states.pattern)
            readings[place] = before = self._expose(first + place, lit, before)
            if lit:
                stamps[place] = self._state
                self._state = int(states.successors[self._state, before[0]])

    @abstractmethod
    def _at_once(self, first: int, slot: int, stamps: U16, readings: U8, before: U8) -> None:
        """Follow the walk through exposures of one cycle in a compiled loop; stamps (n,) and readings (n, 1) are set."""

    @abstractmethod
    def _expose(self, exposure: int, lit: bool, before: U8) -> U8:
        """Draw one exposure, of the present state or in the dark, uint8 (1,), as `before` of the exposure before."""

    def _light_now(self, exposure: int, lit: bool) -> float:
        """The photoelectrons expected of an exposure, of the present state or in the dark."""
        if not lit:
            return 0.0
        pattern, share = int(self._states.pattern[self._state]), float(self._states.light[self._state])
        return self._walked.photoelectrons(exposure, pattern, share)

    @abstractmethod
    def _walk_light(self, light: F64) -> float:
        """The light of a walk in expectation, from that of its states (states,)."""


class WalkSource(Followed):
    """The clicks of an automaton that the device follows."""

    largest = 1

    def __init__(self, walked: Walked, states: States) -> None:
        super().__init__(walked, states, at_once=not walked.changing)
        self._kept: dict[int, U64] = {}

    def prepare(self, exposure: int) -> bool:
        """See `SlotSource`: the thresholds of one of the objects to come."""
        walked = self._walked
        if walked.changing:
            return False
        visit = walked.program.n_slots * walked.program.cycles_per_object
        for ahead in range(OBJECTS_AHEAD):
            number = walked.object_of(exposure + ahead * visit)
            if number not in self._kept:
                self._thresholds(number)
                self.expected_photoelectrons(number)
                return True
        return False

    def _at_once(self, first: int, slot: int, stamps: U16, readings: U8, before: U8) -> None:
        from . import walk_kernels

        walked = self._walked
        self._state = walk_kernels.follow(
            self._thresholds(walked.object_of(first)), self._states.successors, self._adaptive[slot : slot + len(stamps)],
            walk_kernels.key_of(walked.seed), walked.first_draw + first, (self._state, int(before[0])), stamps, readings[:, 0],
        )  # fmt: skip

    def _expose(self, exposure: int, lit: bool, before: U8) -> U8:
        return self._walked.click(exposure, self._light_now(exposure, lit), before)

    def _walk_light(self, light: F64) -> float:
        from . import walk_kernels

        chances = walk_kernels.chances(self._walked.model, light)
        return float(walk_kernels.expected_light(chances, light, self._states.successors))

    def _thresholds(self, number: int) -> U64:
        """What a number must be below to click, uint64 (2, states + 1): without and with a click before, the last column in the dark."""
        kept = self._kept.get(number)
        if kept is None:
            from . import walk_kernels

            light = np.append(self._light(number), 0.0)
            kept = walk_kernels.thresholds(self._walked.model, light)
            if len(self._kept) * kept.size > MAX_THRESHOLDS:
                self._kept.clear()
            self._kept[number] = kept
        return kept
