"""Windows and walks against the plain-loop oracle: any plan, any losses and wrong stamps, any block cutting; compiled and not."""

import zlib
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest
from automata import random_automaton
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_window import count_visits, follow_walk
from plans import parallel, pattern_major, shot_major, walk_plan, walked

from pans.base.errors import PlanError
from pans.decide.decision import Decision, DecisionFlag
from pans.decide.plan.plan import Plan
from pans.decide.still.window_kernels import DARK_CLICKS, DARK_EXPOSURES, LATE_SLOTS, WRONG_PATTERNS
from pans.decide.still.windows import DecisionWindows
from pans.protocol.wire import DARK_PATTERN
from pans.protocol.wire.messages import ClickBlock, FrameBlock

N_VISITS = 3
MISSING, WRONG = DecisionFlag.GAP | DecisionFlag.ABSTAINED, DecisionFlag.WRONG_PATTERN | DecisionFlag.ABSTAINED


class Settled(NamedTuple):
    """A row, in the order of DECISION_DTYPE, and the counts that a back end is asked about; none where it is not asked."""

    row: Decision
    counts: list[int]


def settled_in(windows: DecisionWindows, parts: Iterable[np.ndarray]) -> list[Settled]:
    rows = [Decision(*row) for rows in parts for row in rows.tolist()]
    return [Settled(row, [] if row.flags else counts.tolist()) for row, counts in zip(rows, windows.counts)]


def skipped(windows: DecisionWindows, exposure: int) -> list[Settled]:
    return [one for rows in windows.skip_to(exposure) for one in settled_in(windows, [rows])]


def facts(counts: list[int], missing: bool, wrong: bool) -> tuple[int, int, int, list[int]]:
    """The clicks, flags and checksum of a window, and what a back end is asked about."""
    flags = MISSING * missing | WRONG * wrong
    return sum(counts), flags, zlib.crc32(np.array(counts, np.int64).tobytes()), [] if flags else counts


def found(one: Settled) -> tuple[int, int, int, list[int]]:
    return one.row.clicks, one.row.flags, one.row.counts_crc, one.counts


def run(
    plan: Plan, n_features: int, shots: int, exposures: dict[int, tuple[int, int]], cuts: set[int]
) -> tuple[list[Settled], DecisionWindows]:
    """Push `exposures` as blocks that end at `cuts`, at losses and at cycle ends, as a device would send them."""
    windows = DecisionWindows(plan, n_features, shots)
    end = N_VISITS * windows.visit_exposures
    settled: list[Settled] = []
    block: list[int] = []
    for exposure in range(end + 1):
        if block and (exposure in cuts or exposure not in exposures or exposure % plan.slots_per_cycle == 0):
            settled += skipped(windows, block[0])
            sent = one_block(windows, block[0], [exposures[i] for i in block])
            assert windows.fits(sent)
            settled += settled_in(windows, [windows.push(sent, block[0])])
            block = []
        if exposure in exposures:
            block.append(exposure)
    return [*settled, *skipped(windows, end)], windows


def one_block(windows: DecisionWindows, first: int, exposures: list[tuple[int, int]]) -> ClickBlock:
    shown, bits = (np.array(row, kind) for row, kind in zip(zip(*exposures), (np.uint16, np.uint8)))
    return ClickBlock(0, 0, 0, first, 1, first // windows.visit_exposures, shown, bits, windows.largest)


@pytest.mark.uncompiled
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_windows_match_the_oracle(data: st.DataObject) -> None:
    n_features = data.draw(st.integers(1, 4))
    shots = data.draw(st.integers(1, 3))
    n_windows = data.draw(st.integers(1, 3))
    plan = data.draw(st.sampled_from([shot_major, pattern_major]))(n_features, shots * n_windows)
    end = N_VISITS * plan.slots_per_cycle * plan.cycles_per_object
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    loss = data.draw(st.sampled_from([0.0, 0.05, 0.5]))
    planned = np.tile(plan.slot_pattern, N_VISITS * plan.cycles_per_object)
    wrong = rng.random(end) < data.draw(st.sampled_from([0.0, 0.05]))
    shown = np.where(wrong, n_features + 7, planned)
    bits = rng.integers(0, 2, end)
    exposures = {i: (int(shown[i]), int(bits[i])) for i in range(end) if rng.random() >= loss}
    cuts = set(rng.integers(0, end, 10).tolist())

    settled, windows = run(plan, n_features, shots, exposures, cuts)

    expected = count_visits(plan, n_features, shots, exposures)
    assert len(settled) == N_VISITS * n_windows  # every window is reported exactly once, in order
    assert [w.row.exposure_index for w in settled] == sorted(w.row.exposure_index for w in settled)
    for number, window in enumerate(settled):
        visit, index = divmod(number, n_windows)
        assert (window.row.number, window.row.shot) == (number, index * shots)
        want = expected.get((visit, index), ([0] * n_features, shots * n_features, 0))
        assert found(window) == facts(want[0], want[1] > 0, want[2] > 0)
        if want[1] == 0:
            assert window.row.object == visit
    dark = [i for i in exposures if planned[i] == DARK_PATTERN]
    assert windows.tallies[DARK_EXPOSURES] == sum(1 for i in dark if not wrong[i])
    assert windows.tallies[DARK_CLICKS] == sum(exposures[i][1] for i in dark if not wrong[i])
    assert windows.tallies[WRONG_PATTERNS] == sum(1 for i in exposures if wrong[i])


def test_a_window_is_settled_with_its_last_exposure_not_later() -> None:
    plan = pattern_major(2, 3)
    windows = DecisionWindows(plan, 2, 1)
    shown, ones = plan.slot_pattern, np.ones(9, np.uint8)
    assert not len(windows.push(ClickBlock(0, 0, 0, 0, 1, 5, shown[:6], ones[:6])))
    first = settled_in(windows, [windows.push(ClickBlock(1, 0, 0, 6, 1, 5, shown[6:7], ones[:1]), 700)])
    assert [(w.row.object, w.row.shot, w.row.exposure_index, w.row.tick, w.counts) for w in first] == [
        (5, 0, 6, 700, [1, 1])
    ]
    rest = windows.push(ClickBlock(2, 0, 0, 7, 1, 5, shown[7:], ones[:2]), 800)
    assert (rest["shot"].tolist(), rest["tick"].tolist()) == ([1, 2], [800, 801])


@pytest.mark.uncompiled
@pytest.mark.parametrize("n_features", [1, 8, 10, 64, 70])
def test_parallel_frames(n_features: int) -> None:
    plan = parallel(n_features, 6)
    windows = DecisionWindows(plan, n_features, 3)
    rng = np.random.default_rng(n_features)
    bits = rng.integers(0, 2, (7, n_features), np.uint8)
    words = np.packbits(bits, axis=1, bitorder="little")
    words.setflags(write=False)
    settled = settled_in(windows, [windows.push(FrameBlock(0, 0, 0, 0, 1, 4, words))])
    assert [w.counts for w in settled] == [bits[1:4].sum(0).tolist(), bits[4:7].sum(0).tolist()]
    assert windows.tallies[DARK_EXPOSURES] == n_features
    assert windows.tallies[DARK_CLICKS] == bits[0].sum()


@pytest.mark.uncompiled
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_frames_match_the_oracle(data: st.DataObject) -> None:
    """Frames in any blocks, with any losses: clicks of each window, whether one is whole, and what the dark frames gave."""
    n_features, shots, n_windows = (
        data.draw(st.integers(1, 12)),
        data.draw(st.integers(1, 3)),
        data.draw(st.integers(1, 3)),
    )
    plan = parallel(n_features, shots * n_windows)
    per_visit = plan.slots_per_cycle * plan.cycles_per_object
    end = N_VISITS * per_visit
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    bits = rng.integers(0, 2, (end, n_features), np.uint8)
    came = rng.random(end) >= data.draw(st.sampled_from([0.0, 0.05, 0.5]))
    cuts = set(rng.integers(0, end, 10).tolist())
    windows, settled, block = DecisionWindows(plan, n_features, shots), list[Settled](), list[int]()
    for exposure in range(end + 1):
        if block and (exposure in cuts or exposure == end or not came[exposure] or exposure % per_visit == 0):
            words = np.packbits(bits[block], axis=1, bitorder="little")
            settled += skipped(windows, block[0])
            settled += settled_in(
                windows, [windows.push(FrameBlock(0, 0, 0, block[0], 1, block[0] // per_visit, words))]
            )
            block = []
        if exposure < end and came[exposure]:
            block.append(exposure)
    settled += skipped(windows, end)
    dark = np.tile(plan.slot_pattern == DARK_PATTERN, end // plan.slots_per_cycle)
    of_window = np.flatnonzero(~dark).reshape(-1, shots)
    assert len(settled) == len(of_window)
    for window, exposures in zip(settled, of_window):
        here = exposures[came[exposures]]
        assert found(window) == facts(bits[here].sum(0).tolist(), len(here) < shots, False)
        assert window.row.exposure_index == exposures[-1]
    assert windows.tallies[DARK_EXPOSURES] == n_features * (dark & came).sum()
    assert windows.tallies[DARK_CLICKS] == bits[dark & came].sum()


def test_shots_that_do_not_divide_are_refused_with_the_numbers() -> None:
    with pytest.raises(PlanError, match="5 shots per object cannot be cut into windows of 2"):
        DecisionWindows(shot_major(2, 5), 2, 2)


def test_a_visit_that_does_not_fit_in_memory_is_refused() -> None:
    with pytest.raises(PlanError, match="exposures, allowed"):
        DecisionWindows(shot_major(1000, 1 << 20), 1000, 1)


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
@settings(max_examples=60, deadline=None)
@given(case=runs())
def test_walks_match_the_oracle(case: tuple[Plan, dict[int, tuple[int, int]], set[int]]) -> None:
    plan, exposures, cuts = case
    settled, windows = run(plan, plan.automaton.n_slots, 1, exposures, cuts)
    walks = [follow_walk(plan, cycle, exposures) for cycle in range(N_VISITS * plan.cycles_per_object)]
    assert len(settled) == len(walks)  # every walk is reported exactly once, in order
    slots = int(np.flatnonzero(plan.slot_pattern != DARK_PATTERN)[-1])
    for cycle, (window, walk) in enumerate(zip(settled, walks)):
        missing, wrong = {"whole": (False, False), "wrong": (False, True), "lost": (True, False)}[
            walk["fate"] or "lost"
        ]
        assert found(window) == facts(walk["clicks"], missing, wrong)
        assert window.row.exposures == len(walk["states"])
        assert window.row.shot == cycle % plan.cycles_per_object
        whole = walk["fate"] == "whole"
        assert window.row.exposure_index == (walk["last"] if whole else cycle * plan.slots_per_cycle + slots)
        if whole:
            assert window.row.object == cycle // plan.cycles_per_object
    tallies = windows.tallies
    assert tallies[DARK_EXPOSURES] == sum(len(walk["dark"]) for walk in walks)
    assert tallies[DARK_CLICKS] == sum(number > 0 for walk in walks for number in walk["dark"])
    assert tallies[WRONG_PATTERNS] == sum(walk["strange"] for walk in walks)
    assert tallies[LATE_SLOTS] == sum(walk["late"] for walk in walks)
    shown = np.bincount([state for walk in walks for state in walk["states"]], minlength=plan.automaton.n_states)
    assert windows.walks.shown.tolist() == shown.tolist()
    clicked = np.zeros(plan.automaton.n_states, np.int64)
    for walk in walks:
        np.add.at(clicked, walk["states"], np.array(walk["clicks"][: len(walk["states"])]) > 0)
    assert windows.walks.clicked.tolist() == clicked.tolist()


def test_a_walk_is_decided_at_its_leaf_not_at_the_end_of_its_cycle() -> None:
    automaton = random_automaton(5, 6, 3)
    plan = walk_plan(automaton, 1, dark=0)
    for seed in range(50):
        sent = walked(plan, 1, np.random.default_rng(seed))
        length = sum(stamp != DARK_PATTERN for stamp, _ in sent)
        windows = DecisionWindows(plan, automaton.n_slots, 1)
        settled_at = []
        for exposure, (stamp, bit) in enumerate(sent):
            settled_at += [exposure] * len(windows.push(one_block(windows, exposure, [(stamp, bit)])))
        assert settled_at == [length - 1]


@pytest.mark.uncompiled
@settings(max_examples=40, deadline=None)
@given(case=runs())
def test_another_core_goes_on_from_a_place_between_two_walks(
    case: tuple[Plan, dict[int, tuple[int, int]], set[int]],
) -> None:
    plan, exposures, _ = case
    n_slots = plan.automaton.n_slots
    first, settled = DecisionWindows(plan, n_slots, 1), []
    for exposure in sorted(exposures):
        settled += skipped(first, exposure)
        settled += settled_in(first, [first.push(one_block(first, exposure, [exposures[exposure]]), exposure)])
        if not first.half_seen:
            other = DecisionWindows(plan, n_slots, 1)
            other.position, other.tallies[:] = first.position, first.tallies
            other.walk.state["n_decisions"] = len(settled)
            first = other
    last = skipped(first, N_VISITS * first.visit_exposures)
    expected, windows = run(plan, n_slots, 1, exposures, set())
    assert [*settled, *last] == expected
    assert first.tallies.tolist()[:2] == windows.tallies.tolist()[:2]


def test_what_cannot_be_followed_is_refused() -> None:
    automaton = random_automaton(1, 4, 2)
    with pytest.raises(PlanError, match="2 walks make one decision"):
        DecisionWindows(walk_plan(automaton, 2), 4, 2)
    with pytest.raises(PlanError, match="walks of 4 exposures"):
        DecisionWindows(walk_plan(automaton, 1), 3, 1)
