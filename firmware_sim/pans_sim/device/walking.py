"""What the exposures of a sequential run show, and what is read of them, one slot after the other.

Three kinds of run: fixed patterns, an automaton that the device follows, states that the host names. Each asks a reader (readings.py) for
what the detector reads. Light and walk share no code with the host's check of the walks, so that each tests the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pans.instrument.profile import Profile
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, NO_OBJECT
from pans_sim.scene.changes import Changes
from pans_sim.scene.detector_model import DetectorModel
from pans_sim.scene.drawing import ClickSource
from pans_sim.scene.optics import expected_photoelectrons
from pans_sim.scene.program import Exposures, Program, States
from pans_sim.scene.still import Scene

from .bleached import Sample
from .states import ShowList

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
BATCH_EXPOSURES = 1 << 14  # of a plan with fixed patterns, drawn at a time
MOST_AHEAD = 1024  # the same of photon numbers: an object may stay for as many as the host likes
BLOCK_ENTRIES = 1 << 20  # objects times patterns that are computed at a time
OBJECTS_AHEAD = 3  # for whose walks everything is made where there is time
MAX_BLOCKS = 4  # and how many of those are kept: 32 MiB of float64


class Reader(Protocol):
    """What a detector reads; see readings.Clicks."""

    largest: int
    at_once: bool  # whether exposures of a cycle depend on nothing but the walk, so that they can be followed together

    def light(self, exposure: int, pattern: int, share: float) -> F64: ...

    def read(self, first: int, light: F64, before: U8) -> U8: ...

    def prepare(self, number: int, states: States) -> bool: ...

    def follow(
        self, first: int, node: int, states: States, adaptive: NDArray[np.bool_], before: U8, stamps: U16, readings: U8
    ) -> int: ...

    def expected_light(self, number: int, states: States) -> float: ...


class SlotSource(Protocol):
    """The exposures of a sequential run, asked for in their order, `ahead` of them at a time where they are known."""

    ahead: int
    largest: int  # number that an exposure can have: 1 of clicks

    def prepare(self, exposure: int) -> bool:
        """Do a piece of work of a fraction of a millisecond that `exposure` or those after it will need; whether there was any."""

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """Return what is stamped, uint16 (count,), and what is read, uint8 (count, 1), of exposures from `first` on.

        before uint8 (1,): the reading of the one before.
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
        # a patternset that does not fit raises here
        for block in range(min(MAX_BLOCKS, -(-scene.n_objects // self._at_a_time))):
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
    """What every exposure depends on that is read by itself; `first_draw` exposures were drawn in earlier runs."""

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


class NumberSource:
    """The exposures of a plan whose patterns are fixed, read as photon numbers."""

    def __init__(self, walked: Walked, reader: Reader) -> None:
        self._walked, self._reader, self.largest = walked, reader, reader.largest
        self.ahead = min(walked.program.n_slots * walked.program.cycles_per_object, MOST_AHEAD)

    def prepare(self, exposure: int) -> bool:
        """Nothing."""
        return False

    def expected_photoelectrons(self, number: int) -> float:
        """The photoelectrons of one exposure of every pattern on object `number` of the scene; NaN of one that bleaches."""
        return math.nan if self._walked.sample is not None else float(self._walked.light.of(number).sum())

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        light, program = np.zeros((count, 1)), self._walked.program
        shown = program.patterns[np.arange(first, first + count) % program.n_slots]
        for place in np.flatnonzero(shown != DARK_PATTERN).tolist():
            light[place] = self._reader.light(first + place, int(shown[place]), 1.0)
        return shown, self._reader.read(first, light, before)


class ShownSource:
    """The exposures that the host names one by one; one without a name is dark."""

    ahead = 0

    def __init__(self, reader: Reader, shows: ShowList, channels: int) -> None:
        self._reader, self._shows, self._channels, self.largest = reader, shows, channels, reader.largest

    def prepare(self, exposure: int) -> bool:
        """Nothing: what is shown is not known."""
        return False

    def expected_photoelectrons(self, number: int) -> float:
        """Not known: only the host knows the automaton."""
        return math.nan

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        stamps, light = np.full(count, DARK_PATTERN, np.uint16), np.zeros((count, self._channels))
        for place, exposure in enumerate(range(first, first + count)):
            shown = self._shows.take(exposure)
            if shown is not None:
                stamps[place] = shown.state
                light[place] = self._reader.light(exposure, shown.pattern, shown.light)
        return stamps, self._reader.read(first, light, before)


class WalkSource:
    """The exposures of an automaton that the device follows."""

    def __init__(self, walked: Walked, reader: Reader, states: States, channels: int) -> None:
        self._walked, self._reader, self._states, self._channels = walked, reader, states, channels
        self._adaptive = walked.program.patterns == ADAPTIVE_PATTERN
        self._state, self.largest = 0, reader.largest
        self._expected: dict[int, float] = {}  # by object of the scene
        self.ahead = walked.program.n_slots if reader.at_once else 0

    def prepare(self, exposure: int) -> bool:
        """See `SlotSource`: what a walk on one of the objects to come needs, and what its mark says of its light."""
        visit = self._walked.program.n_slots * self._walked.program.cycles_per_object
        for ahead in range(OBJECTS_AHEAD):
            number = self._walked.object_of(exposure + ahead * visit)
            if self._reader.prepare(number, self._states):
                return True
            if self._walked.sample is None and number not in self._expected:
                self.expected_photoelectrons(number)
                return True
        return False

    def exposures(self, first: int, count: int, before: U8) -> tuple[U16, U8]:
        """See `SlotSource`."""
        stamps, readings = np.full(count, DARK_PATTERN, np.uint16), np.zeros((count, 1), np.uint8)
        n_slots, at = self._walked.program.n_slots, 0
        while at < count:
            slot = (first + at) % n_slots
            if slot == 0:
                self._state = 0
            part = slice(at, at + min(n_slots - slot, count - at))
            follow = self._together if self._reader.at_once else self._one_by_one
            follow(first + at, slot, stamps[part], readings[part], before)
            before, at = readings[part.stop - 1], part.stop
        return stamps, readings

    def expected_photoelectrons(self, number: int) -> float:
        """The photoelectrons that a walk on object `number` of the scene brings, in expectation and without what changes.

        NaN of one that bleaches: that depends on the walk.
        """
        if self._walked.sample is not None:
            return math.nan
        if number not in self._expected:
            self._expected[number] = self._reader.expected_light(number, self._states)
        return self._expected[number]

    def _together(self, first: int, slot: int, stamps: U16, readings: U8, before: U8) -> None:
        """Follow the walk through exposures of one cycle in a compiled loop; stamps (n,) and readings (n, 1) are set."""
        adaptive = self._adaptive[slot : slot + len(stamps)]
        node, states = self._state, self._states
        self._state = self._reader.follow(first, node, states, adaptive, before, stamps, readings[:, 0])

    def _one_by_one(self, first: int, slot: int, stamps: U16, readings: U8, before: U8) -> None:
        """Follow the walk where the detector changes with time, or the object with its dose."""
        states = self._states
        for place, adaptive in enumerate(self._adaptive[slot : slot + len(stamps)].tolist()):
            node, light = self._state, np.zeros(self._channels)
            lit = adaptive and node < len(states.pattern)
            if lit:
                light = self._reader.light(first + place, int(states.pattern[node]), float(states.light[node]))
            readings[place] = before = self._reader.read(first + place, light[None, :], before)[0]
            if lit:
                stamps[place] = node
                self._state = int(states.successors[node, before[0]])
