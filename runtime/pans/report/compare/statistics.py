"""Tests of two samples, two-sided, that a lean installation must compute itself: exact for counts, bootstrap for quantiles.

Sources: McNemar, Psychometrika 12 (1947), exact form; Fisher's exact test, two-sided by the probabilities that are not larger (Agresti,
Categorical Data Analysis, 3.5); Newcombe, Statistics in Medicine 17 (1998), method 10; Przyborowski and Wilenski, Biometrika 31 (1940) for
two Poisson counts; Clopper and Pearson, Biometrika 26 (1934); Kuensch, Annals of Statistics 17 (1989) for blocks; Holm, Scandinavian
Journal of Statistics 6 (1979).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import Z_95, beta_quantile, binomial_tail, wilson_interval

F64 = NDArray[np.float64]
SAME = 1e-9  # two probabilities closer than this, relative, count as equal
RESAMPLES = 1000
BLOCKS_MAX = 200  # stretches of consecutive decisions that are drawn together, as what follows each other is alike
BIN = math.log(1.01)  # width of a latency's bin: quantiles are right to 1 %
LEAST_US = 0.1


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


def mcnemar_exact(only_first: int, only_second: int) -> float:
    """Return the p-value for pairs of which one alone is right: `only_first` by the first, `only_second` by the second; 1 without any."""
    return min(1.0, 2 * binomial_tail(max(only_first, only_second), only_first + only_second, 0.5))


def paired_difference(first: F64, second: F64, limit: float = math.inf) -> Interval:
    """Return the mean of `first - second` over pairs, +-`limit` at most, with its 95 % interval by the spread of their differences."""
    differences = first - second
    mean = float(differences.mean())
    half = Z_95 * float(differences.std(ddof=1)) / math.sqrt(len(differences)) if len(differences) > 1 else limit
    return Interval(mean, max(mean - half, -limit), min(mean + half, limit))


def mean_difference(first: F64, second: F64) -> Interval:
    """Return the difference of the means of two samples, with its 95 % interval by their spreads."""
    apart = float(first.mean() - second.mean())
    half = Z_95 * math.sqrt(float(first.var(ddof=1)) / len(first) + float(second.var(ddof=1)) / len(second))
    return Interval(apart, apart - half, apart + half)


def fisher_exact(right_1: int, n_1: int, right_2: int, n_2: int) -> float:
    """Return the p-value of `right_1` of `n_1` against `right_2` of `n_2`."""
    total, n = right_1 + right_2, n_1 + n_2
    lowest, highest = max(0, total - n_2), min(total, n_1)
    logs = np.array([_log_choose(n_1, k) + _log_choose(n_2, total - k) for k in range(lowest, highest + 1)])
    logs -= _log_choose(n, total)
    seen = logs[right_1 - lowest]
    return float(min(1.0, np.exp(logs[logs <= seen + SAME]).sum()))


def newcombe_difference(right_1: float, n_1: int, right_2: float, n_2: int) -> Interval:
    """Return the difference of two shares with its 95 % interval from their Wilson intervals; nothing is known without data.

    `right` may be broken numbers: an object that was decided several times is partly right.
    """
    if not n_1 or not n_2:
        return Interval(math.nan, -1.0, 1.0)
    share_1, share_2 = right_1 / n_1, right_2 / n_2
    (low_1, high_1), (low_2, high_2) = wilson_interval(right_1, n_1), wilson_interval(right_2, n_2)
    difference = share_1 - share_2
    below = math.hypot(share_1 - low_1, high_2 - share_2)
    above = math.hypot(high_1 - share_1, share_2 - low_2)
    return Interval(difference, difference - below, difference + above)


def poisson_rates(clicks_1: int, exposures_1: int, clicks_2: int, exposures_2: int) -> float:
    """Return the p-value that two counts have the same rate: given their sum, the first is binomial.

    Twice the smaller tail, which is never too small.
    """
    n, share = clicks_1 + clicks_2, exposures_1 / (exposures_1 + exposures_2)
    above = binomial_tail(clicks_1, n, share)
    below = binomial_tail(clicks_2, n, 1 - share)
    return min(1.0, 2 * min(above, below))


def rate_ratio(clicks_1: int, exposures_1: int, clicks_2: int, exposures_2: int) -> Interval:
    """Return the ratio of two rates with its exact 95 % interval (Clopper and Pearson for the share of the first)."""
    n = clicks_1 + clicks_2
    low = 0.0 if not clicks_1 else beta_quantile(0.025, clicks_1, clicks_2 + 1)
    high = 1.0 if not clicks_2 else beta_quantile(0.975, clicks_1 + 1, clicks_2)
    scale = exposures_2 / exposures_1

    def ratio(share: float) -> float:
        return math.inf if share >= 1.0 else scale * share / (1.0 - share)

    return Interval(ratio(clicks_1 / n) if n else math.nan, ratio(low), ratio(high))


class QuantileRatio(NamedTuple):
    """A quantile of both samples, and the ratio of the first to the second with its 95 % interval."""

    first: float
    second: float
    ratio: Interval


def quantile_ratio(first: F64, second: F64, q: float, seed: int = 0) -> QuantileRatio:
    """Return quantile `q` of two series of latencies (microseconds, in the order of time) and their ratio, by a bootstrap of blocks."""
    rng = np.random.default_rng(seed)
    drawn = [_resampled_quantiles(_block_counts(values), q, rng) for values in (first, second)]
    ratios = drawn[0] / drawn[1]
    low, high = np.quantile(ratios, (0.025, 0.975))
    values = float(np.quantile(first, q)), float(np.quantile(second, q))
    value = max(values[0], LEAST_US) / max(values[1], LEAST_US)
    return QuantileRatio(*values, Interval(value, min(float(low), value), max(float(high), value)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values that are corrected for there being several (Holm 1979), in their order."""
    found, least = [0.0] * len(p_values), 0.0
    for rank, at in enumerate(sorted(range(len(p_values)), key=lambda one: p_values[one])):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[at]))
        found[at] = least
    return found


def _block_counts(values: F64) -> NDArray[np.int64]:
    """How many values of each block lie in each bin, (blocks, bins)."""
    bins = (np.log(np.maximum(values, LEAST_US) / LEAST_US) / BIN).astype(np.int64)
    blocks = min(BLOCKS_MAX, len(values))
    block = np.arange(len(values)) * blocks // len(values)
    counts = np.zeros((blocks, int(bins.max()) + 1), np.int64)
    np.add.at(counts, (block, bins), 1)
    return counts


def _resampled_quantiles(counts: NDArray[np.int64], q: float, rng: np.random.Generator) -> F64:
    """The quantile of each resample of the blocks, (RESAMPLES,)."""
    blocks = len(counts)
    times = rng.multinomial(blocks, np.full(blocks, 1 / blocks), RESAMPLES)
    drawn = times.astype(np.float64) @ counts.astype(np.float64)  # whole numbers, which floats multiply faster
    sums = np.cumsum(drawn, axis=1)
    at = (sums < np.ceil(q * sums[:, -1:])).sum(axis=1)
    return np.asarray(LEAST_US * np.exp(BIN * (at + 0.5)), np.float64)


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
