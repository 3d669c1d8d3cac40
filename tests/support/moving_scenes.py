"""Small scenes that move, and a program that looks at them: for tests of scenes and of the device."""

from typing import Any

import numpy as np

from pans.instrument.profile import Profile, load_profile
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import PARALLEL, Arm
from pans_sim.device.view import View
from pans_sim.scene.moving import Cells, Change, SceneFile, Tape
from pans_sim.scene.program import Program
from pans_sim.scene.still import Scene, scene_from_arrays

FLOW = load_profile("flow-snspd")
TICK_HZ = FLOW.clock.tick_hz
RNG = np.random.default_rng(11)
PICTURES: Scene = scene_from_arrays(
    "noise", RNG.integers(0, 256, (5, 6, 8), dtype=np.uint8), np.array([0, 1, 2, 1, 0]), ("a", "b", "c")
)
LEVELS = np.where(RNG.random((3, 48)) < 0.4, RNG.integers(1, 256, (3, 48)), 0).astype(np.uint16)
CELLS = Cells(PICTURES, 5e4, 40_000.0, 0.2, 2)
TAPE = Tape(10, 4, 50_000.0, 0.03, 1e-3)
BAR_LEVELS = np.where(RNG.random((3, 80)) < 0.4, RNG.integers(1, 256, (3, 80)), 0).astype(np.uint16)


def program(
    n_slots: int = 16, exposure: int = 200, period: int = 250, dark: tuple[int, ...] = (), gap: int = 0
) -> Program:
    shown = np.zeros(n_slots, np.uint16)
    shown[list(dark)] = wire.DARK_PATTERN
    offsets = np.arange(n_slots, dtype=np.int64) * period
    return Program(PARALLEL, 3, exposure, period, n_slots * period + gap, 1, offsets, shown, ((0, n_slots),))


def view_of(what: Any = CELLS, changes: tuple[Change, ...] = (), *, profile: Profile = FLOW, seed: int = 7) -> View:
    """The three-channel instrument before cells, a tape or pictures."""
    return View(profile, SceneFile("x", what, changes), seed=seed)


def light_and_clicks(view: View, plan: Program, cycles: int = 0, first_draw: int = 0) -> tuple[Any, Any]:
    """The light and the clicks of one run through this module's patterns."""
    levels = BAR_LEVELS if isinstance(view.scene.what, Tape) else LEVELS
    return view.light_and_clicks(plan, cycles, view.tabulate(plan, levels), first_draw)


def started(view: View, plan: Program, cycles: int = 0, first_draw: int = 0) -> Any:
    """A run through this module's patterns, armed for tick 1000."""
    levels = BAR_LEVELS if isinstance(view.scene.what, Tape) else LEVELS
    return view.run(plan, Arm(1000, cycles, 1), view.tabulate(plan, levels), first_draw)
