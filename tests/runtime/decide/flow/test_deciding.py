"""The decisions of the kernel on a flow: over any stream those of the core that takes its messages one by one."""

from typing import Any

import numpy as np
import pytest
from flows import NOTHING, PERIOD_TICKS, SESSION, by_one, frame, make, plan_of, scene, state_of, strange, stream
from hypothesis import given, settings
from hypothesis import strategies as st

from pans.bundle.backends.table import TableDecider
from pans.decide.core_state import CORE_FIELDS
from pans.decide.dark.cusum import ChannelWatch
from pans.decide.dark.guard import DarkGuard
from pans.decide.dark.health import DeadChannelTest
from pans.decide.decision import DecisionFlag, Output, joined
from pans.decide.flow.core import FlowCore
from pans.decide.kernel import arrays as ring
from pans.decide.kernel.calls import Kernel
from pans.decide.kernel.follow_up import follow_up_of
from pans.protocol.wire import MessageType, encode_frame
from pans.protocol.wire.framing import FrameDecoder

TAPE = {"kind": "tape", "bars_per_s": 20_000.0}
FOLLOWED = {"kind": "tape", "bars_per_s": 20_500.0, "track": 3}


def table(shots: int) -> TableDecider:
    """Of 10 channels and 4 classes; scores that are not finite, and classes that are not sure, are among its rows."""
    scores = np.random.default_rng(shots).normal(0, 2, ((shots + 1) ** 10, 4)).astype(np.float32)
    scores[5::97, 2] = np.nan
    return TableDecider(scores, shots, shots)


TABLES = {shots: table(shots) for shots in (1, 2)}


def by_turn(core: FlowCore, data: bytes, cuts: list[int]) -> Output:
    """The kernel, and what it leaves to the core by `step`."""
    turn, output, follow_up = Kernel(core.steps(SESSION), FrameDecoder()), NOTHING, follow_up_of(core)
    for first, stop in zip([0, *cuts], [*cuts, len(data)]):
        ended = turn.feed([(1, data[first:stop])])
        while True:
            follow_up.marks(turn)
            for came in follow_up.outputs(turn, turn.rows):
                output = joined(output, came)
            if ended == ring.ALL_TAKEN:
                break
            if ended == ring.ODD:
                frame = turn.take_odd()
                output = output if frame.session != SESSION else joined(output, core.step(frame))
            ended = turn.feed_on()
    return joined(output, core.end())


def guarded(core: FlowCore, block: int, dark: bool) -> FlowCore:
    """With a guard of the dark counts and of dead channels, both so eager that they find much."""
    expected = np.full(10, 1e-3)
    lit = DeadChannelTest(expected, 300.0, 5.0)
    core.guard = DarkGuard(plan_of(block, dark), ChannelWatch(10, expected), lit=lit)
    return core


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_each_decision_is_the_core_s(data: st.DataObject) -> None:
    starts = np.cumsum(data.draw(st.lists(st.integers(45, 150), min_size=3, max_size=7))).tolist()
    words = scene(*((first, 30 + first % 70, first % 4) for first in starts), n=1000)
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    words |= ((rng.random((1000, 10)) < 0.002) @ (1 << np.arange(10))).astype(np.uint16)
    block, dark = data.draw(st.sampled_from([1, 7, 20, 50])), data.draw(st.booleans())
    dark, shots = dark and block > 1, data.draw(st.sampled_from([1, 2]))
    changes: dict[str, Any] = dict(data.draw(st.sampled_from([{}, TAPE, FOLLOWED])))
    changes |= {"sure": data.draw(st.sampled_from([0.0, 0.6])), "gate_classes": ("a", "c")}
    messages = stream(words, block)
    kinds = ["lost", "twice", "another session", "short", "drops", "period", "marked again"]
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
    wanted, found = by_one(one, wire_bytes), by_turn(other, wire_bytes, cuts)
    assert found._replace(block_end_tick=None) == wanted._replace(block_end_tick=None)
    assert state_of(other) == state_of(one)
    tape = list(CORE_FIELDS[CORE_FIELDS.index("middle") :])
    assert other.state[tape].tolist() == one.state[tape].tolist()


@pytest.mark.parametrize("dark", [False, True])
def test_the_guard_finds_the_same_at_the_same_exposures(dark: bool) -> None:
    rng = np.random.default_rng(3)
    words = ((rng.random((30_000, 10)) < 0.02) @ (1 << np.arange(10))).astype(np.uint16)
    data = b"".join(stream(words, 50))
    one, other = (guarded(make(50, dark, decider=TABLES[1]), 50, dark) for _ in range(2))
    found = by_turn(other, data, list(range(5000, len(data), 5000)))
    assert found.events == by_one(one, data).events
    assert len(found.events) > 1, "a rate of twenty times the expected one was not seen"
    assert state_of(other) == state_of(one)


def test_a_block_that_ends_when_the_plan_does_not_is_seen() -> None:
    messages = stream(scene((100, 60, 0)), 20)
    last = frame(messages[-1])
    late = (1000 + 980 * PERIOD_TICKS + 3).to_bytes(8, "little")
    messages[-1] = encode_frame(last.type, last.payload[:8] + late + last.payload[16:], SESSION)
    core = make(decider=TABLES[1])
    by_turn(core, b"".join(messages), [])
    assert core.jitter_ticks == 3


@pytest.mark.parametrize("policy", ["warn", "abstain"])
@pytest.mark.parametrize("pool", [1, 2])
@pytest.mark.parametrize("backend", ["table", "other"])
def test_other_back_ends_pools_and_policies_decide_outside_the_kernel(policy: str, pool: int, backend: str) -> None:
    rng = np.random.default_rng(3)
    words = scene(*((first, 60, first % 4) for first in range(60, 3800, 130)), n=4000)
    words[19::20] |= ((rng.random(200) < 0.5) * 512).astype(np.uint16)
    data = b"".join(stream(words, 20))
    one, other = (make(dark=True, pool=pool, decider=TABLES[1] if backend == "table" else None) for _ in range(2))
    for core in (one, other):
        core.guard = DarkGuard(plan_of(20, dark=True), ChannelWatch(10, np.full(10, 1e-3)), policy)
    assert other.decides == (backend == "table" and policy == "warn" and pool == 1)
    wanted, found = by_one(one, data), by_turn(other, data, list(range(3000, len(data), 3000)))
    assert found._replace(block_end_tick=None) == wanted._replace(block_end_tick=None)
    assert state_of(other) == state_of(one)
    assert any(row.flags & DecisionFlag.DARK_ALARM for row in found.decisions) == (policy == "abstain")
