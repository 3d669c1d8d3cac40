"""Recorded commands in; the plan and the ARM commands that the device was sent out (a plan's own form: decide/plan/plan_codec.py)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from pans.base.errors import DamagedFileError
from pans.base.numbers import Range
from pans.bundle.automaton import Automaton, DoseCap
from pans.bundle.sensor import Bundle
from pans.decide.plan import Plan, plan_from_chunks, reading_of
from pans.protocol.wire import (
    MAX_PHOTON_NUMBER,
    Arm,
    CommandMessage,
    FrameDecoder,
    MalformedMessage,
    MessageType,
    Opcode,
    PlanChunk,
    ReadCounts,
    Show,
    StateChunk,
    decode_command,
    unpack_command,
    unpack_states,
)

from .format import Kind
from .recording import Recording

TICK_HZ = Range(1000, 10_000_000_000, whole=True)
SHOTS = Range(1, 1 << 20, whole=True)
PHOTON_NUMBER = Range(1, MAX_PHOTON_NUMBER, whole=True)


def _sent_commands(recording: Recording) -> Iterator[tuple[int, CommandMessage]]:
    """Yield the commands, each with the session that it was sent in; MalformedMessage for what is none."""
    decoder = FrameDecoder()
    for _, sent in recording.read(Kind.COMMANDS):
        for frame in decoder.feed(b"".join(data for _, data in sent)):
            if frame.type == MessageType.COMMAND:
                yield frame.session, decode_command(frame.payload)


def never_armed(recording: Recording) -> bool:
    """Whether the run ended before it armed the device, so that there was nothing to decide; DamagedFileError for what is no command."""
    try:
        return not recording.n_decisions and first_session(recording) is None
    except MalformedMessage as error:
        raise DamagedFileError(f"{recording.path}: a command cannot be read: {error}") from error


def first_session(recording: Recording) -> int | None:
    """Return the session of the first ARM, with which a part begins too; None without one, MalformedMessage for what is no command."""
    return next((session for session, one in _sent_commands(recording) if one.opcode == Opcode.ARM), None)


@dataclass(frozen=True, slots=True)
class Sent:
    """What a device was sent: plan, states of an automaton, what each state named by the host showed, and ARM by session."""

    chunks: dict[int, PlanChunk] = field(default_factory=dict)  # by first slot
    states: dict[int, StateChunk] = field(default_factory=dict)  # by first state
    shown: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # state: pattern, dwell, dwell steps
    arms: dict[int, Arm] = field(default_factory=dict)
    read: list[ReadCounts] = field(default_factory=list)  # each READ_COUNTS

    def plan(self, tick_hz: int, automaton: Automaton | None, largest: int) -> Plan:
        """Return the plan, which ran `automaton`, or fixed patterns read as numbers up to `largest`; MalformedMessage when it is not
        whole, or another one was sent."""
        chunks = [self.chunks[first] for first in sorted(self.chunks)]
        states = [self.states[first] for first in sorted(self.states)]
        plan = plan_from_chunks(chunks, tick_hz, automaton, states, largest)
        wanted = {reading_of(plan)} if plan.largest > 1 else set()
        if set(self.read) != wanted:
            found = [tuple(one) for one in sorted(set(self.read))]
            raise MalformedMessage(f"numbers up to {found} (largest, detectors) were asked for, needed: {plan.largest}")
        for state, shown in self.shown.items():
            if automaton is None or state >= automaton.n_states:
                raise MalformedMessage(f"state {state} was shown, which the automaton does not have")
            known = (int(automaton.pattern[state]), int(automaton.dwell[state]), automaton.dwell_steps)
            if shown != known:
                raise MalformedMessage(f"state {state} was shown as {shown} (pattern, dwell, steps), it is {known}")
        return plan


def sent_to_device(recording: Recording) -> Sent:
    """Return what was sent to the device (repetitions left out).

    MalformedMessage when a command cannot be read, a state was shown in two ways, or the device was never armed.
    """
    sent = Sent()
    for session, command in _sent_commands(recording):
        if command.opcode == Opcode.LOAD_PLAN:
            chunk = unpack_command(PlanChunk, command.body)
            sent.chunks[chunk.first_slot] = chunk
        elif command.opcode in (Opcode.LOAD_STATES, Opcode.LOAD_COUNT_STATES):
            states = unpack_states(command.opcode, command.body)
            sent.states[states.first_state] = states
        elif command.opcode == Opcode.READ_COUNTS:
            sent.read.append(unpack_command(ReadCounts, command.body))
        elif command.opcode == Opcode.SHOW:
            show = unpack_command(Show, command.body)
            seen = (show.pattern, show.dwell, show.dwell_steps)
            if sent.shown.setdefault(show.state, seen) != seen:
                raise MalformedMessage(f"state {show.state} was shown in two ways")
        elif command.opcode == Opcode.ARM:
            sent.arms[session] = unpack_command(Arm, command.body)
    if not sent.arms:
        raise MalformedMessage("the device was never armed")
    return sent


def automaton_of(config: Mapping[str, Any], bundle: Bundle | None) -> Automaton | None:
    """Return the automaton that a run with this `config` followed, None of fixed patterns; KeyError or ValueError if it does not tell."""
    automaton = None if bundle is None else bundle.automaton
    if not config.get("drive"):
        if automaton is not None:
            raise ValueError("config.drive is missing: the recording does not say who drove its automaton")
        return None
    from pans.bundle.backends import walked_within  # numba is loaded only for those who follow a walk

    if automaton is None or bundle is None:
        raise ValueError("the run followed an automaton, which is not in the recording")
    return walked_within(bundle, automaton, float(config["confidence"]), walk_dose(config))


def walk_dose(config: Mapping[str, Any]) -> DoseCap | None:
    """Return the cap that a run with this `config` kept on each walk, None of others; KeyError or ValueError if it does not tell."""
    cap = config.get("walk_dose")
    return None if cap is None else DoseCap(float(cap["most"]), int(cap["states"]))


def recorded_plan(recording: Recording) -> Plan:
    """Return the plan that the device was sent; DamagedFileError if the recording does not hold it whole."""
    try:
        config = recording.header["config"]
        bundle = recording.bundle() if recording.bundle_place else None
        sent, automaton = sent_to_device(recording), automaton_of(config, bundle)
        largest = PHOTON_NUMBER.checked(config.get("photon_number_max", 1), "photon_number_max")
        return sent.plan(TICK_HZ.checked(config["tick_hz"], "tick_hz"), automaton, largest)
    except (KeyError, TypeError, ValueError, AttributeError, MalformedMessage) as error:
        raise DamagedFileError(f"{recording.path}: its plan cannot be rebuilt: {error}") from error
