"""Streams of frames through the kernel against the core alone: the same rows, counts and events, whatever happens to them."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import pytest
from heads import head_bundle, random_layers
from hypothesis import given, settings
from hypothesis import strategies as st
from plans import parallel
from streams import SESSION, compare, spoilt

from pans.runtime.core import kernel_state
from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.core.kernel_state import count_crc_tables
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Verdicts
from pans.runtime.kernel.calls import StreamCore
from pans.runtime.wire import messages as wire
from pans.runtime.wire.messages import DeviceState, FrameBlock, Mark, MessageType, StateReason, Status

_DECIDERS: dict[tuple[int, int, str], Any] = {}


def decider_for(n_features: int, shots: int, backend: str) -> Any:
    key = (n_features, shots, backend)
    if key not in _DECIDERS:
        bundle = head_bundle(random_layers([n_features, 12, 4], seed=n_features))
        _DECIDERS[key] = make_decider(bundle, shots=shots, backend=backend)
    return _DECIDERS[key]


CASES = [(10, 1, 4, "table"), (3, 3, 2, "count-table"), (11, 2, 3, "sparse"), (2, 300, 1, "sparse")]


def frames(plan: Any, n_features: int, n_visits: int, rng: np.random.Generator, block: int) -> list[bytes]:
    """A clean stream: a mark and blocks for every visit, as a device sends them; words may be wider than they need be."""
    sent, seq, slots = [], 0, plan.slots_per_cycle
    word_bytes = {1: 1, 2: 2}[-(-n_features // 8)] * int(rng.integers(1, 3))
    for visit in range(n_visits):
        truth = int(rng.integers(-1, 4))
        mark = Mark(seq, visit, truth, visit * slots, 1000 + 100 * visit * slots, 2.5)
        sent.append(wire.encode_mark(mark, SESSION))
        seq += 1
        for first in range(0, slots, block):
            count = min(block, slots - first)
            words = rng.integers(0, 256, (count, word_bytes)).astype(np.uint8)
            exposure = visit * slots + first
            blk = FrameBlock(seq, 0, 1000 + 100 * exposure, exposure, 100, visit, words)
            sent.append(wire.encode_frames(blk, SESSION))
            seq += 1
    end = Status(DeviceState.IDLE, StateReason.COMPLETED, 0, 0, 10**6, n_visits * slots)
    return [*sent, wire.encode_status(end, SESSION), wire.encode_status(end, SESSION)]


@pytest.mark.uncompiled("10-1-4-table", "11-2-3-sparse")
@pytest.mark.parametrize(("n_features", "shots", "n_windows", "backend"), CASES)
def test_a_clean_stream(n_features: int, shots: int, n_windows: int, backend: str) -> None:
    plan, decider = parallel(n_features, shots * n_windows), decider_for(n_features, shots, backend)
    rng = np.random.default_rng(3)
    data = b"".join(frames(plan, n_features, 9, rng, 7))
    rows = compare(plan, decider, shots, [data])
    assert len(rows) == 9 * n_windows
    assert not rows["flags"].any()
    assert (rows["label"] < 4).all()


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_faults_any_cuts(data: st.DataObject) -> None:
    n_features, shots, n_windows, backend = data.draw(st.sampled_from(CASES[:3]))
    plan, decider = parallel(n_features, shots * n_windows), decider_for(n_features, shots, backend)
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    clean = frames(plan, n_features, 6, rng, int(rng.integers(1, 9)))
    compare(plan, decider, shots, spoilt(data, clean, rng))


@pytest.mark.uncompiled
def test_more_rows_than_a_call_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_state, "ROWS_PER_CALL", 5)
    plan, decider = parallel(10, 8), decider_for(10, 1, "table")
    clean = frames(plan, 10, 5, np.random.default_rng(4), 3)
    assert len(compare(plan, decider, 1, [b"".join(clean)])) == 40
    del clean[7:12]
    assert len(compare(plan, decider, 1, [b"".join(clean)])) == 40


@pytest.mark.uncompiled
def test_what_device_drops_and_sequence_wraps_do() -> None:
    plan, decider = parallel(3, 4), decider_for(3, 1, "table")
    words = np.ones((5, 1), np.uint8)
    blocks = [
        FrameBlock(0, 0, 0, 0, 100, 0, words),
        FrameBlock(1, 5, 1000, 10, 100, 2, words),
        FrameBlock(2, 5, 1500, 15, 100, 3, words),
    ]
    rows = compare(plan, decider, 1, [b"".join(wire.encode_frames(block, SESSION) for block in blocks)])
    assert (rows["flags"] == DecisionFlag.GAP | DecisionFlag.ABSTAINED).tolist() == [False] * 4 + [True] * 4 + [
        False
    ] * 8
    streamed = StreamCore(plan, decider, 1, 0, SESSION)
    streamed.core.tracker.next_seq = 2**32 - 1
    for seq, first in ((2**32 - 1, 0), (0, 5)):
        block = FrameBlock(seq, 0, 100 * first, first, 100, first // 5, words)
        assert sum(len(batch.rows) for batch in streamed.feed(wire.encode_frames(block, SESSION))) == 4
    assert streamed.core.tracker.counters.gaps == 0


def test_blocks_beyond_the_plan_and_photons() -> None:
    plan, decider = parallel(3, 2), decider_for(3, 1, "table")
    streamed = StreamCore(plan, decider, 1, 1, SESSION)
    streamed.warm_up()
    clean = b"".join(frames(plan, 3, 2, np.random.default_rng(4), 3))
    batches = [(batch.rows.copy(), batch.events, batch.others) for batch in streamed.feed(clean)]
    assert sum(len(rows) for rows, _, _ in batches) == 2
    assert [event.event()["kind"] for _, events, _ in batches for event in events] == [
        "beyond_plan",
        *["contradiction"] * 2,
    ]
    assert {frame.type for _, _, others in batches for frame in others} == {MessageType.STATUS}
    photons = streamed.core.steps(SESSION).photons_of(np.array([0, 1, 5]))
    assert photons[:2].tolist() == [2.5, 2.5]
    assert np.isnan(photons[2])


def test_scores_that_are_not_finite_abstain_in_bulk() -> None:
    class Lost:
        name, n_features, n_classes = "lost", 3, 4

        def verdicts(self, counts: np.ndarray, shots: int) -> Verdicts:
            bad = counts.sum(axis=1) % 2 == 1
            return Verdicts(np.full(len(counts), 2, np.uint16), np.where(bad, 0, 0.5).astype(np.float32))

        def decide(self, counts: np.ndarray, shots: int) -> Any:
            labels, probabilities = self.verdicts(counts[None], shots)
            return int(labels[0]), float(probabilities[0])

    plan = parallel(3, 6)
    rows = compare(plan, Lost(), 1, [b"".join(frames(plan, 3, 4, np.random.default_rng(1), 5))])
    bad = rows["clicks"] % 2 == 1
    assert 0 < bad.sum() < len(rows)
    assert (rows["label"][bad] == NO_LABEL).all()
    assert (rows["flags"][bad] == DecisionFlag.NOT_FINITE | DecisionFlag.ABSTAINED).all()


@pytest.mark.parametrize(("n_features", "shots"), [(1, 1), (10, 1), (3, 255), (5, 256), (2, 70_000)])
def test_the_checksum_of_counts_from_tables(n_features: int, shots: int) -> None:
    table, zero = count_crc_tables(n_features, shots)
    rng = np.random.default_rng(8)
    for counts in [np.full(n_features, shots), *rng.integers(0, shots + 1, (20, n_features))]:
        crc = int(zero[0])
        for byte in range(len(table)):
            for feature, count in enumerate(counts.tolist()):
                crc ^= int(table[byte, feature, (count >> 8 * byte) & 0xFF])
        assert crc == zlib.crc32(counts.astype("<i8").tobytes())
