"""What WELCOME says of a simulated instrument, its scene and its optics."""

from __future__ import annotations

from typing import Any, NamedTuple

from pans.instrument.click_law import cannot_count
from pans.instrument.optics import IDENTITY, NO_BLEACHING
from pans.instrument.profile import Profile
from pans.live.loop import scene_facts
from pans.protocol.wire import EXPOSED_SCHEMA, Extension, announcement, count_announcement
from pans_sim.scene.moving import SceneFile, Tape
from pans_sim.scene.still import Scene

from .gates import GATE_CHANNELS
from .upload import MAX_PATTERN_PIXELS, MAX_SLOTS
from .view import View

FIRMWARE = "pans-sim 1"


def largest_number(profile: Profile) -> int:
    """Return the largest photon number that the detector of `profile` tells; 1 of one that only clicks."""
    largest = profile.detector.photon_number_max
    return largest if largest > 1 and not cannot_count(profile, largest + 1) else 1


class Now(NamedTuple):
    """What changes while the instrument runs."""

    epoch: int
    tick: int
    buffer_messages: int


def facts_of(view: View, extension: Extension | None, number_max: int, now: Now) -> dict[str, Any]:
    """Return WELCOME's map; `extension` None: no automata; `number_max` 1: clicks."""
    profile, optics, scene = view.profile, view.optics, view.scene
    projector = profile.projector
    passive = {} if optics is None else {"optics_sha256": optics.fingerprint}
    automata = {} if extension is None else announcement(extension)
    at_once = profile.detector.channels if extension is not None else 1
    counts = count_announcement(number_max, at_once)
    return (
        passive
        | _table_facts(scene)
        | automata
        | counts
        | _image_facts(scene)
        | {
            "exposed_schema": EXPOSED_SCHEMA,
            "firmware": FIRMWARE,
            "serial": f"SIM-{view.seed & 0xFFFFFFFF:08X}",
            "epoch": now.epoch,
            "tick_hz": profile.clock.tick_hz,
            "tick": now.tick,
            "mode": profile.mode,
            "channels": profile.detector.channels,
            "levels": projector.levels,
            "pattern_memory": projector.pattern_memory,
            "pattern_pixels": min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS),
            "slot_memory": MAX_SLOTS,
            "buffer_messages": now.buffer_messages,
            "simulated": True,
            "profile": profile.name,
            "gate_channels": GATE_CHANNELS,
            "scene": scene.name[:60],  # a receiver takes at most 256 bytes of text
            "objects": scene.n_objects,
            "seed": view.seed,
        }
    )


def _table_facts(scene: SceneFile) -> dict[str, Any]:
    """Return what WELCOME says of imperfect optics and of bleaching: a run against a hidden truth must not pass for another one."""
    imaging = scene.what.imaging if isinstance(scene.what, Scene) else IDENTITY
    optics = {} if imaging.is_identity else {"simulated_optics": imaging.words()[:200]}
    bleaching = scene.what.bleaching if isinstance(scene.what, Scene) else NO_BLEACHING
    return optics if bleaching.is_none else optics | {"simulated_bleaching": bleaching.words()}


def _image_facts(scene: SceneFile) -> dict[str, Any]:
    """Return what WELCOME says of the scene's images; a target has any size, and what moves has its own."""
    if isinstance(scene.what, Tape):
        return {}
    if not isinstance(scene.what, Scene):
        return scene_facts(None, scene.what.objects.classes)
    height, width = scene.what.images.shape[1:]
    return scene_facts(None if (height, width) == (1, 1) else (height, width), scene.what.classes)
