"""Sequential streams through the kernel against the core alone: the same rows, fixed patterns or walks, whatever happens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from heads import head_bundle, random_layers
from hypothesis import given, settings
from hypothesis import strategies as st
from plans import parallel, pattern_major, shot_major, walk_plan, walked
from streams import SESSION, click_frames, compare, spoilt

from pans.runtime.core import kernel_state
from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.core.plan import Plan
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Verdict, Verdicts
from pans.runtime.kernel.calls import StreamCore
from pans.runtime.wire import messages as wire
from pans.runtime.wire.messages import ClickBlock

N_CYCLES = 24
_DECIDERS: dict[Any, Any] = {}


class Foreign:
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
        bundle = head_bundle(random_layers([n_features, 12, 3], seed=n_features))
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


def sent_exposures(plan: Plan, rng: np.random.Generator, wrong: float) -> list[tuple[int, int]]:
    n_cycles = N_CYCLES - N_CYCLES % plan.cycles_per_object
    if plan.automaton is not None:
        sent = walked(plan, n_cycles, rng)
    else:
        shown = np.tile(plan.slot_pattern, n_cycles).tolist()
        sent = list(zip(shown, rng.integers(0, 2, len(shown)).tolist()))
    strange = [0, 1, 7, 0xFFFF, 0xFFFE]
    return [(int(rng.choice(strange)) if rng.random() < wrong else stamp, bit) for stamp, bit in sent]


@pytest.mark.uncompiled("0", "4")
@pytest.mark.parametrize("case", range(len(CASES)))
def test_a_clean_stream(case: int) -> None:
    plan, decider, shots = CASES[case]()
    rng = np.random.default_rng(case)
    clean = click_frames(plan, sent_exposures(plan, rng, 0.0), rng, 7)
    rows = compare(plan, decider, shots, [b"".join(clean)])
    assert len(rows) >= N_CYCLES // (plan.cycles_per_object if plan.automaton is None else 1) - plan.cycles_per_object
    unsure = rows["label"] == NO_LABEL
    assert (rows["flags"] == np.where(unsure, DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED, 0)).all()
    assert unsure.any() == (case == 8)
    assert set(rows["label"][~unsure].tolist()) <= {0, 1, 2}
    assert (rows["probability"] > 0).all()
    assert rows["exposures"].any() == (plan.automaton is not None)


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_faults_any_cuts(data: st.DataObject) -> None:
    plan, decider, shots = data.draw(st.sampled_from(CASES))()
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    sent = sent_exposures(plan, rng, data.draw(st.sampled_from([0.0, 0.01, 0.1])))
    clean = click_frames(plan, sent, rng, int(rng.integers(1, 9)))
    compare(plan, decider, shots, spoilt(data, clean, rng))


@pytest.mark.uncompiled
def test_more_rows_than_a_call_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_state, "ROWS_PER_CALL", 5)
    rng = np.random.default_rng(4)
    for plan, decider, shots in (CASES[2](), CASES[7]()):
        clean = click_frames(plan, sent_exposures(plan, rng, 0.0), rng, 16)
        assert len(compare(plan, decider, shots, [b"".join(clean)])) >= N_CYCLES


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
