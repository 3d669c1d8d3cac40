"""The kernel in a thread of its own: nothing is lost and nothing comes twice, whichever thread is held up where."""

import os
import random
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from heads import head_bundle, random_layers
from plans import shot_major
from streams import SESSION, by_core, by_thread, click_frames, same
from tree import ROOT

from pans.bundle.backends.choose import make_decider
from pans.decide.kernel import arrays as ring
from pans.decide.kernel.calls import StreamCore
from pans.live.deciding import DecidingThread
from pans.protocol.wire import DeviceState, StateReason
from pans.protocol.wire import messages as wire

VISITS = 400


def stream(visits: int = VISITS) -> tuple[Any, Any, list[bytes]]:
    """A plan, a back end, and the messages of `visits` visits, with a STATUS, a PONG, a repeat or a loss here and there."""
    plan, decider = shot_major(3, 2), make_decider(head_bundle(random_layers([3, 12, 3], seed=3)), backend="table")
    sent = [(int(slot), 1) for _ in range(visits) for slot in plan.slot_pattern]
    clean, chance = click_frames(plan, sent, np.random.default_rng(1), 4), random.Random(5)
    status = wire.encode_status(wire.Status(DeviceState.RUNNING, StateReason.NONE, 1000, 0, 5, 0), SESSION)
    messages: list[bytes] = []
    for number, message in enumerate(clean):
        fate = chance.random()
        if fate > 0.02 or number < 3:
            messages.append(message)
        if 0.02 < fate < 0.04:
            messages.append(message)
        if 0.04 < fate < 0.06:
            messages.append(status)
        if 0.06 < fate < 0.1:
            messages.append(wire.encode_pong(wire.Pong(1, 2, 3, 4), SESSION))
    return plan, decider, messages


def assert_the_same(plan: Any, decider: Any, messages: list[bytes], **options: Any) -> None:
    pieces = [b"".join(messages[first : first + 7]) for first in range(0, len(messages), 7)]
    expected, events, core, decoder = by_core(plan, decider, 1, pieces)
    rows, found, streamed = by_thread(plan, decider, 1, pieces, **options)
    same(rows, found, streamed, expected, events, core, decoder)


@pytest.mark.parametrize("gather_ns", [0, 3_000_000])
@pytest.mark.parametrize("held_up", ["", "woken", "received", "taken", "accounted for", "released"])
def test_python_may_be_held_up_at_each_step(held_up: str, gather_ns: int) -> None:
    chance = random.Random(2)

    def pause(step: str) -> None:
        if step == held_up:
            time.sleep(chance.choice([0.0, 0.0, 0.001, 0.004]))

    assert_the_same(*stream(), pause=pause, gather_ns=gather_ns)


def test_a_reader_who_is_away_finds_all_of_it() -> None:
    """Python does not look for as long as it takes to fill both halves of the rings: the kernel waits, and the device is held back."""
    plan, decider, messages = stream(VISITS)
    slept: list[float] = []

    def pause(step: str) -> None:
        if step == "received" and not slept:
            slept.append(0.5)
            time.sleep(0.5)

    assert_the_same(plan, decider, messages * 1, pause=pause)
    assert slept


def test_a_serving_kernel_parks_when_it_is_asked_and_goes_on() -> None:
    plan, decider, messages = stream()
    streamed, thread = StreamCore(plan, decider, 1, 0, SESSION), DecidingThread()
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    turn, seen, until_s = streamed.turn, 0, time.monotonic() + 60

    def park() -> None:
        """Ask, and account for what comes until the kernel is parked."""
        nonlocal seen
        parked = False
        thread.ask_to_park()
        while not parked:
            thread.wait(0.05)
            assert time.monotonic() < until_s
            if turn.receive_batch():
                parked, odd = bool(turn.reported[ring.PARKED]), turn.end.ended == ring.ODD
                seen += len(turn.messages) + len(turn.answers) + odd
                streamed.core.remember_rows(turn.marks())
                if odd:
                    list(streamed._take_one(turn.take_odd()))
                turn.release()

    with ours, theirs:
        turn.allow(0, 0, 1 << 60)  # nothing is handed over before somebody asks
        thread.start(turn, ours.fileno())
        for first in range(0, 30, 10):
            theirs.sendall(b"".join(messages[first : first + 10]))
            while seen < first + 10:  # it may park before it has read them
                park()
                turn.control[ring.PARK] = 0
                turn.allow(0, 0, 1 << 60)
                thread.go_on()
        park()
        thread.stop()
        assert not thread.serves
        thread.close()
        thread.close()  # idempotent
    assert seen == 30


def test_a_thread_that_is_given_up_ends_though_nobody_has_looked() -> None:
    """The watchdog speaks in the loop's place: the kernel ends its call, whatever it holds."""
    plan, decider, messages = stream()
    streamed, thread = StreamCore(plan, decider, 1, 0, SESSION), DecidingThread()
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    with ours, theirs:
        streamed.turn.allow(0, 0, 0)
        thread.start(streamed.turn, ours.fileno())
        theirs.sendall(b"".join(messages[:50]))
        time.sleep(0.05)
        began_s = time.monotonic()
        thread.stop()
        assert time.monotonic() - began_s < 1.0
        thread.close()


SLOWED = """
import random, sys, time
from pans.decide.kernel import receive
import test_serving
chance, held_up = random.Random(1), set()
for name in sys.argv[1:]:
    before = getattr(receive, name)
    def slowed(*arguments, name=name, before=before):
        held_up.add(name)
        time.sleep(chance.choice([0.0, 0.001, 0.003]))
        found = before(*arguments)
        time.sleep(chance.choice([0.0, 0.001, 0.003]))
        return found
    setattr(receive, name, slowed)
    for _ in range(20):  # whether a step is taken at all depends on how the two threads meet
        test_serving.assert_the_same(*test_serving.stream(8))
        if name in held_up:
            break
    setattr(receive, name, before)
print("SAME", sorted(held_up) == sorted(sys.argv[1:]))
"""
STEPS = ("_hand_over", "_park", "_begin", "_read", "write_now", "wait_both", "_nap", "fence")


def test_the_kernel_may_be_held_up_at_each_step() -> None:
    """Uncompiled, in a process of its own, so that each step of the kernel can be slowed down: before it and behind it."""
    here = Path(__file__).parent
    paths = [here, *(ROOT / "tests" / folder for folder in ("support", "oracles", "sessions", "independent"))]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths)), "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", SLOWED, *STEPS], capture_output=True, text=True, env=env, timeout=300)
    assert done.stdout.split() == ["SAME", "True"], done.stderr[-3000:]
