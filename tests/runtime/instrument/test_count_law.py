"""The count law against mpmath at 60 digits: every outcome, from no light to enormous means."""

import math
from dataclasses import replace
from functools import cache

import mpmath
import numpy as np
import pytest

from pans.runtime.instrument.click_law import (
    ClickLaw,
    CountLaw,
    both_chances,
    cannot_count,
    count_chances,
    count_law,
    counting,
)
from pans.runtime.instrument.profile import load_profile

MEANS = [0.0, 1e-30, 1e-7, 0.3, 2.0, 50.0, 700.0, 1e4, 1e6]
LAWS = [
    CountLaw(0.0, 0.0, (0.5, 1.5)),
    CountLaw(1e-9, 0.0, (1.0, 2.0, 3.0, 4.0)),
    CountLaw(0.9, 0.0, (0.5, 2.5)),
    CountLaw(1.8e-5, 0.20, (0.84, 1.5)),
    CountLaw(0.0, 0.3, (0.5, 1.5, 2.5)),
    CountLaw(1e-6, 1.0, (0.5, 1.5, 2.5, 3.5, 4.5)),
    CountLaw(0.0, 3.0, (0.5, 1.5)),
]
RELATIVE = 1e-12  # a chance near 1e-300 is the exponential of about -700, whose own rounding is 1e-13


DIGITS = 90  # 60 are lost where the last outcome is 1 less the others, at a mean of 1e-30


@cache
def weights(law):
    """P(outcome | k photoelectrons) of the definition, of all outcomes but the last, by k."""
    noise = mpmath.mpf(law.read_noise_e) * mpmath.sqrt(2)
    rows = []
    for k in range(100):  # no reading of the first bins comes from more photoelectrons
        below = [mpmath.erfc((k - mpmath.mpf(e)) / noise) / 2 if noise else mpmath.mpf(k < e) for e in law.edges]
        rows.append([high - low for low, high in zip([0, *below], below)])
    return rows


@cache
def exact(law, photoelectrons):
    """P(outcome), a list, from sums of Poisson terms; the last outcome is what remains."""
    with mpmath.workdps(DIGITS):
        mu = mpmath.mpf(photoelectrons) + mpmath.mpf(law.dark_per_exposure)
        chances, term = [mpmath.mpf(0)] * len(law.edges), mpmath.exp(-mu)
        for k, row in enumerate(weights(law)):
            for outcome, w in enumerate(row):
                chances[outcome] += w * term
            term = term * mu / (k + 1)
        return [*chances, 1 - sum(chances)]


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_chances_agree_with_mpmath(law):
    found = count_chances(law, MEANS)
    assert found.shape == (law.outcomes, len(MEANS))
    assert np.abs(found.sum(axis=0) - 1).max() < 1e-13
    for column, mean in enumerate(MEANS):
        for got, truth in zip(found[:, column], exact(law, mean), strict=True):
            assert abs(mpmath.mpf(float(got)) - truth) <= RELATIVE * truth + mpmath.mpf("1e-290"), mean


@pytest.mark.parametrize("clicks", [ClickLaw(), ClickLaw(0.05), ClickLaw(1.8e-5, 0.2, 0.84), ClickLaw(0.0, 1.0, 0.5)])
def test_outcomes_together_are_the_click_law(clicks):
    light = np.array([0.0, 1e-7, 0.2, 3.0, 30.0])
    found = count_chances(counting(clicks, 4), light)
    click, miss = both_chances(clicks, light)
    np.testing.assert_allclose(found[0], miss, rtol=1e-12)
    np.testing.assert_allclose(found[1:].sum(axis=0), click, rtol=1e-12)


def test_law_of_a_profile():
    ideal = load_profile("ideal")
    assert count_law(ideal, 100.0, 3) == CountLaw(0.0, 0.0, (0.5, 1.5))
    assert count_law(ideal, 100.0, 2) == ClickLaw()
    assert "2 to 16" in cannot_count(ideal, 17)


def test_what_cannot_count_is_refused():
    clicks_only = load_profile("dmd-spad")
    assert cannot_count(clicks_only, 2) == ""
    assert "tells 2 apart" in cannot_count(clicks_only, 3)
    counts = replace(clicks_only, detector=replace(clicks_only.detector, photon_number_max=7))
    with pytest.raises(ValueError, match=r"detector\.dead_time_ns: it clicks"):
        count_law(counts, 100.0, 3)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (dict(edges=()), "edges"),
        (dict(edges=(1.5, 0.5)), "rising"),
        (dict(edges=(0.0, 1.0)), "above 0"),
        (dict(edges=(0.5, 21.0)), "at most 20"),
        (dict(read_noise_e=-0.1), "read_noise_e"),
        (dict(dark_per_exposure=math.nan), "dark_per_exposure"),
    ],
)
def test_impossible_laws_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        replace(CountLaw(0.0, 0.0, (0.5, 1.5)), **wrong)


@pytest.mark.parametrize("light", [-1e-9, math.nan, math.inf])
def test_impossible_light_is_refused(light):
    with pytest.raises(ValueError, match="photoelectrons"):
        count_chances(LAWS[0], [0.1, light])
