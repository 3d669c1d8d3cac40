"""What must hold whatever the link does: what the instrument logged against what the host concluded, while the run goes on.

Owns the ledger of what was emitted and executed, and the comparison; never changes a byte. It sees the instrument from inside and
the host's core from its calls, and shares no code with either's accounting. `Checker.violations` lists what was found, at most 20.
Checked are: every emitted block is delivered unchanged or reported lost, exactly once; a window with a missing exposure abstains, and
one without is decided from the clicks that were emitted; no window is skipped or decided twice; no command is executed twice, out of
order or late; every gate is executed or its refusal is reported.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.device.sequential import Measurement, StreamMessage
from pans.firmware_sim.device.stream_buffer import StreamBuffer
from pans.runtime.core.decision import NO_LABEL, Decision, DecisionFlag, Output, StreamEndUnknown
from pans.runtime.core.plan import Plan
from pans.runtime.live import LiveRun
from pans.runtime.wire import messages as wire
from pans.runtime.wire.commands import Gate, unpack_gate
from pans.runtime.wire.frame import Messages, unpack_body
from pans.runtime.wire.messages import ClickBlock, FrameBlock, Mark
from pans.runtime.wire.tracker import Gap

from .books import DELIVERED, EMITTED, LOST, NO_BOOKS, RING, CheckCounts, DeviceBooks, Entry, Stream
from .truths import decoded, walk_truth, window_members

if TYPE_CHECKING:
    from pans.firmware_sim.device.parallel import FrameRun
    from pans.runtime.turn.engine import Turn

MAX_VIOLATIONS = 20
MAX_SESSIONS = 8  # streams that are remembered
MAX_GATES = 4096


class Checker:
    """Compares both ends of one run."""

    def __init__(self, plan: Plan, shots: int) -> None:
        self.violations: list[str] = []
        self.counts = CheckCounts()
        self._visit = plan.slots_per_cycle * plan.cycles_per_object
        self._members, self._features = window_members(plan, shots)
        self._automaton = plan.automaton
        # a walk is decided at its leaf, which may be any of its exposures
        self._window_of = {
            int(member): window
            for window, members in enumerate(self._members)
            for member in (members[-1:] if plan.automaton is None else members)
        }
        self._n_features = plan.n_patterns
        self._parallel = plan.mode == "parallel"
        if self._n_features > 64:
            raise ValueError(f"the checker follows at most 64 patterns, found {self._n_features}")
        self._byte_weights = np.uint64(1) << np.arange(0, 64, 8, dtype=np.uint64)
        self._streams: dict[int, Stream] = {}
        self._host_session = 0
        self._stepped = False  # by the message that the host takes now
        self._last_command: dict[tuple[int, int], int] = {}
        self._gates: dict[tuple[int, int], Gate] = {}  # submitted: (session, command id)
        # by session: behind a reset the device counts its ticks anew, and the same gate is another one
        self._asked: dict[tuple[int, Gate], None] = {}
        self._executed: dict[tuple[int, Gate], None] = {}
        self.books: dict[int, DeviceBooks] = {}  # by session

    def fail(self, text: str) -> None:
        """Keep one violation."""
        if len(self.violations) < MAX_VIOLATIONS:
            self.violations.append(text)

    # -- the instrument's side -----------------------------------------------------------------------------------------

    def on_put(self, session: int, message: StreamMessage, dropped: bool) -> None:
        """A stream message was made; it leaves now or later, or was dropped."""
        self.counts.frames_emitted += not dropped
        if isinstance(message, Mark):
            return
        stream = self._stream(session)
        raw = message.bits if isinstance(message, ClickBlock) else message.words
        entry = Entry(message.exposure_index, len(raw), raw.tobytes(), message.object_index, dropped)
        stream.emitted_to = entry.first + entry.exposures
        books = self.books.get(session, NO_BOOKS)
        self.books[session] = books._replace(
            exposures=stream.emitted_to, dropped=books.dropped + entry.exposures * dropped
        )
        if stream.open_end:
            self.counts.blocks_lost_open_end += 1
            return
        stream.entries.append(entry)
        where = _places(entry.first, stream.emitted_to)
        stream.state[where] = EMITTED
        if self._automaton is not None and isinstance(message, ClickBlock):
            stream.stamps[where] = message.patterns
        stream.clicks[where] = raw if raw.ndim == 1 else raw.astype(np.uint64) @ self._byte_weights[: raw.shape[1]]

    def on_execute(self, epoch: int, session: int, command: wire.CommandMessage, tick: int) -> None:
        """The device carries out a command."""
        self.counts.commands += 1
        key = (epoch, session)
        if command.command_id != self._last_command.get(key, 0) + 1:
            self.fail(
                f"command {command.command_id} of session {session:08x} executed after {self._last_command.get(key)}"
            )
        self._last_command[key] = command.command_id

    def on_gate(self, session: int, gate: Gate, tick: int) -> None:
        """The device has accepted a pulse."""
        self.counts.gates_executed += 1
        if gate.tick <= tick:
            self.fail(f"a gate for tick {gate.tick} was executed at {tick}: late")
        if (session, gate) in self._executed:
            self.fail(f"the gate for tick {gate.tick} was executed twice")
        if (session, gate) not in self._asked:
            self.fail(f"a gate for tick {gate.tick} was executed without a command")
        self._executed[session, gate] = None
        _forget_oldest(self._executed, MAX_GATES)

    # -- the host's side -----------------------------------------------------------------------------------------------

    def attach(self, run: LiveRun) -> None:
        """Listen to the calls of the run's core."""
        core = run.core
        accept, finish, step, begin, end = core.tracker.accept, core.tracker.finish, core.step, core.begin, core.end

        def tapped_accept(frame: wire.Frame) -> Any:
            message, gap = accept(frame)
            self._on_accept(message, gap)
            return message, gap

        def tapped_finish(next_exposure: int, drops: int) -> Any:
            gap = finish(next_exposure, drops)
            if gap is not None:
                self._on_gap(gap)
            return gap

        def tapped_begin(start_tick: int, n_cycles: int) -> Output:
            output = begin(start_tick, n_cycles)
            self._on_output(output)
            self._host_session = run.connection.session.nonce
            self.counts.streams += 1
            return output

        step_messages = core.step_messages

        def tapped_step(frame: wire.Frame) -> Output:
            self._stepped = True
            return self._on_output(step(frame))

        def tapped_messages(messages: Messages, place: int) -> tuple[int, Output]:
            """What compiled steps take in one piece follows without a gap; all else comes by `step`."""
            self._stepped = False
            taken, output = step_messages(messages, place)
            if not self._stepped:
                for one in range(place, place + taken):
                    self._on_accept(decoded(messages.frame(one)), None)
                self._on_output(output)
            return taken, output

        for owner, name, tap in (
            (core.tracker, "accept", tapped_accept),
            (core.tracker, "finish", tapped_finish),
            (core, "begin", tapped_begin),
            (core, "step", tapped_step),
            (core, "step_messages", tapped_messages),
            (core, "end", lambda: self._on_output(end())),
        ):
            setattr(owner, name, tap)

        if run.compiled is not None:
            run.compiled.settled = self._on_settled

    def _on_settled(self, turn: Turn, output: Output) -> None:
        """What one compiled call has taken: it all follows without a gap."""
        for span in turn.messages:
            self._on_accept(decoded(unpack_body(turn.bytes_of(span))), None)
        self._on_output(output)

    def submitted(self, session: int, command_id: int, gate: Gate) -> None:
        """The host has asked for a pulse."""
        self.counts.gates_submitted += 1
        self._gates[session, command_id] = gate
        self._asked[session, gate] = None
        _forget_oldest(self._asked, MAX_GATES)
        _forget_oldest(self._gates, MAX_GATES)

    def on_event(self, session: int, event: dict[str, Any]) -> None:
        """The host has reported an event."""
        if event["kind"] != "gate_refused":
            return
        self.counts.gates_refused += 1
        gate = self._gates.pop((session, event["command_id"]), None)
        if gate is None:
            self.fail(f"a refusal of command {event['command_id']} was reported that is no open gate")
        elif (session, gate) in self._executed:
            self.fail(f"the gate for tick {gate.tick} was executed, and reported as refused")

    def settled(self, session: int, up_to_id: int) -> None:
        """Every command of `session` up to this one has been acknowledged: each gate has been executed or reported."""
        for key in [key for key in self._gates if key[0] == session and key[1] <= up_to_id]:
            gate = self._gates[key]
            if (session, gate) not in self._executed:
                self.fail(f"the gate for tick {gate.tick} was neither executed nor reported as refused")

    def close(self) -> None:
        """The run is over: nothing may be left that was neither delivered nor reported lost."""
        stream = self._stream(self._host_session)
        if stream.entries and not stream.open_end:
            left = stream.entries[0]
            self.fail(f"{len(stream.entries)} blocks from exposure {left.first} on were never accounted for")

    # -- comparing -----------------------------------------------------------------------------------------------------

    def _stream(self, session: int) -> Stream:
        if session not in self._streams:
            self._streams[session] = Stream()
            _forget_oldest(self._streams, MAX_SESSIONS)
        return self._streams[session]

    def _on_accept(self, message: ClickBlock | FrameBlock | Mark | None, gap: Gap | None) -> None:
        if gap is not None:
            self._on_gap(gap)
        if message is None or isinstance(message, Mark):
            return
        stream = self._stream(self._host_session)
        raw = message.bits if isinstance(message, ClickBlock) else message.words
        got = Entry(message.exposure_index, len(raw), raw.tobytes(), message.object_index, False)
        wanted = stream.entries.popleft() if stream.entries else None
        if wanted != got or got.first != stream.accounted_to:
            self.fail(
                f"delivered were exposures {got.first} to {got.first + got.exposures}, due were {stream.accounted_to} "
                f"and {None if wanted is None else wanted[:2]}: repeated, changed, or skipped in silence"
            )
        stream.accounted_to = got.first + got.exposures
        stream.state[_places(got.first, stream.accounted_to)] = DELIVERED
        self.counts.blocks_delivered += 1

    def _on_gap(self, gap: Gap) -> None:
        stream = self._stream(self._host_session)
        if gap.first_exposure != stream.accounted_to:
            self.fail(f"a gap from exposure {gap.first_exposure} was reported, due was {stream.accounted_to}")
        end = gap.first_exposure + gap.exposures
        while stream.entries and stream.entries[0].first < end:
            entry = stream.entries.popleft()
            if entry.first != stream.accounted_to or entry.first + entry.exposures > end:
                self.fail(f"the gap {gap[:2]} cuts the block of exposures {entry[:2]}")
            stream.accounted_to = entry.first + entry.exposures
            self.counts.blocks_lost += 1
        if stream.accounted_to != end:
            self.fail(f"the gap {gap[:2]} ends at {end}, but only exposures up to {stream.accounted_to} were emitted")
            stream.accounted_to = end
        stream.state[_places(gap.first_exposure, end)] = LOST

    def _on_output(self, output: Output) -> Output:
        stream = self._stream(self._host_session)
        for event in output.events:
            if isinstance(event, StreamEndUnknown):
                self.counts.blocks_lost_open_end += len(stream.entries)
                stream.open_end = True
                self.books[self._host_session] = self.books.get(self._host_session, NO_BOOKS)._replace(end_known=False)
                stream.entries.clear()
        for decision in output.decisions:
            self._on_decision(stream, decision)
        return output

    def _on_decision(self, stream: Stream, decision: Decision) -> None:
        self.counts.decisions += 1
        visit = decision.exposure_index // self._visit
        window = self._window_of.get(decision.exposure_index - visit * self._visit, -1)
        number = visit * len(self._members) + window
        if number != stream.next_window:
            self.fail(f"decision {decision.number} is of window {number}, due was {stream.next_window}")
        stream.next_window = number + 1
        exposures = visit * self._visit + self._members[window]
        if self._automaton is not None:
            self._on_walk(stream, decision, exposures)
            return
        complete = bool((stream.state[exposures % RING] == DELIVERED).all())
        flagged = bool(decision.flags & DecisionFlag.ABSTAINED) and decision.label == NO_LABEL
        self.counts.decisions_flagged += flagged
        if not complete and not (flagged and decision.flags & DecisionFlag.GAP):
            self.fail(f"decision {decision.number} was made from a window with a gap: flags {decision.flags}")
        if complete and (flagged or decision.counts_crc != self._truth(stream, exposures, window)):
            self.fail(
                f"decision {decision.number} of a whole window: flags {decision.flags}, or other clicks than were emitted"
            )
        if stream.emitted_to - visit * self._visit > RING:
            self.fail("the checker remembers too few exposures for this plan")

    def _on_walk(self, stream: Stream, decision: Decision, exposures: NDArray[np.int64]) -> None:
        assert self._automaton is not None
        where = exposures % RING
        truth = walk_truth(self._automaton, stream.stamps[where].tolist(), stream.clicks[where].tolist())
        flagged = bool(decision.flags & DecisionFlag.ABSTAINED) and decision.label == NO_LABEL
        self.counts.decisions_flagged += flagged
        delivered = bool((stream.state[where[: truth.taken]] == DELIVERED).all())
        if not (delivered and truth.ended):
            if not flagged:
                self.fail(
                    f"decision {decision.number} was made from a walk with a gap, or without an end: flags {decision.flags}"
                )
            return
        last = int(exposures[truth.taken - 1])
        wanted = zlib.crc32(truth.clicks.tobytes()), truth.taken, last
        found = decision.counts_crc, decision.exposures, decision.exposure_index
        if flagged or found != wanted:
            self.fail(
                f"decision {decision.number} of a whole walk: flags {decision.flags}; clicks, exposures and the last are {found}, "
                f"emitted were {wanted}"
            )

    def _truth(self, stream: Stream, exposures: NDArray[np.int64], window: int) -> int:
        counts = np.zeros(self._n_features, np.int64)
        clicks = stream.clicks[exposures % RING].tolist()
        if self._parallel:
            for channel in range(self._n_features):
                counts[channel] = sum(word >> channel & 1 for word in clicks)
        else:
            for feature, click in zip(self._features[window].tolist(), clicks):
                counts[feature] += click
        return zlib.crc32(counts.tobytes())


class WatchedStream(StreamBuffer):
    """A stream buffer that tells the checker what is put into it."""

    checker: Checker

    def put(self, message: StreamMessage, session: int) -> list[bytes]:
        self.checker.on_put(session, message, len(self._held) >= self.capacity)
        return super().put(message, session)

    def put_due(self, run: Measurement | FrameRun, tick: int, session: int) -> list[bytes | memoryview]:
        return self.put_each(run, tick, session)


class WatchedInstrument(Instrument):
    """An instrument that tells the checker what it emits and executes."""

    checker: Checker

    def watch(self, checker: Checker) -> WatchedInstrument:
        """Report to `checker` from now on; call before the first step."""
        self.checker = checker
        self.stream = WatchedStream(self.stream.capacity)
        self.stream.checker = checker
        return self

    def _execute(self, command: wire.CommandMessage) -> None:
        self.checker.on_execute(self._epoch, self.session, command, self.tick)
        super()._execute(command)

    def _gate(self, body: bytes) -> None:
        super()._gate(body)
        self.checker.on_gate(self.session, unpack_gate(body), self.tick)


def _places(first: int, stop: int) -> slice | NDArray[np.int64]:
    """Return where exposures `first` to `stop` - 1 stand in a ring; as a slice, which is quicker, where they do not go around."""
    begin, end = first % RING, (stop - 1) % RING + 1
    return slice(begin, end) if end - begin == stop - first else np.arange(first, stop) % RING


def _forget_oldest(log: dict[Any, Any], most: int) -> None:
    while len(log) > most:
        del log[next(iter(log))]
