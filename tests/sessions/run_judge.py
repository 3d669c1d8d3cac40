"""The books of one run compared: device, wire, host, recording and replay. Each disagreement is one sentence in `violations`.

Checked are: every emitted exposure is delivered unchanged or reported lost, exactly once; the decisions are those that the independent
reader (tests/independent) makes of the recorded messages; no command is executed twice or out of order; every gate is executed or its
refusal reported, none late; all that came is on record; a replay gives the same decisions.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lab_automaton import read_automaton, walk_again
from lab_bundle import read_bundle
from lab_decisions import decide_again
from lab_recording import read_recording as read_again
from run_books import STOPPED, DeviceLog, Emitted, Heard, ObservedLink, read_of

from pans.bundle.sensor import Bundle, bundle_bytes
from pans.live.loop import RunResult
from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import Frame, unpack_body
from pans.protocol.wire.messages import STREAM_DECODERS, Mark
from pans.record.reading import Recording, read_recording
from pans.record.replay import replay

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


class Judge:
    """Compares the books of one run."""

    def __init__(self) -> None:
        self.violations: list[str] = []
        self.counts = Checked()

    def fail(self, text: str) -> None:
        """Keep one violation."""
        if len(self.violations) < MAX_VIOLATIONS:
            self.violations.append(text)

    def judge(self, log: DeviceLog, wire: ObservedLink, result: RunResult, path: Path, bundle: Bundle) -> None:
        """Compare everything; see the module."""
        recording = read_recording(path)
        if result.ended not in ("completed", "the link was lost within the last object"):
            self.fail(f"the run did not complete: {result.ended}")
        self._wire(wire, result, recording)
        self._commands(log)
        self._gates(log, wire, recording)
        self._streams(log, wire, result, recording)
        found, rows = read_again(path.read_bytes()), recording.decisions()
        there = read_bundle(bundle_bytes(bundle))
        made = decide_again(found, there) if bundle.automaton is None else walk_again(found, read_automaton(there))
        if made.tobytes() != found.rows.tobytes():
            self.fail("the independent reader makes other decisions of the recorded messages")
        self.counts.decisions, self.counts.decisions_flagged = len(rows), int(np.count_nonzero(rows["flags"]))
        again = replay(recording, bundle)
        if (again.decisions, again.sha256) != (recording.n_decisions, recording.decisions_sha256):
            self.fail(f"a replay gives {again.decisions} decisions of {recording.n_decisions}, or other ones")

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

    def _streams(self, log: DeviceLog, wire: ObservedLink, result: RunResult, recording: Recording) -> None:
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
        dropped, accounted, open_ends = 0, 0, False
        for session, spans in accepted.items():
            blocks = log.blocks.get(session, [])
            emitted = sum(len(one.readings) for one in blocks)
            delivered, end = self._stream(emitted, spans, gaps, unknown)
            self.counts.delivered += delivered
            accounted, open_ends = accounted + end, open_ends or end < emitted
            dropped += sum(len(one.readings) for one in blocks if one.dropped)
            self._claim(wire.heard[session], blocks, session)
        if gaps or unknown:
            self.fail(f"gaps {gaps[:3]} and unknown ends {unknown[:3]} were reported where none are")
        self.counts.lost, self.counts.streams = accounted - self.counts.delivered, len(accepted)
        found = result.stream["exposures"], result.stream["lost_exposures"]
        if found != (self.counts.delivered, self.counts.lost):
            self.fail(f"delivered and lost are {self.counts.delivered, self.counts.lost}, the host says {found}")
        if not result.stream["device_drops"] <= dropped or (not open_ends and result.stream["device_drops"] != dropped):
            self.fail(f"the device dropped {dropped} exposures, the host says {result.stream['device_drops']}")

    def _accept(self, frame: Frame, log: DeviceLog, spans: list[tuple[int, int]], sequence: dict[int, int]) -> None:
        """Take one message by the rule of the protocol: numbers go up, and what comes behind its time is useless."""
        message = STREAM_DECODERS[frame.type](frame.payload)
        if message.seq < sequence.get(frame.session, 0):
            return
        sequence[frame.session] = message.seq + 1
        if isinstance(message, Mark):
            return
        stamps, readings = read_of(message)
        spans.append((message.exposure_index, message.exposure_index + len(readings)))
        sent = log.block(frame.session, message.exposure_index)
        if sent is None or not (np.array_equal(sent.readings, readings) and np.array_equal(sent.stamps, stamps)):
            self.fail(f"the block of exposure {message.exposure_index} holds other clicks than were emitted")

    def _stream(
        self, emitted: int, spans: list[tuple[int, int]], gaps: list[tuple[int, int]], unknown: list[int]
    ) -> tuple[int, int]:
        """Return how many of a session's exposures were delivered, and up to which all are accounted for.

        Its gaps are taken from the front of `gaps` and `unknown`.
        """
        delivered, end = 0, 0
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
            delivered, end = delivered + stop - first, stop
        if gaps and end < emitted and gaps[0] == (end, emitted - end):
            del gaps[0]
            end = emitted
        elif unknown and unknown[0] == end:
            del unknown[0]
        elif end != emitted:
            self.fail(f"exposures {end} to {emitted} were never accounted for: skipped in silence")
        return delivered, end

    def _claim(self, heard: Heard, blocks: list[Emitted], session: int) -> None:
        status = heard.last_status
        if status is None or status.state not in STOPPED or not blocks:
            return
        made = sum(len(one.readings) for one in blocks), sum(len(one.readings) for one in blocks if one.dropped)
        if (status.next_exposure, status.drops) != made:
            self.fail(
                f"session {session:08x}: STATUS claims {status.next_exposure, status.drops}, the device made {made}"
            )
