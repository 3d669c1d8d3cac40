"""The scene as it stands on the optical table: what the profile states of the optics and of readings that shift, and a hidden truth in its
place.

Owns the choice between the two; the light that follows is computed by scene/optics.py. A scene that moves has perfect optics or none.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pans.firmware_sim.scene.detector import uniform_numbers
from pans.firmware_sim.scene.detector_model import TELEGRAPH_STREAM
from pans.firmware_sim.scene.moving import ALL_CHANNELS, Change, SceneFile
from pans.firmware_sim.scene.scene_file import open_scene
from pans.firmware_sim.scene.still import Scene
from pans.runtime.errors import ConfigError
from pans.runtime.imaging import bleaching_of, imaging_of, is_spec
from pans.runtime.instrument.profile import Profile


def scene_on_table(
    name: str, changes: str, optics: str, profile: Profile, bleach: str = "", seed: int = 0
) -> SceneFile:
    """Open the scene `name` with `changes` where `profile` says, or where `optics` does; ConfigError for one that moves.

    `optics` is as of `--optics`; keys that it does not name are as the profile states them. `bleach` is as of `--bleach`; `seed` chooses
    the pixels that jump.
    """
    scene = _bleaching(open_scene(name, changes), bleach)
    imaging = profile.imaging()
    if is_spec(optics):
        imaging = imaging_of(optics, imaging)
    scene = _drifting(scene, profile)
    scene = replace(scene, changes=(*scene.changes, *reading_changes(profile, seed)))
    if imaging.is_identity:
        return scene
    if not isinstance(scene.what, Scene):
        raise ConfigError(
            f"scene {scene.name!r} moves: optics other than perfect ones are simulated for still objects",
            remedy="leave the optics out, or choose a scene of still objects",
        )
    return replace(scene, what=replace(scene.what, imaging=imaging))


def _bleaching(scene: SceneFile, bleach: str) -> SceneFile:
    if not bleach:
        return scene
    if not isinstance(scene.what, Scene):
        raise ConfigError(
            f"scene {scene.name!r} moves: bleaching is simulated for still objects",
            remedy="leave bleach= out, or choose a scene of still objects",
        )
    return replace(scene, what=replace(scene.what, bleaching=bleaching_of(bleach)))


def _drifting(scene: SceneFile, profile: Profile) -> SceneFile:
    """Let the source drift as the profile states, for as long as a run may last."""
    drift = 0.0 if profile.optics is None else profile.optics.source_drift_percent_per_hour
    if not drift:
        return scene
    return replace(scene, changes=(*scene.changes, Change("drift", 0.0, math.inf, ALL_CHANNELS, drift / 3600)))


def reading_changes(profile: Profile, seed: int) -> tuple[Change, ...]:
    """Return what the profile states of readings that shift: a threshold that drifts, and pixels that jump between two levels."""
    detector, changes = profile.detector, []
    if detector.threshold_drift_e_per_hour:
        changes.append(Change("threshold", 0.0, math.inf, ALL_CHANNELS, detector.threshold_drift_e_per_hour / 3600))
    jumping = round(detector.telegraph_share * detector.channels)
    order = np.argsort(uniform_numbers(seed, 0, detector.channels, 1, TELEGRAPH_STREAM)[:, 0])
    for channel in np.sort(order[:jumping]).tolist():
        changes.append(
            Change("telegraph", float(seed % 2**32), detector.telegraph_time_s, channel, detector.telegraph_offset_e)
        )
    return tuple(changes)
