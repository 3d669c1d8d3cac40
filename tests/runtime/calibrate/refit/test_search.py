"""The search of `pans tune` on a table that is known: what it finds, what it does not take for a gain, and how it goes on."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pans.base.errors import DamagedFileError, PlanError
from pans.bundle.sensor import load_bundle
from pans.calibrate.refit.tune import BENDS, STILL, Cost, Move, Search, Step, moved, paired
from pans_sim.testing import small_automaton_bundle

NAMES = ("right_px", "down_px", "rotation_deg")
UNLIMITED = Cost(math.inf, math.inf)
HARD = np.random.default_rng(0).exponential(size=1000)


class Table:
    """A table off by (right, down, rotation): losses of 1000 objects, each with its own difficulty and the noise of its photons."""

    def __init__(self, right: float = 0.0, down: float = 0.0, rotation: float = 0.0, slope: float = 0.2) -> None:
        self.truth, self.slope, self.asked = (right, down, rotation), slope, 0

    def measure(self, move: Move, number: int):
        self.asked += 1
        there = (move.right_px, move.down_px, move.rotation_deg / 2)
        off = sum((a - b) ** 2 for a, b in zip(there, (self.truth[0], self.truth[1], self.truth[2] / 2)))
        noise = np.random.default_rng(number).normal(size=1000)
        return HARD + self.slope * off + 0.7 * noise, Cost(1000.0, 2.0)


def searched(measure, budget: Cost = UNLIMITED, journal=(), names=NAMES) -> Search:
    search = Search(names, 1000, budget, measure, lambda journal: None, list(journal))
    search.run()
    return search


def test_the_table_is_found_within_what_the_objects_can_tell() -> None:
    found = searched(Table(1.0, -2.0, 4.0).measure)
    assert found.ended == "the smallest steps change nothing more"
    assert (abs(found.best.right_px - 1), abs(found.best.down_px + 2)) <= (0.5, 0.5)
    assert abs(found.best.rotation_deg - 4) <= 2
    assert len(found.journal) < 80


def test_steps_that_are_not_clear_alone_are_taken_together() -> None:
    """Each of three ways is worth 1.7 standard errors, all of them 5: the noise spreads the differences and adds nothing to their mean."""
    table = Table(1.0, -1.0, 2.0, slope=0.03)
    spread = np.zeros(1000)
    spread[np.arange(1000) % 5 < 4] = 0.25 * (-1.0) ** np.arange(800)

    def measure(move: Move, number: int):
        there = (move.right_px - 1, move.down_px + 1, move.rotation_deg / 2 - 1)
        return HARD + table.slope * np.square(there).sum() + (spread if number else -spread), Cost(1000.0, 2.0)

    search = searched(measure, Cost(11_000, math.inf))
    assert search.journal[7].move == search.best == Move(right_px=1.0, down_px=-1.0, rotation_deg=2.0)
    assert search.accepted == 1
    assert search.resolution == pytest.approx(2.33 * 0.5 / math.sqrt(800), rel=0.01)  # differences of +-0.5


def test_a_table_that_is_right_is_left_alone() -> None:
    tried = [searched(Table(slope=0.0).measure) for _ in range(3)]
    assert sum(search.accepted for search in tried) <= 3  # one in a hundred of about 19 trials each
    assert searched(Table(slope=0.5).measure).best == STILL


def test_objects_that_are_held_out_never_choose() -> None:
    table = Table(1.0)

    def tempted(move: Move, number: int):
        loss, cost = table.measure(STILL, 0)
        if move.right_px > 0:
            loss = loss - 5.0 * (np.arange(1000) % 5 == 4)
        return loss, cost

    assert searched(tempted).best == STILL


def test_a_search_goes_on_where_its_journal_ends() -> None:
    whole = searched(Table(1.0, 1.0).measure)
    again = Table(1.0, 1.0)
    resumed = searched(again.measure, journal=[Step.of(step.as_json()) for step in whole.journal[:9]])
    assert again.asked == len(whole.journal) - 9
    assert (resumed.best, resumed.journal) == (whole.best, whole.journal)
    with pytest.raises(DamagedFileError, match="trial 1 of the checkpoint is right_px 1, here rotation_deg 2"):
        searched(again.measure, journal=whole.journal, names=("rotation_deg",))


@pytest.mark.parametrize(("budget", "most"), [(Cost(9_500, math.inf), 7), (Cost(math.inf, 17), 6)])
def test_the_budget_leaves_room_for_the_comparison(budget: Cost, most: int) -> None:
    found = searched(Table(1.0, 1.0).measure, budget)
    assert found.ended == "the budget is spent"
    assert len(found.journal) == most
    assert found.spent.plus(Cost(1000.0, 2.0), 2).within(budget)


def test_what_the_device_cannot_show_is_passed_over() -> None:
    table = Table(1.0)

    def measure(move: Move, number: int):
        if move.right_px > 0:
            raise PlanError("too bright")
        return table.measure(move, number)

    search = searched(measure)
    assert search.best.right_px <= 0
    assert [any(step.loss) for step in search.journal[:3]] == [True, False, True]


def test_the_paired_test_is_that_of_the_differences() -> None:
    old, new = np.array([1.0, 2.0, 4.0, np.nan, 9.0]), np.array([0.5, 1.0, 1.0, 0.0, 0.0])
    gain, error = paired(old, new, np.array([True, True, True, True, False]))
    assert gain == pytest.approx(1.5)
    assert error == pytest.approx(np.std([0.5, 1.0, 3.0], ddof=1) / math.sqrt(3))
    assert paired(old, new, np.zeros(5, bool)) == (0.0, math.inf)


def test_whole_pixels_are_moved_exactly() -> None:
    bundle = load_bundle("fashion10")[0]
    found = moved(bundle, Move(right_px=1.0, down_px=-2.0)).pattern_levels.reshape(-1, 28, 28)
    was = bundle.pattern_levels.reshape(-1, 28, 28)
    assert np.array_equal(found[:, :-2, 1:], was[:, 2:, :-1])
    assert not found[:, -2:].any()
    assert not found[:, :, 0].any()
    brighter = moved(bundle, Move(brightness=1.5))
    assert brighter.photons_per_level == pytest.approx(1.5 * bundle.photons_per_level)
    assert np.array_equal(brighter.pattern_levels, bundle.pattern_levels)


def test_binary_patterns_stay_binary_and_keep_their_light() -> None:
    bundle = load_bundle("fashion-adaptive")[0]
    found = moved(bundle, Move(right_px=0.5, rotation_deg=1.0)).pattern_levels
    assert set(np.unique(found).tolist()) <= {0, 1}
    inside = bundle.pattern_levels.reshape(-1, 28, 28)[:, 3:-3, 3:-3].sum(axis=(1, 2)) == bundle.pattern_levels.sum(1)
    assert np.abs(found.sum(1) - bundle.pattern_levels.sum(1).astype(int))[inside].max() <= 1


@pytest.mark.parametrize("name", BENDS)
def test_a_bend_moves_a_spot_as_it_says(name: str) -> None:
    bundle = load_bundle("fashion10")[0]
    spot = np.zeros((1, 28, 28), np.uint16)
    spot[0, 20, 22] = 120
    y, x = 2 * 20 / 27 - 1, 2 * 22 / 27 - 1
    wanted = {
        "stretch_px": (x, -y),
        "shear_px": (y, x),
        "keystone_right_px": (x * y, 0),
        "keystone_down_px": (0, x * y),
    }
    wide = replace(bundle, pattern_levels=spot.reshape(1, -1))
    light = moved(wide, STILL._replace(**{name: 0.5})).pattern_levels.reshape(28, 28).astype(float)
    middle = [(light.sum(axis=1 - axis) @ np.arange(28)) / light.sum() for axis in (0, 1)]
    assert middle[1] - 22 == pytest.approx(0.5 * wanted[name][0], abs=0.03)
    assert middle[0] - 20 == pytest.approx(0.5 * wanted[name][1], abs=0.03)


def test_an_automaton_keeps_its_walks() -> None:
    bundle = small_automaton_bundle()
    found = moved(bundle, Move(right_px=1.0))
    assert found.automaton is bundle.automaton
    assert found.expected is None
    assert moved(bundle, STILL).expected == bundle.expected
