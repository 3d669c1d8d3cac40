"""Strings: direct imaging against an independent walk; the bound of any scheme against closed forms, trees of questions, and schemes."""

import functools
import itertools
import math

import numpy as np
import pytest

from pans_trainer.baselines.strings import Bars, at_clicks, at_photons, bounds, imaged, word_chances
from pans_trainer.tasks.barcode import all_strings, weights


def has_target(bars):
    return "1010" in "".join(map(str, bars))


def walked(bright, dark, prior):
    """Accuracy in % and mean clicks, one string and one word after the other."""
    strings = list(itertools.product((0, 1), repeat=10))
    having = sum(map(has_target, strings))
    right, clicks = 0.0, 0.0
    for word in strings[::37]:  # some of the words: each has its own best decision
        of_class = {True: 0.0, False: 0.0}
        for bars in strings:
            kind = has_target(bars)
            share = 1 / 1024 if prior == "uniform" else 0.5 / (having if kind else 1024 - having)
            for bar, click in zip(bars, word):
                p = 1 - math.exp(-bar * bright - dark)
                share *= p if click else 1 - p
            of_class[kind] += share
        right += max(of_class.values())
        clicks += sum(word) * sum(of_class.values())
    return right, clicks


@pytest.mark.parametrize(("bright", "dark", "prior"), [(0.7, 0.0, "uniform"), (2.0, 0.03, "balanced")])
def test_words_and_decisions_are_those_of_a_walk_over_all_strings(bright, dark, prior):
    chances = word_chances(bright, dark)
    assert chances.sum(axis=1) == pytest.approx(np.ones(1024))
    _, labels = all_strings()
    joint = np.stack([weights(prior)[labels == k] @ chances[labels == k] for k in (0, 1)])[:, ::37]
    ones = np.array([bin(word).count("1") for word in range(1024)])[::37]
    right, clicks = walked(bright, dark, prior)
    assert joint.max(axis=0).sum() == pytest.approx(right)
    assert joint.sum(axis=0) @ ones == pytest.approx(clicks)


def test_light_decides_and_its_absence_guesses():
    assert imaged(0.0)["value"] == pytest.approx(100 * 667 / 1024)  # the more frequent class
    assert imaged(100.0)["value"] == pytest.approx(100)


def test_photons_and_clicks_asked_for_are_those_given():
    found = at_photons(13.0, 0.01)
    assert (found["photons"], found["illumination"]) == pytest.approx((13.0, 26.0))
    again = at_clicks(found["clicks"], 0.01)
    assert again == pytest.approx(found)
    assert at_clicks(5.2) is None  # five bars are lit on average
    assert at_clicks(0.01, 0.03) is None  # fewer than the dark counts


FINE = tuple(np.linspace(0.0, 8.0, 41))


def label_of(target: str, n: int) -> np.ndarray:
    return np.array([target in "".join(bars) for bars in itertools.product("01", repeat=n)], np.int64)


@pytest.mark.parametrize(("photon_price", "unit_price"), [(0.0, 0.02), (0.1, 0.05), (0.3, 0.1)])
def test_one_bar_is_lit_until_its_silence_is_worth_no_more_light(photon_price: float, unit_price: float) -> None:
    # of 1 - s/2 - photons (1 - s)/2 - unit (1 - s - ln s)/2 the best weight s left to the bright case
    s = unit_price / (1 - photon_price - unit_price)
    wanted = 1 - s / 2 - photon_price * (1 - s) / 2 - unit_price * (1 - s - math.log(s)) / 2
    found = Bars(label_of("1", 1)).most(photon_price, unit_price, FINE)
    assert wanted <= found <= wanted + 0.01 * unit_price


def tree(labels: np.ndarray, n: int, price: float, bits: bool, known: tuple[int | None, ...]) -> float:
    """The best order to read bars that cost `price` where they are bright, by all strings that agree with what is known."""
    agree = [
        i
        for i, bars in enumerate(itertools.product((0, 1), repeat=n))
        if all(k in (None, b) for k, b in zip(known, bars))
    ]
    p = labels[agree].mean()
    best = max(p, 1 - p) if not bits else sum(q * math.log2(q) for q in (p, 1 - p) if q)
    for bar in range(n):
        if known[bar] is None:
            ways = [tree(labels, n, price, bits, (*known[:bar], b, *known[bar + 1 :])) for b in (0, 1)]
            best = max(best, sum(ways) / 2 - price / 2)
    return best


@pytest.mark.parametrize("price", [0.01, 0.08, 0.2])
@pytest.mark.parametrize(("target", "n"), [("10", 2), ("10", 3), ("101", 4)])
def test_with_a_price_on_photons_alone_the_bound_is_the_best_tree_of_questions(
    target: str, n: int, price: float
) -> None:
    labels, nothing = label_of(target, n), (None,) * n
    assert Bars(labels).most(price) == pytest.approx(tree(labels, n, price, False, nothing), abs=1e-6)
    p = labels.mean()
    entropy = -sum(q * math.log2(q) for q in (p, 1 - p))
    wanted = entropy + tree(labels, n, price, True, nothing)
    assert Bars(labels).most(price, bits=True) == pytest.approx(wanted, abs=1e-6)


def scheme(labels: np.ndarray, strings: np.ndarray, prices: tuple[float, float], joint: np.ndarray, left: int) -> float:
    """The best accuracy less the price of light, of `left` exposures of any pattern of a grid; `joint` P(string, clicks so far)."""
    best = max(joint[labels == 0].sum(), joint[labels == 1].sum())
    if left:
        for pattern in itertools.product((0.0, 0.6, 1.5), repeat=strings.shape[1]):
            light = strings @ np.array(pattern)
            cost = prices[0] * (joint @ light) + prices[1] * joint.sum() * sum(pattern)
            if sum(pattern) and cost < best:
                click = -np.expm1(-light)
                parts = [scheme(labels, strings, prices, joint * p, left - 1) for p in (click, 1 - click)]
                best = max(best, sum(parts) - cost)
    return best


def many_dim_exposures(labels: np.ndarray, strings: np.ndarray, prices: tuple[float, float]) -> float:
    """The best of up to 40 exposures of each bar alone, of 0.15 photoelectrons."""
    step, most = 0.15, 40

    @functools.cache
    def value(state: tuple[int, ...]) -> float:  # exposures without a click, or -1 for a bar that clicked
        joint = np.full(len(strings), 1 / len(strings))
        for bar, silent in zip(strings.T, state):
            joint *= bar if silent < 0 else np.exp(-step * silent * bar)
        best = max(joint[labels == 0].sum(), joint[labels == 1].sum())
        for at, silent in enumerate(state):
            if 0 <= silent < most:
                cost = prices[0] * step * (joint @ strings[:, at]) + prices[1] * step * joint.sum()
                click, none = ((*state[:at], now, *state[at + 1 :]) for now in (-1, silent + 1))
                chance = math.exp(-step * silent) * -math.expm1(-step)  # of a bright bar to click now
                best = max(best, chance * value(click) + value(none) - cost)
        return float(best)

    return value((0,) * strings.shape[1])


@pytest.mark.parametrize("prices", [(0.0, 0.03), (0.05, 0.02)])
@pytest.mark.parametrize("target", ["10", "11", "1"])
def test_no_scheme_of_patterns_over_both_bars_is_above_and_the_bound_is_close(
    target: str, prices: tuple[float, float]
) -> None:
    labels = label_of(target, 2)
    strings = np.array(list(itertools.product((0, 1), repeat=2)))
    found = scheme(labels, strings, prices, np.full(4, 0.25), 4)
    coarse, fine = (Bars(labels).most(*prices, lights) for lights in ((0.0, 1.0, 2.2, 4.0), FINE))
    dim = many_dim_exposures(labels, strings, prices)
    assert max(found, dim) <= fine <= coarse + 1e-6
    assert fine - dim < 0.01
    assert coarse - fine < 0.5 * prices[1]


def test_a_camera_of_barcodes_is_below_the_bound_of_its_photons() -> None:
    camera = [imaged(bright) for bright in (0.1, 0.2, 0.4)]
    for one, most in zip(camera, bounds([each["photons"] for each in camera], "photons")):
        assert one["value"] < most["value"]
        assert 0 < one["bits"] < most["bits"]


@pytest.mark.slow
def test_a_camera_of_barcodes_is_below_the_bound_of_its_illumination() -> None:
    camera = [imaged(bright) for bright in (0.3, 0.6, 1.0)]
    for one, most in zip(camera, bounds([each["illumination"] for each in camera], "illumination")):
        assert (one["value"], one["bits"]) < (most["value"], most["bits"])
        assert most["value"] < 100
