"""What a core does behind a call of the kernel: marks, the guard of the dark counts, the truth of passages, pulses.

The kernel has decided and given its rows; a follow-up brings the rest of the core to where the kernel is. It sees each call once, in order:
`marks`, then `outputs`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from pans.base.machine import give_way
from pans.decide.dark.health import Finding
from pans.decide.decision import Action, Output, RowDecisions
from pans.decide.flow.core import FlowCore
from pans.decide.follower import Follower
from pans.decide.plan.marks import mark_of, unknown_photons
from pans.decide.still.core import Core
from pans.decide.still.kernel_state import CoreState
from pans.protocol.wire import BLOCK_DTYPE, HEADER, MessageType, decode_frames

from . import arrays as ring
from .arrays import I64
from .calls import Kernel
from .receive import unpack_blocks

Rows = npt.NDArray[np.void]
# object numbers (n,) -> photoelectrons of one shot (n,), NaN where nobody told
PhotonsOf = Callable[[I64], npt.NDArray[np.float32]]


class Ends(NamedTuple):
    """When the last exposures of decisions ended; int64 (n,) each: device ticks, how many decisions share it, and in which block."""

    ticks: I64
    counts: I64
    blocks: I64


NO_ENDS = Ends(*(np.zeros(0, np.int64) for _ in Ends._fields))


class FollowUp(Protocol):
    """What follows a call of the kernel; `rows` are its decisions, DECISION_DTYPE (n,), which are asked for once."""

    def warm_up(self, kernel: Kernel) -> None:
        """Compile or load what is used here, before arming."""

    def marks(self, kernel: Kernel) -> None:
        """Let the core know of the marks of a call, before any message that Python takes behind it."""

    def outputs(self, kernel: Kernel, rows: Rows) -> Iterator[Output]:
        """Yield what came of the blocks of a call; the core has seen them when the iterator is used up."""

    def ends(self, kernel: Kernel) -> Ends:
        """Return when the decisions of a call ended."""

    def pulses(self, kernel: Kernel) -> list[tuple[Action, int]]:
        """Return the pulses that a call asks for, in order, each with the place of its block."""

    def photons_of(self, kernel: Kernel) -> PhotonsOf:
        """Return what tells the photoelectrons of one shot on each of the objects of a call."""


def follow_up_of(core: Follower) -> FollowUp:
    """Return the follow-up for `core`."""
    if isinstance(core, Core):
        return StillFollowUp(core)
    return FlowFollowUp(core) if isinstance(core, FlowCore) else IdleFollowUp(core)


class IdleFollowUp:
    """Of a core that takes every message itself."""

    def __init__(self, core: Follower) -> None:
        self.core = core

    def warm_up(self, kernel: Kernel) -> None:
        """See FollowUp."""

    def marks(self, kernel: Kernel) -> None:
        """See FollowUp."""
        self.core.remember_rows(kernel.marks())

    def outputs(self, kernel: Kernel, rows: Rows) -> Iterator[Output]:
        """See FollowUp: there are no blocks."""
        yield from ()

    def ends(self, kernel: Kernel) -> Ends:
        """See FollowUp."""
        return NO_ENDS

    def pulses(self, kernel: Kernel) -> list[tuple[Action, int]]:
        """See FollowUp: objects that stand still ask for none."""
        return []

    def photons_of(self, kernel: Kernel) -> PhotonsOf:
        """See FollowUp."""
        return self.core.marks.photons_of


class StillFollowUp(IdleFollowUp):
    """Of objects that stand still: the guard of the dark counts sees the exposures, and then the decisions that they gave."""

    def __init__(self, core: Core) -> None:
        super().__init__(core)
        self._still = core
        self._by_blocks = core.guard is not None and not core.windows.parallel
        exposures = ring.KEPT_BYTES // 2 if self._by_blocks else 1  # two bytes each
        self._stamps, self._bits = np.ones(exposures, np.uint16), np.ones(exposures, np.uint8)

    def warm_up(self, kernel: Kernel) -> None:
        """See FollowUp."""
        unpack_blocks(kernel.kept, kernel.messages, self._stamps, self._bits)

    def outputs(self, kernel: Kernel, rows: Rows) -> Iterator[Output]:
        """See FollowUp: all blocks are one output."""
        if not len(kernel.blocks):
            return
        events = self._watch(kernel)
        give_way()
        if self._by_blocks:
            self._still.watch_objects(rows)
            give_way()
        yield Output(RowDecisions(rows), events, int(kernel.blocks[-1, ring.END_TICK]))

    def ends(self, kernel: Kernel) -> Ends:
        """See FollowUp: the decisions of a block share its end."""
        counts = kernel.rows_by_block
        some = np.flatnonzero(counts)
        return Ends(kernel.blocks[some, ring.END_TICK], counts[some], some)

    def photons_of(self, kernel: Kernel) -> PhotonsOf:
        """See FollowUp: the kernel's own marks, which are looked up in one go."""
        assert isinstance(kernel.steps, CoreState)
        return kernel.steps.photons_of

    def _watch(self, kernel: Kernel) -> list[Finding]:
        """Let the guard of the dark counts see the exposures of a call."""
        core = self._still
        if core.guard is None:
            return []
        if core.windows.parallel:
            spans, heads = kernel.heads(MessageType.FRAMES, BLOCK_DTYPE)
            return core.watch_frames(_words_of(kernel.kept, spans, heads), heads)
        n = int(unpack_blocks(kernel.kept, kernel.messages, self._stamps, self._bits))
        return core.watch_blocks(self._stamps[:n], self._bits[:n], kernel.end.following - n)


class FlowFollowUp(IdleFollowUp):
    """Of a flow: the core sees block by block where something came, in the order of the stream."""

    def __init__(self, core: FlowCore) -> None:
        super().__init__(core)
        self._flow = core

    def marks(self, kernel: Kernel) -> None:
        """See FollowUp: `outputs` tells of marks among blocks, in their order."""
        if not len(kernel.blocks):
            super().marks(kernel)

    def ends(self, kernel: Kernel) -> Ends:
        """See FollowUp: each object left at a time of its own."""
        by_block, n = kernel.rows_by_block, kernel.end.rows - kernel.begin.rows
        ticks = self._flow.leave_ticks(kernel.begin.rows, kernel.end.rows)
        return Ends(ticks, np.ones(n, np.int64), np.repeat(np.arange(len(by_block)), by_block))

    def pulses(self, kernel: Kernel) -> list[tuple[Action, int]]:
        """See FollowUp; mostly of the last block, which was urgent."""
        if not len(kernel.blocks):
            return []
        pulses = self._flow.pulses(kernel.begin.rows, kernel.end.rows)
        if not pulses:
            return []
        first = int(kernel.rows["index"][0])
        places = [pulse.number - first + kernel.begin.rows for pulse in pulses]
        return [*zip(pulses, np.searchsorted(kernel.blocks[:, ring.ROWS], places, "right").tolist())]

    def photons_of(self, kernel: Kernel) -> PhotonsOf:
        """See FollowUp: a passage's number is no mark's."""
        return unknown_photons

    def outputs(self, kernel: Kernel, rows: Rows) -> Iterator[Output]:
        """See FollowUp: one output for each block of which something came."""
        core, blocks = self._flow, kernel.blocks
        if not len(blocks):
            return
        by_block = core.guard is not None and not core.watches_empty  # it wants to see every block
        spans, heads = kernel.heads(MessageType.FRAMES, BLOCK_DTYPE)
        behind = (heads["exposure_index"] + heads["count"]).astype(np.int64)  # the exposure that follows each block
        empty = {told[0]: told for told in core.told_empty(kernel.end.told)}
        mark_rows, places = kernel.marks(), np.flatnonzero(kernel.messages[:, ring.WHAT] == int(MessageType.MARK))
        core.marks.add_rows(mark_rows)
        marks = deque(map(mark_of, mark_rows))
        # of each mark the block that follows it
        before = np.searchsorted(blocks[:, ring.MESSAGES] - kernel.begin.messages, places, "right")
        decided, told = kernel.rows_by_block > 0, np.isin(behind, list(empty))
        decided[-1] = True
        # The matcher need not see each block, but the last one before a mark or a decision, which may change what it finds.
        some = decided | told | by_block
        some[:-1] |= decided[1:]
        some[before[before > 0] - 1] = True
        which = np.flatnonzero(some)
        n_marks, columns = np.searchsorted(before, which, "right"), blocks[some][:, [ring.END_TICK, ring.ROWS]]
        row = kernel.begin.rows
        for block, n, (end_tick, stop) in zip(which.tolist(), n_marks.tolist(), columns.tolist()):
            while len(mark_rows) - len(marks) < n:
                core.matcher.add_mark(marks.popleft())
            following = int(behind[block])
            if decided[block] or by_block:
                frames = decode_frames(kernel.bytes_of(spans[block])[HEADER.size :]) if by_block else None
                yield core.account(slice(row, stop), following, end_tick, empty.get(following), frames)
                row = stop
                continue
            if told[block] and (events := core.watch(empty[following])):
                yield Output([], events, end_tick)
            core.matcher.settle(following)
        for mark in marks:
            core.matcher.add_mark(mark)


def _words_of(kept: npt.NDArray[np.uint8], spans: I64, heads: npt.NDArray[np.void]) -> npt.NDArray[np.uint8]:
    """Return the words of all FRAMES of a call behind one another, uint8 (frames, bytes), as wide as the narrowest."""
    data, width = kept.data, int(heads["width"].min())
    bodies = [data[begin:end] for begin, end in (spans[:, : ring.END + 1] + [BLOCK_DTYPE.itemsize, 0]).tolist()]
    if width == heads["width"].max():
        return np.frombuffer(b"".join(bodies), np.uint8).reshape(-1, width)
    wide = zip(bodies, heads["width"].tolist())
    return np.concatenate([np.frombuffer(body, np.uint8).reshape(-1, n)[:, :width] for body, n in wide])
