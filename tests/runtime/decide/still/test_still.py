"""The core: the same frames give the same decisions, a window with a gap never gives a guess; and which marks it remembers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plans import parallel, shot_major

from pans.bundle.backends import NO_LABEL, Decider
from pans.bundle.backends.verdict import Verdict, softmax_winner
from pans.decide.dark.cusum import ChannelWatch
from pans.decide.dark.guard import DarkGuard
from pans.decide.dark.health import DeadChannelTest
from pans.decide.decision import DECISION_DTYPE, DecisionFlag
from pans.decide.plan import marks
from pans.decide.plan.marks import Marks
from pans.decide.still.core import Core
from pans.protocol.wire import DeviceState, Frame, FrameDecoder, StateReason
from pans.protocol.wire import messages as wire
from pans.protocol.wire.messages import ClickBlock, Mark, Status
from pans.protocol.wire.schema import MARK_DTYPE

N_FEATURES = 3
PLAN = shot_major(N_FEATURES, 2)  # 4 slots per cycle, 2 cycles per object


class CountingDecider(Decider):
    """Decides the number of clicks; remembers what it was asked."""

    name, n_features, n_classes = "counting", N_FEATURES, N_FEATURES + 1

    def __init__(self) -> None:
        self.asked: list[list[int]] = []

    def decide(self, counts: np.ndarray, shots: int) -> Verdict:
        self.asked.append(counts.tolist())
        return Verdict(int(counts.sum()) // shots, 0.5)


def make(n_cycles: int = 6) -> tuple[Core, CountingDecider]:
    decider = CountingDecider()
    return Core(PLAN, decider, 1, n_cycles), decider  # type: ignore[arg-type]


def frame(data: bytes) -> Frame:
    return FrameDecoder().feed(data)[0]


def cycle(seq: int, number: int, bits: list[int], patterns: list[int] | None = None) -> Frame:
    shown = np.array(patterns or PLAN.slot_pattern, np.uint16)
    return frame(
        wire.encode_clicks(
            ClickBlock(seq, 0, 1000 + 400 * number, 4 * number, 100, number // 2, shown, np.array(bits, np.uint8)), 1
        )
    )


def completed(next_exposure: int, tick: int = 10**6) -> Frame:
    return frame(wire.encode_status(Status(DeviceState.IDLE, StateReason.COMPLETED, 0, 0, tick, next_exposure), 1))


def test_a_wrong_pattern_abstains() -> None:
    core, decider = make()
    (decision,) = core.step(cycle(0, 0, [0, 1, 1, 1], [0xFFFF, 0, 2, 1])).decisions
    assert decision.flags == DecisionFlag.WRONG_PATTERN | DecisionFlag.ABSTAINED
    assert decider.asked == []


def test_completion_settles_what_never_came() -> None:
    core, _ = make()
    core.step(cycle(0, 0, [0, 0, 0, 0]))
    assert not core.step(completed(24)).decisions  # it may have overtaken what is missing
    assert not core.step(completed(24)).decisions  # a repetition says nothing new
    assert not core.completed
    assert core.step(completed(24, tick=10**6 + 1)).decisions
    assert core.completed
    assert core.n_decisions == 6
    assert core.tracker.counters.lost_exposures == 20
    assert core.step(completed(24)).decisions == []


@pytest.mark.parametrize(("claimed", "contradictions"), [(4, {}), (10**12, {"claimed_exposures": 1})])
def test_a_status_that_overtook_the_last_block_is_judged_and_the_block_still_counts(
    claimed: int, contradictions: dict[str, int]
) -> None:
    core, decider = make(n_cycles=1)
    assert [event.event()["what"] for event in core.step(completed(claimed)).events] == [*contradictions]
    assert core.step(completed(claimed)).events == []  # the same once more
    assert core.step(cycle(0, 0, [0, 1, 0, 0])).decisions[0].flags == 0
    core.step(completed(4, tick=10**6 + 1))
    assert (core.completed, core.contradictions, core.tracker.counters.lost_exposures) == (True, contradictions, 0)
    assert decider.asked == [[1, 0, 0]]


def test_what_comes_after_the_end_was_settled_is_dropped_and_counted() -> None:
    core, decider = make(n_cycles=1)
    core.step(completed(4))
    assert core.step(completed(4, tick=10**6 + 1)).decisions[0].flags & DecisionFlag.GAP
    assert core.step(cycle(0, 0, [0, 1, 0, 0])).decisions == []
    assert (core.tracker.counters.repeated, decider.asked) == (1, [])


def test_another_stream_settles_the_open_visit_and_counts_anew() -> None:
    core, decider = make(n_cycles=6)  # three visits of two cycles
    core.begin(0, 6)
    core.step(cycle(0, 0, [0, 1, 1, 1]))
    core.step(cycle(1, 1, [0, 1, 1, 1]))
    core.step(cycle(2, 2, [0, 1, 1, 1]))
    ended = core.end()
    assert [event.event() for event in ended.events] == [{"kind": "stream_end_unknown", "first_exposure": 12}]
    assert core.cycles_left(6) == 2
    (given_up,) = core.begin(500, 2).decisions
    assert given_up.flags == DecisionFlag.GAP | DecisionFlag.INCOMPLETE | DecisionFlag.ABSTAINED
    assert given_up.number == 3
    (decision,) = core.step(cycle(0, 0, [0, 1, 1, 0])).decisions
    assert (decision.number, decision.flags, decision.exposure_index) == (4, 0, 3)
    assert len(decider.asked) == 4


def test_a_stream_that_was_stopped_reports_what_was_exposed_and_never_came() -> None:
    core, _ = make(n_cycles=0)
    core.begin(0, 0)
    core.step(cycle(0, 0, [0, 1, 1, 1]))
    stopped = wire.encode_status(Status(DeviceState.IDLE, StateReason.STOPPED, 0, 0, 2000, 9), 1)
    assert core.step(frame(stopped)).events == []
    ended = core.end()
    assert [event.event()["exposures"] for event in ended.events] == [5]
    assert len(ended.decisions) == 1  # the window that lies whole in the gap
    assert core.end().events == []


def test_an_absurd_exposure_number_is_damage_not_a_million_windows() -> None:
    core, _ = make(n_cycles=0)
    assert core.step(cycle(0, 1 << 17, [0, 0, 0, 0])).decisions == []
    assert core.tracker.counters.malformed == 1
    assert core.step(cycle(0, 0, [0, 1, 0, 0])).decisions[0].flags == 0


def test_an_earlier_runs_completion_is_no_news() -> None:
    core, _ = make()
    core.start_tick = 500
    assert core.step(completed(24, tick=499)).decisions == []
    assert not core.completed


def test_exposures_beyond_the_plan_are_refused() -> None:
    core, decider = make(n_cycles=1)
    output = core.step(cycle(0, 5, [0, 0, 0, 0]))
    assert output.decisions == []
    assert {"kind": "beyond_plan", "exposure_index": 20} in [event.event() for event in output.events]
    assert decider.asked == []


def test_damaged_frames_change_nothing() -> None:
    core, _ = make()
    assert core.step(Frame(wire.MessageType.CLICKS, 0, 1, b"xx")).decisions == []
    assert core.step(Frame(wire.MessageType.STATUS, 0, 1, b"xx")).decisions == []
    assert core.step(cycle(0, 0, [0, 1, 0, 0])).decisions[0].label == 1


@pytest.mark.parametrize("off", [-3, 0, 3])
def test_a_block_that_ends_early_differs_from_the_plan_as_one_that_ends_late(off: int) -> None:
    core, _ = make()
    block = cycle(0, 0, [0, 1, 0, 0])
    first = int.from_bytes(block.payload[8:16], "little")
    core.begin(first, 0)
    tick = first + off
    core.step(block._replace(payload=block.payload[:8] + tick.to_bytes(8, "little") + block.payload[16:]))
    assert core.jitter_ticks == abs(off)


@pytest.mark.parametrize("score", [float("nan"), float("inf")])
def test_scores_that_are_not_finite_give_no_label(score: float) -> None:
    core, decider = make()
    decider.decide = lambda counts, shots: softmax_winner(np.array([0.0, score], np.float32))  # type: ignore[method-assign]
    (decision,) = core.step(cycle(0, 0, [0, 1, 0, 1])).decisions
    assert (decision.label, decision.probability) == (NO_LABEL, 0.0)
    assert decision.flags == DecisionFlag.NOT_FINITE | DecisionFlag.ABSTAINED
    assert core.n_abstained == 1


def test_blocks_that_do_not_fit_the_plan_are_counted_not_read() -> None:
    plan = parallel(N_FEATURES + 8, 4)
    decider = CountingDecider()
    decider.n_features = N_FEATURES + 8
    core = Core(plan, decider, 1, 0)  # type: ignore[arg-type]
    too_narrow = wire.FrameBlock(0, 0, 0, 0, 100, 0, np.ones((5, 1), np.uint8))
    two_visits = wire.FrameBlock(1, 0, 0, 5, 100, 0, np.ones((6, 2), np.uint8))
    other_kind = ClickBlock(2, 0, 0, 11, 100, 0, np.zeros(2, np.uint16), np.ones(2, np.uint8))
    encode = wire.encode_frames
    for message in (encode(too_narrow, 1), encode(two_visits, 1), wire.encode_clicks(other_kind, 1)):
        output = core.step(frame(message))
        assert output.events[-1].event()["kind"] == "beyond_plan"
        assert all(d.flags & DecisionFlag.GAP for d in output.decisions)
    assert core.contradictions == {"beyond_plan": 3}


def test_the_watch_for_dead_channels_sees_only_what_was_measured() -> None:
    """Exposures that the kernel took, and its decisions: one with a gap or a wrong pattern says nothing about its object."""
    plan = shot_major(N_FEATURES, 2)
    lit = DeadChannelTest(np.full(1, 1e-4), 1e9, 1e6)
    core = Core(plan, CountingDecider(), 1, 9, DarkGuard(plan, ChannelWatch(1, np.full(1, 1e-4)), lit=lit))  # type: ignore[arg-type]
    rows = np.zeros(5, DECISION_DTYPE)
    rows["object"], rows["clicks"] = range(5), (2, 0, 3, 1, 1)
    rows["flags"][1:4] = [DecisionFlag.GAP | DecisionFlag.ABSTAINED, DecisionFlag.WRONG_PATTERN, DecisionFlag.AMBIGUOUS]
    core.watch_blocks(np.zeros(20, np.uint16), np.ones(20, np.uint8), 0)
    core.watch_objects(rows)
    lit.end_object()
    assert (lit.objects, lit.clicked.tolist()) == (3, [3])


def rows_of(some: list[Mark]) -> np.ndarray:
    columns = ("seq", "object_index", "truth", "exposure_index", "tick", "photons", "half_exposures")
    rows = np.zeros(len(some), MARK_DTYPE)
    for name, values in zip(columns, zip(*some)):
        rows[name] = values
    return rows


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(st.integers(0, 9), st.lists(st.integers(0, 9), max_size=12)), max_size=20), st.booleans())
def test_the_latest_objects_are_remembered(steps: list[int | list[int]], keeps: bool) -> None:
    """One by one or many rows at once; one that comes again is as young as a new one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marks, "MAX_MARKS", 4)
        found, expected, seq = Marks(), dict[int, Mark](), 0
        for step in steps:
            some = []
            for number in [step] if isinstance(step, int) else step:
                seq += 1
                some.append(Mark(seq, number, number - 1, 8 * seq, 10**15 + seq, 0.5 * seq, seq % 3))
                expected.pop(number, None)
                expected[number] = some[-1]
                expected = dict(list(expected.items())[-4:])
            if isinstance(step, int):
                found.add(some[0])
            elif some:
                found.add_rows(rows_of(some))
            assert [found.get(number) for number in range(10)] == [expected.get(number) for number in range(10)]
        assert (len(found), found.latest()) == (len(expected), list(expected.values()))
        if keeps:
            found.keep(2)
            assert found.latest() == list(expected.values())[-2:]
