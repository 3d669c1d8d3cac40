"""Streams through the kernel against the core alone: the same rows, counts and events, whatever happens to them."""

import zlib
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from heads import head_bundle, random_layers
from hypothesis import given, settings
from hypothesis import strategies as st
from inner_kernels import called
from naive_window import earliest_decision
from plans import parallel, pattern_major, shot_major, walk_plan, walked
from streams import SESSION, click_frames, compare, spoilt

from pans.bundle.backends import NO_LABEL, Decider
from pans.bundle.backends.choose import make_decider
from pans.bundle.backends.verdict import Verdict, Verdicts
from pans.decide.decision import DecisionFlag
from pans.decide.kernel.stream_core import StreamCore
from pans.decide.plan.plan import Plan
from pans.decide.still import kernel_state, kernels
from pans.decide.still.tables import count_crc_tables
from pans.protocol.wire import DeviceState, StateReason
from pans.protocol.wire import messages as wire
from pans.protocol.wire.messages import ClickBlock, FrameBlock, Mark, Status

N_CYCLES = 24
_DECIDERS: dict[Any, Any] = {}


class Foreign(Decider):
    """A back end of another's: it decides on click words of a walk, and has no table that could be looked into."""

    name = "foreign"

    def __init__(self, own: Any) -> None:
        self.own, self.n_features, self.n_classes = own, own.n_features, own.n_classes

    def decide(self, counts: np.ndarray, shots: int) -> Verdict:
        return Verdict(*self.own.decide(counts, shots))

    def verdicts(self, counts: np.ndarray, shots: int) -> Verdicts:
        return Verdicts(*self.own.verdicts(counts, shots))


def fixed(make: Any, n_features: int, shots: int, windows: int, backend: str) -> tuple[Plan, Any, int]:
    key = (n_features, shots, backend)
    if key not in _DECIDERS:
        bundle = head_bundle(random_layers([n_features, 12, 4], seed=n_features))
        _DECIDERS[key] = make_decider(bundle, shots=shots, backend=backend)
    return make(n_features, shots * windows), _DECIDERS[key], shots


def walking(seed: int, confidence: float = 0.0, foreign: bool = False) -> tuple[Plan, Any, int]:
    rng = np.random.default_rng(seed)
    automaton = random_automaton(seed, int(rng.integers(2, 9)), 4)
    decider = make_decider(automaton_bundle(automaton), confidence=confidence)
    plan = walk_plan(getattr(decider, "automaton"), int(rng.integers(1, 4)), int(rng.integers(0, 3)))  # noqa: B009
    return plan, Foreign(decider) if foreign else decider, 1


CASES = [
    lambda: fixed(shot_major, 10, 1, 2, "table"),
    lambda: fixed(shot_major, 3, 3, 2, "count-table"),
    lambda: fixed(pattern_major, 3, 1, 4, "table"),
    lambda: fixed(pattern_major, 11, 2, 2, "sparse"),
    *(lambda seed=seed: walking(seed) for seed in range(4)),
    lambda: walking(5, confidence=0.8),
    lambda: walking(6, foreign=True),
]
OF_FRAMES = [
    lambda: fixed(parallel, 10, 1, 4, "table"),
    lambda: fixed(parallel, 3, 3, 2, "count-table"),
    lambda: fixed(parallel, 11, 2, 3, "sparse"),
    lambda: fixed(parallel, 2, 300, 1, "sparse"),
]


def sent_exposures(plan: Plan, rng: np.random.Generator, wrong: float) -> list[tuple[int, int]]:
    n_cycles = N_CYCLES - N_CYCLES % plan.cycles_per_object
    if plan.automaton is not None:
        sent = walked(plan, n_cycles, rng)
    else:
        shown = np.tile(plan.slot_pattern, n_cycles).tolist()
        sent = list(zip(shown, rng.integers(0, 2, len(shown)).tolist()))
    strange = [0, 1, 7, 0xFFFF, 0xFFFE]
    return [(int(rng.choice(strange)) if rng.random() < wrong else stamp, bit) for stamp, bit in sent]


def frames(plan: Plan, n_visits: int, rng: np.random.Generator, block: int) -> list[bytes]:
    """A clean stream: a mark and blocks for every visit, as a device sends them; words may be wider than they need be."""
    sent, seq, slots = [], 0, plan.slots_per_cycle
    word_bytes = -(-plan.n_patterns // 8) * int(rng.integers(1, 3))
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


@pytest.mark.uncompiled("0", "4")
@pytest.mark.parametrize("case", range(len(CASES)))
def test_a_clean_stream_of_one_detector(case: int) -> None:
    plan, decider, shots = CASES[case]()
    rng = np.random.default_rng(case)
    clean = click_frames(plan, sent_exposures(plan, rng, 0.0), rng, 7)
    rows = compare(plan, decider, shots, [b"".join(clean)])
    assert len(rows) >= N_CYCLES // (plan.cycles_per_object if plan.automaton is None else 1) - plan.cycles_per_object
    unsure = rows["label"] == NO_LABEL
    assert (rows["flags"] == np.where(unsure, DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED, 0)).all()
    assert unsure.any() == (case == 8)
    assert set(rows["label"][~unsure].tolist()) <= {0, 1, 2, 3}
    assert (rows["probability"] > 0).all()
    assert rows["exposures"].any() == (plan.automaton is not None)


@pytest.mark.uncompiled("0", "2")
@pytest.mark.parametrize("case", range(len(OF_FRAMES)))
def test_a_clean_stream_of_frames(case: int) -> None:
    plan, decider, shots = OF_FRAMES[case]()
    rows = compare(plan, decider, shots, [b"".join(frames(plan, 9, np.random.default_rng(3), 7))])
    assert len(rows) == 9 * plan.shots_per_cycle // shots
    assert not rows["flags"].any()
    assert (rows["label"] < 4).all()


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_faults_any_cuts(data: st.DataObject) -> None:
    plan, decider, shots = data.draw(st.sampled_from([*CASES, *OF_FRAMES[:3]]))()
    rng, block = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1))), data.draw(st.integers(1, 8))
    if plan.mode == "parallel":
        clean = frames(plan, 6, rng, block)
    else:
        clean = click_frames(plan, sent_exposures(plan, rng, data.draw(st.sampled_from([0.0, 0.01, 0.1]))), rng, block)
    compare(plan, decider, shots, spoilt(data, clean, rng))


@pytest.mark.uncompiled
def test_more_rows_than_a_call_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_state, "ROWS_PER_CALL", 5)
    rng = np.random.default_rng(4)
    for plan, decider, shots in (CASES[2](), CASES[7]()):
        clean = click_frames(plan, sent_exposures(plan, rng, 0.0), rng, 16)
        assert len(compare(plan, decider, shots, [b"".join(clean)])) >= N_CYCLES
    plan, decider, _ = fixed(parallel, 10, 1, 8, "table")
    clean = frames(plan, 5, rng, 3)
    assert len(compare(plan, decider, 1, [b"".join(clean)])) == 40
    del clean[7:12]
    assert len(compare(plan, decider, 1, [b"".join(clean)])) == 40


def test_a_stamp_that_no_state_has_contradicts_the_plan_and_the_walk_abstains() -> None:
    plan, decider, shots = CASES[6]()
    n_states = decider.automaton.n_states
    rng = np.random.default_rng(1)
    sent = sent_exposures(plan, rng, 0.0)
    at = int(np.flatnonzero(plan.slot_pattern == 0xFFFE)[0])
    sent[at] = (n_states, 0)
    rows = compare(plan, decider, shots, [b"".join(click_frames(plan, sent, rng, 64))])
    assert rows["flags"][0] == DecisionFlag.GAP | DecisionFlag.ABSTAINED
    assert not rows["flags"][1:].any()
    streamed = StreamCore(plan, decider, shots, 0, SESSION)
    list(streamed.feed(b"".join(click_frames(plan, sent, rng, 64))))
    assert dict(streamed.core.contradictions) == {"stamp": 1}


def test_blocks_of_the_other_kind_do_not_fit() -> None:
    clicks = wire.encode_clicks(ClickBlock(0, 0, 0, 0, 100, 0, np.zeros(3, np.uint16), np.zeros(3, np.uint8)), SESSION)
    decider = fixed(shot_major, 3, 3, 2, "count-table")[1]
    streamed = StreamCore(parallel(3, 6), decider, 3, 0, SESSION)
    assert sum(len(batch.rows) for batch in streamed.feed(clicks)) == 0
    assert dict(streamed.core.contradictions) == {"beyond_plan": 1}


@pytest.mark.uncompiled
def test_what_device_drops_and_sequence_wraps_do() -> None:
    plan, decider, _ = fixed(parallel, 3, 1, 4, "table")
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
    plan, decider, _ = fixed(parallel, 3, 1, 2, "table")
    streamed = StreamCore(plan, decider, 1, 1, SESSION)
    streamed.warm_up()
    clean = b"".join(frames(plan, 2, np.random.default_rng(4), 3))
    batches = [(batch.rows.copy(), batch.events, batch.others) for batch in streamed.feed(clean)]
    assert sum(len(rows) for rows, _, _ in batches) == 2
    assert [event.event()["kind"] for _, events, _ in batches for event in events] == [
        "beyond_plan",
        *["contradiction"] * 2,
    ]
    assert not any(others for _, _, others in batches)
    photons = streamed.core.steps(SESSION).photons_of(np.array([0, 1, 5]))
    assert photons[:2].tolist() == [2.5, 2.5]
    assert np.isnan(photons[2])


def test_scores_that_are_not_finite_abstain_in_bulk() -> None:
    class Lost(Decider):
        name, n_features, n_classes = "lost", 3, 4

        def verdicts(self, counts: np.ndarray, shots: int) -> Verdicts:
            bad = counts.sum(axis=1) % 2 == 1
            return Verdicts(np.full(len(counts), 2, np.uint16), np.where(bad, 0, 0.5).astype(np.float32))

        def decide(self, counts: np.ndarray, shots: int) -> Any:
            labels, probabilities = self.verdicts(counts[None], shots)
            return int(labels[0]), float(probabilities[0])

    plan = parallel(3, 6)
    rows = compare(plan, Lost(), 1, [b"".join(frames(plan, 4, np.random.default_rng(1), 5))])
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


@pytest.mark.uncompiled
@pytest.mark.parametrize("case", CASES)
def test_no_decision_falls_due_while_a_kernel_may_sleep(case: Any) -> None:
    """After each block: no clicks can end a window earlier, and without dark slots the time is used to the end."""
    plan, decider, shots = case()
    slots, rng = plan.slots_per_cycle, np.random.default_rng(3)
    lit = [(int(slot), int(rng.integers(2))) for _ in range(N_CYCLES) for slot in plan.slot_pattern]
    sent = lit if plan.automaton is None else walked(plan, N_CYCLES, rng)
    spare, streamed = called(kernels.ticks_to_spare), StreamCore(plan, decider, shots, N_CYCLES, SESSION)
    exposures = 0
    for message in click_frames(plan, sent, rng, 2):
        list(streamed.feed(message))
        if streamed.core.tracker.next_exposure == exposures:
            continue
        exposures = streamed.core.tracker.next_exposure
        if exposures == slots * N_CYCLES:
            break
        earliest = min(earliest_decision(plan, shots, sent[:exposures]), slots * N_CYCLES - 1)
        spared = int(spare(streamed.core.steps(SESSION).walk)) // 100
        most = max(earliest - exposures, 0)
        assert spared <= most
        if plan.automaton is None or plan.dark_slots_per_cycle == 0:
            assert spared == most
    assert exposures == slots * N_CYCLES
