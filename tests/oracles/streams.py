"""The kernel and the core alone over the same bytes, and the faults that a link may add to them."""

import socket
import threading
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pans.decide.decision import DECISION_DTYPE
from pans.decide.kernel import arrays as ring
from pans.decide.kernel.calls import Limits
from pans.decide.kernel.stream_core import StreamCore
from pans.decide.still.core import Core
from pans.decide.still.kernel_state import IdleSteps
from pans.live.deciding import DecidingThread
from pans.protocol.wire import DeviceState, MessageType, StateReason
from pans.protocol.wire import messages as wire
from pans.protocol.wire.framing import FrameDecoder
from pans.protocol.wire.messages import ClickBlock, FrameBlock, Mark, Status

SESSION = 7
MOST_SENT = 1 << 15


def by_core(
    plan: Any, decider: Any, shots: int, pieces: list[bytes]
) -> tuple[np.ndarray, list[Any], Core, FrameDecoder]:
    core, decoder = Core(plan, decider, shots, 0), FrameDecoder()
    rows: list[Any] = []
    events: list[Any] = []
    for piece in pieces:
        for frame in decoder.feed(piece):
            if frame.session == SESSION and frame.type in (0x84, 0x90, 0x91, 0x92):
                output = core.step(frame)
                rows += output.decisions
                events += output.events
    return np.array([tuple(row) for row in rows], DECISION_DTYPE), events, core, decoder


def by_stream(plan: Any, decider: Any, shots: int, pieces: list[bytes]) -> tuple[np.ndarray, list[Any], StreamCore]:
    streamed = StreamCore(plan, decider, shots, 0, SESSION)
    rows, events = [np.zeros(0, DECISION_DTYPE)], []
    for piece in pieces:
        for batch in streamed.feed(piece):
            rows.append(batch.rows.copy())
            events += batch.events
    return np.concatenate(rows), events, streamed


def by_descriptor(plan: Any, decider: Any, shots: int, pieces: list[bytes]) -> tuple[np.ndarray, list[Any], StreamCore]:
    """As `by_stream`, but the kernel waits for and reads the bytes itself, one piece at a read."""
    streamed = StreamCore(plan, decider, shots, 0, SESSION)
    rows, events = [np.zeros(0, DECISION_DTYPE)], []
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        for piece in pieces:
            for first in range(0, len(piece), MOST_SENT):
                theirs.send(piece[first : first + MOST_SENT])
                for batch in streamed.listen(ours.fileno(), Limits(due_ns=0)):
                    rows.append(batch.rows.copy())
                    events += batch.events
    return np.concatenate(rows), events, streamed


def by_thread(
    plan: Any,
    decider: Any,
    shots: int,
    pieces: list[bytes],
    pause: Callable[[str], None] = lambda step: None,
    gather_ns: int = 0,
    tick_us: float = 0.0,
    kept: list[bytes] | None = None,
) -> tuple[np.ndarray, list[Any], StreamCore]:
    """As `by_descriptor`, but the kernel serves in a thread of its own; Python calls `pause` at each step of its side.

    With `tick_us` the kernel sleeps while no decision can fall due. `kept` gets what would be recorded.
    """
    streamed = StreamCore(plan, decider, shots, 0, SESSION)
    core, turn = streamed.core, streamed.turn
    rows, events = [np.zeros(0, DECISION_DTYPE)], list[Any]()
    ours, theirs = socket.socketpair()
    ours.setblocking(False)

    def send() -> None:
        for piece in pieces:
            theirs.sendall(piece)
        theirs.shutdown(socket.SHUT_WR)

    thread, sender, ended = DecidingThread(), threading.Thread(target=send), ring.ALL_TAKEN
    with ours, theirs:
        turn.allow(0, 0, gather_ns, tells_exposed=True, tick_us=tick_us)
        thread.start(turn, ours.fileno())
        sender.start()
        while ended != ring.GONE:
            thread.wait(1.0)
            pause("woken")
            if not turn.receive_batch():
                continue
            ended, parked = turn.end.ended, bool(turn.reported[ring.PARKED])
            pause("received")
            rows.append(turn.rows.copy())
            if kept is not None:
                kept += [turn.bytes_of(span) for spans in (turn.messages, turn.answers) for span in spans]
            core.remember_rows(turn.marks())
            for _, frame, standing in turn.passed():
                events += core.step(frame, standing).events
            if parked and ended == ring.ODD:
                for batch in streamed._take_one(turn.take_odd()):
                    rows.append(batch.rows.copy())
                    events += batch.events
                core.steps(SESSION)
                turn.allow(0, 0, gather_ns, tells_exposed=True, tick_us=tick_us)
                pause("taken")
                thread.go_on()
            pause("accounted for")
            if turn.release():
                thread.wake()
            pause("released")
        thread.close()
        sender.join()
    return np.concatenate(rows), events, streamed


def compare(plan: Any, decider: Any, shots: int, pieces: list[bytes]) -> np.ndarray:
    expected, expected_events, core, decoder = by_core(plan, decider, shots, pieces)
    fed = by_stream(plan, decider, shots, pieces)
    ways = [fed, by_descriptor(plan, decider, shots, pieces)]
    if not isinstance(core.steps(SESSION), IdleSteps) and core.steps(SESSION).decides:
        ways.append(by_thread(plan, decider, shots, pieces))
    for rows, events, streamed in ways:
        same(rows, events, streamed, expected, expected_events, core, decoder)
    return fed[0]


def same(
    rows: np.ndarray, events: list[Any], streamed: StreamCore, expected: np.ndarray, expected_events: list[Any],
    core: Core, decoder: FrameDecoder,
) -> None:  # fmt: skip
    """Assert that two ways through the same bytes gave the same, down to the places where the cores stand."""
    for name in DECISION_DTYPE.names or ():
        assert rows[name].tolist() == expected[name].tolist(), name
    assert events == expected_events
    assert asdict(streamed.core.tracker.counters) == asdict(core.tracker.counters)
    assert asdict(streamed.decoder.counters) == asdict(decoder.counters)
    assert streamed.core.windows.tallies.tolist() == core.windows.tallies.tolist()
    for name in ("n_decisions", "n_abstained", "completed", "last_tick", "jitter_ticks"):
        assert getattr(streamed.core, name) == getattr(core, name), name
    assert streamed.core.windows.walks.shown.tolist() == core.windows.walks.shown.tolist()
    assert streamed.core.tracker.position == core.tracker.position
    assert streamed.core.windows.position == core.windows.position


def spoilt(data: st.DataObject, clean: list[bytes], rng: np.random.Generator) -> list[bytes]:
    """Frames lost, damaged, repeated, held back, and others among them; cut into pieces anywhere."""
    foreign = [
        wire.encode_ping(1, 5, SESSION),
        wire.encode_mark(Mark(0, 1, 2, 0, 0, 1.0), SESSION + 1),
        wire.encode_frame(MessageType.FRAMES, bytes(40), SESSION),
        wire.encode_frame(MessageType.MARK, bytes(5), SESSION),
        wire.encode_frames(FrameBlock(3, 0, 0, 2**63, 1, 0, np.ones((2, 1), np.uint8)), SESSION),
        wire.encode_frames(FrameBlock(4, 2, 2**63, 0, 1, 0, np.ones((50, 8), np.uint8)), SESSION),
    ]
    sent: list[bytes] = []
    for message in clean:
        fate = data.draw(st.sampled_from(["arrives"] * 6 + ["lost", "damaged", "twice", "foreign", "held"]))
        if fate == "damaged":
            spoilt = bytearray(message)
            spoilt[int(rng.integers(len(spoilt)))] ^= 1 << int(rng.integers(8))
            message = bytes(spoilt)
        if fate == "foreign":
            sent.append(foreign[int(rng.integers(len(foreign)))])
        if fate != "lost":
            sent += [message] * (2 if fate == "twice" else 1)
        if fate == "held" and len(sent) > 1:
            sent[-1], sent[-2] = sent[-2], sent[-1]
    whole = b"".join(sent)
    at = sorted(rng.integers(0, len(whole) + 1, int(rng.integers(0, 6))).tolist())
    return [whole[a:b] for a, b in zip([0, *at], [*at, len(whole)])]


def click_frames(plan: Any, sent: list[tuple[int, int]], rng: np.random.Generator, block: int) -> list[bytes]:
    """A clean sequential stream of (stamp, click): a mark and blocks for every visit, which end with a cycle."""
    messages: list[bytes] = []
    slots, visit_exposures = plan.slots_per_cycle, plan.slots_per_cycle * plan.cycles_per_object
    for first in range(0, len(sent), slots):
        visit, within = divmod(first, visit_exposures)
        if not within:
            truth = int(rng.integers(-1, 3))
            mark = Mark(len(messages), visit, truth, first, 1000 + 100 * first, 2.5)
            messages.append(wire.encode_mark(mark, SESSION))
        for at in range(first, first + slots, block):
            stamps, bits = zip(*sent[at : min(at + block, first + slots)])
            facts = len(messages), 0, 1000 + 100 * at + int(rng.integers(3)), at, 100, visit
            clicks = ClickBlock(*facts, np.array(stamps, np.uint16), np.array(bits, np.uint8))
            messages.append(wire.encode_clicks(clicks, SESSION))
    end = Status(DeviceState.IDLE, StateReason.COMPLETED, 0, 0, 10**6, len(sent))
    return [*messages, wire.encode_status(end, SESSION), wire.encode_status(end, SESSION)]
