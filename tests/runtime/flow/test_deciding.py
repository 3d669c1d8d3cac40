"""The compiled decisions of a flow: over any stream those of the core that takes its messages one by one."""

from __future__ import annotations

import socket
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flows import NOTHING, SESSION, by_one, frame, make, plan_of, scene, state_of, strange, stream
from hypothesis import given, settings
from hypothesis import strategies as st

from pans.runtime.core.dark_guard import DarkGuard
from pans.runtime.core.decision import Output, joined
from pans.runtime.core.plan import Plan
from pans.runtime.decide.table import TableDecider
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.steps import FlowSteps
from pans.runtime.instrument.cusum import ChannelWatch
from pans.runtime.instrument.dead_channels import DeadChannelTest
from pans.runtime.live.flow_run import settled_blocks
from pans.runtime.live.loop import choose_turn
from pans.runtime.turn import rings as ring
from pans.runtime.turn import system
from pans.runtime.turn.engine import Turn
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.messages import MessageType

pytestmark = pytest.mark.skipif(bool(system.offered()), reason="no compiled turn here")
TAPE = {"kind": "tape", "bars_per_s": 20_000.0}
FOLLOWED = {"kind": "tape", "bars_per_s": 20_500.0, "track": 3}


def table(shots: int) -> TableDecider:
    """Of 10 channels and 4 classes; scores that are not finite, and classes that are not sure, are among its rows."""
    scores = np.random.default_rng(shots).normal(0, 2, ((shots + 1) ** 10, 4)).astype(np.float32)
    scores[5::97, 2] = np.nan
    return TableDecider(scores, shots, shots)


TABLES = {shots: table(shots) for shots in (1, 2)}


def by_turn(core: FlowCore, plan: Plan, data: bytes, cuts: list[int]) -> Output:
    """The compiled turn, what it leaves to Python by `step`."""
    steps, decoder = FlowSteps(core, plan), BulkDecoder()
    steps.begin(SESSION)
    turn, output = Turn(steps, decoder), NOTHING
    for first, stop in zip([0, *cuts], [*cuts, len(data)]):
        ended = turn.feed([(1, data[first:stop])])
        while True:
            for _, came in settled_blocks(turn) if turn.counts.steps else ():
                output = output if came is None else joined(output, came)
            for mark in turn.marks() if not turn.counts.steps else ():
                core.remember(mark)
            if ended == ring.ALL_TAKEN:
                break
            if ended == ring.ODD:
                frame = decoder.frame(*turn.left[0].tolist())
                turn.skip()
                output = output if frame.session != SESSION else joined(output, core.step(frame))
            ended = turn.feed_on()
    return joined(output, core.end())


def guarded(core: FlowCore, block: int, dark: bool) -> FlowCore:
    """With a guard of the dark counts and of dead channels, both so eager that they find much."""
    expected = np.full(10, 1e-3)
    lit = DeadChannelTest(expected, 300.0, 5.0)
    core.guard = DarkGuard(plan_of(block, dark), ChannelWatch(10, expected), lit=lit)
    return core


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_each_decision_is_python_s(data: st.DataObject) -> None:
    starts = np.cumsum(data.draw(st.lists(st.integers(45, 150), min_size=3, max_size=7))).tolist()
    words = scene(*((first, 30 + first % 70, first % 4) for first in starts), n=1000)
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    words |= ((rng.random((1000, 10)) < 0.002) @ (1 << np.arange(10))).astype(np.uint16)
    block, dark = data.draw(st.sampled_from([1, 7, 20, 50])), data.draw(st.booleans())
    dark, shots = dark and block > 1, data.draw(st.sampled_from([1, 2]))
    changes: dict[str, Any] = dict(data.draw(st.sampled_from([{}, TAPE, FOLLOWED])))
    changes |= {"sure": data.draw(st.sampled_from([0.0, 0.6])), "gate_classes": ("a", "c")}
    messages = stream(words, block)
    kinds = ["lost", "twice", "another session", "short", "drops", "period"]
    for place in sorted(data.draw(st.sets(st.integers(0, len(messages) - 1), max_size=4)), reverse=True):
        kind = data.draw(st.sampled_from(kinds))
        if kind == "period" and frame(messages[place]).type == MessageType.MARK:  # it has none
            kind = "lost"
        messages[place : place + 1] = strange(kind, messages[place])
    wire_bytes = b"".join(messages)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(wire_bytes) - 1), max_size=12)))
    one, other = (make(block, dark, shots=shots, decider=TABLES[shots], **changes) for _ in range(2))
    if data.draw(st.booleans()):
        one, other = guarded(one, block, dark), guarded(other, block, dark)
    wanted, found = by_one(one, wire_bytes), by_turn(other, plan_of(block, dark), wire_bytes, cuts)
    assert found._replace(block_end_tick=None) == wanted._replace(block_end_tick=None)
    assert state_of(other) == state_of(one)
    if changes.get("kind") == "tape":
        assert (other.__dict__["_middle"], other.__dict__["_pitch"]) == (
            one.__dict__["_middle"],
            one.__dict__["_pitch"],
        )


@pytest.mark.parametrize("dark", [False, True])
def test_the_guard_finds_the_same_at_the_same_exposures(dark: bool) -> None:
    rng = np.random.default_rng(3)
    words = ((rng.random((30_000, 10)) < 0.02) @ (1 << np.arange(10))).astype(np.uint16)
    data = b"".join(stream(words, 50))
    one, other = (guarded(make(50, dark, decider=TABLES[1]), 50, dark) for _ in range(2))
    found = by_turn(other, plan_of(50, dark), data, list(range(5000, len(data), 5000)))
    assert found.events == by_one(one, data).events
    assert len(found.events) > 1, "a rate of twenty times the expected one was not seen"
    assert state_of(other) == state_of(one)


def test_pulses_at_real_pace_are_python_s_unless_asked_otherwise() -> None:
    gated = make(decider=TABLES[1], gate_classes=("a",))
    with socket.socket() as port:
        link: Any = SimpleNamespace(virtual=False, fileno=port.fileno, now_ns=time.perf_counter_ns)
        assert choose_turn("auto", gated, link, drives=False).taken == "compiled"
        assert choose_turn("compiled", gated, link, drives=False).taken == "compiled"
        assert choose_turn("auto", make(decider=TABLES[1]), link, drives=False).taken == "compiled"


def test_what_has_no_compiled_turn_says_why() -> None:
    assert make(decider=TABLES[1]).excluded == ""
    assert "no table" in make().excluded
    assert "side by side" in make(decider=TABLES[1], pool=2).excluded
    other = make(decider=TABLES[1])
    other.guard = DarkGuard(plan_of(20), ChannelWatch(10, np.full(10, 1e-3)), "abstain")
    assert "--on-dark" in other.excluded
