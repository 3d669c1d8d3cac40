"""Bleaching: against arithmetic of 60 digits, and against emitters that die one by one."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

from pans.runtime.imaging import NO_BLEACHING, Bleaching, bleached, bleaching_of, mean_left

RNG = np.random.default_rng(11)


@pytest.mark.parametrize("dose", [1e-9, 1e-3, 0.7, 40.0, 1e6, 1e15])
def test_the_law_holds_at_tiny_and_huge_doses(dose: float) -> None:
    light = np.array([[1e-12, 0.3, 5.0, 1e4], [0.0, 2.0, 1e-6, 20.0], [3.0, 0.1, 9.0, 1e-3]])
    found = bleached(Bleaching(dose), light)
    with mpmath.workdps(60):
        for pixel in range(light.shape[1]):
            before = mpmath.mpf(0)
            for row in range(len(light)):
                shown = mpmath.mpf(light[row, pixel])
                after = before + shown
                wanted = mpmath.mpf(dose) * (mpmath.exp(-before / dose) - mpmath.exp(-after / dose))
                # the exponent itself is known to a few ulp, so that its exponential is to that many times its size
                size = max(1.0, min(750.0, float(before / dose)))
                assert abs(found[row, pixel] - wanted) <= 4e-15 * size * wanted + mpmath.mpf(10) ** -300
                before = after


def test_the_mean_over_an_exposure_has_its_limits() -> None:
    assert mean_left(np.array([0.0, 5e-324, 1e-9])).tolist() == [1.0, 1.0, 1.0 - 0.5e-9]
    assert mean_left(np.array([1e30]))[0] == pytest.approx(1e-30, rel=1e-15)
    assert mean_left(np.array([math.log(2)]))[0] == pytest.approx(0.5 / math.log(2), rel=1e-15)


def _dying(light: np.ndarray, dose: float, mixed: bool, emitters: int, steps: int) -> np.ndarray:
    """Emitters that die one by one: in every small step each one glows by its light, then dies with that light's chance."""
    pixels = light.shape[1]
    alive = np.ones((pixels, emitters), bool)
    glow = np.zeros(light.shape)
    for row, shown in enumerate(light):
        part = shown / steps
        for _ in range(steps):
            glow[row] += alive.mean(axis=1) * part
            received = np.full(pixels, part.mean()) if mixed else part
            alive &= RNG.random(alive.shape) >= (received / dose)[:, None]
    return glow


@pytest.mark.parametrize("mixed", [False, True])
def test_emitters_that_die_one_by_one_give_the_law(mixed: bool) -> None:
    light = np.array([[4.0, 0.0, 1.0], [0.0, 6.0, 2.0], [3.0, 1.0, 0.5]])
    dose, emitters, steps = 5.0, 20_000, 100
    found = bleached(Bleaching(dose, mixed), light)
    simulated = _dying(light, dose, mixed, emitters, steps)
    # the share alive has at most the variance 1/4 over the emitters; a step of light / steps is off by half of itself over the dose
    allowed = light * (5 * 0.5 / math.sqrt(emitters) + light.max() / steps / dose)
    assert (np.abs(found - simulated) <= allowed).all()
    assert (found[2] < 0.75 * light[2]).all()  # it bleaches by much more than that


def test_light_that_stays_is_as_it_was_and_order_matters() -> None:
    light = RNG.random((4, 9)) * 3
    np.testing.assert_array_equal(bleached(NO_BLEACHING, light), light)
    one = bleached(Bleaching(2.0), light)
    back = bleached(Bleaching(2.0), light[::-1])[::-1]
    np.testing.assert_allclose(one.sum(axis=0), back.sum(axis=0), rtol=1e-13)  # what a pixel gives in all is the same
    assert not np.allclose(one, back)
    np.testing.assert_allclose(bleached(Bleaching(1e14), light), light, rtol=1e-12)


@pytest.mark.parametrize("text", ["", "x", "0", "-3", "nan", "inf", "40:", "40:fixed", "1e16", "40:mixed:"])
def test_what_is_no_law_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="bleaching"):
        bleaching_of(text)


@pytest.mark.parametrize("law", [Bleaching(40.0), Bleaching(0.3, True)])
def test_a_law_is_read_back_as_it_was_spelled(law: Bleaching) -> None:
    assert bleaching_of(law.spelled()) == law
