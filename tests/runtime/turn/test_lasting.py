"""A call that goes on in its own thread: it publishes what Python's core decides, in order; nothing is lost where nobody takes it."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from heads import head_bundle, random_layers
from plans import shot_major
from streams import SESSION, by_core, click_frames

from pans.runtime.decide.backends import make_decider
from pans.runtime.turn import rings as ring
from pans.runtime.turn import system
from pans.runtime.turn.lasting import LastingCall
from pans.runtime.turn.shared import HOLD, LEAVE, READY, ask
from pans.runtime.turn.streaming import StreamCore
from pans.runtime.wire.frame import unpack_body
from pans.runtime.wire.messages import (
    DeviceState,
    MessageType,
    Pong,
    StateReason,
    Status,
    decode_pong,
    encode_pong,
    encode_status,
)

pytestmark = pytest.mark.skipif(bool(system.offered()), reason="no compiled turn here")
PLAN = shot_major(3, 2)
RUNNING = Status(DeviceState.RUNNING, StateReason.NONE, 900, 0, 70, 3)
PONG = Pong(9, 11, 12, 13)


@pytest.fixture
def call() -> Iterator[LastingCall]:
    made = LastingCall()
    yield made
    made.close()


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def stream(cycles: int, block: int) -> tuple[StreamCore, list[bytes], Any]:
    """A core, its stream in frames, and what Python's core decides on it."""
    decider = make_decider(head_bundle(random_layers([3, 12, 3], seed=3)), backend="table")
    rng = np.random.default_rng(1)
    sent = [(int(slot), int(rng.integers(2))) for _ in range(cycles) for slot in PLAN.slot_pattern]
    frames = click_frames(PLAN, sent, rng, block)[:-2]  # without the end
    return StreamCore(PLAN, decider, 1, 0, SESSION), frames, by_core(PLAN, decider, 1, frames)[0]


def taken(call: LastingCall, turn: Any) -> tuple[list[Any], list[bytes], list[bytes]]:
    """The rows, messages and answers of what has been published, and behind a call's end of the rest."""
    rows, messages, answers = list[Any](), list[bytes](), list[bytes]()

    def take() -> None:
        rows.extend(turn.rows.tolist())
        messages.extend(turn.bytes_of(span) for span in turn.messages)
        answers.extend(turn.bytes_of(span) for span in turn.answers)

    for _ in call.banks():
        take()
    if not call.under_way:
        turn.show_rest()
        take()
    return rows, messages, answers


def await_bank(turn: Any) -> None:
    """Wait until a bank has been published, however slow the machine is."""
    until = time.monotonic() + 10
    while ask(turn.control, READY) == turn.control[ring.TAIL] and time.monotonic() < until:
        time.sleep(0.001)


def test_what_is_published_is_what_python_decides(call: LastingCall, ends: tuple[socket.socket, socket.socket]) -> None:
    """Probes and an ordinary STATUS do not end the call; the messages keep their order."""
    streamed, frames, wanted = stream(cycles=60, block=4)
    turn = streamed.turn
    call.begin(turn, ends[0].fileno(), 0)
    rows, messages, answers = list[Any](), list[bytes](), list[bytes]()
    for number, frame in enumerate(frames):
        ends[1].send(frame)
        if number % 20 == 7:
            ends[1].send(encode_status(RUNNING, SESSION) + encode_pong(PONG, SESSION))
        if number % 10 == 0:
            await_bank(turn)
            for had, more in zip((rows, messages, answers), taken(call, turn)):
                had.extend(more)  # type: ignore[arg-type]
    until = time.monotonic() + 10
    while len(rows) < len(wanted) and time.monotonic() < until:
        assert call.wait(0.005) is None
        for had, more in zip((rows, messages, answers), taken(call, turn)):
            had.extend(more)  # type: ignore[arg-type]
    assert rows == wanted.tolist()
    kinds = [body[0] for body in messages]
    assert kinds.count(MessageType.STATUS) == len(answers) == len(range(7, len(frames), 20))
    assert kinds[:12].index(MessageType.STATUS) == 8  # behind the eighth block
    assert decode_pong(unpack_body(answers[0]).payload) == PONG
    assert turn.control[ring.HEAD] > ring.N_BANKS  # every bank was used again
    assert streamed.core.n_decisions == len(wanted)
    assert call.end() == ring.DUE
    assert call.lives


def test_nothing_is_lost_when_nobody_takes_what_is_published(
    call: LastingCall, ends: tuple[socket.socket, socket.socket]
) -> None:
    streamed, frames, wanted = stream(cycles=1400, block=1)
    turn = streamed.turn
    sender = threading.Thread(target=lambda: [ends[1].sendall(frame) for frame in frames])
    call.begin(turn, ends[0].fileno(), 0)
    sender.start()
    assert call.wait(20) == ring.FULL
    assert turn.control[ring.HEAD] == ring.N_BANKS - 1  # all but the last are published, and that is full
    rows, _, _ = taken(call, turn)
    assert 0 < len(rows) < len(wanted)
    call.begin(turn, ends[0].fileno(), 0)
    until = time.monotonic() + 10
    while len(rows) < len(wanted) and time.monotonic() < until:
        ended = call.wait(0.005)
        rows += taken(call, turn)[0]
        if ended is not None:  # it was full again: this thread had to wait for a core
            assert ended == ring.FULL
            call.begin(turn, ends[0].fileno(), 0)
    sender.join()
    assert rows == wanted.tolist()


def test_what_is_not_ordinary_ends_the_call(call: LastingCall, ends: tuple[socket.socket, socket.socket]) -> None:
    """The first missing message, and a STATUS that ends the run, are Python's; what came before them is shown."""
    streamed, frames, _ = stream(cycles=4, block=1)
    turn = streamed.turn
    for ended in (b"".join(frames[:5] + frames[6:]), encode_status(RUNNING._replace(state=DeviceState.IDLE), SESSION)):
        call.begin(turn, ends[0].fileno(), 0)
        ends[1].send(ended)
        assert call.wait(10) == ring.ODD
        _, messages, _ = taken(call, turn)
        assert len(messages) == (5 if len(ended) > 200 else 0)
        turn.skip(len(turn.left))


def test_the_other_end_goes_and_a_call_that_hangs_gives_no_sign_of_life(
    call: LastingCall, ends: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    streamed, _, _ = stream(cycles=1, block=1)
    call.begin(streamed.turn, ends[0].fileno(), 0)
    ends[1].close()
    assert call.wait(10) == ring.GONE
    goes_on = threading.Event()
    monkeypatch.setattr(streamed.turn, "_kernel", lambda *arguments: ring.DUE if goes_on.wait(10) else ring.FULL)
    monkeypatch.setattr("pans.runtime.turn.lasting.DEAD_S", 0.02)
    monkeypatch.setattr("pans.runtime.turn.lasting.STOP_S", 0.02)
    call.begin(streamed.turn, ends[0].fileno(), 0)
    assert call.lives
    time.sleep(0.03)
    assert not call.lives
    assert call.end() is None
    goes_on.set()
    assert call.wait(10) == ring.DUE
    assert call.lives


def test_one_at_a_time_writes(call: LastingCall) -> None:
    streamed, _, _ = stream(cycles=1, block=1)
    control = streamed.turn.control
    call.begin(streamed.turn, -1, 0)
    assert call.wait(10) == ring.ALL_TAKEN
    with call.writing():
        assert ask(control, HOLD) == 0
    assert ask(control, HOLD) == 1
    with contextlib.suppress(TimeoutError), call.writing():
        assert ask(control, HOLD) == 0  # a writer that never ends is not waited for
    assert ask(control, HOLD) == 0
    ask(control, LEAVE)
    assert control[ring.WRITES] == 0


def test_an_error_in_the_thread_is_raised_where_it_is_waited_for(call: LastingCall) -> None:
    streamed, _, _ = stream(cycles=1, block=1)

    def fails(*arguments: Any) -> int:
        raise MemoryError("planted")

    streamed.turn._kernel = fails
    call.begin(streamed.turn, -1, 0)
    with pytest.raises(MemoryError, match="planted"):
        call.wait(10)
