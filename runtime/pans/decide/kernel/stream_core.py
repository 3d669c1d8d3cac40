"""`StreamCore`: a core that the kernel drives without a live run, as replays, benches and tests do.

Bytes, a descriptor or recorded messages come in, batches of rows go out. Irregular messages are taken by the core's `step`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pans.bundle.backends import Decider
from pans.decide.decision import DECISION_DTYPE, CoreEvent, Output, rows_of
from pans.decide.follower import Follower
from pans.decide.plan.plan import Plan
from pans.decide.still.core import Core
from pans.decide.still.kernel_state import CoreState
from pans.decide.still.kernels import DecisionTables
from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import CHUNK_BYTES, Frame, FrameDecoder, Messages, MessageType

from . import arrays as ring
from .calls import Bytes, Kernel, Limits
from .follow_up import follow_up_of

_CORE_TYPES = STREAM_TYPES | {MessageType.STATUS, MessageType.EXPOSED}
_NO_ROWS: npt.NDArray[np.void] = np.zeros(0, DECISION_DTYPE)


class Batch(NamedTuple):
    """Rows (n,) of DECISION_DTYPE, valid until the next batch, events, and the frames that are not the core's alone."""

    rows: npt.NDArray[np.void]
    events: Sequence[CoreEvent] = ()
    others: Sequence[Frame] = ()


class StreamCore:
    """A core that the kernel drives without a live run; all memory is allocated here, before arming."""

    def __init__(self, plan: Plan, decider: Decider, shots: int, n_cycles: int, session: int) -> None:
        self._attach(Core(plan, decider, shots, n_cycles), session)

    @classmethod
    def of(cls, core: Follower, session: int) -> StreamCore:
        """Return one for a core that exists, of any kind."""
        streamed = cls.__new__(cls)
        streamed._attach(core, session)
        return streamed

    def _attach(self, core: Any, session: int) -> None:
        self.core, self.decoder, self.wrong_session, self.session = core, FrameDecoder(), 0, session
        self.turn, self._follow_up = Kernel(core.steps(session), self.decoder), follow_up_of(core)

    @property
    def tables(self) -> DecisionTables:
        """What decides without asking the back end."""
        steps = self.core.steps(self.session)
        assert isinstance(steps, CoreState)
        return steps.tables

    def warm_up(self) -> None:
        """Compile or load every kernel of the path, before arming."""
        self.core.warm_up()
        self.turn.warm_up()

    def follow(self, session: int) -> None:
        """Take messages of `session`, which the core has begun."""
        self.session = session
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
        """Process recorded messages; the iterator must be used up. `others` has those of another session, for the caller to take."""
        self.turn.hold(messages)
        yield from self._continue(self.turn.run(), self.turn.run)

    def _continue(self, ended: int, again: Callable[[], int]) -> Iterator[Batch]:
        """Yield what a call of the kernel brought, and take what ended it, until nothing is left."""
        turn, core = self.turn, self.core
        while True:
            self._follow_up.marks(turn)  # the same order as live/receiver.py
            events = [event for _, frame, standing in turn.passed() for event in core.step(frame, standing).events]
            rows = turn.rows
            events += [event for output in self._follow_up.outputs(turn, rows) for event in output.events]
            if len(rows) or events:
                yield Batch(rows, events)
            if ended == ring.ODD:
                yield from self._take_one(turn.take_odd())
                while turn.has_bodies and not core.steps(self.session).takes:  # no call is needed to find the next one
                    yield from self._take_one(turn.take_odd())
            elif ended != ring.FULL:
                return
            core.steps(self.session)
            ended = again()

    def _take_one(self, frame: Frame) -> Iterator[Batch]:
        """Let the core take a message that is not ordinary: one out of order, with a gap before it, or no block at all."""
        if frame.session != self.session:
            self.wrong_session += 1
            yield Batch(_NO_ROWS, (), [frame])
        elif frame.type not in _CORE_TYPES:
            yield Batch(_NO_ROWS, (), [frame])
        else:
            yield from _batches(self.core.step(frame))


def _batches(output: Output) -> Iterator[Batch]:
    if output.decisions or output.events:
        yield Batch(rows_of(output.decisions), output.events)
