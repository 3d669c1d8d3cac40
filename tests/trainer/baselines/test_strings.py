"""Direct imaging of barcodes: chances and decisions against an independent walk over strings and words."""

import itertools
import math

import numpy as np
import pytest

from pans.trainer.baselines.strings import at_clicks, at_photons, imaged, word_chances
from pans.trainer.tasks.barcode import all_strings, weights


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
