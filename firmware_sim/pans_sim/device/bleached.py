"""Objects that bleach: their light depends on all that was shown to them since they came (`pans.instrument.optics.bleaching`).

Patterns of a plan are tabulated exposure by exposure; of an automaton, one sample is kept, which the walk bleaches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.instrument.optics import bleached, mean_left
from pans.instrument.profile import Profile
from pans.protocol.wire import DARK_PATTERN, NO_OBJECT
from pans_sim.scene.optics import MAX_TABLE_ENTRIES, patterns_met, transmissions
from pans_sim.scene.program import Program
from pans_sim.scene.still import Scene

MAX_PIXELS_MET = 1 << 24  # exposures or patterns times pixels, float64: 128 MiB
_OBJECTS_AT_ONCE = 1024

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def bleached_photoelectrons(
    profile: Profile, scene: Scene, levels: NDArray[np.uint16], program: Program, exposure_us: float
) -> F64:
    """Return photoelectrons, float64 (objects, exposures), of all exposures of one object's stay; ValueError for too many.

    `levels` uint16 (patterns, pixels); an object stays for `cycles_per_object` cycles of the program.
    """
    stay, n_pixels = program.n_slots * program.cycles_per_object, levels.shape[1]
    if scene.n_objects * (stay + 1) > MAX_TABLE_ENTRIES or stay * n_pixels > MAX_PIXELS_MET:
        raise ValueError(
            f"{scene.n_objects} objects that bleach through {stay} exposures of {n_pixels} pixels, allowed: "
            f"{MAX_TABLE_ENTRIES} objects times exposures, {MAX_PIXELS_MET} exposures times pixels"
        )
    if not scene.lit:
        return np.zeros((scene.n_objects, stay))
    shown = np.tile(program.patterns.astype(np.int64), program.cycles_per_object)
    light = np.concatenate([patterns_met(profile, scene, levels, exposure_us), np.zeros((1, n_pixels))])
    acts = bleached(scene.bleaching, light[np.where(shown == DARK_PATTERN, len(levels), shown)])
    found = np.empty((scene.n_objects, stay))
    for first in range(0, scene.n_objects, _OBJECTS_AT_ONCE):
        numbers = np.arange(first, min(first + _OBJECTS_AT_ONCE, scene.n_objects))
        found[numbers] = transmissions(profile, scene, numbers, n_pixels) @ acts.T
    return found


class Sample:
    """The object before an automaton, as the light of its walks has left it."""

    def __init__(self, profile: Profile, scene: Scene, levels: NDArray[np.uint16], exposure_us: float) -> None:
        self._profile, self._scene, self._levels, self._exposure_us = profile, scene, levels, exposure_us
        self._met = patterns_met(profile, scene, levels, exposure_us) if levels.size <= MAX_PIXELS_MET else None
        self._visit, self._left = -1, np.zeros(levels.shape[1])

    def photoelectrons(self, visit: int, pattern: int, share: float) -> float:
        """Show `pattern` for `share` of an exposure to the object that has come as number `visit`; a new one is fresh."""
        if visit != self._visit:
            number = np.array([visit % NO_OBJECT % self._scene.n_objects])
            self._visit, self._left = visit, transmissions(self._profile, self._scene, number, len(self._left))[0]
        if not self._scene.lit:
            return 0.0
        light = self._pattern(pattern) * share
        dose = self._scene.bleaching.doses(light)
        found = float(self._left @ (light * mean_left(dose)))
        self._left = self._left * np.exp(-dose)
        return found

    def _pattern(self, number: int) -> F64:
        if self._met is not None:
            return np.asarray(self._met[number])
        return patterns_met(self._profile, self._scene, self._levels[[number]], self._exposure_us)[0]
