"""The C core in this process with the simulator's own physics as its hardware: what is compared with the simulator's `Instrument`."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pans.instrument.profile import Profile
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN
from pans.protocol.wire.commands import MODES, PatternChunk
from pans_sim.device import readings
from pans_sim.device.gates import GATE_CHANNELS, MAX_PENDING_GATES
from pans_sim.device.upload import MAX_PATTERN_PIXELS, PatternMemory, Refused
from pans_sim.device.view import View
from pans_sim.pc_instrument.core import Core, Hardware, find_compiler, limits_of, states_of
from pans_sim.scene.detector import sample_clicks
from pans_sim.scene.detector_model import detector_model, first_click_probability
from pans_sim.scene.light import LightTable
from pans_sim.scene.program import Program, States
from pans_sim.scene.scene_file import open_scene

COMPILER = find_compiler()


class SimulatedHardware(Hardware):
    """A scene before the detector of `view`; clicks are drawn by the number of the exposure since power-on, as the simulator does."""

    def __init__(self, view: View) -> None:
        self._view, self._draw, self._key = view, -1, None
        self._forget(1)

    def _forget(self, revision: int) -> None:
        projector = self._view.profile.projector
        pixels = min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS)
        self._patterns = PatternMemory(projector.pattern_memory, pixels, projector.levels, revision)

    def store(self, chunk: PatternChunk | None) -> None:
        if chunk is None:
            self._forget(self._patterns.revision + 1)
        else:
            with suppress(Refused):  # a projector takes what it is sent: to refuse is the core's part
                self._patterns.load(chunk)

    def prepare(self, task: Any) -> None:
        view, ticks, n_patterns = self._view, task.exposure_ticks, task.n_patterns
        shown = np.full(1, ADAPTIVE_PATTERN if task.adaptive else 0, np.uint16)
        mode, one = MODES[view.profile.mode], np.zeros(1, np.int64)
        program = Program(mode, n_patterns, ticks, 1, ticks, 1, one, shown, ((0, 1),))
        key = (self._patterns.revision, n_patterns, ticks, task.adaptive)
        if self._key != key:
            self._key, self._light = key, view.tabulate(program, self._patterns.stack(n_patterns))
        self._model, self._channels = detector_model(view.profile, view.exposure_us(program)), program.channels
        rows = states_of(task)
        self._states = States(rows[:, 0], rows[:, 1] / np.maximum(rows[:, 2], 1), rows[:, 3:])

    def expose(self, exposure: Any) -> int:
        if exposure.number == 0:
            self._before = np.zeros(self._channels, np.uint8)
        self._draw += 1
        self._end, light = exposure.tick + exposure.ticks, exposure.light
        number = exposure.object % self._view.scene.n_objects
        self._probability = self._of(number, light.pattern, light.dwell / light.dwell_steps)
        return exposure.tick

    def clicks(self) -> tuple[int, Any]:
        drawn = sample_clicks(self._model, self._probability[None, :], self._view.seed, self._draw, self._before)
        self._before = drawn[0]
        return self._end, drawn[0]

    def mark(self, number: int) -> tuple[int, float]:
        scene, light = self._view.scene, self._light
        here, photons = number % scene.n_objects, math.nan
        if isinstance(light, LightTable):
            photons = float(light.photoelectrons[here].sum())
        elif len(self._states.pattern):
            lit = np.asarray(light.of(here)[self._states.pattern] * self._states.light)
            click = readings.click_chances(self._model, lit)
            photons = readings.expected_light(np.stack([1 - click, click], axis=1), lit, self._states.successors)
        return int(scene.what.labels[here]), photons

    def _of(self, number: int, pattern: int, share: float) -> Any:
        """The chance of a click of each channel, without the exposure before."""
        light, lit = self._light, pattern != DARK_PATTERN
        if not isinstance(light, LightTable):
            return first_click_probability(self._model, np.array([light.of(number)[pattern] * share if lit else 0.0]))
        row = light.probability[number]
        if self._view.profile.mode == "parallel":
            return row[:-1] if lit else np.repeat(row[-1:], len(row) - 1)
        return row[pattern : pattern + 1] if lit else row[-1:]


class CDevice(Core):
    """The C core before a scene from power-on at `tick`: a `SteppedDevice`."""

    def __init__(
        self, profile: Profile, scene: Any = None, *, tick: int = 0, seed: int = 0, buffer: int = 256,
        library: Path | None = None,
    ) -> None:  # fmt: skip
        scene = scene or open_scene("uniform")
        view = View(profile, scene, None, seed)
        view.check_and_warm_up()
        readings.warm_up()
        facts = {"profile": profile.name, "scene": scene.name[:60], "objects": scene.n_objects, "seed": seed}
        gates = {"gate_outputs": GATE_CHANNELS, "gate_pulses": MAX_PENDING_GATES}
        words = {"simulated": True, "buffer_messages": buffer, "epoch": 1, **gates}
        serial = f"SIM-{seed & 0xFFFFFFFF:08X}"
        limits = limits_of(profile, facts, firmware="pans-reference 1", serial=serial, **words)
        super().__init__(limits, SimulatedHardware(view), tick, library)
