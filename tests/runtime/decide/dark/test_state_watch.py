"""The watch of an automaton's states: silent while nothing changes, and it finds a loss of light that the clicks of walks do not show."""

from pathlib import Path

import numpy as np
import pytest
from commands import Pans, page_of

from pans.decide.dark.state_watch import LEARNT, TOLERATED, StateWatch, found_at

WALKS = 100
# Click chances of objects of 4 kinds in states 0, 1 (after no click) and 2 (after one): who clicks seldom is shown more light.
KINDS = np.array([[0.2, 0.5, 0.1], [0.4, 0.6, 0.2], [0.6, 0.8, 0.2], [0.7, 0.9, 0.4]])


def stretches(efficiency: float, n: int, seed: int, *, stay: int = 1) -> np.ndarray:
    """Exposures and clicks of each state in `n` stretches, int64 (n, 2, 3); objects stay for `stay` walks."""
    rng = np.random.default_rng(seed)
    chance = -np.expm1(efficiency * np.log1p(-KINDS))[np.repeat(rng.integers(0, 4, n * WALKS // stay), stay)]
    first = rng.random(len(chance)) < chance[:, 0]
    second = rng.random(len(chance)) < np.where(first, chance[:, 2], chance[:, 1])
    shown = np.stack([np.ones(len(chance), np.int64), ~first, first], axis=1)
    clicked = np.stack([first, ~first & second, first & second], axis=1)
    return np.stack([shown, clicked], axis=1).reshape(n, WALKS, 2, 3).sum(axis=1)


def watched(*parts: np.ndarray) -> StateWatch:
    watch = StateWatch(3, WALKS, 1e8)
    for shown, clicked in np.cumsum(np.concatenate(parts), axis=0):
        assert watch.is_due(int(shown[0]))
        watch.take(shown, clicked)
    return watch


@pytest.mark.parametrize("stay", [1, 20])
def test_silent_while_nothing_changes(stay: int) -> None:
    watch = watched(stretches(1.0, 4000, 1, stay=stay))
    assert watch.found == []
    report = watch.report()
    assert report["walks"] == 4000 * WALKS
    assert report["first_state_clicked"] == pytest.approx(KINDS[:, 0].mean(), abs=0.01)
    assert TOLERATED < report["change_found"] < 0.05


@pytest.mark.parametrize(("efficiency", "side"), [(0.7, "fall"), (1.4, "rise")])
def test_a_change_is_found_once_and_against_the_new_level_again(efficiency: float, side: str) -> None:
    watch = watched(stretches(1.0, 200, 2), stretches(efficiency, 200, 3), stretches(1.0, 200, 4))
    other = {"fall": "rise", "rise": "fall"}[side]
    assert [one["side"] for one in watch.found] == [side, other]
    for one, at in zip(watch.found, (200 * WALKS, 400 * WALKS)):
        assert at < one["decision"] < at + 100 * WALKS
        assert at - 20 * WALKS <= one["since"] < one["decision"]
    assert (watch.found[0]["ratio"] < 1) == (side == "fall")
    assert "state 0 in" in watch.found[0]["words"]


@pytest.mark.parametrize(
    ("efficiency", "objects", "sides"),
    [
        (0.7, 20_000, ["fall"]),
        (1.4, 20_000, ["rise"]),
        (1.0, 20_000, []),
        (0.96, 20_000, []),
        (0.7, 200, []),
        (0.0, 200, ["fall"]),
    ],
)
def test_a_beginning_unlike_what_is_stated_is_found_where_enough_objects_differ(
    efficiency: float, objects: int, sides: list[str]
) -> None:
    watch = StateWatch(3, WALKS, 1e8)
    watch.stated, watch.objects = (float(KINDS[:, 0].mean()),) * 2, objects
    for shown, clicked in np.cumsum(stretches(efficiency, 200, 8), axis=0):
        watch.take(shown, clicked)
    assert [one["side"] for one in watch.found] == sides
    for one in watch.found:
        assert (one["stated"], one["since"]) == (True, 0)
        assert one["objects"] == min(one["decision"], objects)
        assert "state 0" in one["words"]


def test_walks_before_one_object_and_a_wide_statement_say_less() -> None:
    rate = float(KINDS[:, 0].mean())
    for trials, stated, found in ((1, (rate, rate), 1), (100, (rate, rate), 0), (1, (0.7 * rate, rate), 0)):
        watch = StateWatch.of_pace(3, 100.0, trials)
        watch.stated = stated
        for shown, clicked in np.cumsum(stretches(0.7, 200, 8), axis=0):
            watch.take(shown, clicked)
        assert len(watch.found) == found


def test_what_does_not_count_is_left_out() -> None:
    watch, sums = StateWatch(3, WALKS, 1e8), np.zeros((2, 3), np.int64)
    for counts, part in (
        (True, stretches(1.0, 200, 5)),
        (False, stretches(0.4, 200, 6)),
        (True, stretches(1.0, 200, 7)),
    ):
        for one in part:
            sums = sums + one
            assert watch.take(*sums, counts=counts) == []
    assert watch.report()["walks"] == 600 * WALKS


def test_objects_that_stay_widen_the_test() -> None:
    """Stretches of few objects differ by more than chance: the same spread is told from a change by what was seen before."""
    few = [watched(stretches(1.0, 400, seed, stay=50)) for seed in range(5)]
    assert [watch.found for watch in few] == [[]] * 5
    alone, many = (watched(stretches(1.0, 400, 1, stay=stay)).report()["change_found"] for stay in (1, 50))
    assert many > 1.5 * alone


def test_nothing_is_said_before_the_spread_is_known() -> None:
    assert watched(stretches(1.0, LEARNT // 2, 1), stretches(0.3, LEARNT // 2, 2)).found == []
    assert watched(stretches(1.0, 0, 1)).report()["change_found"] is None


def test_bernsteins_bound_holds_for_bounded_steps() -> None:
    rng = np.random.default_rng(1)
    looks, n, chance = 100, 50, 0.2
    sums = rng.binomial(n, chance, 2_000_000) - n * chance
    at = found_at(n * chance * (1 - chance), looks)
    assert (
        np.count_nonzero(np.abs(sums) > at) / len(sums) * 3 * looks < 1
    )  # COMPARED comparisons, of two sides, in a look
    assert np.count_nonzero(np.abs(sums) > at) > 0


def test_a_run_that_loses_light_warns(tmp_path: Path, pans: Pans) -> None:
    device = "sim:dmd-spad?scene=fashion200&pace=fast&seed=3&changes=drift:at_s=10:percent_per_s=-60:for_s=1"
    words = ["run", "fashion-adaptive", "--device", device, "--decisions", "2600", "--no-realtime", "--out", tmp_path]
    summary = pans(*words)
    (found,) = summary["light"]["states"]["found"]
    assert 1570 < found["decision"] < 2600
    assert found["ratio"] < 0.95
    assert summary["light"]["found"] == []  # the clicks of walks do not tell
    assert (summary["verdict"], summary["warnings"]) == ("PASS", [found["words"]])
    assert "Warning: the states of the walks clicked" in page_of(tmp_path / "run.pansrec", tmp_path)
