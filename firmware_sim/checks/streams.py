"""Random streams, spoilt as a bad link spoils them, through the plain core and through the compiled turn: both must give the same.

Owns the making of the streams and the comparison, stream by stream: decisions bit for bit, events, counters, and where both cores stand.
Each stream is an ARM, one or two cycles of what the plan asks for, and an end or none; messages are lost, damaged, repeated, held
back, of another session, or say what the plan excludes, and the bytes are cut anywhere. The compiled turn reads them from a socket.
"""

from __future__ import annotations

import random
import socket
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pans.firmware_sim.testing import small_setup
from pans.runtime.core.decision import DECISION_DTYPE, Output
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.flow.core import FlowCore
from pans.runtime.turn.streaming import Batch, StreamCore
from pans.runtime.wire import messages as wire
from pans.runtime.wire.messages import DARK_PATTERN, NO_OBJECT, DeviceState, Mark, MessageType, StateReason, Status
from pans.runtime.wire.session import STREAM_TYPES

from .flow_stream import FlowStream
from .flowing import KINDS, small_flow
from .twin import AT_ONCE, Streamed, unlike, unlike_rows

MODES = ("sequential", "parallel", "device-driven", "host-driven", *KINDS)
CORE_TYPES = STREAM_TYPES | {MessageType.STATUS}
FATES = ("lost", "damaged", "twice", "changed", "held", "foreign", "excluded")
Head = tuple[int, int, int, int, int, int]  # of a block, in the order of the fields
CYCLES = (1, 1, 1, 2)
SHORT = 2  # times as many of frames of all channels, whose cycles hold a block or two
REOPENED = 0.002  # of the streams come through a link that has been opened anew


@dataclass(slots=True)
class StreamCounts:
    """How much was compared, and how far it came."""

    streams: int = 0
    messages: int = 0
    faults: int = 0
    decisions: int = 0
    decisions_flagged: int = 0
    events: int = 0
    compiled_messages: int = 0


class Pair:
    """A plain core and one behind the compiled turn, for the same plan."""

    def __init__(self, mode: str) -> None:
        self.core: Core | FlowCore
        self.streamed: Streamed
        if mode in KINDS:
            flow = small_flow(mode)
            self.plan, self.core = flow.plan, flow.core(0)
            self.streamed = FlowStream(flow.core(0), flow.plan, 0)
        else:
            _, bundle, self.plan = small_setup(mode)
            decider = make_decider(bundle, shots=1, backend="table" if bundle.automaton is None else "automaton")
            self.core = Core(self.plan, decider, 1, 0)
            self.streamed = StreamCore(self.plan, decider, 1, 0, 0)
        self.core.warm_up()
        self.streamed.warm_up()
        self.decoder = wire.FrameDecoder()
        self._ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def close(self) -> None:
        """Close the socket."""
        self._ours.close()
        self._theirs.close()

    def reopen(self) -> None:
        """Decode another connection from its beginning."""
        self.decoder = wire.FrameDecoder()
        self.streamed.reopen()

    def listen(self, piece: bytes) -> Iterator[Batch]:
        """Let the compiled turn read `piece`."""
        self._theirs.send(piece)
        yield from self.streamed.listen(self._ours.fileno(), AT_ONCE)


class Streams:
    """The random streams of one seed."""

    def __init__(self, seed: int) -> None:
        self.counts = StreamCounts()
        self._dice = random.Random(seed)
        self._pairs = {mode: Pair(mode) for mode in MODES}

    def close(self) -> None:
        """Close all sockets."""
        for pair in self._pairs.values():
            pair.close()

    def compare(self, mode: str) -> str:
        """Send one stream of `mode`; return where the two differ, "" where they agree."""
        dice, pair, counts = self._dice, self._pairs[mode], self.counts
        if dice.random() < REOPENED:
            pair.reopen()
        session, start_tick = dice.randrange(1, 1 << 32), dice.randrange(1 << 40)
        cycles = dice.choice(CYCLES) * (1 if pair.plan.mode == "sequential" else dice.randrange(1, 1 + SHORT))
        n_cycles, ends = dice.choice((0, cycles, cycles + 1)), dice.random() < 0.5
        clean = self._clean(pair.plan, session, start_tick, cycles)
        pieces = self._cut(b"".join(self._spoilt(clean, session)))
        outputs, batches = self._gathered(pair, (session, start_tick, n_cycles), pieces, ends=ends)
        counts.streams += 1
        counts.messages += len(clean)
        rows = np.array([row for output in outputs for row in output.decisions], DECISION_DTYPE)
        events = [event for output in outputs for event in output.events]
        counts.decisions += len(rows)
        counts.decisions_flagged += int(np.count_nonzero(rows["flags"]))
        counts.events += len(events)
        wrong = unlike(pair.streamed.core, pair.core) + unlike_rows([batch[0] for batch in batches], rows)
        told = [event for batch in batches for event in batch[1]]
        wrong += [] if told == events else [f"events {told}, Python's {events}"]
        ours, theirs = pair.streamed.decoder.counters, pair.decoder.counters
        return "; ".join(wrong + ([] if ours == theirs else [f"decoder {ours}, Python's {theirs}"]))

    def _gathered(
        self, pair: Pair, arm: tuple[int, int, int], pieces: Iterable[bytes], *, ends: bool
    ) -> tuple[list[Output], list[tuple[Any, list[Any]]]]:
        """What the two make of a stream: outputs of the one, copied batches of the other."""
        core, streamed, session = pair.core, pair.streamed, arm[0]
        outputs, batches = [core.begin(*arm[1:])], _kept(streamed.begin(*arm))
        for piece in pieces:
            for frame in pair.decoder.feed(piece):
                if frame.session == session and frame.type in CORE_TYPES:
                    outputs.append(core.step(frame))
            before = streamed.core.tracker.counters.messages
            batches += _kept(pair.listen(piece))
            self.counts.compiled_messages += streamed.core.tracker.counters.messages - before
        if ends:
            outputs.append(core.end())
            batches += _kept(streamed.end())
        return outputs, batches

    # -- what is sent --------------------------------------------------------------------------------------------------

    def _clean(self, plan: Plan, session: int, start_tick: int, cycles: int) -> list[bytes]:
        """The messages of some cycles, as the device would send them."""
        dice, sent = self._dice, list[bytes]()
        slots = plan.slots_per_cycle
        offsets = plan.slot_offset_ticks.tolist()
        lit = dice.choice((0.02, 0.3, 0.7))
        for cycle in range(cycles):
            first = cycle * slots
            stamps, clicks = self._cycle(plan, lit)
            if cycle % plan.cycles_per_object == 0:
                number, truth = cycle // plan.cycles_per_object, dice.randrange(-1, 3)
                half = slots // 2 if plan.mode == "parallel" else 0
                tick = start_tick + cycle * plan.cycle_ticks
                sent.append(wire.encode_mark(Mark(len(sent), number, truth, first, tick, 2.5, half), session))
            for at in range(0, slots, plan.block_exposures):
                stop = min(at + plan.block_exposures, slots)
                tick = start_tick + cycle * plan.cycle_ticks + offsets[at]
                head = (len(sent), 0, tick, first + at, plan.slot_period_ticks, NO_OBJECT)
                sent.append(_block(plan, head, stamps[at:stop], clicks[at:stop], session))
        tick = start_tick + (cycles + 1) * plan.cycle_ticks
        reason = StateReason.COMPLETED if dice.random() < 0.7 else StateReason.STOPPED
        end = wire.encode_status(Status(DeviceState.IDLE, reason, 0, 0, tick, cycles * slots), session)
        return [*sent, end, end] if dice.random() < 0.7 else sent

    def _cycle(self, plan: Plan, lit: float) -> tuple[np.ndarray, np.ndarray]:
        """What is shown in one cycle, uint16 (slots,), and the clicks: uint8 (slots,), or of frames (slots, bytes)."""
        dice, slots = self._dice, plan.slots_per_cycle
        if plan.mode == "parallel":
            width = -(-plan.n_patterns // 8)
            random_bits = np.frombuffer(dice.randbytes(slots * width), np.uint8).reshape(slots, width)
            on = np.zeros((slots, 1), np.uint8)
            begin = dice.randrange(slots)
            on[begin : begin + dice.randrange(1 + slots)] = dice.random() < 2 * lit
            mask = np.uint8((1 << min(plan.n_patterns, 8)) - 1)
            return plan.slot_pattern, random_bits & mask & (on * np.uint8(255))
        clicks = np.array([dice.random() < lit for _ in range(slots)], np.uint8)
        if plan.automaton is None:
            return plan.slot_pattern, clicks
        automaton, node, stamps = plan.automaton, 0, plan.slot_pattern.copy()
        for slot in np.flatnonzero(plan.slot_pattern != DARK_PATTERN).tolist():
            if node >= automaton.n_states or dice.random() < 0.02:
                stamps[slot] = DARK_PATTERN
                continue
            stamps[slot] = node
            node = int(automaton.successors[node, clicks[slot]])
        return stamps, clicks

    def _spoilt(self, clean: list[bytes], session: int) -> list[bytes]:
        """What a bad link makes of the messages."""
        dice, sent = self._dice, list[bytes]()
        often = dice.choice((0.0, 0.05, 0.3))
        for message in clean:
            fate = dice.choice(FATES) if dice.random() < often else ""
            self.counts.faults += bool(fate)
            if fate == "damaged":
                message = self._damaged(message)
            elif fate == "foreign":
                sent.append(self._foreign(message, session))
            elif fate == "excluded":
                message = self._excluded(message)
            if fate != "lost":
                sent += [message] * (2 if fate == "twice" else 1)
            if fate == "changed":  # once more, not the same
                sent.append(self._excluded(message))
            if fate == "held" and len(sent) > 1:
                sent[-1], sent[-2] = sent[-2], sent[-1]
        return sent

    def _damaged(self, message: bytes) -> bytes:
        if self._dice.random() < 0.3:  # cut short
            return message[: self._dice.randrange(1, len(message))]
        damaged = bytearray(message)
        damaged[self._dice.randrange(len(damaged))] ^= 1 << self._dice.randrange(8)
        return bytes(damaged)

    def _foreign(self, message: bytes, session: int) -> bytes:
        """A message between: an answer, one of another session, or a short one."""
        frame = wire.FrameDecoder().feed(message)[0]
        kind = self._dice.randrange(4)
        if kind == 0:
            return wire.encode_ping(1, 5, session)
        if kind == 1:
            return wire.encode_frame(frame.type, frame.payload, session ^ 1)
        return wire.encode_frame(frame.type, frame.payload[: self._dice.randrange(len(frame.payload))], session)

    def _excluded(self, message: bytes) -> bytes:
        """One byte of the payload is another, under a right CRC: a time, a number, a pattern or a click that cannot be, or could."""
        frame = wire.FrameDecoder().feed(message)[0]
        payload = bytearray(frame.payload)
        payload[self._dice.randrange(min(len(payload), 40))] ^= 1 << self._dice.randrange(8)
        return wire.encode_frame(frame.type, bytes(payload), frame.session)

    def _cut(self, data: bytes) -> Iterator[bytes]:
        cuts = sorted(self._dice.randrange(len(data) + 1) for _ in range(self._dice.choice((0, 0, 0, 1, 3))))
        return (data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)]) if b > a)


def _block(plan: Plan, head: Head, stamps: np.ndarray, clicks: np.ndarray, session: int) -> bytes:
    if plan.mode == "parallel":
        return wire.encode_frames(wire.FrameBlock(*head, np.ascontiguousarray(clicks)), session)
    return wire.encode_clicks(wire.ClickBlock(*head, stamps.astype(np.uint16), clicks), session)


def _kept(batches: Iterator[Batch]) -> list[tuple[Any, list[Any]]]:
    """Copies: rows are valid until the next batch."""
    return [(batch.rows.copy(), list(batch.events)) for batch in batches]


def compare_streams(seed: int, count: int) -> tuple[StreamCounts, str]:
    """Send `count` streams; return the counts and "" or what went wrong, with the stream's number."""
    streams = Streams(seed)
    try:
        for number in range(count):
            wrong = streams.compare(MODES[number % len(MODES)])
            if wrong:
                return streams.counts, f"stream {number} of seed {seed}, {MODES[number % len(MODES)]}: {wrong}"
    except Exception:
        return streams.counts, f"stream {streams.counts.streams} of seed {seed}:\n{traceback.format_exc()}"
    finally:
        streams.close()
    return streams.counts, ""
