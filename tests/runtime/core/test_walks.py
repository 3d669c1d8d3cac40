"""Walks against the plain-loop oracle: any automaton, any losses and wrong stamps, any block cutting; compiled and not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from automata import random_automaton
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_window import follow_walk
from plans import walk_plan, walked

from pans.runtime.core.plan import Plan
from pans.runtime.core.window import DARK_CLICKS, DARK_EXPOSURES, LATE_SLOTS, WRONG_PATTERNS, DecisionWindows
from pans.runtime.errors import PlanError
from pans.runtime.wire.messages import DARK_PATTERN, ClickBlock

N_VISITS = 3


def run(plan: Plan, exposures: dict[int, tuple[int, int]], cuts: set[int]) -> tuple[list[Any], DecisionWindows]:
    """Push `exposures` as blocks that end at `cuts`, at losses and at cycle ends, as a device would send them."""
    assert plan.automaton is not None
    windows = DecisionWindows(plan, plan.automaton.n_slots, 1)
    end = N_VISITS * windows.visit_exposures
    settled: list[Any] = []

    def keep(found: list[Any]) -> None:
        settled.extend(window._replace(counts=window.counts.tolist()) for window in found)

    block: list[int] = []
    for exposure in range(end + 1):
        if block and (exposure in cuts or exposure not in exposures or exposure % plan.slots_per_cycle == 0):
            shown = np.array([exposures[i][0] for i in block], np.uint16)
            bits = np.array([exposures[i][1] for i in block], np.uint8)
            keep(windows.skip_to(block[0]))
            visit = block[0] // windows.visit_exposures
            sent = ClickBlock(0, 0, 0, block[0], 1, visit, shown, bits, plan.largest)
            assert windows.fits(sent)
            keep(windows.push(sent))
            block = []
        if exposure in exposures:
            block.append(exposure)
    keep(windows.skip_to(end))
    return settled, windows


@st.composite
def runs(draw: st.DrawFn) -> tuple[Plan, dict[int, tuple[int, int]], set[int]]:
    """A plan, what arrives of its exposures, and where blocks are cut."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    outcomes = draw(st.sampled_from([0, 0, 3, 7]))  # 0: clicks
    slots, width = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    automaton = random_automaton(draw(st.integers(0, 2**32 - 1)), slots, width, outcomes=outcomes)
    plan = walk_plan(automaton, draw(st.integers(1, 3)), draw(st.integers(0, 3)))
    sent = walked(plan, N_VISITS * plan.cycles_per_object, rng)
    loss, strange = draw(st.sampled_from([0.0, 0.02, 0.3])), draw(st.sampled_from([0.0, 0.02, 0.3]))
    stamps = [DARK_PATTERN, *range(automaton.n_states)]
    exposures = {
        i: (int(rng.choice(stamps)) if rng.random() < strange else stamp, bit)
        for i, (stamp, bit) in enumerate(sent)
        if rng.random() >= loss
    }
    return plan, exposures, set(rng.integers(0, len(sent), draw(st.sampled_from([0, 3, len(sent)]))).tolist())


@pytest.mark.uncompiled
@settings(max_examples=150, deadline=None)
@given(case=runs())
def test_walks_match_the_oracle(case: tuple[Plan, dict[int, tuple[int, int]], set[int]]) -> None:
    plan, exposures, cuts = case
    settled, windows = run(plan, exposures, cuts)
    walks = [follow_walk(plan, cycle, exposures) for cycle in range(N_VISITS * plan.cycles_per_object)]
    assert len(settled) == len(walks)  # every walk is reported exactly once, in order
    slots = int(np.flatnonzero(plan.slot_pattern != DARK_PATTERN)[-1])
    for cycle, (window, walk) in enumerate(zip(settled, walks)):
        assert window.counts == walk["clicks"]
        assert window.exposures == len(walk["states"])
        assert (window.missing > 0, window.wrong) == {"whole": (False, 0), "wrong": (False, 1), "lost": (True, 0)}[
            walk["fate"] or "lost"
        ]
        assert window.first_shot == cycle % plan.cycles_per_object
        whole = walk["fate"] == "whole"
        assert window.last_exposure == (walk["last"] if whole else cycle * plan.slots_per_cycle + slots)
        if whole:
            assert window.object_index == cycle // plan.cycles_per_object
    tallies = windows.tallies
    assert tallies[DARK_EXPOSURES] == sum(len(walk["dark"]) for walk in walks)
    assert tallies[DARK_CLICKS] == sum(number > 0 for walk in walks for number in walk["dark"])
    assert tallies[WRONG_PATTERNS] == sum(walk["strange"] for walk in walks)
    assert tallies[LATE_SLOTS] == sum(walk["late"] for walk in walks)
    shown = np.bincount([state for walk in walks for state in walk["states"]], minlength=plan.automaton.n_states)
    assert windows.walks.shown.tolist() == shown.tolist()


@settings(max_examples=40, deadline=None)
@given(case=runs())
def test_how_blocks_are_cut_changes_nothing(case: tuple[Plan, dict[int, tuple[int, int]], set[int]]) -> None:
    plan, exposures, cuts = case
    everywhere = set(range(N_VISITS * plan.slots_per_cycle * plan.cycles_per_object))
    logs = [run(plan, exposures, where) for where in (set(), cuts, everywhere)]
    assert logs[0][0] == logs[1][0] == logs[2][0]
    assert logs[0][1].tallies.tolist() == logs[1][1].tallies.tolist() == logs[2][1].tallies.tolist()


def test_a_walk_is_decided_at_its_leaf_not_at_the_end_of_its_cycle() -> None:
    automaton = random_automaton(5, 6, 3)
    plan = walk_plan(automaton, 1, dark=0)
    for seed in range(50):
        sent = walked(plan, 1, np.random.default_rng(seed))
        length = sum(stamp != DARK_PATTERN for stamp, _ in sent)
        windows = DecisionWindows(plan, automaton.n_slots, 1)
        settled_at = []
        for exposure, (stamp, bit) in enumerate(sent):
            block = ClickBlock(0, 0, 0, exposure, 1, 0, np.array([stamp], np.uint16), np.array([bit], np.uint8))
            settled_at += [exposure] * len(windows.push(block))
        assert settled_at == [length - 1]


@pytest.mark.uncompiled
@settings(max_examples=40, deadline=None)
@given(case=runs())
def test_another_core_goes_on_from_a_place_between_two_walks(
    case: tuple[Plan, dict[int, tuple[int, int]], set[int]],
) -> None:
    plan, exposures, _ = case
    n_slots = plan.automaton.n_slots if plan.automaton is not None else 0
    first, settled = DecisionWindows(plan, n_slots, 1), []
    for exposure in sorted(exposures):
        stamp, bit = exposures[exposure]
        number = exposure // first.visit_exposures
        block = ClickBlock(0, 0, 0, exposure, 1, number, np.array([stamp], np.uint16), np.array([bit], np.uint8))
        settled += [w._replace(counts=w.counts.tolist()) for w in first.skip_to(exposure)]
        settled += [w._replace(counts=w.counts.tolist()) for w in first.push(block)]
        if not first.half_seen:
            other = DecisionWindows(plan, n_slots, 1)
            other.position, other.tallies[:] = first.position, first.tallies
            first = other
    expected = run(plan, exposures, set())
    assert [
        *settled,
        *(w._replace(counts=w.counts.tolist()) for w in first.skip_to(N_VISITS * first.visit_exposures)),
    ] == expected[0]
    assert first.tallies.tolist()[:2] == expected[1].tallies.tolist()[:2]


def test_what_cannot_be_followed_is_refused() -> None:
    automaton = random_automaton(1, 4, 2)
    with pytest.raises(PlanError, match="2 walks make one decision"):
        DecisionWindows(walk_plan(automaton, 2), 4, 2)
    with pytest.raises(PlanError, match="walks of 4 exposures"):
        DecisionWindows(walk_plan(automaton, 1), 3, 1)
