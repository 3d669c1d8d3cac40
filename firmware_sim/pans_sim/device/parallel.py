"""One armed run of an instrument that exposes all channels at once: its stream, made ahead of time in stretches.

The future of a scene is fixed, so clicks and the order of messages are made before they are due. Sequence numbers, drop counts and the
session are stamped when the first message of a stretch leaves, and again when one of them turns out otherwise for the rest. What is not
yet due can be forgotten at any time: numbers drawn ahead belong to exposures.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque

import numpy as np
from numpy.typing import NDArray

from pans.protocol.wire import SCHEMA, Arm, FrameBlock, Mark
from pans_sim.scene.drawing import ClickSource
from pans_sim.scene.light import RunLight
from pans_sim.scene.marks import Stamp
from pans_sim.scene.program import Program

from . import frame_writer
from .frame_writer import BlockPlan
from .sequential import Timetable
from .upload import word_bytes

STRETCH_EXPOSURES = 2048  # made at a time, in whole blocks, where time is virtual,
AHEAD_EXPOSURES = 256  # and where it is real, between one block and the next: making them must not hold that one up
STRETCH_NUMBERS = 1 << 15  # but not more clicks than these
AHEAD_STRETCHES = 16
_U32 = 0xFFFFFFFF


class Stretch:
    """Consecutive messages, int64 (n, N_COLUMNS), and the words that their blocks hold; encoded when first asked for."""

    def __init__(self, messages: NDArray[np.int64], words: NDArray[np.uint8], period_ticks: int) -> None:
        self._messages, self._words, self._period_ticks = messages, words, period_ticks
        self.due: list[int] = messages[:, frame_writer.DUE].tolist()
        self.sent = 0
        self._stamp: Stamp | None = None  # of all messages, if they were sent in one row
        self._data = memoryview(b"")
        self._ends: list[int] = []

    def exposures(self) -> int:
        """How many exposures the next message holds."""
        return int(self._messages[self.sent, frame_writer.EXPOSURES])

    def message(self, ended: int | None = None) -> FrameBlock | Mark:
        """The next message without sequence number and drop count; of a block only the first `ended` exposures if it says so."""
        _, count, tick, exposure, number, *rest = self._messages[self.sent].tolist()
        if not count:
            truth, half, photons = rest
            light = float(np.uint32(photons).view(np.float32))
            return Mark(0, number, truth, exposure, tick, light, half)
        words = self._words[rest[0] : rest[0] + (count if ended is None else ended)]
        return FrameBlock(0, 0, tick, exposure, self._period_ticks, number, words)

    def due_by(self, tick: int) -> int:
        """How many messages from the next one on are due before or at `tick`."""
        return bisect_right(self.due, tick, self.sent) - self.sent

    def take(self, n: int, sequence: int, drops: int, session: int) -> memoryview:
        """Return the next `n` messages as frames, the first one with this sequence number, and move on."""
        first = self.sent
        if ((sequence - first) & _U32, drops, session) != self._stamp:
            self._encode(Stamp((sequence - first) & _U32, drops, session))
        self.sent = first + n
        return self._data[self._ends[first] : self._ends[first + n]]

    def skip(self) -> int:
        """Leave out the next message; return how many exposures it holds."""
        self.sent += 1
        return int(self._messages[self.sent - 1, frame_writer.EXPOSURES])

    def _encode(self, stamp: Stamp) -> None:
        """Encode all messages again, sent ones included, as if they had been sent in one row."""
        n, largest = len(self.due), int(self._messages[:, frame_writer.EXPOSURES].max()) * self._words.shape[1]
        body = np.empty(frame_writer.OVERHEAD_BYTES + largest, np.uint8)
        out = np.empty(frame_writer.encoded_bytes(n, self._words.size), np.uint8)
        ends = np.empty(n + 1, np.int64)
        frame_writer.write_messages(self._messages, self._words, self._period_ticks, stamp, SCHEMA, body, out, ends)
        self._stamp, self._data, self._ends = stamp, memoryview(out.data), ends.tolist()


class FrameRun(Timetable):
    """The run that ARM started; `next_tick` is the tick of the next message, None after the last."""

    def __init__(self, program: Program, arm: Arm, light: RunLight, source: ClickSource, moves: bool) -> None:
        super().__init__(program, arm)
        self._light, self._source = light, source
        first, count = np.array(program.blocks, np.int64).reshape(-1, 2).T
        ends = program.offsets[first + count - 1] + program.exposure_ticks
        blocks = np.column_stack([first, count, program.offsets[first], ends])
        self._plan = BlockPlan(blocks, program.n_slots, program.cycle_ticks, 0 if moves else program.cycles_per_object)
        self._word_bytes = word_bytes(program.channels)
        self._drawn_blocks = 0
        self._n_blocks = None if self._n_cycles is None else self._n_cycles * len(program.blocks)
        self._due_blocks, self._ahead_blocks = (
            max(1, min(most, STRETCH_NUMBERS // program.channels) * len(program.blocks) // program.n_slots)
            for most in (STRETCH_EXPOSURES, AHEAD_EXPOSURES)
        )
        self._at_once = self._due_blocks  # how many to make; fewer as soon as the shell has them made ahead
        self._before = np.zeros(program.channels, np.uint8)
        self._ahead: deque[Stretch] = deque()
        self._broken_off = False

    @property
    def next_tick(self) -> int | None:
        """See the class."""
        stretch = self.stretch()
        return None if stretch is None else stretch.due[stretch.sent]

    def stretch(self) -> Stretch | None:
        """The stretch that holds the next message, made now if it was not before; None after the last message."""
        ahead = self._ahead
        if ahead and ahead[0].sent == len(ahead[0].due):
            ahead.popleft()
        return ahead[0] if ahead or self._draw() else None

    def draw_ahead(self) -> bool:
        """Make a stretch of what is to come, if there is room; whether it did."""
        self._at_once = self._ahead_blocks
        return len(self._ahead) < AHEAD_STRETCHES and self._draw()

    def emit(self) -> FrameBlock | Mark:
        """Return the message that is due at `next_tick` and move on to the next one."""
        message = self._ahead[0].message()
        self._ahead[0].sent += 1
        return message

    def cut(self, tick: int) -> FrameBlock | None:
        """Return the finished exposures of the block under way when the run is broken off at `tick`; None without any."""
        while self.next_tick is not None and not self._ahead[0].exposures():
            self._ahead[0].sent += 1  # marks of what is not to come
        if self.next_tick is None:
            return None
        block = self._ahead[0].message()
        assert isinstance(block, FrameBlock)
        first = block.exposure_index % self._program.n_slots
        begins = self._program.offsets[first : first + len(block.words)] - self._program.offsets[first]
        ended = int(np.searchsorted(begins, tick - block.tick - self._program.exposure_ticks, "right"))
        self._broken_off = True
        self._ahead.clear()
        return block._replace(words=block.words[:ended]) if ended else None

    def _draw(self) -> bool:
        """Make the stretch after those at hand; False when the run is over."""
        n = self._at_once
        if self._n_blocks is not None:
            n = min(n, self._n_blocks - self._drawn_blocks)
        if n <= 0 or self._broken_off:
            return False
        plan = self._plan
        cycle, block = divmod(self._drawn_blocks, len(plan.blocks))
        last_cycle, last = divmod(self._drawn_blocks + n - 1, len(plan.blocks))
        last_slot, last_count, _, end = plan.blocks[last].tolist()
        first = cycle * plan.n_slots + int(plan.blocks[block, frame_writer.FIRST_SLOT])
        words = np.zeros((last_cycle * plan.n_slots + last_slot + last_count - first, self._word_bytes), np.uint8)
        self._source.words(first, self._before, words)
        marks = self._light.take_marks(last_cycle * plan.cycle_ticks + end)
        messages = np.empty((n + len(marks), frame_writer.N_COLUMNS), np.int64)
        frame_writer.lay_out(plan, cycle, block, marks, self._start_tick, messages)
        self._ahead.append(Stretch(messages, words, self._program.slot_period_ticks))
        self._drawn_blocks += n
        return True
