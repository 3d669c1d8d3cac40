"""Small flows for whole runs: an instrument, what passes before it, a bundle, a plan and a core, of cells or of a tape. SIMULATED.

Blocks are 0.2 ms apart, as those of pans.firmware_sim.testing, so that faults every second meet a flow as they meet still objects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pans.firmware_sim.scene.moving import Cells, SceneFile, Tape
from pans.firmware_sim.scene.still import scene_from_arrays
from pans.runtime.bundle.model import BackEnd, Bundle, Shown, make_bundle
from pans.runtime.core.plan import Plan
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.make import make_flow_core, plan_flow
from pans.runtime.flow.settings import FlowSettings
from pans.runtime.instrument.profile import Profile, load_profile

KINDS = ("cells", "cells-dark", "tape", "tape-tracked")
EXPOSURE_US, BLOCK_US = 20.0, 200.0
SIDE = 16  # pixels of a cell's picture
BARS, PIXELS_PER_BAR = 6, 4
BARS_PER_S = 1500.0  # 33 exposures each
_CELLS = FlowSettings(
    "cells", block_us=BLOCK_US, fields_per_s=2000.0, onset_frames=4, gate_delay_us=20_000.0, gate_classes=("a", "b")
)
_TAPE = FlowSettings(
    "tape", block_us=BLOCK_US, bars_per_s=BARS_PER_S, gate_delay_us=20_000.0, gate_us=30.0, gate_classes=("yes",)
)
SETTINGS = {
    "cells": _CELLS,
    "cells-dark": FlowSettings(**(_CELLS.as_header() | {"dark_every": 2, "gate_classes": ("a",), "sure": 0.6})),
    "tape": _TAPE,
    # the tape is faster than said
    "tape-tracked": FlowSettings(**(_TAPE.as_header() | {"bars_per_s": 1480.0, "track": 3, "gate_classes": ()})),
}


@dataclass(frozen=True, slots=True)
class SmallFlow:
    """What a run of a flow needs; `core` makes one that follows `n_cycles` cycles, 0 until it is stopped."""

    profile: Profile
    bundle: Bundle
    plan: Plan
    settings: FlowSettings
    scene: SceneFile
    decider: Decider
    dark_probability: float

    def core(self, n_cycles: int) -> FlowCore:
        """Return a fresh core."""
        classes, dark = self.bundle.classes, self.dark_probability
        return make_flow_core(
            self.plan, self.decider, self.settings, classes, shots=1, dark_probability=dark, n_cycles=n_cycles
        )


def small_flow(kind: str) -> SmallFlow:
    """Return the small flow `kind`, one of KINDS."""
    profile, settings = load_profile("flow-snspd"), SETTINGS[kind]
    bundle, scene = _cells(profile) if settings.kind == "cells" else _tape(profile)
    decider = make_decider(bundle, backend="table")
    plan, core, _ = plan_flow(profile, bundle, decider, settings, 1, 0.0)
    return SmallFlow(profile, bundle, plan, settings, scene, decider, core.dark_probability)


def _cells(profile: Profile) -> tuple[Bundle, SceneFile]:
    """Cells of three classes, each with another third of its rows lit, and patterns that tell the thirds apart."""
    images = np.zeros((6, SIDE, SIDE), np.uint8)
    levels = np.zeros((3, SIDE, SIDE), np.uint16)
    for third in range(3):
        rows = slice(5 * third, 5 * third + 5)
        images[third::3, rows, 4:12] = 200
        levels[third, rows, 4:12] = 2
    levels[0, 0, 0] = profile.projector.levels - 1  # beside every cell
    objects = scene_from_arrays("cells", images, np.arange(6) % 3, ("a", "b", "c"))
    words = (np.arange(8)[:, None] >> np.arange(3)) & 1
    bundle = _bundle(profile, "small cells", ("a", "b", "c"), (SIDE, SIDE), levels, 4.0 * words)
    return bundle, SceneFile("cells", Cells(objects, 500.0, 2000.0, 0.05))


def _tape(profile: Profile) -> tuple[Bundle, SceneFile]:
    """A window of bars, each with a pattern on its middle pixels, and a class for the windows that contain 1010."""
    levels = np.zeros((BARS, BARS, PIXELS_PER_BAR), np.uint16)
    levels[np.arange(BARS), np.arange(BARS), 1:3] = 20
    levels[0, 0, 1] = profile.projector.levels - 1
    has = ["1010" in "".join(str(word >> bar & 1) for bar in range(BARS)) for word in range(1 << BARS)]
    scores = np.where(np.array(has)[:, None], [0.0, 3.0], [3.0, 0.0])
    bundle = _bundle(profile, "small tape", ("no", "yes"), (1, BARS * PIXELS_PER_BAR), levels, scores)
    return bundle, SceneFile("tape", Tape(BARS, PIXELS_PER_BAR, BARS_PER_S, jitter_bars=0.02, jitter_time_s=0.1))


def _bundle(
    profile: Profile,
    name: str,
    classes: tuple[str, ...],
    shape: tuple[int, int],
    levels: np.ndarray,
    scores: np.ndarray,
) -> Bundle:
    top = profile.projector.peak_photoelectrons_hz * EXPOSURE_US * 1e-6
    shown = Shown(
        profile.projector.levels,
        levels.reshape(len(levels), -1),
        photons_per_level=top / (profile.projector.levels - 1),
    )
    back_end = BackEnd(table=scores.astype(np.float32))
    return make_bundle(
        name=name, task="small", classes=classes, image_shape=shape, optics=shown, back_end=back_end, provenance={}
    )
