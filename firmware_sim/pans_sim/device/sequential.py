"""One armed run of a program, pattern after pattern: which stream message is due at which tick, and what is in it.

`Measurement.emit` returns messages without sequence number and drop count, which the device adds. Clicks are drawn in batches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.protocol.wire import NO_OBJECT, AckStatus, Arm, ClickBlock, FrameBlock, Mark
from pans_sim.scene.light import StillMarks
from pans_sim.scene.program import Program

from .upload import Refused
from .walking import SlotSource

MAX_LEASE_MS = 3_600_000  # an hour without a word from the host
MAX_ARM_AHEAD_S = 3600
MAX_TICK = 1 << 62  # ticks are signed 64-bit numbers in the kernels; a cycle more does not overflow

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


class Timetable:
    """When the exposures of one armed run begin and end, as far as states and STATUS are concerned."""

    def __init__(self, program: Program, arm: Arm) -> None:
        self._program, self._start_tick = program, arm.start_tick
        self._n_cycles = arm.n_cycles or None
        # at which the last cycle is over; None when the run lasts until STOP
        self.end_tick = None if self._n_cycles is None else arm.start_tick + self._n_cycles * program.cycle_ticks

    @property
    def n_exposures(self) -> int | None:
        """Exposures of the whole run; None when it lasts until STOP."""
        return None if self._n_cycles is None else self._n_cycles * self._program.n_slots

    @property
    def start_tick(self) -> int:
        """The tick at which the first cycle begins."""
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


class Measurement(Timetable):
    """The run that ARM started; `next_tick` is the tick of the next message, None after the last."""

    def __init__(self, program: Program, arm: Arm, light: StillMarks, source: SlotSource) -> None:
        super().__init__(program, arm)
        self._light, self._source = light, source
        self._block_ends = [
            int(program.offsets[first + count - 1]) + program.exposure_ticks for first, count in program.blocks
        ]
        self._cycle, self._block, self._cycle_tick = 0, 0, arm.start_tick
        self._mark_tick = self._next_mark_tick()
        self._batch = np.zeros((0, 1), np.uint8)
        self._stamps = np.zeros(0, np.uint16)
        self._batch_first = 0
        self._before_batch = np.zeros(1, np.uint8)
        self.next_tick: int | None = None
        self._mark_is_next = False
        self._schedule()

    def emit(self) -> StreamMessage:
        """Return the message that is due at `next_tick` and move on to the next one."""
        if self._mark_is_next:
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

    def draw_ahead(self) -> bool:
        """Prepare what the clicks to come need; they themselves are not drawn, as what is shown next may be up to those of now."""
        return self._source.prepare(self._batch_first + len(self._batch))

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
        mark = self._light.mark
        over = self._n_cycles is not None and mark.exposure_index >= self._n_cycles * self._program.n_slots
        return None if over else mark.tick + self._start_tick

    def _advance(self) -> None:
        self._block += 1
        if self._block == len(self._program.blocks):
            self._block = 0
            self._cycle += 1
            self._cycle_tick += self._program.cycle_ticks

    def _schedule(self) -> None:
        """A block is due at its end, a mark at its tick; a block that ends where a mark is due goes first (protocol.md, section 5)."""
        if self._n_cycles is not None and self._cycle >= self._n_cycles:
            self.next_tick = None
            return
        end = self._cycle_tick + self._block_ends[self._block]
        self._mark_is_next = self._mark_tick is not None and self._mark_tick < end
        self.next_tick = self._mark_tick if self._mark_is_next else end

    def _message(self, first: int, count: int) -> ClickBlock:
        program = self._program
        exposure = self._cycle * program.n_slots + first
        tick = self._cycle_tick + int(program.offsets[first])
        number = (self._cycle // program.cycles_per_object) % NO_OBJECT
        patterns, clicks = self._drawn(exposure, count)
        return ClickBlock(
            0, 0, tick, exposure, program.slot_period_ticks, number, patterns, clicks, self._source.largest
        )

    def _drawn(self, first: int, count: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """What was shown, uint16 (count,), and the clicks, uint8 (count,)."""
        start = first - self._batch_first
        if start + count > len(self._batch):
            if start:  # forget what has been sent, but for the clicks of the last exposure
                self._before_batch, self._batch, self._stamps = (
                    self._batch[start - 1],
                    self._batch[start:],
                    self._stamps[start:],
                )
                self._batch_first = first
            before = self._batch[-1] if len(self._batch) else self._before_batch
            missing = max(count - len(self._batch), self._source.ahead)
            stamps, clicks = self._source.exposures(first + len(self._batch), missing, before)
            self._batch = np.concatenate([self._batch, clicks]) if len(self._batch) else clicks
            self._stamps = np.concatenate([self._stamps, stamps]) if len(self._stamps) else stamps
            start = 0
        return self._stamps[start : start + count], self._batch[start : start + count, 0]
