"""Compiled turns that go on in a thread of their own: what they publish is settled here, in the run's thread, meanwhile.

Owns when a call is begun and ended, and what is done with answers and STATUS that came while it went on; the rest is compiled.py's. A call
ends when something is not ordinary: it is settled up to there, that one message is Python's, and the next call begins.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pans.runtime.core.decision import Output
from pans.runtime.core.still import Core
from pans.runtime.record import PartedRecorder
from pans.runtime.turn import rings as ring
from pans.runtime.turn.engine import Turn
from pans.runtime.turn.lasting import LastingCall
from pans.runtime.wire.frame import unpack_body
from pans.runtime.wire.messages import MessageType, decode_status

from .compiled import CompiledTurns

if TYPE_CHECKING:
    from pans.runtime.flow.core import FlowCore
    from pans.runtime.link.connection import Arrived

    from .run import LiveRun

LEAST_LOOK_S, LOOK_S = 0.001, 0.005  # how long the run's thread waits for what is published
_PONG, _ACK, _STATUS = (int(kind) for kind in (MessageType.PONG, MessageType.ACK, MessageType.STATUS))


class LastingTurns(CompiledTurns):
    """The compiled turns of `run` over a link with a descriptor; where a call cannot go on, they are CompiledTurns'."""

    def __init__(self, run: LiveRun, core: Core | FlowCore) -> None:
        super().__init__(run, core, prompt=False)
        self._wakes = False  # whether what is published at once must be taken at once
        self._call: LastingCall | None = None
        self.held_up = 0  # calls that ended because what they had published was not taken

    def attach(self) -> None:
        """See Turns: the thread begins here, with the priority and on the cores that the run has by now."""
        super().attach()
        if self._call is None:
            self._call = LastingCall(wakes=self._wakes)
        turn = self._turn
        assert turn is not None
        self._call.begin(turn, -1, 0)  # the thread's stack is touched
        self._call.end()
        with self._call.writing():
            turn.show_rest()
        self._run.lateness.loop_thread = self._call.thread_id

    @property
    def goes_on(self) -> bool:
        """See Turns."""
        return self._call is not None and self._call.under_way

    @property
    def lives(self) -> bool:
        """See Turns."""
        return self._call is None or self._call.lives

    @property
    def page_faults(self) -> dict[str, int]:
        """See Turns."""
        return {} if self._call is None else self._call.page_faults

    def turn(self, poll_s: float) -> list[Output]:
        """See CompiledTurns: what has been published until now."""
        call, run = self._call, self._run
        assert call is not None
        outputs = list[Output]()
        if call.under_way:
            if call.is_behind:  # what has been answered is not asked again
                self._take_banks(outputs)
            with call.writing():
                run.connection.send_due()  # at once: a probe has its time already
        elif not self._begin():
            return super().turn(poll_s)
        self._error = None
        ended = call.wait(min(max(poll_s, LEAST_LOOK_S), LOOK_S))
        self._take_banks(outputs)
        if ended is None:
            self._look_ahead()
            if self._wants_part:
                self.halt()
        else:
            self._finish(ended, outputs)
        run.connection.take_pongs()
        if self._error is not None:
            raise self._error
        if not call.under_way:
            run.tell(outputs)  # before the rings are filled anew
            run.connection.raise_failure()
            self._begin()
        return outputs

    def last(self, poll_s: float) -> list[Arrived]:
        """See Turns; beside a call that did not stop, Python takes what comes."""
        return self._run.connection.pump(poll_s) if self.goes_on else super().last(poll_s)

    def halt(self) -> None:
        """See Turns; a call that does not stop is left behind."""
        call = self._call
        if call is None or not call.under_way:
            return
        ended = call.end()
        if ended is not None:
            outputs = list[Output]()
            self._take_banks(outputs)
            self._finish(ended, outputs)
            self._run.tell(outputs)

    def leave_off(self) -> int:
        """See Turns; what was published is not settled, since it may be settling that is stuck."""
        if self._turn is None or not self.goes_on:
            return 0
        self._turn.stop()
        return int(self._turn.control[ring.NEXT_ID])

    def close(self) -> None:
        """See Turns."""
        if self._call is not None:
            self._call.close()

    def _begin(self) -> bool:
        """Begin a call, unless it could not go on here and now."""
        run, turn, call = self._run, self._turn, self._call
        assert turn is not None
        assert call is not None
        if self._fd is None or not turn.can_last or self._wants_part:
            return False
        run.connection.send_due()
        if (run.driver is not None and run.connection.session.window[3]) or not run.connection.reader.lend():
            return False
        self._lend(turn)
        call.begin(turn, self._fd, run.lateness.evidence.floor_ns)
        return True

    @property
    def _wants_part(self) -> bool:
        """Whether the recording waits for a place at which its next part may begin: that is looked for call by call."""
        recorder = self._run.recorder
        return isinstance(recorder, PartedRecorder) and recorder.wants_part

    def _look_ahead(self) -> None:
        """Know of blocks that have come and are not published yet: nothing is overdue then."""
        turn, lateness = self._turn, self._run.lateness
        assert turn is not None
        block_ns = int(turn.control[ring.BLOCK_NS])
        if block_ns > lateness.block_ns:
            lateness.block_came(block_ns)

    def _take_banks(self, outputs: list[Output]) -> None:
        """Settle what has been published."""
        call, turn = self._call, self._turn
        assert call is not None
        assert turn is not None
        for _ in call.banks():
            self._settle_bank(turn, outputs)
            self._run.tell(outputs)  # before the bank is filled anew

    def _settle_bank(self, turn: Turn, outputs: list[Output]) -> None:
        self._settle(turn, outputs)
        if turn.counts.notes or turn.counts.arrivals:
            self._note(turn)
        self._take_aside(turn, outputs)

    def _finish(self, ended: int, outputs: list[Output]) -> None:
        """Settle what a call that has ended left, and deal with why it has."""
        turn, connection = self._turn, self._run.connection
        assert turn is not None
        connection.reader.take_back()
        turn.show_rest()
        self._sent(turn, ended)
        self._settle_bank(turn, outputs)
        if ended == ring.FULL:
            self.held_up += 1
            self._run.journal.note("turn_held_up", times=self.held_up)
        self._go_on(turn, ended, outputs, turn.run)
        if ended == ring.GONE:
            self._ask_why(turn)

    def _take_aside(self, turn: Turn, outputs: list[Output]) -> None:
        """Give answers to the session, and STATUS to session and core, as they would have been given one by one."""
        run = self._run
        connection = run.connection
        own = (_PONG,) if turn.reported[ring.DRIVES] else (_PONG, _ACK)
        for span in turn.answers:
            if span[ring.WHAT] in own:
                connection.digest(unpack_body(turn.bytes_of(span)), int(span[ring.TIME]))
        for span in turn.messages[turn.messages[:, ring.WHAT] == _STATUS]:
            frame, arrival_ns = unpack_body(turn.bytes_of(span)), int(span[ring.TIME])
            connection.digest(frame, arrival_ns)
            outputs.append(self._core.step(frame))
            for event in outputs[-1].events:
                run.journal.take(event)
            status = decode_status(frame.payload)
            run.check_tick(status.tick, arrival_ns)
            run.lateness.status_came(connection, status, arrival_ns)
