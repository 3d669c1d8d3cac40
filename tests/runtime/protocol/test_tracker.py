"""Loss accounting: every exposure arrives once or is in exactly one gap, whatever the link does."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inner_kernels import called

from pans.decide.core_state import CORE_DTYPE
from pans.protocol.tracker import MEMORY_BYTES, Gap, StreamTracker
from pans.protocol.wire import Frame, FrameDecoder, kernels
from pans.protocol.wire import messages as wire
from pans.protocol.wire.framing import content_crc
from pans.protocol.wire.messages import ClickBlock, Mark
from pans.protocol.wire.schema import MAX_GAP_EXPOSURES, RECEIVE_WINDOW


def clicks(seq: int, first: int, n: int, drops: int = 0) -> Frame:
    block = ClickBlock(
        seq % (1 << 32), drops, 10 * first % (1 << 60), first, 10, 0, np.zeros(n, np.uint16), np.ones(n, np.uint8)
    )
    return FrameDecoder().feed(wire.encode_clicks(block, 1))[0]


def mark(seq: int) -> Frame:
    return FrameDecoder().feed(wire.encode_mark(Mark(seq, 3, 1, 0, 0, 0.0), 1))[0]


def frames(first: int, n: int) -> Frame:
    block = wire.FrameBlock(1, 0, 0, first, 1, 0, np.ones((n, 1), np.uint8))
    return FrameDecoder().feed(wire.encode_frames(block, 1))[0]


@pytest.mark.parametrize(
    ("then", "gaps", "counts"),
    [
        (
            [clicks(2, 8, 4)],
            [Gap(first_exposure=4, exposures=4, messages=1, dropped_by_device=0)],
            {"lost_messages": 1},
        ),
        ([clicks(1, 10, 4, drops=6)], [Gap(4, 6, 0, 6)], {"device_drops": 6}),
        # the counter of drops goes on
        (
            [clicks(1, 6, 4, drops=2), clicks(2, 13, 4, drops=5)],
            [Gap(4, 2, 0, 2), Gap(10, 3, 0, 3)],
            {"device_drops": 5},
        ),
        ([frames(6, 6)], [Gap(4, 2, 0, 0)], {"exposures": 10, "unexplained_drops": 1}),
        # a mark was lost, or came
        ([clicks(2, 4, 4), mark(3), clicks(4, 8, 4)], [None, None, None], {"lost_messages": 1, "exposures": 12}),
        # overtaken, or repeated: a late photon is useless
        (
            [clicks(2, 8, 4), clicks(1, 4, 4), clicks(2, 8, 4), clicks(3, 12, 4)],
            [Gap(4, 4, 1, 0), None, None, None],
            {"repeated": 2},
        ),
        # a device that counts backwards, or far ahead
        ([clicks(1, 2, 8)], [None], {"malformed": 1, "exposures": 4}),
        ([clicks(1, 3, 1)], [None], {"malformed": 1, "exposures": 4}),
        ([clicks(1, 4 + MAX_GAP_EXPOSURES, 1)], [Gap(4, MAX_GAP_EXPOSURES, 0, 0)], {"unexplained_drops": 1}),
        ([clicks(1, 5 + MAX_GAP_EXPOSURES, 1)], [None], {"malformed": 1, "messages": 1}),
        # each gap counts its own lost messages
        ([clicks(2, 8, 4), clicks(3, 14, 2, drops=2)], [Gap(4, 4, 1, 0), Gap(12, 2, 0, 2)], {"lost_messages": 1}),
    ],
)
def test_what_is_missing_before_a_message(then: list[Frame], gaps: list[Gap | None], counts: dict[str, int]) -> None:
    tracker = StreamTracker()
    tracker.accept(clicks(0, 0, 4))
    assert [tracker.accept(frame)[1] for frame in then] == gaps
    lost = sum(gap.exposures for gap in gaps if gap is not None)
    wanted = {"gaps": len(list(filter(None, gaps))), "lost_exposures": lost, "malformed": 0, "unexplained_drops": 0}
    found = asdict(tracker.counters)
    assert {name: found[name] for name in wanted | counts} == wanted | counts


def by_kernel(tracker: StreamTracker, next_seq: int, exposures: int) -> None:
    """Let the kernel account for a message with so many exposures; `next_seq` follows it."""
    called(kernels.go_on)(tracker.cells.view(CORE_DTYPE)[0], exposures)
    assert tracker.next_seq == next_seq


def test_marks_taken_elsewhere_do_not_hide_a_loss() -> None:
    tracker = StreamTracker(np.zeros(1, CORE_DTYPE))
    tracker.accept(clicks(0, 0, 4))
    tracker.accept(mark(2))  # message 1, with four exposures, is lost
    by_kernel(tracker, 4, exposures=0)  # a mark
    assert tracker.accept(clicks(4, 8, 4))[1] == Gap(4, 4, 1, 0)
    tracker.accept(mark(6))
    by_kernel(tracker, 8, exposures=4)  # they follow without a gap: what was lost held none
    assert tracker.accept(clicks(8, 20, 4, drops=4))[1] == Gap(16, 4, 0, 4)
    counters = tracker.counters
    assert (counters.messages, counters.exposures, counters.unexplained_drops) == (7, 16, 0)


@pytest.mark.parametrize(
    ("end", "drops", "gap", "position", "unexplained"),
    [
        (4, 0, None, 4, 0),
        (10, 3, Gap(4, 6, 0, 3), 10, 0),
        (10, 6, Gap(4, 6, 0, 6), 10, 0),
        (6, 5, Gap(4, 2, 0, 2), 6, 1),
        (3, 0, None, 4, 1),  # before what came
        (4 + MAX_GAP_EXPOSURES, 0, Gap(4, MAX_GAP_EXPOSURES, 0, 0), 4 + MAX_GAP_EXPOSURES, 0),
        (5 + MAX_GAP_EXPOSURES, 0, None, 4, 1),
    ],
)
def test_what_is_missing_at_the_end_is_dropped_or_lost(
    end: int, drops: int, gap: Gap | None, position: int, unexplained: int
) -> None:
    tracker = StreamTracker()
    tracker.accept(clicks(0, 0, 4))
    assert tracker.finish(end, drops) == gap
    dropped = 0 if gap is None else gap.dropped_by_device
    assert (tracker.counters.device_drops, tracker.counters.unexplained_drops) == (dropped, unexplained)
    assert (tracker.next_exposure, tracker.open) == (position, False)


@pytest.mark.parametrize(("ahead", "malformed"), [(RECEIVE_WINDOW - 1, 0), (RECEIVE_WINDOW, 1)])
def test_a_message_beyond_the_receive_window_is_malformed(ahead: int, malformed: int) -> None:
    tracker = StreamTracker()
    assert (tracker.accept(clicks(ahead, 0, 1))[0] is None) == bool(malformed)
    assert tracker.counters.malformed == malformed


@pytest.mark.parametrize(("ahead", "malformed"), [(2**31 - 1, 1), (2**31, 0)])
def test_half_of_the_numbers_lie_ahead_and_half_have_passed(ahead: int, malformed: int) -> None:
    tracker = StreamTracker()
    assert tracker.accept(clicks(ahead, 0, 1)) == (None, None)
    assert (tracker.counters.malformed, tracker.counters.repeated) == (malformed, 1 - malformed)


def test_a_gap_is_an_event() -> None:
    facts = {"first_exposure": 4, "exposures": 3, "messages": 2, "dropped_by_device": 1}
    assert Gap(4, 3, 2, 1).event() == {"kind": "gap", **facts}


def changed(frame: Frame) -> Frame:
    return frame._replace(payload=frame.payload[:-1] + bytes([frame.payload[-1] ^ 1]))


@pytest.mark.parametrize("first", [0, 2**32 - 3])
def test_a_repeat_with_another_content_differs_from_what_was_taken(first: int) -> None:
    tracker = StreamTracker()
    tracker.next_seq = first
    frames = [clicks(first + n, 4 * n, 4) for n in range(6)]
    for frame in frames:
        assert tracker.accept(frame)[0] is not None
        assert tracker.differs is None
    for frame in frames:
        assert tracker.accept(frame._replace(flags=5)) == (None, None)  # flags are ignored
        assert tracker.differs is None
    assert tracker.counters.repeats_differing == 0
    for n, frame in enumerate(frames):
        assert tracker.accept(changed(frame)) == (None, None)
        assert tracker.differs is not None
        assert tracker.differs == (4 * n, content_crc(changed(frame)), content_crc(frame))
    counters = tracker.counters
    assert (counters.messages, counters.repeated, counters.repeats_differing) == (6, 12, 6)


def test_what_was_lost_or_is_older_than_the_window_cannot_be_compared() -> None:
    tracker = StreamTracker()
    for seq in range(1, 4100):  # 0 is lost; of 1 to 3 the places have been taken by later messages
        tracker.accept(clicks(seq, seq, 1))
    for seq in range(4):
        tracker.accept(changed(clicks(seq, seq, 1)))
    assert (tracker.counters.repeats_unchecked, tracker.counters.repeats_differing) == (4, 0)
    tracker.accept(changed(clicks(4, 4, 1)))
    assert (tracker.counters.repeats_unchecked, tracker.counters.repeats_differing) == (4, 1)


@pytest.mark.parametrize("seq", [0, 1])
def test_a_message_that_comes_after_its_loss_was_reported_has_nothing_to_be_compared_with(seq: int) -> None:
    tracker = StreamTracker()
    tracker.accept(clicks(2, 2, 1))
    tracker.accept(clicks(seq, seq, 1))
    assert (tracker.counters.repeats_unchecked, tracker.counters.repeats_differing) == (1, 0)


def test_another_stream_has_other_messages_under_the_same_numbers() -> None:
    tracker = StreamTracker()
    tracker.accept(clicks(0, 0, 4))
    tracker.restart()
    tracker.finish(0, 0)
    tracker.accept(changed(clicks(0, 0, 4)))
    assert (tracker.counters.repeats_unchecked, tracker.counters.repeats_differing) == (1, 0)


def test_another_stream_begins_anew_and_the_totals_go_on() -> None:
    tracker = StreamTracker()
    tracker.accept(clicks(0, 5, 4, drops=5))
    tracker.accept(mark(2))
    tracker.restart()
    assert tracker.position == (0, 0, 0)
    assert tracker.accept(clicks(0, 3, 4, drops=3))[1] == Gap(0, 3, 0, 3)
    counters = tracker.counters
    assert (counters.messages, counters.exposures, counters.gaps, counters.device_drops) == (3, 8, 2, 8)
    assert (counters.lost_messages, counters.unexplained_drops) == (1, 0)
    tracker.finish(7, 3)
    tracker.restart()
    assert tracker.open


def test_an_exposure_beyond_the_state_is_known_exactly() -> None:
    """The block that ends with exposure 2^63 - 1 is followed by 2^63, which no field of the state holds."""
    tracker = StreamTracker()
    tracker.resume((0, 2**63 - 2, 0))
    assert tracker.accept(clicks(0, 2**63 - 2, 2))[1] is None
    assert tracker.position == (1, 2**63, 0)
    assert tracker.accept(clicks(1, 2**63 - 1, 1)) == (None, None)  # it came already
    assert tracker.counters.malformed == 1
    tracker.next_exposure = 2**63 - 1
    assert tracker.next_exposure == 2**63 - 1


@pytest.mark.parametrize("first", [0, 2**32 - 3])
def test_the_memory_goes_on_in_another_tracker(first: int) -> None:
    one, other = StreamTracker(), StreamTracker()
    one.next_seq = first
    for n in (0, 1, 3, 4):
        one.accept(clicks(first + n, n, 1))
    other.resume(one.position, one.memory)
    for n in range(5):
        for tracker in (one, other):
            tracker.accept(changed(clicks(first + n, n, 1)))
        assert one.differs == other.differs
        assert (one.differs is None) == (n == 2)
    assert other.counters.repeats_unchecked == 1


def test_the_memory_holds_the_window_and_no_more() -> None:
    one, other = StreamTracker(), StreamTracker()
    assert one.memory == bytes(MEMORY_BYTES)
    lost = RECEIVE_WINDOW + 5  # its row holds message 5
    for seq in range(RECEIVE_WINDOW + 10):
        if seq != lost:
            one.accept(clicks(seq, seq, 1, drops=3))
    other.resume(one.position, one.memory)
    assert other.position == one.position == (RECEIVE_WINDOW + 10, RECEIVE_WINDOW + 10, 3)
    assert other.memory == one.memory
    for seq, checked in ((9, False), (10, True), (lost, False), (lost + 4, True)):
        for tracker in (one, other):
            tracker.accept(changed(clicks(seq, seq, 1, drops=3)))
            assert (tracker.differs is not None) == checked, seq
    other.resume(one.position)
    other.accept(changed(clicks(10, 10, 1)))
    assert other.differs is None  # without a memory nothing is known of earlier messages


@pytest.mark.parametrize(
    ("position", "frame", "gap"),
    [
        ((2**32 - 1, 4, 2**32 - 2), clicks(2**32 - 1, 9, 1, drops=3), Gap(4, 5, 0, 5)),
        ((0, 2**40, 0), clicks(0, 2**40 + 3, 2), Gap(2**40, 3, 0, 0)),
    ],
)
def test_counters_wrap_and_exposures_pass_32_bits(position: tuple[int, int, int], frame: Frame, gap: Gap) -> None:
    tracker = StreamTracker()
    tracker.resume(position)
    block, found = tracker.accept(frame)
    assert isinstance(block, ClickBlock)
    assert (found, tracker.next_seq) == (gap, (position[0] + 1) % 2**32)


def test_damage_is_counted() -> None:
    tracker = StreamTracker()
    assert tracker.accept(Frame(wire.MessageType.CLICKS, 0, 1, b"too short")) == (None, None)
    assert tracker.accept(Frame(wire.MessageType.STATUS, 0, 1, b"")) == (None, None)
    assert tracker.counters.malformed == 2


@settings(max_examples=100, deadline=None)
@given(
    fates=st.lists(st.sampled_from(["arrives", "lost", "dropped", "twice", "late"]), min_size=1, max_size=40),
    size=st.integers(1, 5),
)
def test_every_exposure_arrives_once_or_is_lost_once(fates: list[str], size: int) -> None:
    tracker = StreamTracker()
    arrived: list[int] = []
    lost: list[int] = []
    seq = drops = 0
    overtaken: list[Frame] = []
    for number, fate in enumerate(fates):
        first = number * size
        if fate == "dropped":  # on the device: no sequence number, but the counter says so
            drops += size
            continue
        frame = clicks(seq, first, size, drops)
        seq += 1
        if fate == "lost":
            continue
        if fate == "late":
            overtaken.append(frame)
            continue
        for sent in [frame] * (2 if fate == "twice" else 1) + overtaken:
            block, gap = tracker.accept(sent)
            if gap is not None:
                lost += range(gap.first_exposure, gap.first_exposure + gap.exposures)
            if isinstance(block, ClickBlock):
                arrived += range(block.exposure_index, block.exposure_index + len(block.patterns))
        overtaken = []
    last = tracker.finish(len(fates) * size, drops)
    if last is not None:
        lost += range(last.first_exposure, last.first_exposure + last.exposures)
    assert sorted(arrived + lost) == list(range(len(fates) * size))
    assert tracker.counters.lost_exposures == len(lost)
    assert tracker.counters.exposures == len(arrived)
