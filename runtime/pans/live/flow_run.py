"""A run with passing objects: what a call of the kernel brought of a flow, the actuator, and the flow's part of the summary."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pans.decide import Output
from pans.decide.flow import FlowCore, PassageFigures
from pans.decide.kernel import Kernel
from pans.decide.kernel import arrays as ring
from pans.decide.plan import mark_of
from pans.protocol.wire import BLOCK_DTYPE, HEADER, MessageType, decode_frames

from .gates import Actuator, SecondInstrument
from .receiver import Receiver
from .tally import unknown_photons

if TYPE_CHECKING:
    from .run import LiveRun


@dataclass(frozen=True, slots=True)
class FlowFigures:
    """What came of a run with passing objects: its settings, what the decisions were worth, what became of the pulses."""

    flow: dict[str, Any]
    passages: PassageFigures
    gates: dict[str, int]
    second_instrument: dict[str, Any] | None

    def as_json(self) -> dict[str, Any]:
        """Return the figures under the contract's keys."""
        rest = {"gates": self.gates, "second_instrument": self.second_instrument}
        return {"flow": self.flow, **self.passages.as_json(), **rest}


class FlowRun:
    """Joins core and gates of one run, and says afterwards what came of both."""

    def __init__(self, core: FlowCore, actuator: Actuator | SecondInstrument | None) -> None:
        self.core = core
        self._actuator = actuator
        self._run: LiveRun | None = None

    def header(self) -> dict[str, Any]:
        """What a replay needs to make the same core."""
        return {"settings": self.core.settings.as_header(), "dark_probability": self.core.dark_probability}

    def prepared(self, run: LiveRun) -> None:
        """Before arming: pulses go to the actuator, and the figures hear of those that were not made."""
        self._run = run
        if isinstance(self._actuator, SecondInstrument):
            self._actuator.connect()
            run.gates.second = self._actuator
        else:
            run.gates.actuator = self._actuator
        run.gates.failed = self.core.matcher.undo

    def figures(self) -> FlowFigures:
        """Let go of the actuator and return the flow's part of the summary."""
        core, limits, settings = self.core, self.core.limits, self.core.settings
        core.matcher.finish()
        second = self._actuator.facts() if isinstance(self._actuator, SecondInstrument) else None
        if self._actuator is not None:
            self._actuator.close()
        flow = {
            "kind": settings.kind,
            "frames_per_decision": core.frames,
            "pool": settings.pool,
            "bars_per_s": core.bars_per_s,  # of a tape: as said, or as last found
            "onset_clicks": limits.onset_clicks,
            "release_clicks": limits.release_clicks,
            "onset_frames": limits.onset_frames,
            "longest_frames": limits.longest,
            "empty_frames": core.empty_frames,
            "gate_delay_us": settings.gate_delay_us,
            "gate_classes": list(settings.gate_classes),
        }
        gates = {} if self._run is None else self._run.gates.summary()
        return FlowFigures(flow, core.matcher.figures(core.frames), gates, second)


# -- behind the kernel -------------------------------------------------------------------------------------------------


class FlowReceiver(Receiver):
    """The receiver of a flow: the core sees block by block where something came, in the order of the stream.

    A pulse is sent here, once its decision is on record: a block that asks for one ends the kernel's call.
    """

    _outputs: Sequence[Output] = ()

    def _settle_marks(self, kernel: Kernel) -> None:
        if not len(kernel.blocks):
            super()._settle_marks(kernel)

    def _record(self, kernel: Kernel) -> None:
        """Record decisions, too, and send the pulses that they ask for: before all else, since their time runs."""
        super()._record(kernel)
        run, steps = self._run, kernel.steps
        if not len(kernel.blocks):
            return
        assert isinstance(steps, FlowCore)
        if not steps.decides:
            self._outputs = list(settled_blocks(kernel))  # the back end decides
            kernel.blocks[:, ring.DECIDED : ring.RECORDED + 1] = run.now_ns()
        if run.recorder is not None:
            run.recorder.add_decisions(kernel.rows)
        if pulses := steps.pulses(kernel.begin.rows, kernel.end.rows):  # mostly of the last block, which was urgent
            places = [pulse.number - int(kernel.rows["index"][0]) + kernel.begin.rows for pulse in pulses]
            block_of = np.searchsorted(kernel.blocks[:, ring.ROWS], places, "right")
            for pulse, stamps in zip(pulses, kernel.blocks[block_of]):
                run.take_pulses([pulse], int(stamps[ring.ARRIVAL]), int(stamps[ring.DECIDED]))
            run.pulse()

    def _settle_blocks(self, kernel: Kernel, outputs: list[Output]) -> None:
        run, blocks, rows, steps = self._run, kernel.blocks, kernel.rows, kernel.steps
        assert isinstance(steps, FlowCore)
        for output in settled_blocks(kernel) if steps.decides else self._outputs:
            for event in output.events:
                run.journal.take(event)
            outputs.append(output)
        self._ends_of(kernel)
        run.block_came(int(blocks[-1, ring.ARRIVAL]))
        if len(rows):
            run.tally.add_rows(rows, unknown_photons)  # a passage's number is no mark's
            block_of = np.repeat(np.arange(len(blocks)), kernel.rows_by_block)
            leave_ticks = steps.leave_ticks(kernel.begin.rows, kernel.end.rows)
            ends_ns, unsure_ns = run.connection.known_clock().to_host_ns_many(leave_ticks)
            stamps = blocks[block_of, : ring.RECORDED + 1]
            run.account_times(int(rows["index"][0]), np.ones(len(rows), np.int64), ends_ns, unsure_ns, stamps)


def settled_blocks(kernel: Kernel) -> Iterator[Output]:
    """Let the core of a flow see what a call brought; yield what came of each block of which something came."""
    core, blocks = kernel.steps, kernel.blocks
    assert isinstance(core, FlowCore)
    by_block = core.guard is not None and not core.watches_empty  # it wants to see every block
    spans, heads = kernel.heads(MessageType.FRAMES, BLOCK_DTYPE)
    behind = (heads["exposure_index"] + heads["count"]).astype(np.int64)  # the exposure that follows each block
    empty = {told[0]: told for told in core.told_empty(kernel.end.told)}
    places = np.flatnonzero(kernel.messages[:, ring.WHAT] == int(MessageType.MARK)).tolist()
    marks, row = deque(zip(places, map(mark_of, kernel.marks()))), kernel.begin.rows
    first = kernel.begin.messages
    decided = kernel.rows_by_block > 0
    some = decided | np.isin(behind, list(empty)) | by_block
    decided[-1] = some[-1] = True
    columns = blocks[:, ring.END_TICK : ring.MESSAGES + 1].tolist()
    for block, (end_tick, stop, place) in enumerate(columns):
        while marks and marks[0][0] < place - first:
            core.remember(marks.popleft()[1])
        following = int(behind[block])
        if decided[block] or by_block:
            frames = decode_frames(kernel.bytes_of(spans[block])[HEADER.size :]) if by_block else None
            yield core.account(slice(row, stop), following, end_tick, empty.get(following), frames)
            row = stop
            continue
        if some[block] and (events := core.watch(empty[following])):
            yield Output([], events, end_tick)
        core.matcher.settle(following)
    for _, mark in marks:
        core.remember(mark)
