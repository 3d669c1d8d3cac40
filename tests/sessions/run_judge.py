"""The books of one run compared: device, wire, host, recording and replay. Each disagreement is one sentence in `violations`.

Checked are: every emitted exposure is delivered unchanged or reported lost, exactly once; a window with a missing exposure abstains and
a whole one is decided from the clicks that were emitted, none skipped or decided twice; no command is executed twice or out of order;
every gate is executed or its refusal reported, none late; all that came is on record; a replay gives the same decisions.
The definitions are plain loops and share no code with the host's kernels.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from run_books import STOPPED, DeviceLog, Emitted, Heard, ObservedLink

from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.core.plan import Plan
from pans.runtime.live import RunResult
from pans.runtime.record import Recording
from pans.runtime.record.replaying import replay
from pans.runtime.wire.messages import (
    DARK_PATTERN,
    STREAM_DECODERS,
    ClickBlock,
    Frame,
    Mark,
    unpack_body,
)
from pans.runtime.wire.session import STREAM_TYPES

MAX_VIOLATIONS = 20
DECODED = ("frames", "crc_errors", "cobs_errors", "short_frames", "oversized_frames")
LATE_ANSWER = ("the link was lost before the device answered", "no answer before the end of the run")


@dataclass(slots=True)
class Checked:
    """How much was checked: a check that saw nothing proves nothing."""

    delivered: int = 0
    lost: int = 0
    decisions: int = 0
    decisions_flagged: int = 0
    gates_executed: int = 0
    gates_refused: int = 0
    streams: int = 0


class Stream(NamedTuple):
    """What became of one session's exposures: stamps, clicks as a word for each, whether it was delivered; up to `end` accounted for."""

    stamps: np.ndarray
    words: np.ndarray
    delivered: np.ndarray
    end: int


class Judge:
    """Compares the books of one run."""

    def __init__(self, plan: Plan, shots: int) -> None:
        self.violations: list[str] = []
        self.counts = Checked()
        self.plan = plan
        self._visit = plan.slots_per_cycle * plan.cycles_per_object
        self._windows = list(_windows(plan, shots))

    def fail(self, text: str) -> None:
        """Keep one violation."""
        if len(self.violations) < MAX_VIOLATIONS:
            self.violations.append(text)

    def judge(self, log: DeviceLog, wire: ObservedLink, result: RunResult, recording: Recording, bundle: Any) -> None:
        """Compare everything; see the module."""
        if result.ended not in ("completed", "the link was lost within the last object"):
            self.fail(f"the run did not complete: {result.ended}")
        self._wire(wire, result, recording)
        self._commands(log)
        self._gates(log, wire, recording)
        streams = self._streams(log, wire, result, recording)
        rows, at = recording.decisions(), 0
        for stream in streams:
            at += self.decisions(stream, rows[at:])
        if at != len(rows):
            self.fail(f"{len(rows)} decisions were made, due were {at}")
        self.counts.decisions, self.counts.decisions_flagged = len(rows), int(np.count_nonzero(rows["flags"]))
        again = replay(recording, bundle)
        if (again.decisions, again.sha256) != (recording.n_decisions, recording.decisions_sha256):
            self.fail(f"a replay gives {again.decisions} decisions of {recording.n_decisions}, or other ones")

    # -- wire, host and recording --------------------------------------------------------------------------------------

    def _wire(self, wire: ObservedLink, result: RunResult, recording: Recording) -> None:
        there, host = wire.decoded(DECODED), {name: result.decoder.get(name, 0) for name in DECODED}
        if host != there:
            self.fail(f"on the wire were {there}, the host counted {host}")
        recorded: dict[int, Heard] = {}
        kinds: Counter[int] = Counter()
        for _, body in recording.messages():
            frame = unpack_body(body)
            kinds[frame.type] += 1
            recorded.setdefault(frame.session, Heard()).add(body)
        for session in wire.heard.keys() | recorded.keys():
            came, kept = wire.heard.get(session, Heard()), recorded.get(session, Heard())
            if not came.same(kept):
                self.fail(
                    f"session {session:08x}: {came.messages} messages arrived, recorded are {kept.messages}, or others"
                )
        answers = Heard()
        for _, body in recording.answers():
            answers.add(body)
        if not wire.answers.same(answers):
            self.fail(f"{wire.answers.messages} answers arrived, recorded are {answers.messages}, or others")
        on_record, stream = sum(kinds[kind] for kind in STREAM_TYPES), result.stream
        counted = stream["messages"] + stream["repeated"] + stream["malformed"]
        if on_record != counted:
            self.fail(f"{on_record} stream messages are recorded, the host counted {counted}")
        if result.tally.decisions != recording.n_decisions:
            self.fail(f"{result.tally.decisions} decisions were made, {recording.n_decisions} are recorded")

    # -- commands and pulses -------------------------------------------------------------------------------------------

    def _commands(self, log: DeviceLog) -> None:
        last: dict[tuple[int, int], int] = {}
        for epoch, session, number in log.commands:
            if number != last.get((epoch, session), 0) + 1:
                self.fail(f"command {number} of session {session:08x} executed after {last.get((epoch, session))}")
            last[epoch, session] = number

    def _gates(self, log: DeviceLog, wire: ObservedLink, recording: Recording) -> None:
        executed: set[tuple[int, Any]] = set()
        asked = {(session, gate) for (session, _), gate in wire.gates.items()}
        for session, gate, tick in log.pulses:
            if gate.tick <= tick:
                self.fail(f"a gate for tick {gate.tick} was executed at {tick}: late")
            if (session, gate) in executed:
                self.fail(f"the gate for tick {gate.tick} was executed twice")
            if (session, gate) not in asked:
                self.fail(f"a gate for tick {gate.tick} was executed without a command")
            executed.add((session, gate))
        self.counts.gates_executed = len(log.pulses)
        last = next(reversed(wire.heard), 0)
        refused = self._refused(wire, recording, last, executed)
        for (session, number), gate in wire.gates.items():
            if session != last or number > wire.acknowledged.get(session, 0):
                continue
            if ((session, gate) in executed) == (number in refused):
                how = "executed, and reported as refused" if number in refused else "neither executed nor reported"
                self.fail(f"the gate for tick {gate.tick} was {how}")

    def _refused(self, wire: ObservedLink, recording: Recording, last: int, executed: set[tuple[int, Any]]) -> set[int]:
        """The commands of the last session whose refusals were reported; of a decision's own pulse the event names the tick."""
        refused: set[int] = set()
        session = 0
        for event in recording.events():
            if event["kind"] == "session":
                session = event["nonce"]
            if event["kind"] != "gate_refused":
                continue
            self.counts.gates_refused += 1
            if "command_id" in event:
                number = event["command_id"]
                if session == last and (last, number) not in wire.gates:
                    self.fail(f"a refusal of command {number} was reported that is no gate")
                refused |= {number} if session == last else set()
                continue
            asked = [key for key, gate in wire.gates.items() if gate.tick == event["tick"]]
            no_answer = event["text"] in LATE_ANSWER
            if not asked and not no_answer:
                self.fail(f"a refusal of decision {event['decision']}'s pulse was reported that was never asked for")
            elif asked and (not no_answer or (asked[-1][0], wire.gates[asked[-1]]) not in executed):
                refused |= {number for of, number in asked if of == last}
        return refused

    # -- the exposures -------------------------------------------------------------------------------------------------

    def _streams(self, log: DeviceLog, wire: ObservedLink, result: RunResult, recording: Recording) -> list[Stream]:
        """Match the gaps that the host reported with what each session's messages left out; both in their order."""
        events = list(recording.events())
        gaps = [(event["first_exposure"], event["exposures"]) for event in events if event["kind"] == "gap"]
        unknown = [event["first_exposure"] for event in events if event["kind"] == "stream_end_unknown"]
        accepted: dict[int, list[tuple[int, int]]] = {session: [] for session in wire.heard}
        sequence: dict[int, int] = {}
        for _, body in recording.messages():
            frame = unpack_body(body)
            if frame.type in STREAM_TYPES:
                self._accept(frame, log, accepted[frame.session], sequence)
        streams, dropped = [], 0
        for session, spans in accepted.items():
            blocks = log.blocks.get(session, [])
            stream = self._stream(blocks, spans, gaps, unknown)
            streams.append(stream)
            dropped += sum(len(one.readings) for one in blocks if one.dropped)
            self._claim(wire.heard[session], blocks, session)
        if gaps or unknown:
            self.fail(f"gaps {gaps[:3]} and unknown ends {unknown[:3]} were reported where none are")
        self.counts.delivered = sum(int(one.delivered.sum()) for one in streams)
        self.counts.lost = sum(one.end for one in streams) - self.counts.delivered
        self.counts.streams = len(streams)
        found = result.stream["exposures"], result.stream["lost_exposures"]
        if found != (self.counts.delivered, self.counts.lost):
            self.fail(
                f"delivered and lost were {self.counts.delivered, self.counts.lost} exposures, the host says {found}"
            )
        open_ends = any(one.end < len(one.words) for one in streams)
        if not result.stream["device_drops"] <= dropped or (not open_ends and result.stream["device_drops"] != dropped):
            self.fail(f"the device dropped {dropped} exposures, the host says {result.stream['device_drops']}")
        return streams

    def _accept(self, frame: Frame, log: DeviceLog, spans: list[tuple[int, int]], sequence: dict[int, int]) -> None:
        """Take one message by the rule of the protocol: numbers go up, and what comes behind its time is useless."""
        message = STREAM_DECODERS[frame.type](frame.payload)
        if message.seq < sequence.get(frame.session, 0):
            return
        sequence[frame.session] = message.seq + 1
        if isinstance(message, Mark):
            return
        readings = message.bits if isinstance(message, ClickBlock) else message.words
        spans.append((message.exposure_index, message.exposure_index + len(readings)))

    def _stream(
        self, blocks: list[Emitted], spans: list[tuple[int, int]], gaps: list[tuple[int, int]], unknown: list[int]
    ) -> Stream:
        """Return what became of one session's exposures; takes its gaps from the front of `gaps` and `unknown`."""
        emitted = sum(len(one.readings) for one in blocks)
        delivered, end = np.zeros(emitted, bool), 0
        for first, stop in spans:
            if first > end:
                if gaps and gaps[0] == (end, emitted - end):
                    break  # the stream was closed before: what came later counts as lost
                if not gaps or gaps[0] != (end, first - end):
                    self.fail(f"exposures {end} to {first} never came: no gap, reported is {gaps[:1]}")
                else:
                    del gaps[0]
            if first < end:
                self.fail(f"exposure {first} was delivered again")
            delivered[first:stop], end = True, stop
        if gaps and end < emitted and gaps[0] == (end, emitted - end):
            del gaps[0]
            end = emitted
        elif unknown and unknown[0] == end:
            del unknown[0]
        elif end != emitted:
            self.fail(f"exposures {end} to {emitted} were never accounted for: skipped in silence")
        stamps = [one.stamps for one in blocks if one.stamps is not None]
        words = [_words(one.readings) for one in blocks]
        return Stream(
            np.concatenate(stamps) if stamps else np.zeros(0, np.uint16),
            np.concatenate(words) if words else np.zeros(0, np.uint64),
            delivered,
            end,
        )

    def _claim(self, heard: Heard, blocks: list[Emitted], session: int) -> None:
        status = heard.last_status
        if status is None or status.state not in STOPPED or not blocks:
            return
        made = sum(len(one.readings) for one in blocks), sum(len(one.readings) for one in blocks if one.dropped)
        if (status.next_exposure, status.drops) != made:
            self.fail(
                f"session {session:08x}: STATUS claims {status.next_exposure, status.drops}, the device made {made}"
            )

    # -- decisions -----------------------------------------------------------------------------------------------------

    def decisions(self, stream: Stream, rows: Any) -> int:
        """Compare the decisions of one session, from the first of `rows` on; return how many those are."""
        taken = 0
        while True:
            visit, window = divmod(taken, len(self._windows))
            members = visit * self._visit + self._windows[window][0]
            whole, row = bool(members[-1] < stream.end), rows[taken] if taken < len(rows) else None
            begun = members[0] < stream.end or (row is not None and row["flags"] & DecisionFlag.INCOMPLETE)
            if visit * self._visit >= stream.end or not begun:
                return taken
            if row is None or not self._is_of(row, members):
                if whole:
                    self.fail(f"the window of exposures {members[0]} to {members[-1]} is due, found {row}")
                return taken
            self._decision(stream, row, members, self._windows[window][1])
            taken += 1

    def _is_of(self, row: Any, members: np.ndarray) -> bool:
        last = int(row["exposure_index"])
        return last in members if self.plan.automaton is not None else last == members[-1]

    def _decision(self, stream: Stream, row: Any, members: np.ndarray, features: np.ndarray) -> None:
        there = members[members < len(stream.words)]
        delivered = len(there) == len(members) and bool(stream.delivered[there].all())
        flagged = bool(row["flags"] & DecisionFlag.ABSTAINED) and row["label"] == NO_LABEL
        if self.plan.automaton is not None:
            self._walk(stream, row, there, flagged)
            return
        if not delivered:
            if not (flagged and row["flags"] & (DecisionFlag.GAP | DecisionFlag.INCOMPLETE)):
                self.fail(f"decision {row['index']} was made from a window with a gap: flags {row['flags']}")
            return
        words, counts = stream.words[members].tolist(), np.zeros(self.plan.n_patterns, np.int64)
        if self.plan.mode == "parallel":
            for channel in range(len(counts)):
                counts[channel] = sum(word >> channel & 1 for word in words)
        else:
            np.add.at(counts, features, np.array(words, np.int64))
        if flagged or row["counts_crc"] != zlib.crc32(counts.tobytes()):
            self.fail(f"decision {row['index']}: flags {row['flags']}, or other clicks than were emitted")

    def _walk(self, stream: Stream, row: Any, members: np.ndarray, flagged: bool) -> None:
        """Follow the automaton through the visit's slots: each with the state that was stamped, and what was read in it."""
        automaton = self.plan.automaton
        assert automaton is not None
        counted = np.zeros((len(self._windows[0][0]), automaton.channels), np.int64)
        node, taken = 0, 0
        for stamp, word in zip(stream.stamps[members].tolist(), stream.words[members].tolist()):
            if stamp != node:
                break
            bits = [word >> channel & 1 for channel in range(automaton.channels)]
            counted[taken] = word if automaton.channels == 1 else bits
            node, taken = int(automaton.successors[node, word]), taken + 1
            if node >= automaton.n_states:
                break
        if not (node >= automaton.n_states and stream.delivered[members[:taken]].all()):
            if not flagged:
                self.fail(f"decision {row['index']} was made from a walk with a gap: flags {row['flags']}")
            return
        wanted = zlib.crc32(counted.ravel().tobytes()), taken, int(members[taken - 1])
        found = int(row["counts_crc"]), int(row["exposures"]), int(row["exposure_index"])
        if flagged or found != wanted:
            self.fail(f"decision {row['index']}: clicks, exposures and the last are {found}, emitted were {wanted}")


def _words(readings: np.ndarray) -> np.ndarray:
    """Readings as a number each: a click, a photon number, or a bit for each channel."""
    if readings.ndim == 1:
        return readings.astype(np.uint64)
    return readings.astype(np.uint64) @ (np.uint64(1) << np.arange(0, 8 * readings.shape[1], 8, dtype=np.uint64))


def _windows(plan: Plan, shots: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The windows of a visit: their exposures, ascending, and the pattern of each; from the plan alone."""
    for window in range(plan.shots_per_cycle * plan.cycles_per_object // shots):
        places = [
            (cycle * plan.slots_per_cycle + slot, int(plan.slot_pattern[slot]))
            for cycle in range(plan.cycles_per_object)
            for slot in range(plan.slots_per_cycle)
            if plan.slot_pattern[slot] != DARK_PATTERN
            and (cycle * plan.shots_per_cycle + int(plan.slot_shot[slot])) // shots == window
        ]
        yield np.array([place for place, _ in places]), np.array([pattern for _, pattern in places])
