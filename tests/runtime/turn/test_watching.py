"""The guard behind compiled turns: what it finds in many blocks at once is what it finds block by block."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from heads import head_bundle, random_layers
from plans import parallel

from pans.runtime.core.dark_guard import DarkGuard
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.instrument.cusum import ChannelWatch, WatchSettings
from pans.runtime.instrument.dead_channels import DeadChannelTest
from pans.runtime.turn.rings import BEGIN, END, WHAT
from pans.runtime.turn.watching import MOST_FRAMES, FrameWatch, slots_until_dark
from pans.runtime.wire.framing import FrameDecoder
from pans.runtime.wire.messages import FrameBlock, Mark, decode_frames, encode_frames, encode_mark, pack_body

D_F, SHOTS, OBJECTS, SESSION = 10, 20, 1500, 7
VISIT = SHOTS + 1


def core_of(*, lit: bool) -> Core:
    decider = make_decider(head_bundle(random_layers([D_F, 6, 3], seed=3)), backend="table")
    plan = parallel(D_F, SHOTS)
    watch = ChannelWatch(D_F, np.full(D_F, 0.02), WatchSettings(arl_exposures=1e5))
    test = DeadChannelTest(np.full(D_F, 0.01), 1e6, 1e4) if lit else None
    core = Core(plan, decider, 1, 0, DarkGuard(plan, watch, lit=test))
    core.warm_up()
    return core


def bodies() -> list[bytes]:
    """Marks, and two blocks to a visit: a channel dies and comes back, later another gets hot; the last objects have no number."""
    rng = np.random.default_rng(5)
    frames: list[bytes] = []
    for visit in range(OBJECTS):
        rates = np.full((VISIT, D_F), 0.3)
        rates[0] = 0.02
        rates[:, 4] *= visit not in range(300, 700)
        rates[0, 7] = 0.3 if visit > 1000 else rates[0, 7]
        words = np.packbits(rng.random((VISIT, D_F)) < rates, axis=1, bitorder="little")
        number = visit if visit < OBJECTS - 50 else 0xFFFFFFFF
        frames.append(encode_mark(Mark(0, visit, 0, visit * VISIT, 0, 1.0), SESSION))
        for first, stop in itertools.pairwise((0, 12, VISIT)):
            block = FrameBlock(0, 0, 0, visit * VISIT + first, 100, number, words[first:stop])
            frames.append(encode_frames(block, SESSION))
    return [pack_body(frame) for frame in FrameDecoder().feed(b"".join(frames))]


@pytest.mark.parametrize("lit", [True, False])
def test_many_blocks_at_once_tell_what_each_of_them_tells(lit: bool) -> None:
    sent, rng = bodies(), np.random.default_rng(1)
    one, many = core_of(lit=lit), core_of(lit=lit)
    wanted = [event for body in sent if len(body) > 60 for event in one.watch_frames(decode_frames(body[8:]))]
    watch, found, at = FrameWatch(many), [], 0
    while at < len(sent):
        part = sent[at : at + int(rng.integers(1, 200))]
        spans = np.zeros((len(part), 4), np.int64)
        spans[:, END] = np.cumsum([len(body) for body in part])
        spans[1:, BEGIN], spans[:, WHAT] = spans[:-1, END], [body[0] for body in part]
        found += watch.take(np.frombuffer(b"".join(part), np.uint8).copy(), spans)
        at += len(part)
    assert one.guard is not None
    assert many.guard is not None
    wanted += one.guard.news()
    kinds = {event.kind for event in wanted}
    assert "hot" in kinds
    assert ("dead" in kinds) == lit
    assert [event.event() for event in found] == [event.event() for event in wanted]
    for ours, theirs in ((one.guard.watch, many.guard.watch),):
        assert (ours.exposures, ours.clicks.tolist()) == (theirs.exposures, theirs.clicks.tolist())
        assert ours.sums().tolist() == theirs.sums().tolist()
    if one.guard.lit is not None and many.guard.lit is not None:
        assert one.guard.lit.place == many.guard.lit.place
        for a, b in zip(one.guard.lit.arrays, many.guard.lit.arrays):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("dark", [[0], [3], [0, 1, 6], [2, 5, 6], range(7), []])
def test_how_far_the_next_dark_slot_is(dark: list[int]) -> None:
    slots = np.zeros(7, np.bool_)
    slots[list(dark)] = True
    around = np.concatenate([slots, slots]).tolist()
    wanted = [around.index(True, slot) - slot if len(dark) else MOST_FRAMES for slot in range(7)]
    assert slots_until_dark(slots).tolist() == wanted
