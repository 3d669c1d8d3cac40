"""Beta, chi-square and the Jeffreys interval against 40 digits, and the interval's coverage."""

from __future__ import annotations

import mpmath
import pytest

from pans.runtime.intervals import CHI2_95, beta_cdf, beta_quantile, chi2_quantile, chi2_tail, jeffreys_interval


@pytest.mark.parametrize(
    ("x", "a", "b"), [(0.3, 0.5, 10.5), (1e-9, 0.5, 1e6), (2e-4, 100.5, 1e6), (0.9, 900.5, 100.5), (0.5, 3.0, 3.0)]
)
def test_beta_against_mpmath(x: float, a: float, b: float) -> None:
    mpmath.mp.dps = 40
    exact = float(mpmath.betainc(a, b, 0, mpmath.mpf(x), regularized=True))
    assert beta_cdf(x, a, b) == pytest.approx(exact, rel=1e-9)
    if 1e-12 < exact < 1 - 1e-6:
        assert beta_quantile(exact, a, b) == pytest.approx(x, rel=1e-8)


@pytest.mark.parametrize(("value", "degrees"), [(0.1, 1), (3.84, 1), (30.0, 63), (120.0, 63), (1e-3, 5), (900.0, 800)])
def test_chi_square_against_mpmath(value: float, degrees: int) -> None:
    mpmath.mp.dps = 40
    exact = float(mpmath.gammainc(mpmath.mpf(degrees) / 2, mpmath.mpf(value) / 2, mpmath.inf, regularized=True))
    assert chi2_tail(value, degrees) == pytest.approx(exact, rel=1e-10)
    assert chi2_quantile(1 - exact, degrees) == pytest.approx(value, rel=1e-6)


def test_the_95_percent_quantile() -> None:
    assert chi2_quantile(0.95, 1) == pytest.approx(CHI2_95, rel=1e-10)


def test_jeffreys_interval_at_its_ends() -> None:
    assert jeffreys_interval(0, 0) == (0.0, 1.0)
    low, high = jeffreys_interval(0, 1000)
    assert low == 0.0
    assert high == pytest.approx(2.51e-3, rel=0.01)
    assert jeffreys_interval(1000, 1000)[1] == 1.0
    low, high = jeffreys_interval(4_294_967_296 * 2, 4_294_967_296 * 4)  # counters past 2**32
    assert low == pytest.approx(0.5 - 7.5e-6, abs=1e-7)
    assert high == pytest.approx(0.5 + 7.5e-6, abs=1e-7)


@pytest.mark.parametrize(("exposures", "mean"), [(1000, 5.3), (10_000, 30.7), (300, 100.0)])
def test_jeffreys_interval_covers(exposures: int, mean: float) -> None:
    mpmath.mp.dps = 20
    p = mean / exposures
    covered = 0.0
    for clicks in range(int(mean + 12 * mean**0.5 + 12)):
        low, high = jeffreys_interval(clicks, exposures)
        if low <= p <= high:
            chance = mpmath.mpf(p) ** clicks * (1 - mpmath.mpf(p)) ** (exposures - clicks)
            covered += float(mpmath.binomial(exposures, clicks) * chance)
    assert 0.92 < covered < 0.985
