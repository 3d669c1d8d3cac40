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
from automata import automaton_bundle, random_automaton
from heads import head_bundle, random_layers
from plans import shot_major, walk_plan, walked
from streams import SESSION, by_core, by_thread, click_frames, same
from tree import ROOT

from pans.bundle.backends.choose import make_decider
from pans.decide.kernel import arrays as ring
from pans.decide.kernel.stream_core import StreamCore
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


@pytest.mark.parametrize("tick_us", [0.5, 2.0, 9.0])  # an exposure lasts 100 of them; a sleep ends after 2 ms
def test_a_kernel_that_sleeps_decides_and_keeps_the_same(tick_us: float) -> None:
    automaton = random_automaton(4, 8, 4)
    decider = make_decider(automaton_bundle(automaton))
    plan = walk_plan(automaton, 2)
    walks = click_frames(plan, walked(plan, 200, np.random.default_rng(2)), np.random.default_rng(3), 1)
    for case in (stream(50), (plan, decider, walks)):
        kept: dict[float, list[bytes]] = {0.0: [], tick_us: []}
        for tick, bodies in kept.items():
            assert_the_same(*case, tick_us=tick, kept=bodies, gather_ns=30_000_000)
        assert kept[tick_us] == kept[0.0] != []


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
        test_serving.assert_the_same(*test_serving.stream(8), tick_us=9.0, gather_ns=30_000_000)
        if name in held_up:
            break
    setattr(receive, name, before)
print("SAME", sorted(held_up) == sorted(sys.argv[1:]))
"""
STEPS = ("_hand_over", "_park", "_begin", "_read", "write_now", "wait_both", "_nap", "fence")


ASLEEP = """
import random, socket, sys, threading, time
from pans.decide.kernel import arrays as ring, receive
from pans.decide.kernel.stream_core import StreamCore
from pans.live.deciding import DecidingThread
from pans.protocol.wire import messages as wire
from streams import SESSION, click_frames
import numpy as np, test_serving
receive.SLEEP_NS = receive.NAP_NS = 60_000_000_000
plan, decider = test_serving.shot_major(3, 10), test_serving.stream(1)[1]
sent = [(int(slot), 1) for _ in range(10) for slot in plan.slot_pattern]
messages = click_frames(plan, sent, np.random.default_rng(1), 1)[:-2]
asleep, before = threading.Semaphore(0), receive._nap
def nap(rings, control, wait_ns, scratch):
    if wait_ns > 5_000_000_000:
        asleep.release()
    before(rings, control, wait_ns, scratch)
receive._nap = nap
streamed, thread = StreamCore(plan, decider, 10, 0, SESSION), DecidingThread()
turn, (ours, theirs) = streamed.turn, socket.socketpair()
ours.setblocking(False)
def until(true):
    began_s = time.monotonic()
    while not true():
        thread.wait(0.01)
        assert time.monotonic() - began_s < 5
turn.allow(0, 0, 1 << 60, tick_us=100_000.0)  # ten seconds from one exposure to the next
thread.start(turn, ours.fileno())
theirs.sendall(b"".join(messages[:4]))  # a mark is the first
assert asleep.acquire(timeout=20)
seen = turn.control[ring.N_MESSAGES]
theirs.sendall(messages[4])
assert not asleep.acquire(timeout=0.2) and turn.control[ring.N_MESSAGES] == seen
turn.stay_awake(time.perf_counter_ns())
thread.wake()
until(lambda: turn.control[ring.N_MESSAGES] == seen + 1)
theirs.sendall(messages[5])
until(lambda: turn.control[ring.N_MESSAGES] == seen + 2)  # awake until the PONG comes
theirs.sendall(wire.encode_pong(wire.Pong(1, 2, 3, 4), SESSION))
assert asleep.acquire(timeout=20)
thread.ask_to_park()
until(turn.receive_batch)
assert turn.reported[ring.PARKED] and len(turn.messages) == 6 and len(turn.answers) == 1
turn.release()
turn.control[ring.PARK] = 0
thread.go_on()
theirs.sendall(b"".join(messages[6:8]))
assert asleep.acquire(timeout=20)
began_s = time.monotonic()
thread.stop()
assert time.monotonic() - began_s < 1
thread.close()
print("WOKEN")
"""


def test_parking_a_probe_and_the_end_of_serving_wake_a_kernel_that_sleeps() -> None:
    """Uncompiled, so that it sleeps for much longer than it ever may."""
    done = _uncompiled(ASLEEP)
    assert done.stdout.split() == ["WOKEN"], done.stderr[-3000:]


def test_the_kernel_may_be_held_up_at_each_step() -> None:
    """Uncompiled, in a process of its own, so that each step of the kernel can be slowed down: before it and behind it."""
    done = _uncompiled(SLOWED, *STEPS)
    assert done.stdout.split() == ["SAME", "True"], done.stderr[-3000:]


def _uncompiled(code: str, *arguments: str) -> Any:
    here = Path(__file__).parent
    paths = [here, *(ROOT / "tests" / folder for folder in ("support", "oracles", "sessions", "independent"))]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths)), "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=env, timeout=300)
