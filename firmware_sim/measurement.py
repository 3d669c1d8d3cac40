"""One armed run of a program: which stream message is due at which tick, and what is in it.

Owns the schedule of exposures, objects and blocks and the clicks drawn for them; never knows about sessions, windows or
buffers (device.py). `Measurement.emit` returns messages without sequence number and drop count, which the device adds.
Clicks are drawn ahead in batches, of parallel instruments while the shell has nothing else to do (`draw_ahead`): they depend on the
exposure's number alone, so the size of batches changes nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.runtime.wire import NO_OBJECT, AckStatus, ClickBlock, FrameBlock, Mark
from pans.runtime.wire_commands import PARALLEL, Arm

from .changes import Changes
from .detector import DetectorModel, first_click_probability, sample_clicks
from .exposures import Exposures
from .light import RunLight, StillObjects
from .upload import Program, Refused, word_bytes

BATCH_NUMBERS = 1 << 14  # clicks of a sequential instrument drawn at a time
AHEAD_EXPOSURES = 512  # of a parallel one
MAX_LEASE_MS = 3_600_000
MAX_ARM_AHEAD_S = 3600
MAX_TICK = 1 << 62

StreamMessage = ClickBlock | FrameBlock | Mark


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
        light: RunLight,
        exposures: Exposures,
        model: DetectorModel,
        changes: Changes,
        seed: int,
        first_draw: int,
    ) -> None:
        self._program, self._light, self._exposures, self._changes = program, light, exposures, changes
        self._start_tick = arm.start_tick
        self._n_cycles = arm.n_cycles or None
        self._model, self._seed = model, seed
        self._first_draw = first_draw  # exposures drawn in earlier runs: no number is used twice
        self._moves = not isinstance(light, StillObjects)
        self._parallel = program.mode == PARALLEL
        self._block_ends = [
            int(program.offsets[first + count - 1]) + program.exposure_ticks for first, count in program.blocks
        ]
        self.end_tick = (
            None if self._n_cycles is None else arm.start_tick + self._n_cycles * program.cycle_ticks
        )  # at which the last cycle is over; None when the run lasts until STOP
        self._cycle, self._block, self._cycle_tick = 0, 0, arm.start_tick
        self._mark_tick = self._next_mark_tick()
        # A parallel batch holds packed words, a sequential one clicks; one row for each exposure.
        self._batch = np.zeros((0, word_bytes(program.channels) if self._parallel else 1), np.uint8)
        self._batch_first = 0
        self._before_batch = np.zeros(program.channels, np.uint8)
        self.next_tick: int | None = None
        self._schedule()

    @property
    def start_tick(self) -> int:
        return self._start_tick

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
        if self._mark_tick is not None and self._mark_tick == self.next_tick:
            mark = self._light.mark
            message: StreamMessage = Mark(*mark[:4], mark.tick + self._start_tick, *mark[5:])
            self._light.take_mark()
            self._mark_tick = self._next_mark_tick()
        else:
            first, count = self._program.blocks[self._block]
            message = self._message(first, count)
            self._advance()
        self._schedule()
        return message

    def draw_ahead(self) -> None:
        """Draw clicks of exposures to come (parallel instruments), so that a block that is due need not wait for them."""
        if not self._parallel or self.next_tick is None:
            return
        first, _ = self._program.blocks[self._block]
        drawn = self._batch_first + len(self._batch) - (self._cycle * self._program.n_slots + first)
        left = self._left(first)
        if drawn < min(AHEAD_EXPOSURES, left):
            self._drop(len(self._batch) - drawn)
            self._extend(min(AHEAD_EXPOSURES, left - drawn))

    def cut(self, tick: int) -> StreamMessage | None:
        """Return the finished exposures of the block under way when the run is broken off at `tick`; None without any."""
        if self.next_tick is None:
            return None
        first, count = self._program.blocks[self._block]
        latest_begin = tick - self._cycle_tick - self._program.exposure_ticks
        ended = int(np.searchsorted(self._program.offsets[first : first + count], latest_begin, "right"))
        self.next_tick = None
        return self._message(first, ended) if ended else None

    def _next_mark_tick(self) -> int | None:
        mark, n_exposures = self._light.mark, self._exposures.n_exposures
        over = n_exposures is not None and mark.exposure_index >= n_exposures
        return None if over else mark.tick + self._start_tick

    def _advance(self) -> None:
        self._block += 1
        if self._block == len(self._program.blocks):
            self._block = 0
            self._cycle += 1
            self._cycle_tick += self._program.cycle_ticks

    def _schedule(self) -> None:
        """A block is due at its end, a mark at its tick; a block that ends where a mark is due goes first."""
        if self._n_cycles is not None and self._cycle >= self._n_cycles:
            self.next_tick = None
            return
        end = self._cycle_tick + self._block_ends[self._block]
        self.next_tick = end if self._mark_tick is None or end <= self._mark_tick else self._mark_tick

    def _message(self, first: int, count: int) -> ClickBlock | FrameBlock:
        program = self._program
        exposure = self._cycle * program.n_slots + first
        tick = self._cycle_tick + int(program.offsets[first])
        number = NO_OBJECT if self._moves else (self._cycle // program.cycles_per_object) % NO_OBJECT
        head = (0, 0, tick, exposure, program.slot_period_ticks, number)
        clicks = self._clicks(exposure, count)
        if self._parallel:
            return FrameBlock(*head, clicks)
        return ClickBlock(*head, program.patterns[first : first + count], clicks[:, 0])

    def _left(self, first: int) -> int:
        """Exposures that are still to come from slot `first` of this cycle on, as far as they concern `draw_ahead`."""
        n_exposures = self._exposures.n_exposures
        if n_exposures is None:
            return 2 * AHEAD_EXPOSURES
        return n_exposures - self._cycle * self._program.n_slots - first

    def _clicks(self, first: int, count: int) -> NDArray[np.uint8]:
        start = first - self._batch_first
        if start + count > len(self._batch):
            self._drop(start)
            start = 0
            missing = count - len(self._batch)
            self._extend(missing if self._parallel else max(missing, BATCH_NUMBERS // self._program.channels))
        return self._batch[start : start + count]

    def _drop(self, count: int) -> None:
        """Forget the first `count` exposures of the batch, but for the clicks of the last one."""
        if count:
            self._before_batch = self._unpacked(self._batch[count - 1])
            self._batch, self._batch_first = self._batch[count:], self._batch_first + count

    def _extend(self, count: int) -> None:
        before = self._unpacked(self._batch[-1]) if len(self._batch) else self._before_batch
        new = self._draw(self._batch_first + len(self._batch), count, before)
        self._batch = np.concatenate([self._batch, new]) if len(self._batch) else new

    def _unpacked(self, row: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.unpackbits(row, bitorder="little", count=self._program.channels) if self._parallel else row

    def _draw(self, first: int, count: int, before: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The clicks of exposures first..first+count-1, as a batch holds them, after those of the exposure `before`, uint8 (channels,)."""
        probability, row_of = self._probability(first, count)
        number = self._first_draw + first
        if not self._parallel:
            return sample_clicks(self._model, probability[row_of], self._seed, number, before)
        from .detector_kernels import sample_words  # numba is loaded only for instruments of many channels

        words = np.zeros((count, self._batch.shape[1]), np.uint8)
        sample_words(self._model, probability, row_of, self._seed, number, before.copy(), words)
        if self._changes.any_dead:  # nor does crosstalk wake a dead channel
            times_s = self._exposures.seconds(self._exposures.begins(first, count))
            alive = np.packbits(self._changes.alive(times_s), axis=1, bitorder="little")
            words[:, : alive.shape[1]] &= alive
        return words

    def _probability(self, first: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Click probabilities float64 (rows, channels), and int64 (count,) of the row of each exposure."""
        light, row_of = self._light.rows(first, count)
        if self._changes:
            times_s = self._exposures.seconds(self._exposures.begins(first, count))
            exposure_s = self._exposures.exposure_ticks / self._exposures.tick_hz
            return self._changes.probability(self._model, light[row_of], times_s, exposure_s), np.arange(count)
        known = self._light.probability
        if known is None:
            return first_click_probability(self._model, light), row_of
        if len(known) > count:
            return known[row_of], np.arange(count)
        return known, row_of
