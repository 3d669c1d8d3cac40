"""Beta, chi-square, binomial tails and intervals against 40 digits, and their coverage."""

from fractions import Fraction
from math import comb

import pytest

from pans.base.numbers import intervals
from pans.decide.dark.health import dark_report

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")


@pytest.mark.parametrize(
    ("x", "a", "b"), [(0.3, 0.5, 10.5), (1e-9, 0.5, 1e6), (2e-4, 100.5, 1e6), (0.9, 900.5, 100.5), (0.5, 3.0, 3.0)]
)
def test_beta_against_mpmath(x: float, a: float, b: float) -> None:
    mpmath.mp.dps = 40
    exact = float(mpmath.betainc(a, b, 0, mpmath.mpf(x), regularized=True))
    assert intervals.beta_cdf(x, a, b) == pytest.approx(exact, rel=1e-9)
    if 1e-12 < exact < 1 - 1e-6:
        assert intervals.beta_quantile(exact, a, b) == pytest.approx(x, rel=1e-8)


@pytest.mark.parametrize(("value", "degrees"), [(0.1, 1), (3.84, 1), (30.0, 63), (120.0, 63), (1e-3, 5), (900.0, 800)])
def test_chi_square_against_mpmath(value: float, degrees: int) -> None:
    mpmath.mp.dps = 40
    exact = float(mpmath.gammainc(mpmath.mpf(degrees) / 2, mpmath.mpf(value) / 2, mpmath.inf, regularized=True))
    assert intervals.chi2_tail(value, degrees) == pytest.approx(exact, rel=1e-10)
    assert intervals.chi2_quantile(1 - exact, degrees) == pytest.approx(value, rel=1e-6)


def test_the_95_percent_quantile() -> None:
    assert intervals.chi2_quantile(0.95, 1) == pytest.approx(intervals.CHI2_95, rel=1e-10)


def test_jeffreys_interval_at_its_ends() -> None:
    assert intervals.jeffreys_interval(0, 0) == (0.0, 1.0)
    low, high = intervals.jeffreys_interval(0, 1000)
    assert low == 0.0
    assert high == pytest.approx(2.51e-3, rel=0.01)
    assert intervals.jeffreys_interval(1000, 1000)[1] == 1.0
    low, high = intervals.jeffreys_interval(4_294_967_296 * 2, 4_294_967_296 * 4)  # counters past 2**32
    assert low == pytest.approx(0.5 - 7.5e-6, abs=1e-7)
    assert high == pytest.approx(0.5 + 7.5e-6, abs=1e-7)


@pytest.mark.parametrize(("exposures", "mean"), [(1000, 5.3), (10_000, 30.7), (300, 100.0)])
def test_jeffreys_interval_covers(exposures: int, mean: float) -> None:
    mpmath.mp.dps = 20
    p = mean / exposures
    covered = 0.0
    for clicks in range(int(mean + 12 * mean**0.5 + 12)):
        low, high = intervals.jeffreys_interval(clicks, exposures)
        if low <= p <= high:
            chance = mpmath.mpf(p) ** clicks * (1 - mpmath.mpf(p)) ** (exposures - clicks)
            covered += float(mpmath.binomial(exposures, clicks) * chance)
    assert 0.92 < covered < 0.985


@pytest.mark.parametrize(
    ("clicks", "exposures", "p"), [(30, 10**9, 1e-9), (3, 10**9, 1e-12), (200, 10**6, 1e-5), (100, 10**6, 1e-5)]
)
def test_tail_with_many_exposures_and_tiny_rates(clicks: int, exposures: int, p: float) -> None:
    mpmath.mp.dps = 40
    exact = mpmath.betainc(clicks, exposures - clicks + 1, 0, mpmath.mpf(p), regularized=True)
    assert intervals.binomial_tail(clicks, exposures, p) == pytest.approx(float(exact), rel=1e-6)


@pytest.mark.parametrize("p", [0.0, 1e-9, 1e-3, 0.3, 0.9, 1.0])
@pytest.mark.parametrize("n", [1, 20, 150])
def test_tails_are_exact(p: float, n: int) -> None:
    """Relative error at most 1e-10 above the mean (at or below it the alarm does not ask)."""
    exact_p = Fraction(p)
    for clicks in {0, 1, n // 3, n - 1, n}:
        exact = sum((comb(n, k) * exact_p**k * (1 - exact_p) ** (n - k) for k in range(clicks, n + 1)), Fraction(0))
        found = intervals.binomial_tail(clicks, n, p)
        if clicks <= n * p:
            assert found == 1.0
        elif exact > Fraction(1, 10**290):
            assert abs(Fraction(found) - exact) <= exact * Fraction(1, 10**10)
        else:
            assert 0 <= found <= 1e-289


@pytest.mark.parametrize(
    ("clicks", "exposures"), [(0, 10), (1, 1000), (500, 1000), (1000, 1000), (3 * 10**9 + 7, 10**12 + 1)]
)
def test_wilson_interval_is_the_root_of_its_definition(clicks: int, exposures: int) -> None:
    with mpmath.workdps(40):
        z, n, rate = mpmath.mpf("1.959963984540054"), mpmath.mpf(exposures), mpmath.mpf(clicks) / exposures
        centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * mpmath.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
        for found, exact in zip(
            intervals.wilson_interval(clicks, exposures), (centre - half, centre + half), strict=True
        ):
            assert abs(found - exact) <= 1e-15 * centre
    assert intervals.wilson_interval(0, 0) == (0.0, 1.0)


def test_alarm_only_when_the_profile_is_contradicted() -> None:
    assert dark_report(1e-4, 10_000, 3).alarm == dark_report(1e-4, 0, 0).alarm == ""
    assert "30 clicks in 10000 dark exposures" in dark_report(1e-4, 10_000, 30).alarm
    assert dark_report(0.0, 100, 1).alarm
