"""One armed run of a program: which stream message is due at which tick, and what is in it.

Owns the schedule of exposures, objects and blocks and the clicks drawn for them; never knows about sessions, windows or
buffers (device.py). `Measurement.emit` returns messages without sequence number and drop count, which the device adds.
Clicks are drawn ahead in batches: they depend on the exposure's number alone, so the batch size changes nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.profile import Profile
from pans.runtime.wire import DARK_PATTERN, NO_OBJECT, AckStatus, ClickBlock, FrameBlock, Mark
from pans.runtime.wire_commands import PARALLEL, Arm

from .detector import DetectorModel, detector_model, first_click_probability, sample_clicks
from .optics import expected_photoelectrons
from .scene import Scene
from .upload import Program, Refused, word_bytes

BATCH_NUMBERS = 1 << 14
MAX_LEASE_MS = 3_600_000
MAX_ARM_AHEAD_S = 3600
MAX_TICK = 1 << 62

StreamMessage = ClickBlock | FrameBlock | Mark


class LightTable(NamedTuple):
    """Every object under every pattern: click probabilities and expected photons of one shot.

    `probability` is float64 (objects, patterns + 1), the last column is the dark pattern; `photons` is float64 (objects,).
    """

    probability: NDArray[np.float64]
    photons: NDArray[np.float64]


def light_table(profile: Profile, scene: Scene, levels: NDArray[np.uint16], exposure_us: float) -> LightTable:
    """Tabulate a loaded pattern set, uint16 (patterns, pixels); ConfigError when it does not fit the scene."""
    return tabulate(profile, expected_photoelectrons(profile, scene, levels, exposure_us), exposure_us)


def tabulate(profile: Profile, photons: NDArray[np.float64], exposure_us: float) -> LightTable:
    """Return the table of expected photoelectrons (objects, patterns) of one exposure each."""
    with_dark = np.column_stack([photons, np.zeros(len(photons))])
    model = detector_model(profile, exposure_us)
    return LightTable(first_click_probability(model, with_dark), photons.sum(axis=1))


def check_arm(program: Program, arm: Arm, now: int, tick_hz: int) -> None:
    """Raise `Refused` when `program` cannot be started as `arm` says at tick `now`."""
    if arm.start_tick <= now:
        raise Refused(AckStatus.TOO_LATE, f"start tick {arm.start_tick} has passed, it is {now}")
    if arm.start_tick > now + MAX_ARM_AHEAD_S * tick_hz:
        raise Refused(AckStatus.OUT_OF_RANGE, f"start tick {arm.start_tick} is more than {MAX_ARM_AHEAD_S} s ahead")
    if not 0 < arm.lease_ms <= MAX_LEASE_MS:
        raise Refused(AckStatus.OUT_OF_RANGE, f"lease of {arm.lease_ms} ms: allowed 1..{MAX_LEASE_MS}")
    if arm.start_tick + max(program.cycle_ticks, program.n_slots) * arm.n_cycles >= MAX_TICK:
        raise Refused(AckStatus.OUT_OF_RANGE, f"{arm.n_cycles} cycles last beyond tick {MAX_TICK}")


class Measurement:
    """The run that ARM started; `next_tick` is the tick of the next message, None after the last."""

    def __init__(
        self,
        program: Program,
        arm: Arm,
        scene: Scene,
        light: LightTable,
        model: DetectorModel,
        seed: int,
        first_draw: int,
    ) -> None:
        self._program = program
        self._start_tick = arm.start_tick
        self._n_cycles = arm.n_cycles or None
        self._scene = scene
        self._light = light
        self._model = model
        self._seed = seed
        self._first_draw = first_draw  # exposures drawn in earlier runs: no number is used twice
        self._column = np.where(program.patterns == DARK_PATTERN, program.n_patterns, program.patterns).astype(np.int64)
        self._word_bytes = word_bytes(program.channels)
        self._cycle, self._block, self._marked = 0, 0, False
        self._batch = np.zeros((0, program.channels), np.uint8)
        self._batch_first = 0
        self._before_batch = np.zeros(program.channels, np.uint8)
        self.next_tick: int | None = None
        self._schedule()

    @property
    def start_tick(self) -> int:
        return self._start_tick

    @property
    def end_tick(self) -> int | None:
        """Tick at which the last cycle is over; None when the run lasts until STOP."""
        return None if self._n_cycles is None else self._start_tick + self._n_cycles * self._program.cycle_ticks

    def begun_by(self, tick: int) -> int:
        """Number of exposures that have begun before or at `tick`."""
        if tick < self._start_tick:
            return 0
        cycle, within = divmod(tick - self._start_tick, self._program.cycle_ticks)
        if self._n_cycles is not None and cycle >= self._n_cycles:
            return self._n_cycles * self._program.n_slots
        return cycle * self._program.n_slots + int(np.searchsorted(self._program.offsets, within, "right"))

    def ended_by(self, tick: int) -> int:
        """Number of exposures that have ended before or at `tick`."""
        return self.begun_by(tick - self._program.exposure_ticks)

    def emit(self) -> StreamMessage:
        """Return the message that is due at `next_tick` and move on to the next one."""
        if not self._marked:
            self._marked = True
            message: StreamMessage = self._mark()
        else:
            first, count = self._program.blocks[self._block]
            message = self._exposures(first, count)
            self._advance()
        self._schedule()
        return message

    def cut(self, tick: int) -> StreamMessage | None:
        """Return the finished exposures of the block under way when the run is broken off at `tick`; None without any."""
        if self.next_tick is None or not self._marked:
            return None
        first, count = self._program.blocks[self._block]
        latest_begin = tick - self._cycle_tick - self._program.exposure_ticks
        ended = int(np.searchsorted(self._program.offsets[first : first + count], latest_begin, "right"))
        self.next_tick = None
        return self._exposures(first, ended) if ended else None

    @property
    def _cycle_tick(self) -> int:
        return self._start_tick + self._cycle * self._program.cycle_ticks

    @property
    def _object(self) -> int:
        return (self._cycle // self._program.cycles_per_object) % NO_OBJECT

    def _advance(self) -> None:
        self._block += 1
        if self._block == len(self._program.blocks):
            self._block = 0
            self._cycle += 1
            self._marked = self._cycle % self._program.cycles_per_object != 0

    def _schedule(self) -> None:
        program = self._program
        if self._n_cycles is not None and self._cycle >= self._n_cycles:
            self.next_tick = None
        elif not self._marked:
            self.next_tick = self._cycle_tick + int(program.offsets[0])
        else:
            first, count = program.blocks[self._block]
            self.next_tick = self._cycle_tick + int(program.offsets[first + count - 1]) + program.exposure_ticks

    def _mark(self) -> Mark:
        row = self._object % self._scene.n_objects
        tick = self._cycle_tick + int(self._program.offsets[0])
        exposure = self._cycle * self._program.n_slots
        return Mark(0, self._object, self._scene.truth(row), exposure, tick, float(self._light.photons[row]))

    def _exposures(self, first: int, count: int) -> ClickBlock | FrameBlock:
        program = self._program
        exposure = self._cycle * program.n_slots + first
        tick = self._cycle_tick + int(program.offsets[first])
        clicks = self._clicks(exposure, count)
        head = (0, 0, tick, exposure, program.slot_period_ticks, self._object)
        if program.mode != PARALLEL:
            return ClickBlock(*head, program.patterns[first : first + count], clicks[:, 0])
        words = np.zeros((count, self._word_bytes), np.uint8)
        packed = np.packbits(clicks, axis=1, bitorder="little")
        words[:, : packed.shape[1]] = packed
        return FrameBlock(*head, words)

    def _clicks(self, first: int, count: int) -> NDArray[np.uint8]:
        start = first - self._batch_first
        if start + count > len(self._batch):
            if start:
                self._before_batch = self._batch[start - 1]
            self._batch_first, start = first, 0
            probability = self._probability(first, max(count, BATCH_NUMBERS // self._program.channels))
            self._batch = sample_clicks(
                self._model, probability, self._seed, self._first_draw + first, self._before_batch
            )
        return self._batch[start : start + count]

    def _probability(self, first: int, count: int) -> NDArray[np.float64]:
        """Click probabilities of exposures first..first+count-1, float64 (count, channels)."""
        program = self._program
        cycle, slot = np.divmod(np.arange(first, first + count), program.n_slots)
        row = cycle // program.cycles_per_object % NO_OBJECT % self._scene.n_objects
        column = self._column[slot]
        if program.mode != PARALLEL:
            return self._light.probability[row, column][:, None]
        lit = self._light.probability[row, :-1]
        lit[column == program.n_patterns] = self._light.probability[0, -1]
        return lit
