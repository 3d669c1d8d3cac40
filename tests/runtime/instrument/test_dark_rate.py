"""Dark-count statistics against exact rationals and high precision."""

from __future__ import annotations

from fractions import Fraction
from math import comb

import mpmath
import pytest

from pans.runtime.instrument.channel_health import dark_report
from pans.runtime.intervals import binomial_tail, wilson_interval


@pytest.mark.parametrize(
    ("clicks", "exposures", "p"), [(1, 10, 0.01), (5, 50, 0.01), (9, 10, 0.25), (40, 200, 0.05), (10, 10, 0.5)]
)
def test_tail_against_exact_rationals(clicks: int, exposures: int, p: float) -> None:
    q = Fraction(p)
    exact = sum(comb(exposures, k) * q**k * (1 - q) ** (exposures - k) for k in range(clicks, exposures + 1))
    assert binomial_tail(clicks, exposures, p) == pytest.approx(float(exact), rel=1e-11)


@pytest.mark.parametrize(
    ("clicks", "exposures", "p"), [(30, 10**9, 1e-9), (3, 10**9, 1e-12), (200, 10**6, 1e-5), (100, 10**6, 1e-5)]
)
def test_tail_with_many_exposures_and_tiny_rates(clicks: int, exposures: int, p: float) -> None:
    mpmath.mp.dps = 40
    exact = mpmath.betainc(clicks, exposures - clicks + 1, 0, mpmath.mpf(p), regularized=True)
    assert binomial_tail(clicks, exposures, p) == pytest.approx(float(exact), rel=1e-6)


def test_tail_at_its_ends() -> None:
    assert binomial_tail(0, 10, 0.0) == 1.0
    assert binomial_tail(1, 10, 0.0) == 0.0
    assert binomial_tail(10, 10, 1.0) == 1.0
    assert binomial_tail(5, 100, 0.05) == 1.0  # not above its mean: never alarming
    assert binomial_tail(10**6, 10**6, 1e-9) == 0.0


def test_wilson_interval_is_the_root_of_its_definition() -> None:
    z = mpmath.mpf("1.959963984540054")
    for clicks, exposures in [(0, 10), (1, 1000), (500, 1000), (1000, 1000)]:
        for bound in wilson_interval(clicks, exposures):
            rate = mpmath.mpf(clicks) / exposures
            assert abs((rate - bound) ** 2 - z**2 * bound * (1 - bound) / exposures) < 1e-15
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_alarm_only_when_the_profile_is_contradicted() -> None:
    assert dark_report(1e-4, 10_000, 3).alarm == dark_report(1e-4, 0, 0).alarm == ""
    assert "30 clicks in 10000 dark exposures" in dark_report(1e-4, 10_000, 30).alarm
    assert dark_report(0.0, 100, 1).alarm
