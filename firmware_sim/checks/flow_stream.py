"""The streaming core of a flow: wire bytes in, decisions out, through the compiled turn, as turn/streaming.py is of still objects.

Owns a decoder and the order of what comes; the way through is the live run's own (`Turn`, `settled_blocks`). `FlowStream` has the shape of
`StreamCore`: its batches are lists of decisions in rows.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pans.runtime.core.decision import DECISION_DTYPE, Output
from pans.runtime.core.plan import Plan
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.steps import FlowSteps
from pans.runtime.live.flow_run import settled_blocks
from pans.runtime.turn import rings as ring
from pans.runtime.turn.engine import Limits, Turn
from pans.runtime.turn.streaming import Batch
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.messages import MessageType
from pans.runtime.wire.session import STREAM_TYPES

_CORE_TYPES = STREAM_TYPES | {MessageType.STATUS}


class FlowStream:
    """A decoder and the core of a flow, for the session `session`."""

    def __init__(self, core: FlowCore, plan: Plan, session: int) -> None:
        self.core = core
        self.decoder = BulkDecoder()
        self._session = session
        self._steps = FlowSteps(core, plan)
        self._steps.begin(session)
        self.turn = Turn(self._steps, self.decoder)

    def warm_up(self) -> None:
        """Compile or load every kernel of the path, before arming."""
        self.decoder.warm_up()
        self.core.warm_up()
        self.turn.warm_up()
        self._steps.begin(self._session)

    def begin(self, session: int, start_tick: int, n_cycles: int) -> Iterator[Batch]:
        """Follow the stream that an ARM starts in `session`; what the one before left open is yielded."""
        output = self.core.begin(start_tick, n_cycles)
        self._session = session
        self._steps.begin(session)
        yield _batch(output)

    def end(self) -> Iterator[Batch]:
        """End the stream, and yield what it leaves open."""
        yield _batch(self.core.end())

    def reopen(self) -> None:
        """Decode another connection from its beginning; until `begin` nothing in it is of a stream that is followed."""
        self._session = 0
        self._steps.begin(0)
        self.decoder = BulkDecoder()
        self.turn = Turn(self._steps, self.decoder)

    def listen(self, fd: int, limits: Limits) -> Iterator[Batch]:
        """Take what comes from a descriptor until `limits`; the iterator must be used up."""
        turn = self.turn
        ended = turn.run(fd, limits)
        while True:
            if turn.counts.steps:
                yield from (_batch(output) for _, output in settled_blocks(turn) if output is not None)
            else:
                for mark in turn.marks():
                    self.core.remember(mark)
            if ended == ring.ODD:
                frame = turn.decoder.frame(*turn.left[0].tolist())
                turn.skip()
                if frame.session == self._session and frame.type in _CORE_TYPES:
                    yield _batch(self.core.step(frame))
            elif ended != ring.FULL:
                return
            ended = turn.run()


def _batch(output: Output) -> Batch:
    return Batch(np.array(output.decisions, DECISION_DTYPE), output.events, [])
