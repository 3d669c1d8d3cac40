"""A core behind the kernel without a live run: bytes or recorded messages in, rows of the decision log out.

A replay, the benches and the tests drive a core so. Each call yields a `Batch` for what the kernel took, and one for each message that it
left to the core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.runtime.core.bulk_steps import BulkSteps
from pans.runtime.core.decision import DECISION_DTYPE, CoreEvent, Output
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.core.stream_arrays import DecisionTables
from pans.runtime.decide.verdict import Decider
from pans.runtime.wire.bulk import CHUNK_BYTES, BulkDecoder
from pans.runtime.wire.frame import Frame, Messages
from pans.runtime.wire.messages import MessageType
from pans.runtime.wire.session import STREAM_TYPES

from . import rings as ring
from .engine import Bytes, Limits, Turn

_CORE_TYPES = STREAM_TYPES | {MessageType.STATUS}
_NO_ROWS: npt.NDArray[np.void] = np.zeros(0, DECISION_DTYPE)


class Batch(NamedTuple):
    """Rows (n,) of DECISION_DTYPE, valid until the next batch, events, and the frames that are not the core's alone."""

    rows: npt.NDArray[np.void]
    events: Sequence[CoreEvent] = ()
    others: Sequence[Frame] = ()


class StreamCore:
    """A decoder and a core, for the session `session`; all memory is allocated here, before arming."""

    def __init__(self, plan: Plan, decider: Decider, shots: int, n_cycles: int, session: int) -> None:
        self._take_over(Core(plan, decider, shots, n_cycles), session)

    @classmethod
    def of(cls, core: Core, session: int) -> StreamCore:
        """Return one for a core that exists."""
        streamed = cls.__new__(cls)
        streamed._take_over(core, session)
        return streamed

    def _take_over(self, core: Core, session: int) -> None:
        self.core, self.decoder, self.wrong_session, self._session = core, BulkDecoder(), 0, session
        self.turn = Turn(core.steps(session), self.decoder)

    @property
    def tables(self) -> DecisionTables:
        """What decides without asking the back end."""
        steps = self.core.steps(self._session)
        assert isinstance(steps, BulkSteps)
        return steps.tables

    def warm_up(self) -> None:
        """Compile or load every kernel of the path, before arming."""
        self.core.windows.warm_up()
        self.turn.warm_up()

    def follow(self, session: int) -> None:
        """Take messages of `session`, which the core has begun."""
        self._session = session
        self.core.steps(session)

    def begin(self, session: int, start_tick: int, n_cycles: int) -> Iterator[Batch]:
        """Follow the stream that an ARM starts in `session`; what the one before left open is yielded."""
        output = self.core.begin(start_tick, n_cycles)
        self.follow(session)
        yield from _batches(output)

    def end(self) -> Iterator[Batch]:
        """End the stream, and yield what it leaves open."""
        yield from _batches(self.core.end())

    def feed(self, data: Bytes) -> Iterator[Batch]:
        """Take bytes as they arrived, whatever they hold; the iterator must be used up."""
        for first in range(0, len(data), CHUNK_BYTES):
            yield from self._continue(self.turn.feed([(0, data[first : first + CHUNK_BYTES])]), self.turn.feed_on)

    def listen(self, fd: int, limits: Limits) -> Iterator[Batch]:
        """Take what comes from a descriptor until `limits`, or until the other end has closed it; the iterator must be used up."""
        yield from self._continue(self.turn.run(fd, limits), self.turn.run)

    def replay(self, messages: Messages) -> Iterator[Batch]:
        """Take recorded messages; the iterator must be used up. `others` has those of another session, for the caller to take."""
        self.turn.hold(messages)
        yield from self._continue(self.turn.run(), self.turn.run)

    def _continue(self, ended: int, again: Callable[[], int]) -> Iterator[Batch]:
        """Yield what a call of the kernel brought, and take what ended it, until nothing is left."""
        while True:
            rows = self.turn.rows
            for mark in self.turn.marks():
                self.core.remember(mark)
            if len(rows):
                yield Batch(rows)
            if ended == ring.ODD:
                yield from self._take_one(self.turn.take_odd())
            elif ended != ring.FULL:
                return
            self.core.steps(self._session)
            ended = again()

    def _take_one(self, frame: Frame) -> Iterator[Batch]:
        """Let the core take a message that is not ordinary: one out of order, with a gap before it, or no block at all."""
        if frame.session != self._session:
            self.wrong_session += 1
            yield Batch(_NO_ROWS, (), [frame])
        elif frame.type not in _CORE_TYPES:
            yield Batch(_NO_ROWS, (), [frame])
        else:
            yield from _batches(self.core.step(frame))
            if frame.type == MessageType.STATUS:
                yield Batch(_NO_ROWS, (), [frame])


def _batches(output: Output) -> Iterator[Batch]:
    if output.decisions or output.events:
        yield Batch(np.array(output.decisions, DECISION_DTYPE), output.events)
