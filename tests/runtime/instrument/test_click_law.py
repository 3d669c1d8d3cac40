"""The laws of clicks and photon numbers against mpmath at 90 digits: no light, tiny, ordinary and enormous means."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pans.instrument.click_law import (
    ClickLaw,
    CountLaw,
    both_chances,
    cannot_count,
    click_law,
    click_probability,
    count_chances,
    count_law,
    counting,
    log_no_click,
    object_transmission,
    survival_coefficients,
)
from pans.instrument.profile import load_profile

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")

MEANS = [0.0, 1e-30, 1e-7, 0.3, 1.0, 2.0, 50.0, 700.0, 1e4, 1e6]
LAWS = [
    ClickLaw(),
    ClickLaw(dark_per_exposure=1e-9),
    ClickLaw(dark_per_exposure=0.9),
    ClickLaw(1.8e-5, 0.20, 0.84),
    ClickLaw(3e-5, 0.21, 0.83),
    ClickLaw(0.0, 0.3, 0.5),
    ClickLaw(0.0, 1.0, 0.5),
    ClickLaw(0.0, 3.0, 0.5),
    ClickLaw(0.0, 0.0, 1.5),
    ClickLaw(1e-6, 0.3, 2.5),
]
COUNTING = [
    CountLaw(0.0, 0.0, (0.5, 1.5)),
    CountLaw(1e-9, 0.0, (1.0, 2.0, 3.0, 4.0)),
    CountLaw(0.9, 0.0, (0.5, 2.5)),
    CountLaw(1.8e-5, 0.20, (0.84, 1.5)),
    CountLaw(0.0, 0.3, (0.5, 1.5, 2.5)),
    CountLaw(1e-6, 1.0, (0.5, 1.5, 2.5, 3.5, 4.5)),
    CountLaw(0.0, 3.0, (0.5, 1.5)),
]
RELATIVE = 2e-13  # of the click law; reached almost everywhere is 1e-15
DIGITS = 90  # 60 are lost where the last outcome is 1 less the others, at a mean of 1e-30


@cache
def weights(law: CountLaw) -> list[list[mpmath.mpf]]:
    """P(outcome | k photoelectrons) of the definition, of all outcomes but the last, by k."""
    noise = mpmath.mpf(law.read_noise_e) * mpmath.sqrt(2)
    rows = []
    for k in range(100):  # no reading of the first bins comes from more photoelectrons
        below = [mpmath.erfc((k - mpmath.mpf(e)) / noise) / 2 if noise else mpmath.mpf(k < e) for e in law.edges]
        rows.append([high - low for low, high in zip([0, *below], below)])
    return rows


@cache
def exact(law: CountLaw, photoelectrons: float) -> list[mpmath.mpf]:
    """P(outcome) from sums of Poisson terms; the last outcome is what remains."""
    with mpmath.workdps(DIGITS):
        mu = mpmath.mpf(photoelectrons) + mpmath.mpf(law.dark_per_exposure)
        chances, term = [mpmath.mpf(0)] * len(law.edges), mpmath.exp(-mu)
        for k, row in enumerate(weights(law)):
            for outcome, w in enumerate(row):
                chances[outcome] += w * term
            term = term * mu / (k + 1)
        return [*chances, 1 - sum(chances)]


def off(found: float, truth: mpmath.mpf) -> float:
    """The relative error of what is large enough for a float to hold it well."""
    return float(abs(mpmath.mpf(float(found)) - truth) / (abs(truth) + mpmath.mpf("1e-290")))


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_the_click_law_agrees_with_mpmath(law: ClickLaw) -> None:
    for mean, log_miss, click, miss in zip(MEANS, log_no_click(law, MEANS), *both_chances(law, MEANS), strict=True):
        missed, clicked = exact(CountLaw(law.dark_per_exposure, law.read_noise_e, (law.threshold_e,)), mean)
        assert max(off(click, clicked), off(miss, missed)) < RELATIVE, mean
        with mpmath.workdps(DIGITS):
            assert off(log_miss, mpmath.log1p(-clicked) if clicked < 0.5 else mpmath.log(missed)) < RELATIVE, mean


@pytest.mark.parametrize("law", COUNTING, ids=str)
def test_the_count_law_agrees_with_mpmath(law: CountLaw) -> None:
    found = count_chances(law, MEANS)
    assert found.shape == (law.outcomes, len(MEANS))
    assert np.abs(found.sum(axis=0) - 1).max() < 1e-13
    for column, mean in enumerate(MEANS):
        # a chance near 1e-300 is the exponential of about -700, whose own rounding is 1e-13
        assert max(map(off, found[:, column], exact(law, mean))) < 1e-12, mean


def test_survival_coefficients_are_the_definition():
    law = ClickLaw(0.0, 0.21, 0.83)
    found = survival_coefficients(law)
    for k, value in enumerate(found):
        truth = mpmath.erfc((k - mpmath.mpf(0.83)) / (mpmath.mpf(0.21) * mpmath.sqrt(2))) / 2 / mpmath.factorial(k)
        assert off(value, truth) < 1e-12
    assert len(found) > 3
    assert survival_coefficients(ClickLaw()).tolist() == [1.0]


def test_no_read_noise_is_the_limit_of_little():
    means = np.array([0.0, 1e-7, 0.3, 1.0, 50.0])
    little = click_probability(ClickLaw(0.0, 1e-3, 0.5), means)
    np.testing.assert_allclose(little, -np.expm1(-means), rtol=1e-14)


def test_paper_figures_follow_from_the_shipped_profile():
    profile = load_profile("oled-qcmos")
    law = click_law(profile, 3000.0)
    seen = 1 - survival_coefficients(law)[1]  # P(click | exactly one photoelectron)
    assert profile.detector.efficiency * seen == pytest.approx(0.68, abs=0.005)
    dark_hz = float(click_probability(law, 0.0)) / 3e-3
    assert dark_hz == pytest.approx(0.01, abs=0.001)
    assert law.read_noise_e < 0.3


def test_click_law_takes_dark_counts_of_the_exposure():
    assert click_law(load_profile("dmd-spad"), 50.0).dark_per_exposure == pytest.approx(100 * 50e-6)
    assert click_law(load_profile("ideal"), 50.0) == ClickLaw()


any_law = st.builds(
    ClickLaw,
    st.sampled_from([0.0, 1e-9, 3e-5, 0.9]),
    st.sampled_from([0.0, 1e-3, 0.05, 0.21, 0.3, 1.0, 3.0]),
    st.floats(0.01, 10.0),
)
any_mean = st.one_of(st.floats(0, 1), st.floats(0, 100), st.floats(0, 1e6), st.sampled_from([1e-300, 5e-324, 1e300]))


@given(any_law, any_mean, any_mean)
def test_probability_is_a_probability_and_grows_with_light(law, one, other):
    low, high = click_probability(law, sorted([one, other]))
    assert 0 <= low <= 1
    assert 0 <= high <= 1
    assert high >= low * (1 - 1e-12)


def test_shapes_are_kept():
    for law in (ClickLaw(), ClickLaw(0.0, 0.3, 0.5)):
        for call in (click_probability, log_no_click):
            assert call(law, 0.5).shape == ()
            assert call(law, np.zeros((2, 0, 3))).shape == (2, 0, 3)
            assert call(law, np.full((4, 5), 0.5, np.float32)).dtype == np.float64


@pytest.mark.parametrize("wrong", [-1e-3, math.nan, math.inf])
def test_impossible_light_is_refused(wrong: float) -> None:
    for chances, law in ((click_probability, ClickLaw(0.01)), (count_chances, COUNTING[0])):
        with pytest.raises(ValueError, match="finite and at least 0"):
            chances(law, [0.5, wrong])


@pytest.mark.parametrize(
    ("law", "wrong", "words"),
    [
        (LAWS[0], dict(dark_per_exposure=-1.0), "dark_per_exposure"),
        (LAWS[0], dict(dark_per_exposure=math.inf), "dark_per_exposure"),
        (LAWS[0], dict(read_noise_e=math.nan), "read_noise_e"),
        (LAWS[0], dict(threshold_e=0.0), "threshold_e"),
        (COUNTING[0], dict(edges=()), "edges"),
        (COUNTING[0], dict(edges=(1.5, 0.5)), "rising"),
        (COUNTING[0], dict(edges=(0.0, 1.0)), "above 0"),
        (COUNTING[0], dict(edges=(0.5, 21.0)), "at most 20"),
        (COUNTING[0], dict(read_noise_e=-0.1), "read_noise_e"),
        (COUNTING[0], dict(dark_per_exposure=math.nan), "dark_per_exposure"),
    ],
)
def test_impossible_laws_are_refused(law: Any, wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(law, **wrong)


@pytest.mark.parametrize("clicks", [ClickLaw(), ClickLaw(0.05), ClickLaw(1.8e-5, 0.2, 0.84), ClickLaw(0.0, 1.0, 0.5)])
def test_outcomes_together_are_the_click_law(clicks: ClickLaw) -> None:
    light = np.array([0.0, 1e-7, 0.2, 3.0, 30.0])
    found = count_chances(counting(clicks, 4), light)
    click, miss = both_chances(clicks, light)
    np.testing.assert_allclose(found[0], miss, rtol=1e-12)
    np.testing.assert_allclose(found[1:].sum(axis=0), click, rtol=1e-12)


def test_the_count_law_of_a_profile() -> None:
    ideal = load_profile("ideal")
    assert count_law(ideal, 100.0, 3) == CountLaw(0.0, 0.0, (0.5, 1.5))
    assert count_law(ideal, 100.0, 2) == ClickLaw()
    assert "2 to 16" in cannot_count(ideal, 17)


def test_what_cannot_count_is_refused() -> None:
    clicks_only = load_profile("dmd-spad")
    assert cannot_count(clicks_only, 2) == ""
    assert "tells 2 apart" in cannot_count(clicks_only, 3)
    counts = replace(clicks_only, detector=replace(clicks_only.detector, photon_number_max=7))
    with pytest.raises(ValueError, match=r"detector\.dead_time_ns: it clicks"):
        count_law(counts, 100.0, 3)


def test_object_transmission_spans_the_contrast():
    images = np.array([[0, 51, 255]], np.uint8)
    np.testing.assert_allclose(object_transmission(None, images), [[0.0, 0.2, 1.0]])
    np.testing.assert_allclose(object_transmission(load_profile("ideal"), images), [[0.0, 0.2, 1.0]])
    paper = load_profile("oled-qcmos")
    np.testing.assert_allclose(object_transmission(paper, images), [[0.001, 0.001 + 0.999 * 0.2, 1.0]])
    assert paper.object_modulator is not None
    bare = replace(paper, object_modulator=replace(paper.object_modulator, black_transmission=None))
    np.testing.assert_allclose(object_transmission(bare, images), [[0.02, 0.02 + 0.98 * 0.2, 1.0]])
    assert object_transmission(None, images, np.float32).dtype == np.float32


def test_object_transmission_refuses_other_images():
    with pytest.raises(ValueError, match="uint8"):
        object_transmission(None, np.zeros(3))
