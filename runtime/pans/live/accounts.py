"""What a run has done so far: `Accounts` adds up its batches, `Account` is how that stands at one moment.

With each batch: `record`, then `act`, then `add`. What is acted upon is on record first. Nothing in here waits.
"""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.base.errors import LinkError
from pans.base.machine import give_way
from pans.decide import DECISION_DTYPE, Follower, Output
from pans.decide.kernel import Kernel
from pans.decide.kernel import arrays as ring
from pans.decide.plan import unknown_photons
from pans.decide.still import DARK_CLICKS, DARK_EXPOSURES, LATE_SLOTS, WRONG_PATTERNS
from pans.live.timing.causes import INFERENCE, LateWork, Stamped
from pans.live.timing.lateness import Lateness
from pans.live.timing.ledger import TimingLedger
from pans.protocol.clock import STEP_MARGIN_NS, future_tick
from pans.protocol.links import Link
from pans.protocol.tracker import Gap
from pans.protocol.wire import MalformedMessage, MessageType, decode_status, pack_body
from pans.record.reading import TIMING_RUN_DTYPE, Kind
from pans.record.recorder import Recorder

from .gates import GateQueue
from .job import Job
from .journal import Journal
from .receiver import Batch, Taken
from .session import Session
from .tally import RunTally

NS_PER_US = 1_000
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Account:
    """The figures of a run so far, by the names of the contract; nothing in it changes any more."""

    decided: dict[str, Any]  # sums of the decisions, for base.numbers.decision_figures
    objects: int  # distinct ones
    late: int
    late_cause: dict[str, int]  # late decisions by who is to blame (causes.CAUSES)
    lost_cause: dict[str, int]  # lost exposures
    latency_us: dict[str, float | None]  # p50, p99, p999, max
    latency_counts: I64  # of timing.ledger.LatencyHistogram
    clock_uncertainty_us: float  # the worst one behind a latency
    stream: dict[str, int]
    decoder: dict[str, int]  # of sessions that have ended
    contradictions: dict[str, int]  # messages that are excluded, by what is wrong
    dark_exposures: int
    dark_clicks: int
    wrong_patterns: int  # late slots among them
    late_slots: int  # that stayed dark because the host named no state in time
    light_changed: int
    trouble: dict[str, Any] | None  # the latest event that is trouble


class Accounts:
    """The figures of one run, across reconnections; the loop's thread alone adds to them."""

    def __init__(self, job: Job, core: Follower, link: Link, recorder: Recorder | None) -> None:
        options = job.options
        self.recorder = recorder
        self.timing = TimingLedger(int(options.deadline_us * NS_PER_US))
        self.tally = RunTally(len(job.bundle.classes), options.shots)
        self.journal = Journal(recorder)
        self.gates = GateQueue(recorder, self.journal)
        self.lateness = Lateness(job.plan, self.timing.deadline_ns, link, recorder)
        self.decoded: Counter[str] = Counter()  # what the sessions that have ended have counted
        self.contradictions: Counter[str] = Counter()  # between messages and the clock, or the host's own books
        self.late: list[int] = []  # numbers of the late ones among the decisions that are shown next
        self._core = core

    def account(self) -> Account:
        """Return how things stand; from any thread."""
        core, total, tallies = self._core, self.timing.total, self._core.tallies
        incidents, counters = self.lateness.incidents, core.tracker.counters
        return Account(
            decided=self.tally.sums(),
            objects=self.tally.objects,
            late=self.timing.late,
            late_cause=dict(incidents.causes),
            lost_cause=dict(incidents.missing),
            latency_us=total.summary(),
            latency_counts=total.counts.copy(),
            clock_uncertainty_us=self.timing.worst_uncertainty_ns / NS_PER_US,
            stream={name: getattr(counters, name) for name in counters.__slots__},
            decoder=dict(self.decoded),
            contradictions=_added(core.contradictions, self.contradictions),
            dark_exposures=int(tallies[DARK_EXPOSURES]),
            dark_clicks=int(tallies[DARK_CLICKS]),
            wrong_patterns=int(tallies[WRONG_PATTERNS]),
            late_slots=int(tallies[LATE_SLOTS]),
            light_changed=self.journal.counts["light_changed"],
            trouble=self.journal.trouble,
        )

    # -- record, act, add ----------------------------------------------------------------------------------------------

    def record(self, batch: Batch) -> None:
        """Put into the recording's buffers: bytes as they came, then decisions."""
        recorder, kernel = self.recorder, batch.kernel
        if recorder is None:
            return
        if kernel is not None and kernel.end.kept > kernel.begin.kept:
            recorder.add_stamped(Kind.MESSAGES, kernel.kept, kernel.messages)
            recorder.add_stamped(Kind.ANSWERS, kernel.kept, kernel.answers)
            recorder.add_stamped(Kind.COMMANDS, kernel.kept, kernel.shows)
        if len(batch.rows):
            recorder.add_decisions(batch.rows)
        if (odd := batch.odd) is not None:
            recorder.add_message(odd.times_ns[0], pack_body(odd.frame))
            if odd.output.decisions:
                recorder.add_decisions(np.array(odd.output.decisions, DECISION_DTYPE))

    def act(self, batch: Batch, session: Session) -> None:
        """Send the pulses that a batch asks for; those of late decisions expire, as the deadline judges them."""
        if not batch.pulses:
            return
        clock, deadline_ns = session.known_clock(), self.timing.deadline_ns
        for action, arrival_ns, decided_ns in batch.pulses:
            end_ns, unsure_ns = clock.to_host_ns(action.end_tick)
            end_ns = arrival_ns if end_ns - unsure_ns > arrival_ns else end_ns  # what has arrived has happened
            self.gates.take([action], (decided_ns - end_ns - unsure_ns - deadline_ns) / NS_PER_US)
        if session.broken is None:
            try:
                self.turn_gates(session)
            except LinkError as error:
                session.note_broken(error)

    def turn_gates(self, session: Session) -> None:
        """Send the pulses that wait, at once: a pulse does not wait for the rest of what has to be done."""
        now_ns = session.link.now_ns()
        if self.gates.turn(session.host, session.known_clock(), now_ns):
            session.host.poll(now_ns)
            session.flush()

    def add(self, batch: Batch, session: Session) -> list[Output]:
        """Account for a batch; return what came of it, in order."""
        outputs = [self._add_taken(taken, session) for taken in batch.passed]
        kernel = batch.kernel
        if kernel is not None:
            give_way()
            if kernel.end.steps > kernel.begin.steps:
                outputs += self._add_blocks(batch, kernel, session)
            if not session.link.virtual and (
                kernel.end.notes > kernel.begin.notes or kernel.end.arrivals > kernel.begin.arrivals
            ):
                self._add_waits(kernel)
        if batch.odd is not None:
            outputs.append(self._add_taken(batch.odd, session))
        return outputs

    def settle(self, output: Output, session: Session) -> None:
        """Account for what the core settled without a message; its windows have no exposure to be late for."""
        if self.recorder is not None and output.decisions:
            self.recorder.add_decisions(np.array(output.decisions, DECISION_DTYPE))
        self.gates.take(output.actions)
        now_ns = session.link.now_ns()
        self._add_output(output, (now_ns, now_ns, now_ns), session)

    def _add_blocks(self, batch: Batch, kernel: Kernel, session: Session) -> list[Output]:
        """Account for the blocks of a call and their decisions."""
        outputs, blocks, rows = list(batch.outputs), kernel.blocks, batch.rows
        for output in outputs:
            for event in output.events:
                self.journal.take(event)
        give_way()
        clock = session.known_clock()
        ends_ns, unsure_ns = clock.to_host_ns_many(blocks[:, ring.END_TICK])
        for at in np.flatnonzero(ends_ns - unsure_ns - STEP_MARGIN_NS > blocks[:, ring.ARRIVAL]).tolist():
            self._check_tick(int(blocks[at, ring.END_TICK]), int(blocks[at, ring.ARRIVAL]), session)
        give_way()
        self.lateness.block_came(int(blocks[-1, ring.ARRIVAL]))
        if not len(rows):
            return outputs
        self.tally.add_rows(rows, batch.photons_of)
        give_way()
        ends = batch.ends
        stamps = blocks[ends.blocks, : ring.RECORDED + 1]
        self._add_times(int(rows["index"][0]), ends.counts, *clock.to_host_ns_many(ends.ticks), stamps)
        return outputs

    def _add_waits(self, kernel: Kernel) -> None:
        """Give what a call has waited for, and long decisions, to the evidence of what makes work late, in the order of time."""
        evidence, blocks = self.lateness.evidence, kernel.blocks
        worked = blocks[blocks[:, ring.DECIDED] - blocks[:, ring.DECODED] >= evidence.floor_ns]
        spans = [(ended, began, -1) for began, ended in worked[:, ring.DECODED : ring.DECIDED + 1].tolist()]
        spans += [(ended, began, asked) for began, asked, ended, _ in kernel.notes.tolist()]
        for ended, began, asked in sorted(spans) if len(worked) else spans:
            if asked < 0:
                evidence.worked(INFERENCE, began, ended)
            else:
                evidence.waited(began, asked, ended)
        evidence.arrived(*kernel.arrivals.tolist())

    def _add_taken(self, taken: Taken, session: Session) -> Output:
        """Account for what came of a message that the core has taken."""
        frame, output, arrival_ns = taken.frame, taken.output, taken.times_ns[0]
        self._add_output(output, taken.times_ns, session)
        if output.block_end_tick is not None:
            self._check_tick(output.block_end_tick, arrival_ns, session)
            self.lateness.block_came(arrival_ns)
        if frame.type == MessageType.STATUS:
            with suppress(MalformedMessage):  # counted where it was taken
                status = decode_status(frame.payload)  # the session may know a later one, where the host was held up
                self._check_tick(status.tick, arrival_ns, session)
                left_ns, _ = session.known_clock().to_host_ns(status.tick)
                self.lateness.evidence.stamped(Stamped(None, None, left_ns, arrival_ns))
        return output

    def _add_output(self, output: Output, times_ns: tuple[int, int, int], session: Session) -> None:
        """Judge and tally one step's output."""
        for event in output.events:
            self.journal.take(event)
            if isinstance(event, Gap):
                self.journal.take(self.lateness.lost(event, session, session.link.now_ns()))
        if not output.decisions:
            return
        rows = np.array(output.decisions, DECISION_DTYPE)
        self.tally.add_rows(rows, unknown_photons if output.passages else self._core.marks.photons_of)
        if output.block_end_tick is None:  # given up at the end of the plan
            return
        counts, end_ticks = np.array([len(rows)]), [output.block_end_tick]
        if output.passages:  # each has a time of its own
            counts, end_ticks = np.ones(len(rows), np.int64), [passage.leave_tick for passage in output.passages]
        ends = np.minimum(np.array(end_ticks, np.uint64), 1 << 62).astype(np.int64)
        stamps = np.tile(np.array([*times_ns, session.link.now_ns()]), (len(ends), 1))
        self._add_times(int(rows["index"][0]), counts, *session.known_clock().to_host_ns_many(ends), stamps)

    def _add_times(self, first: int, counts: I64, ends_ns: I64, unsure_ns: I64, stamps_ns: I64) -> None:
        """Judge and record the times of decisions from number `first` on, of which `counts` each share theirs.

        ends_ns and unsure_ns (n,): when the last exposure ended, and how uncertain that is; stamps_ns (n, 4): arrival, decoded, decided,
        recorded.
        """
        # what has arrived has happened
        ends_ns = np.where(ends_ns - unsure_ns > stamps_ns[:, 0], stamps_ns[:, 0], ends_ns)
        marks_ns = np.column_stack((ends_ns, stamps_ns))
        late, numbers = self.timing.judge(marks_ns, unsure_ns, counts), first + np.cumsum(counts) - counts
        if self.recorder is not None:
            runs = np.zeros(len(counts), TIMING_RUN_DTYPE)
            runs["index"], runs["count"], runs["device_end_ns"] = numbers, counts, ends_ns
            runs["arrival_ns"], runs["decided_ns"], runs["recorded_ns"] = marks_ns[:, 1], marks_ns[:, 3], marks_ns[:, 4]
            self.recorder.add_timing_runs(runs)
        for at in np.flatnonzero(late).tolist():
            for number in range(int(numbers[at]), int(numbers[at] + counts[at])):
                self.late.append(number)
                self.journal.note("late", decision=number, latency_us=float(marks_ns[at, 3] - marks_ns[at, 0]) / 1000)
                begin_ns, arrival_ns, _, decided_ns, _ = marks_ns[at].tolist()
                self.lateness.incidents.late(LateWork(number, begin_ns, arrival_ns, decided_ns))

    def _check_tick(self, tick: int, arrival_ns: int, session: Session) -> None:
        """Note a tick that lies in the future."""
        wrong = future_tick(session.known_clock(), tick, arrival_ns)
        if wrong is not None:
            self.contradictions[wrong.what] += 1
            self.journal.take(wrong)

    # -- the books of all sessions -------------------------------------------------------------------------------------

    def drop_recorder(self, session: Session) -> None:
        """Go on without a recording, which cannot be written any further, so that the device can be told to stop."""
        self.recorder = self.journal.recorder = None
        session.on_sent = session.on_answer = None

    def close_books(self, session: Session) -> None:
        """Add up what a session has counted, once: before it goes, or at the end; those that broke too.

        Every frame is an answer or was given to the core; what is not is a contradiction of our own.
        """
        if session.counted:
            return
        session.counted = True
        counters, host = session.decoder.counters, session.host.counters
        self.decoded.update({name: getattr(counters, name) for name in counters.__slots__})
        self.decoded.update({name: getattr(host, name) for name in ("wrong_session", "unknown_type")})
        self.decoded.update(malformed_answers=host.malformed, implausible_answers=host.implausible)
        lost = counters.frames - session.answers - session.delivered
        untaken = session.delivered - session.taken if session.armed else 0
        for what, count in (("frames_lost_in_host", lost), ("messages_not_taken", untaken)):
            if count:
                self.contradictions[what] += abs(count)
                self.journal.note("contradiction", what=what, found=count, expected=0)


def _added(first: Counter[str], second: Counter[str]) -> dict[str, int]:
    """Return the sum of two counters, which may grow meanwhile in another thread."""
    both = dict(first)
    for what, count in dict(second).items():
        both[what] = both.get(what, 0) + count
    return both
