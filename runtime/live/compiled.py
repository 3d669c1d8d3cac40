"""The compiled turns of a live run: when they are used, what is lent to them, and what is done with all that came in one call.

Owns the hand-over between Python's turn (run.py) and turn/engine.py's: when it is Python's turn again, session, driver and core are where
it would have them, so that either goes on where the other stopped. What is not ordinary is given to Python's own ways, one by one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from pans.runtime.core.bulk_steps import BulkSteps
from pans.runtime.core.decision import Decision, NumberedDecisions, Output, RowDecisions
from pans.runtime.core.still import Core
from pans.runtime.core.stream_arrays import MarkArrays
from pans.runtime.errors import LinkError
from pans.runtime.link.base import descriptor_of
from pans.runtime.link.connection import Arrived, Connection
from pans.runtime.link.reader import count_delimiters
from pans.runtime.record.format import Kind
from pans.runtime.timing.evidence import INFERENCE, NS_PER_S
from pans.runtime.turn import rings as ring
from pans.runtime.turn import settling as kernels
from pans.runtime.turn.engine import Limits, Steps, Turn
from pans.runtime.turn.kernels import QUIET_NS, unpack_blocks
from pans.runtime.turn.watching import FrameWatch
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import Opcode, decode_ack
from pans.runtime.wire.schema import HEADER
from pans.runtime.wire.session import STREAM_TYPES, Refusal

from .lateness import Judged
from .tally import NO_DECISIONS

if TYPE_CHECKING:
    from pans.runtime.flow.core import FlowCore

    from .run import LiveRun

I64 = npt.NDArray[np.int64]
Rows = npt.NDArray[np.void]

NOTHING = Output([], [], None)
GATHERED_BYTES = 1 << 18
EAGER_NS = 200_000  # as link/reader.py: an answer that was asked for is waited for awake
LEAST_NS = 100_000
TURN_NS = 20_000_000  # a call comes back at least so often: signals, the watchdog's heartbeat, other threads' wishes


class CompiledTurns:
    """The compiled turns of `run`, across reconnections: `prepare` before each ARM, then `turn` again and again.

    With `prompt`, a call ends behind the first bytes that gave a decision, for a watcher that acts.
    """

    def __init__(self, run: LiveRun, core: Core | FlowCore, *, prompt: bool) -> None:
        self._run, self._prompt = run, prompt
        self._core: Core | FlowCore = core
        self._turn: Turn | None = None
        self._attached: Connection | None = None
        self._fd: int | None = None
        self.none = NO_DECISIONS
        self._stamps, self._bits = np.ones(0, np.uint16), np.ones(0, np.uint8)
        self._frames: FrameWatch | None = None
        if isinstance(core, Core) and core.guard is not None and core.windows.parallel:
            self._frames = FrameWatch(core)
        elif isinstance(core, Core) and core.guard is not None:
            exposures = ring.KEPT_BYTES // 2  # two bytes each
            self._stamps, self._bits = np.ones(exposures, np.uint16), np.ones(exposures, np.uint8)
        self._judged = Judged(run.timing)
        self._error: LinkError | None = None  # met while something is left to take
        self._asked = False  # what Python sent of a call is about to be answered
        self.settled: Callable[[Turn, Output], None] | None = None  # told after each call that brought messages

    def leave_off(self) -> int:
        """Let a call that is under way end, from any thread; return the id of the command that follows those that it has sent."""
        if self._turn is None:
            return 0
        self._turn.stop()
        return int(self._turn.control[ring.NEXT_ID])

    def prepare(self) -> None:
        """Lend the run's present connection to the compiled turn, once; kernels are compiled or loaded."""
        run = self._run
        if self._attached is run.connection:
            return
        self._attached = run.connection
        nonce = run.connection.session.nonce
        steps, bulk = self._steps(nonce), run.connection.decoder.bulk
        assert bulk is not None
        drive = None if run.driver is None else run.driver.arrays(nonce)
        self._turn = Turn(steps, bulk, drive)
        self._turn.warm_up()
        self._warm_up(self._turn)
        link = run.connection.link
        self._fd = None if link.virtual else descriptor_of(link)

    def _warm_up(self, turn: Turn) -> None:
        """Compile or load what takes over what a call brought."""
        steps = turn.steps
        assert isinstance(steps, BulkSteps)
        run, self.none = self._run, steps.decisions(slice(0, 0))
        unpack_blocks(turn.kept, turn.messages, self._stamps, self._bits)
        run.tally.warm_up(steps.walk.marks, steps.windows.n_windows, self.none)
        self._judged.take(turn.blocks[:0], self.none, run.connection.known_clock())
        if isinstance(self.none, NumberedDecisions):
            assert not len(self.none.rows)  # compiles or loads what makes them
            if run.recorder is not None:
                run.recorder.prepare(self.none)
        if self._frames is not None:
            self._frames.warm_up()

    def turn(self, poll_s: float) -> list[Output]:
        """Wait for bytes, decide on them and answer until something is due; return what came of it."""
        run, outputs = self._run, list[Output]()
        connection, turn = run.connection, self._turn
        assert turn is not None
        self._error = None
        if self._fd is not None and connection.reader.lend():
            try:
                asked = connection.send_due()
                self._lend(turn)
                ended = self._sent(turn, turn.run(self._fd, self._limits(poll_s, eager=asked)))
            finally:
                connection.reader.take_back()
            self._settle(turn, outputs)
            if turn.counts.notes or turn.counts.arrivals:
                self._note(turn)
            self._go_on(turn, ended, outputs, turn.run)
            if ended == ring.GONE:
                self._ask_why(turn)
        else:
            chunks = self._gathered(poll_s)
            if chunks:
                self._lend(turn)
                ended = self._sent(turn, turn.feed(chunks))
                self._settle(turn, outputs)
                if not run.connection.link.virtual:
                    self._note(turn)
                self._go_on(turn, ended, outputs, turn.feed_on)
        connection.take_pongs()
        if self._error is not None:
            raise self._error
        if not outputs:
            connection.raise_failure()
        return outputs

    def last(self, poll_s: float) -> list[Arrived]:
        """Take a turn while the device stops; return what is left to Python. No state is named any more."""
        if self._attached is not self._run.connection:  # a new one, broken off before it was armed
            return self._run.connection.pump(poll_s)
        self.turn(poll_s)
        return []

    # -- before a call -------------------------------------------------------------------------------------------------

    def _limits(self, poll_s: float, *, eager: bool) -> Limits:
        run = self._run
        now_ns = run.now_ns()
        budget = 1 if self._prompt else max(run.messages_granted, 1)
        due_ns = min(now_ns + TURN_NS - (QUIET_NS if run.driver is not None else 0), max(run.due_ns, now_ns + LEAST_NS))
        patience_ns = run.lateness.patience_ns
        return Limits(due_ns, patience_ns, EAGER_NS if eager else 0, budget, run.lateness.evidence.floor_ns)

    def _lend(self, turn: Turn) -> None:
        """Put what Python knows of the stream, the session and the driver where the kernel looks for it."""
        run, control = self._run, turn.control
        next_id, oldest_id, oldest_ns, waiting = run.connection.session.window
        driver = run.driver
        drives = driver is not None and not run.stops and not run.is_broken
        control[ring.DRIVES : ring.WAITING + 1] = (drives, waiting)
        control[ring.BLOCK_NS : ring.OLDEST_NS + 1] = (run.lateness.block_ns, next_id, oldest_id, oldest_ns)
        if driver is not None:
            control[ring.SENT_EXPOSURE : ring.SENT_STATE + 1] = driver.sent
        self._steps(run.connection.session.nonce)

    def _steps(self, nonce: int) -> Steps:
        """Return the compiled steps of the core, ready for messages of session `nonce`."""
        assert isinstance(self._core, Core)
        steps = self._core.bulk_steps(nonce)
        assert steps is not None
        return steps

    # -- after a call --------------------------------------------------------------------------------------------------

    def _gathered(self, poll_s: float) -> Sequence[tuple[int, bytes]]:
        """Return what was read elsewhere; of parallel frames in virtual time many reads, where nobody acts on the first."""
        run = self._run
        connection, link = run.connection, run.connection.link
        chunks, self._asked = connection.chunks(poll_s, asked=self._asked), False
        gathers = isinstance(self._core, Core) and self._core.windows.parallel
        if not (link.virtual and gathers and chunks) or self._prompt:
            return chunks
        left = run.messages_granted - count_delimiters(chunks[0].data)
        return [*chunks, *connection.reader.ahead(poll_s, left, GATHERED_BYTES, run.due_ns)]

    def _go_on(self, turn: Turn, ended: int, outputs: list[Output], again: Callable[[], int]) -> None:
        """Deal with what ended a call until nothing that was read is left; no more is read."""
        while ended in (ring.ODD, ring.FULL, ring.BROKEN):
            try:
                if ended == ring.ODD:
                    self._take_odd(turn, outputs)
            except LinkError as error:
                self._error = self._error or error
            self._lend(turn)
            self._run.tell(outputs)  # before the rings are filled anew
            ended = self._sent(turn, again())
            self._settle(turn, outputs)

    def _take_odd(self, turn: Turn, outputs: list[Output]) -> None:
        """Give one message that is not ordinary to Python's ways."""
        run, left = self._run, turn.left[:1]
        connection, arrival_ns = run.connection, turn.arrival_ns
        frame = turn.decoder.frame(*left[0].tolist())
        turn.skip()
        arrived: list[Any] = []
        if frame.type in STREAM_TYPES and frame.session == connection.session.nonce:
            connection.session.heard_ns = arrival_ns
            connection.delivered += 1
            arrived.append(Arrived(arrival_ns, Messages(turn.decoder.buffer, left)))
        else:
            connection.sort(frame, arrival_ns, arrived)
        outputs += run.take(arrived)

    def _sent(self, turn: Turn, ended: int) -> int:
        """Send what is left of a command that the kernel could not send whole, all of it without a descriptor; return `ended`."""
        if ended == ring.BROKEN:
            last, unsent = turn.shows[-1], turn.counts.unsent
            try:
                self._run.connection.link.write(turn.bytes_of(last)[-unsent:])
                last[ring.TIME], self._asked = self._run.now_ns(), True
            except LinkError as error:
                self._error = self._error or error
        return ended

    def _ask_why(self, turn: Turn) -> None:
        """The descriptor says that the other end is gone: the link says it in its words."""
        link, errno = self._run.connection.link, turn.counts.errno
        try:
            self._run.connection.reader.wait(0.0)
            raise LinkError(f"{link.name} went away: {os.strerror(errno) if errno else 'closed by the other end'}")
        except LinkError as error:
            self._error = self._error or error

    def _note(self, turn: Turn) -> None:
        """Give what a call has waited for, and long decisions, to the evidence of what makes work late, in the order of time."""
        evidence = self._run.lateness.evidence
        spans: list[tuple[int, int, int]] = []
        blocks = turn.blocks
        worked = np.flatnonzero(blocks[:, ring.DECIDED] - blocks[:, ring.DECODED] >= evidence.floor_ns)
        for at in worked.tolist():
            spans.append((int(blocks[at, ring.DECIDED]), int(blocks[at, ring.DECODED]), -1))
        for began, asked, ended, _ in turn.notes.tolist():
            spans.append((ended, began, asked))
        for ended, began, asked in sorted(spans) if len(worked) else spans:
            if asked < 0:
                evidence.worked(INFERENCE, began, ended)
            else:
                evidence.waited(began, (asked - began) / NS_PER_S, ended)
        evidence.arrived(*turn.arrivals.tolist())

    def _settle(self, turn: Turn, outputs: list[Output]) -> None:
        """Account for what a call took and sent: session, driver, marks, recording, decisions."""
        run, counts = self._run, turn.counts
        if not counts.kept:
            return
        connection = run.connection
        connection.session.heard_ns = counts.heard_ns or connection.session.heard_ns
        connection.delivered += counts.messages
        connection.answers += counts.answers
        run.taken_here += counts.messages
        if turn.control[ring.DRIVES] and (counts.shows or counts.answers):
            self._settle_commands(turn)
        if counts.messages > counts.steps:
            self._settle_marks(turn)
        self._record(turn)
        if counts.steps:
            self._settle_blocks(turn, outputs)
        if self.settled is not None:
            self.settled(turn, outputs[-1] if counts.steps else NOTHING)

    def _record(self, turn: Turn) -> None:
        """Record what a call took and sent."""
        recorder, counts = self._run.recorder, turn.counts
        if recorder is not None:
            recorder.add_stamped(Kind.MESSAGES, turn.kept, turn.messages)
            if counts.answers:
                recorder.add_stamped(Kind.ANSWERS, turn.kept, turn.answers)
            if counts.shows:
                recorder.add_stamped(Kind.COMMANDS, turn.kept, turn.shows)

    def _settle_marks(self, turn: Turn) -> None:
        """Let the core know of the marks of a call."""
        assert isinstance(turn.steps, BulkSteps)
        for mark in turn.marks():
            self._core.remember(mark)
            turn.steps.told(mark)

    def _settle_commands(self, turn: Turn) -> None:
        """Bring the session and the driver to where the kernel has them."""
        run, control, shows = self._run, turn.control, turn.shows
        first = int(control[ring.NEXT_ID]) - len(shows)
        open_since = max(int(control[ring.OLDEST_ID]), first)
        sent = [(number, turn.bytes_of(shows[number - first])) for number in range(open_since, first + len(shows))]
        session = run.connection.session
        session.continue_from(int(control[ring.OLDEST_ID]), int(control[ring.OLDEST_NS]), sent, Opcode.SHOW)
        session.next_id = first + len(shows)
        for span in turn.answers[turn.answers[:, ring.WHAT] == ring.REFUSAL]:
            ack = decode_ack(turn.bytes_of(span)[HEADER.size :])
            session.refusals.append(Refusal(ack.refused_id, ack.status, ack.text, Opcode.SHOW))
        if run.driver is not None:
            exposure, state = control[ring.SENT_EXPOSURE : ring.SENT_STATE + 1].tolist()
            run.driver.went_on((exposure, state), shows[:, ring.TIME] - shows[:, ring.WHAT])

    def _settle_blocks(self, turn: Turn, outputs: list[Output]) -> None:
        """Account for the blocks of a call and their decisions."""
        run, blocks, steps = self._run, turn.blocks, turn.steps
        assert isinstance(steps, BulkSteps)
        decided = steps.decisions(turn.place)
        if run.connection.link.virtual:
            blocks[:, ring.DECODED : ring.RECORDED + 1] = blocks[:, ring.ARRIVAL, None]  # no time passes in between
        events = self._watch(turn, decided)
        for event in events:
            run.journal.take(event)
        runs, marked = self._judged.take(blocks, decided, run.connection.known_clock())
        account_many(run, steps.walk.marks, runs, decided)
        for step, end_ns, uncertainty_ns, look in marked.tolist():
            arrival_ns, decoded_ns, decided_ns, recorded_ns, end_tick, stop = blocks[step, : ring.ROWS + 1].tolist()
            if look & kernels.IS_LATE:
                first = int(blocks[step - 1, ring.ROWS]) if step else 0
                for number in range(decided.first + first, decided.first + stop):
                    run.note_late(number, (end_ns, arrival_ns, decoded_ns, decided_ns, recorded_ns), uncertainty_ns)
            if look & kernels.IS_AHEAD:
                run.check_tick(end_tick, arrival_ns)
        run.block_came(int(blocks[-1, ring.ARRIVAL]))
        # read like a list, by whoever looks at an output
        outputs.append(Output(cast(list[Decision], decided), events, self._core.last_tick))

    def _watch(self, turn: Turn, decided: RowDecisions) -> list[Any]:
        """Let the guard of the dark counts see the exposures of a call."""
        core = self._core
        if not isinstance(core, Core) or core.guard is None:
            return []
        if not core.windows.parallel:
            n = int(unpack_blocks(turn.kept, turn.messages, self._stamps, self._bits))
            return core.watch_blocks(self._stamps[:n], self._bits[:n], core.tracker.next_exposure - n, decided.rows)
        return [] if self._frames is None else self._frames.take(turn.kept, turn.messages)


def account_many(run: LiveRun, marks: MarkArrays, runs: Rows, decided: RowDecisions) -> None:
    """Tally and record decisions whose times are `runs`."""
    if not len(decided):
        return
    run.tally.add_many(decided, marks)
    if run.recorder is not None:
        run.recorder.add_decisions(decided if isinstance(decided, NumberedDecisions) else decided.rows)
        run.recorder.add_timing_runs(runs)
