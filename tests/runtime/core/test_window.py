"""Windows against the plain-loop oracle: any plan, any losses, any block cutting; compiled and not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_window import count_visits
from plans import parallel, pattern_major, shot_major

from pans.runtime.core.plan import Plan
from pans.runtime.core.window import DARK_CLICKS, DARK_EXPOSURES, WRONG_PATTERNS, DecisionWindows
from pans.runtime.errors import PlanError
from pans.runtime.wire.messages import DARK_PATTERN, ClickBlock, FrameBlock

N_VISITS = 3


def run(
    plan: Plan, n_features: int, shots: int, exposures: dict[int, tuple[int, int]], cuts: set[int]
) -> tuple[Any, DecisionWindows]:
    """Push `exposures` as blocks that end at `cuts`, at losses and at cycle ends, as a device would send them."""
    windows = DecisionWindows(plan, n_features, shots)
    end = N_VISITS * windows.visit_exposures
    settled: list[Any] = []

    def keep(found: list[Any]) -> None:
        settled.extend(window._replace(counts=window.counts.tolist()) for window in found)

    block: list[int] = []
    for exposure in range(end + 1):
        breaks = exposure in cuts or exposure not in exposures or exposure % plan.slots_per_cycle == 0
        if block and breaks:
            shown = np.array([exposures[i][0] for i in block], np.uint16)
            bits = np.array([exposures[i][1] for i in block], np.uint8)
            keep(windows.skip_to(block[0]))
            keep(windows.push(ClickBlock(0, 0, 0, block[0], 1, block[0] // windows.visit_exposures, shown, bits)))
            block = []
        if exposure in exposures:
            block.append(exposure)
    keep(windows.skip_to(end))
    return settled, windows


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
    assert [w.last_exposure for w in settled] == sorted(w.last_exposure for w in settled)
    for number, window in enumerate(settled):
        visit, index = divmod(number, n_windows)
        assert window.first_shot == index * shots
        want = expected.get((visit, index), ([0] * n_features, shots * n_features, 0))
        assert (window.counts, window.missing, window.wrong) == want
        if window.missing == 0:
            assert window.object_index == visit
    dark = [i for i in exposures if planned[i] == DARK_PATTERN]
    assert windows.tallies[DARK_EXPOSURES] == sum(1 for i in dark if not wrong[i])
    assert windows.tallies[DARK_CLICKS] == sum(exposures[i][1] for i in dark if not wrong[i])
    assert windows.tallies[WRONG_PATTERNS] == sum(1 for i in exposures if wrong[i])


def test_a_window_is_settled_with_its_last_exposure_not_later() -> None:
    plan = pattern_major(2, 3)
    windows = DecisionWindows(plan, 2, 1)
    shown, ones = plan.slot_pattern, np.ones(9, np.uint8)
    assert windows.push(ClickBlock(0, 0, 0, 0, 1, 5, shown[:6], ones[:6])) == []
    first = windows.push(ClickBlock(1, 0, 0, 6, 1, 5, shown[6:7], ones[:1]))
    assert [(w.object_index, w.first_shot, w.last_exposure, w.counts.tolist()) for w in first] == [(5, 0, 6, [1, 1])]
    rest = windows.push(ClickBlock(2, 0, 0, 7, 1, 5, shown[7:], ones[:2]))
    assert [w.first_shot for w in rest] == [1, 2]


def test_whole_visits_that_were_lost_are_reported_one_by_one() -> None:
    plan = shot_major(2, 2)
    windows = DecisionWindows(plan, 2, 1)
    lost = windows.skip_to(5 * windows.visit_exposures)
    assert [(w.missing, w.counts.sum()) for w in lost] == [(2, 0)] * 10


@pytest.mark.uncompiled
@pytest.mark.parametrize("n_features", [1, 8, 10, 64, 70])
def test_parallel_frames(n_features: int) -> None:
    plan = parallel(n_features, 6)
    windows = DecisionWindows(plan, n_features, 3)
    rng = np.random.default_rng(n_features)
    bits = rng.integers(0, 2, (7, n_features), np.uint8)
    words = np.packbits(bits, axis=1, bitorder="little")
    words.setflags(write=False)
    settled = windows.push(FrameBlock(0, 0, 0, 0, 1, 4, words))
    assert [w.counts.tolist() for w in settled] == [bits[1:4].sum(0).tolist(), bits[4:7].sum(0).tolist()]
    assert windows.tallies[DARK_EXPOSURES] == n_features
    assert windows.tallies[DARK_CLICKS] == bits[0].sum()


def test_shots_that_do_not_divide_are_refused_with_the_numbers() -> None:
    with pytest.raises(PlanError, match="5 shots per object cannot be cut into windows of 2"):
        DecisionWindows(shot_major(2, 5), 2, 2)


def test_a_visit_that_does_not_fit_in_memory_is_refused() -> None:
    with pytest.raises(PlanError, match="exposures, allowed"):
        DecisionWindows(shot_major(1000, 1 << 20), 1000, 1)
