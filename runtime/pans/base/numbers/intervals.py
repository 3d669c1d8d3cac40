"""Intervals and tail probabilities of counts that a lean installation must compute itself: binomial, beta and chi-square, scalar float64.

Sources: Jeffreys interval in Brown, Cai and DasGupta, Statistical Science 16 (2001); continued fractions by Lentz's method, series and
fraction of the incomplete gamma function as in the NIST Digital Library of Mathematical Functions, 8.7, 8.9 and 8.17.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

_TINY = 1e-300
_EPSILON = 1e-16
Z_95 = 1.959963984540054  # 0.975 quantile of the normal distribution: what a two-sided 95 % interval takes
CHI2_95 = 3.841458820694124  # 0.95 quantile of chi-square with one degree of freedom

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}  # that are reported of durations


def has_quantile(n: int, q: float) -> bool:
    """Return whether `n` samples are enough for quantile `q`: one of them is expected beyond it.

    >>> has_quantile(99, 0.99), has_quantile(100, 0.99)
    (False, True)
    """
    return n >= round(1 / (1 - q))


def number(value: float) -> str:
    """Return a number in three digits, thousands with commas.

    >>> number(0.000012), number(1234.5), number(0.25)
    ('1.2e-05', '1,234', '0.25')
    """
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def beta_cdf(x: float, a: float, b: float) -> float:
    """Return I_x(a, b), the probability that a Beta(a, b) variable is at most x; relative error about 1e-12 where a + b is
    below 1e9.
    """
    if x <= 0.0:
        return 0.0
    if x >= 1.0:
        return 1.0
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    if x < (a + 1.0) / (a + b + 2.0):
        return min(1.0, math.exp(log_front) * _fraction(_beta_terms(x, a, b)) / a)
    return max(0.0, 1.0 - math.exp(log_front) * _fraction(_beta_terms(1.0 - x, b, a)) / b)


def jeffreys_interval(clicks: int, exposures: int, coverage: float = 0.95) -> tuple[float, float]:
    """Return the equal-tailed Jeffreys interval of a click probability; 0 and 1 are its ends where no click, or no miss, was seen.

    Without data (0, 1). Averaged over rates it covers the truth as often as it says; at a single small rate counts are too
    coarse for that."""
    if exposures == 0:
        return 0.0, 1.0
    tail = 0.5 * (1.0 - coverage)
    a, b = clicks + 0.5, exposures - clicks + 0.5
    low = 0.0 if clicks == 0 else beta_quantile(tail, a, b)
    high = 1.0 if clicks == exposures else beta_quantile(1.0 - tail, a, b)
    return low, high


def wilson_interval(clicks: float, exposures: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a click probability (Wilson 1927); (0, 1) without data."""
    if exposures == 0:
        return 0.0, 1.0
    z2 = Z_95 * Z_95
    rate = clicks / exposures
    centre = (rate + z2 / (2 * exposures)) / (1 + z2 / exposures)
    half = Z_95 / (1 + z2 / exposures) * math.sqrt(rate * (1 - rate) / exposures + z2 / (4 * exposures**2))
    return (0.0 if clicks == 0 else centre - half), (1.0 if clicks == exposures else centre + half)


def binomial_tail(clicks: int, exposures: int, probability: float) -> float:
    """Return P(X >= clicks) for X ~ Binomial(exposures, probability).

    Terms are summed from the first down their geometric decay, so that tails down to 1e-300 keep their digits; below, 0.
    """
    if clicks <= 0:
        return 1.0
    if probability <= 0.0:
        return 0.0
    if probability >= 1.0 or clicks <= exposures * probability:
        return 1.0  # at or below the mean nothing is alarming: the exact value, at least about a half, is not needed
    log_term = (
        math.lgamma(exposures + 1)
        - math.lgamma(clicks + 1)
        - math.lgamma(exposures - clicks + 1)
        + clicks * math.log(probability)
        + (exposures - clicks) * math.log1p(-probability)
    )
    odds = probability / (1.0 - probability)
    total, term, k = 1.0, 1.0, clicks
    while k < exposures and term > 1e-17 * total:
        term *= odds * (exposures - k) / (k + 1)
        total += term
        k += 1
    return min(1.0, math.exp(log_term) * total) if log_term > -700 else 0.0


def beta_quantile(probability: float, a: float, b: float) -> float:
    """Return the x with I_x(a, b) = `probability`, by bisection of the logit: right to 1e-12 also at 1e-12."""
    high = bisect(lambda t: beta_cdf(1.0 / (1.0 + math.exp(-t)), a, b) - probability, -80.0, 36.0)
    return 1.0 / (1.0 + math.exp(-high))


def chi2_tail(value: float, degrees: float) -> float:
    """Return the probability that a chi-square variable of `degrees` degrees of freedom is at least `value`."""
    x, a = 0.5 * value, 0.5 * degrees
    if x <= 0.0:
        return 1.0
    log_front = a * math.log(x) - x - math.lgamma(a)
    if x < a + 1.0:
        term = total = 1.0 / a
        k = a
        while term > _EPSILON * total:
            k += 1.0
            term *= x / k
            total += term
        return max(0.0, 1.0 - total * math.exp(log_front))
    return math.exp(log_front) * _fraction(_gamma_terms(x, a))


def chi2_quantile(probability: float, degrees: float) -> float:
    """Return the value that a chi-square variable of `degrees` degrees of freedom stays below with `probability`."""
    top = degrees + 20.0 * math.sqrt(2.0 * degrees) + 200.0
    return bisect(lambda value: (1.0 - chi2_tail(value, degrees)) - probability, 0.0, top)


def bisect(rising: Callable[[float], float], low: float, high: float) -> float:
    """Return where `rising` passes 0 between `low` and `high`, to the last digit and from above."""
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if rising(middle) < 0 else (low, middle)
    return high


def _fraction(terms: Iterable[tuple[float, float]]) -> float:
    """The continued fraction a1 / (b1 + a2 / (b2 + ...)) of pairs (a, b), by Lentz."""
    result, c, d = _TINY, _TINY, 0.0
    for a, b in terms:
        d = 1.0 / (b + a * d or _TINY)
        c = b + a / c or _TINY
        result *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return result


def _beta_terms(x: float, a: float, b: float) -> Iterator[tuple[float, float]]:
    yield 1.0, 1.0
    for m in range(100_000):
        if m:
            yield m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m)), 1.0
        yield -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0)), 1.0


def _gamma_terms(x: float, a: float) -> Iterator[tuple[float, float]]:
    yield 1.0, x + 1.0 - a
    yield from ((-n * (n - a), x + 1.0 - a + 2.0 * n) for n in range(1, 100_000))
