"""What the instrument looks at, and through what: from a program and the uploaded patterns to a run.

The table of light is made once for each pattern set and exposure time, which takes seconds for many pictures in flow. A scene that
cannot be shown is refused when the instrument is switched on (ConfigError), patterns that do not fit it when they are tabulated
(`Refused`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError
from pans.bundle.sensor import Analyser
from pans.instrument.profile import Profile
from pans.protocol.wire import PARALLEL, AckStatus, Arm, ReadCounts
from pans_sim.scene.changes import Changes
from pans_sim.scene.detector_model import detector_model
from pans_sim.scene.drawing import ClickSource
from pans_sim.scene.light import RunLight, StillMarks, StillObjects, Table, begin, prepare, tabulate, warm_up
from pans_sim.scene.moving import SceneFile
from pans_sim.scene.optics import passive_photoelectrons
from pans_sim.scene.program import Exposures, Program, States
from pans_sim.scene.still import Scene

from .bleached import bleached_photoelectrons
from .sequential import Measurement
from .states import ShowList
from .upload import Refused
from .walking import NumberSource, PatternLight, PlanSource, ShownSource, Walked, WalkSource

if TYPE_CHECKING:
    from .parallel import FrameRun


CLICKS = ReadCounts(1, 1)  # of one detector


@dataclass(frozen=True, slots=True)
class View:
    """A profile's detector before a scene, with patterns from its projector or, where `optics` are given, behind passive ones."""

    profile: Profile
    scene: SceneFile
    optics: Analyser | None = None
    seed: int = 0
    short_ticks: int = 0  # by which exposures are shorter than planned

    @property
    def bleaches(self) -> bool:
        """Whether light changes the objects."""
        return isinstance(self.scene.what, Scene) and not self.scene.what.bleaching.is_none

    def check_and_warm_up(self) -> None:
        """Refuse what the simulator cannot do with a scene that moves, and compile the kernels: later nothing may wait for that."""
        if self.scene.moves and self.profile.mode != "parallel":
            raise ConfigError(
                f"scene {self.scene.name!r} moves, and {self.profile.name} shows pattern after pattern: "
                "objects would be gone before the last one",
                remedy="choose a parallel profile, such as flow-snspd",
            )
        if self.scene.moves and self.optics is not None:
            raise ConfigError(
                f"scene {self.scene.name!r} moves: not yet possible behind passive optics", remedy="leave optics= out"
            )
        if self.bleaches and (self.profile.mode != "sequential" or self.optics is not None):
            raise ConfigError(
                "bleaching is simulated where pattern follows pattern: not in parallel mode, not behind passive optics",
                remedy="leave bleach= out, or choose a sequential profile and no optics=",
            )
        warm_up(self.scene)
        if self.profile.mode == "parallel":
            from pans_sim.scene import detector_kernels

            from . import frame_writer

            detector_kernels.warm_up()
            frame_writer.warm_up()

    def exposure_ticks(self, program: Program) -> int:
        """The ticks that an exposure of `program` lasts: as planned, unless there is a fault."""
        return max(1, program.exposure_ticks - self.short_ticks)

    def exposure_us(self, program: Program) -> float:
        """The exposure time of `program` on this instrument's clock."""
        return self.exposure_ticks(program) * 1e6 / self.profile.clock.tick_hz

    def stay(self, program: Program) -> bytes:
        """What the light of an object's stay depends on beside the patterns: where it bleaches, their order; else nothing."""
        if not self.bleaches:
            return b""
        return program.cycles_per_object.to_bytes(8, "little") + program.patterns.tobytes()

    def tabulate(self, program: Program, patterns: NDArray[np.uint16] | None, largest: int = 1) -> Table | PatternLight:
        """Return the light of the scene through `patterns`, uint16 (n, pixels), or through the optics; `Refused` if they do not fit.

        `largest` is the largest number that is read, 1 of clicks.
        """
        exposure_us = self.exposure_us(program)
        try:
            if patterns is not None and (program.adaptive or largest > 1):
                assert isinstance(self.scene.what, Scene)  # see check_and_warm_up
                return PatternLight(self.profile, self.scene.what, patterns, exposure_us)
            if patterns is not None and self.bleaches:
                assert isinstance(self.scene.what, Scene)
                photons = bleached_photoelectrons(self.profile, self.scene.what, patterns, program, exposure_us)
                return tabulate(self.profile, photons, exposure_us)
            if patterns is not None:
                return prepare(self.profile, self.scene, patterns, exposure_us)
            assert self.optics is not None
            if program.n_patterns != len(self.optics.matrix):
                text = (
                    f"a plan of {program.n_patterns} patterns, the optics lead to {len(self.optics.matrix)} detectors"
                )
                raise Refused(AckStatus.OUT_OF_RANGE, text)
            assert isinstance(self.scene.what, Scene)  # see check_and_warm_up
            photons = passive_photoelectrons(self.optics, self.scene.what, exposure_us)
            return tabulate(self.profile, photons, exposure_us)
        except ValueError as error:
            raise Refused(AckStatus.OUT_OF_RANGE, str(error)) from error

    def light_and_clicks(
        self, program: Program, n_cycles: int, table: Table, first_draw: int = 0
    ) -> tuple[RunLight, ClickSource]:
        """Start the scene; `first_draw` counts the exposures of earlier runs, 0 cycles last until STOP."""
        exposures = Exposures(program, n_cycles or None, self.profile.clock.tick_hz)
        changes = Changes(self.scene.changes, program.channels)
        light = begin(self.scene, table, program, exposures, changes, self.seed, first_draw)
        model = detector_model(self.profile, self.exposure_us(program))
        return light, ClickSource(light, exposures, model, changes, self.seed, first_draw)

    def run(
        self,
        program: Program,
        arm: Arm,
        table: Table | PatternLight,
        first_draw: int = 0,
        drive: States | ShowList | None = None,
        reading: ReadCounts = CLICKS,
    ) -> Measurement | FrameRun:
        """Return the run that ARM starts: pattern after pattern, or of all channels at once; `drive` chooses patterns by the clicks.

        `reading` says what number every exposure is.
        """
        if isinstance(table, PatternLight):
            return self._one_by_one(program, arm, table, first_draw, drive, reading)
        light, source = self.light_and_clicks(program, arm.n_cycles, table, first_draw)
        if isinstance(light, StillObjects) and program.mode != PARALLEL:
            return Measurement(program, arm, light, PlanSource(program, source))
        from .parallel import FrameRun  # numba is loaded only for parallel instruments

        return FrameRun(program, arm, light, source, self.scene.moves)

    def _one_by_one(
        self,
        program: Program,
        arm: Arm,
        light: PatternLight,
        first_draw: int,
        drive: States | ShowList | None,
        reading: ReadCounts,
    ) -> Measurement:
        scene = self.scene.what
        assert isinstance(scene, Scene)
        if reading.channels > 1 and self.bleaches:
            raise Refused(AckStatus.OUT_OF_RANGE, "bleaching under several patterns at once is not simulated")
        exposures = Exposures(program, arm.n_cycles or None, self.profile.clock.tick_hz)
        changes = Changes(self.scene.changes, reading.channels)
        model = detector_model(self.profile, self.exposure_us(program))
        facts = (scene.n_objects, exposures, changes, model, self.seed, first_draw)
        walked = Walked(program, light, *facts, light.fresh_sample(), np.zeros(reading.channels))
        from .readings import Clicks, Numbers  # numba is loaded only where exposures are read by themselves

        channels = reading.channels
        numbers = reading.largest > 1 and channels == 1
        reader = Numbers(walked, reading.largest) if numbers else Clicks(walked, channels)
        source: NumberSource | ShownSource | WalkSource
        if drive is None:
            source = NumberSource(walked, reader)
        elif isinstance(drive, ShowList):
            source = ShownSource(reader, drive, channels)
        else:
            source = WalkSource(walked, reader, drive, channels)
        marks = StillMarks(scene, program, exposures, changes, source.expected_photoelectrons)
        return Measurement(program, arm, marks, source)
