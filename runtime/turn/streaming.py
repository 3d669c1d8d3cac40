"""The streaming core for fast measurements: wire bytes in, rows of the decision log out, in compiled kernels.

Owns a decoder and a core, and the order of what they give; the way through is the live run's own (`Turn`). Never waits, records or acts.
`StreamCore.feed` yields `Batch`es.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pans.runtime.core.bulk_steps import ROWS_PER_BATCH, BulkSteps, rows_needed
from pans.runtime.core.decision import DECISION_DTYPE, CoreEvent, Decision
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.core.stream_arrays import DecisionTables
from pans.runtime.decide.verdict import Decider
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.frame import Frame
from pans.runtime.wire.messages import MessageType
from pans.runtime.wire.session import STREAM_TYPES

from . import rings as ring
from .engine import Limits, Turn

_CORE_TYPES = STREAM_TYPES | {MessageType.STATUS}

U8 = npt.NDArray[np.uint8]


class Batch(NamedTuple):
    """What came of some messages: rows (n,) of DECISION_DTYPE, a view that is valid until the next batch, events, and other frames."""

    rows: npt.NDArray[np.void]
    events: Sequence[CoreEvent]
    others: list[Frame]


class StreamCore:
    """A decoder and a core, for the session `session`; all memory is allocated here, before arming."""

    def __init__(self, plan: Plan, decider: Decider, shots: int, n_cycles: int, session: int) -> None:
        self.core = Core(plan, decider, shots, n_cycles)
        self.decoder = BulkDecoder()
        self.wrong_session = 0
        self._session = session
        windows = self.core.windows
        rows = rows_needed(windows.n_windows, ROWS_PER_BATCH)
        self._steps = BulkSteps(self.core, windows, plan, decider, shots, rows)
        self._steps.begin(session)
        self.turn = Turn(self._steps, self.decoder)

    def warm_up(self) -> None:
        """Compile or load every kernel of the path, before arming."""
        self.decoder.warm_up()
        self.core.windows.warm_up()
        self.turn.warm_up()
        self._steps.begin(self._session)

    @property
    def tables(self) -> DecisionTables:
        """What decides without asking the back end."""
        return self._steps.tables

    def begin(self, session: int, start_tick: int, n_cycles: int) -> Iterator[Batch]:
        """Follow the stream that an ARM starts in `session`; what the one before left open is yielded."""
        self._steps.hand_over()
        output = self.core.begin(start_tick, n_cycles)
        self._session = session
        self._steps.begin(session)
        yield from _as_rows(output.decisions)
        if output.events:
            yield Batch(np.zeros(0, DECISION_DTYPE), output.events, [])

    def end(self) -> Iterator[Batch]:
        """End the stream, and yield what it leaves open."""
        self._steps.hand_over()
        output = self.core.end()
        yield from _as_rows(output.decisions)
        if output.events:
            yield Batch(np.zeros(0, DECISION_DTYPE), output.events, [])

    def reopen(self) -> None:
        """Decode another connection from its beginning; until `begin` nothing in it is of a stream that is followed."""
        self._steps.hand_over()
        self._session = 0
        self._steps.begin(0)
        self.decoder = BulkDecoder()
        self.turn = Turn(self._steps, self.decoder)

    def photons_of(self, objects: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.float32]:
        """Return the expected photoelectrons of one shot on each object, float32 (n,), NaN where no mark told them."""
        return self._steps.photons_of(objects)

    def feed(self, data: bytes | bytearray | memoryview | U8) -> Iterator[Batch]:
        """Take bytes as they arrived, whatever they hold; the iterator must be used up."""
        for spans in self.decoder.bodies(data):
            yield from self._go_on(self.turn.decoded(len(spans), 0))

    def listen(self, fd: int, limits: Limits) -> Iterator[Batch]:
        """Take what comes from a descriptor until `limits`, or until the other end has closed it; the iterator must be used up."""
        yield from self._go_on(self.turn.run(fd, limits))

    def _go_on(self, ended: int) -> Iterator[Batch]:
        """Yield what a call of the kernel brought, and take what ended it, until nothing decoded is left."""
        while True:
            rows = self.turn.rows
            if len(rows):
                yield Batch(rows, [], [])
            if ended == ring.ODD:
                first, stop = self.turn.left[0].tolist()
                self.turn.skip()
                yield from self._take_one(self.decoder.frame(first, stop))
            elif ended != ring.FULL:
                return
            ended = self.turn.run()

    def _take_one(self, frame: Frame) -> Iterator[Batch]:
        """Let Core take a message that is not ordinary: one out of order, with a gap before it, or no block at all."""
        none: npt.NDArray[np.void] = np.zeros(0, DECISION_DTYPE)
        if frame.session != self._session:
            self.wrong_session += 1
            return
        if frame.type not in _CORE_TYPES:
            yield Batch(none, [], [frame])
            return
        output = self._steps.step(frame)
        others = [frame] if frame.type == MessageType.STATUS else []
        yield from _as_rows(output.decisions)
        if output.events or others:
            yield Batch(none, output.events, others)


def _as_rows(decisions: list[Decision]) -> Iterator[Batch]:
    for start in range(0, len(decisions), ROWS_PER_BATCH):
        yield Batch(np.array(decisions[start : start + ROWS_PER_BATCH], DECISION_DTYPE), [], [])
