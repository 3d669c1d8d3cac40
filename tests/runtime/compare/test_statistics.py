"""The tests behind `pans compare`: against published examples, and against the sums that define them."""

from __future__ import annotations

import itertools
import math
from math import comb

import numpy as np
import pytest

from pans.runtime.compare.statistics import (
    fisher_exact,
    holm,
    mcnemar_exact,
    newcombe_difference,
    paired_difference,
    poisson_rates,
    quantile_ratio,
    rate_ratio,
)


@pytest.mark.parametrize(
    ("first", "second", "p"), [(1, 9, 22 / 1024), (5, 5, 1.0), (0, 0, 1.0), (0, 6, 2 / 64), (8, 2, 112 / 1024)]
)
def test_mcnemar_is_the_sign_test_of_discordant_pairs(first: int, second: int, p: float) -> None:
    assert mcnemar_exact(first, second) == pytest.approx(p)
    assert mcnemar_exact(second, first) == mcnemar_exact(first, second)


def test_mcnemar_over_all_signs_of_the_pairs() -> None:
    n, seen = 9, (2, 7)
    as_extreme = sum(abs(2 * sum(signs) - n) >= abs(seen[0] - seen[1]) for signs in itertools.product((0, 1), repeat=n))
    assert mcnemar_exact(*seen) == pytest.approx(as_extreme / 2**n)


def fisher_by_hand(right_1: int, n_1: int, right_2: int, n_2: int) -> float:
    """All tables of these margins, by whole numbers."""
    total = right_1 + right_2
    weights = [comb(n_1, k) * comb(n_2, total - k) if 0 <= total - k <= n_2 else 0 for k in range(n_1 + 1)]
    return sum(w for w in weights if w <= weights[right_1]) / comb(n_1 + n_2, total)


def test_fisher_against_all_tables_and_the_lady_who_tasted_tea() -> None:
    assert fisher_exact(3, 4, 1, 4) == pytest.approx(34 / 70)
    for right_1, right_2 in itertools.product(range(8), range(6)):
        assert fisher_exact(right_1, 7, right_2, 5) == pytest.approx(fisher_by_hand(right_1, 7, right_2, 5))
    assert fisher_exact(900, 1000, 800, 1000) == pytest.approx(fisher_by_hand(900, 1000, 800, 1000))


def test_newcombe_s_published_example() -> None:
    found = newcombe_difference(56, 70, 48, 80)  # Newcombe 1998, table II, example (a), method 10
    assert (found.value, round(found.low, 4), round(found.high, 4)) == (pytest.approx(0.2), 0.0524, 0.3339)
    assert math.isnan(newcombe_difference(0, 0, 1, 2).value)


def test_poisson_counts_of_equal_exposure_are_a_fair_coin() -> None:
    assert poisson_rates(9, 50, 1, 50) == pytest.approx(22 / 1024)
    assert poisson_rates(0, 50, 0, 70) == 1.0
    assert poisson_rates(3, 10, 1, 30) == pytest.approx(2 * sum(comb(4, k) * 0.25**k * 0.75 ** (4 - k) for k in (3, 4)))


def test_the_test_of_rates_alarms_no_more_often_than_it_says() -> None:
    for n, share in ((12, 0.3), (40, 0.5), (25, 0.9)):
        weights = [comb(n, k) * share**k * (1 - share) ** (n - k) for k in range(n + 1)]
        ps = [poisson_rates(k, round(1000 * share), n - k, round(1000 * (1 - share))) for k in range(n + 1)]
        assert 0 < sum(w for w, p in zip(weights, ps) if p <= 0.05) <= 0.05


def test_the_ratio_of_rates_has_the_interval_of_clopper_and_pearson() -> None:
    found = rate_ratio(5, 100, 5, 100)
    assert found.value == 1.0
    assert found.low == pytest.approx(0.1871 / 0.8129, rel=1e-3)  # 5 of 10: 0.1871 to 0.8129
    assert found.high == pytest.approx(0.8129 / 0.1871, rel=1e-3)
    assert rate_ratio(4, 100, 0, 100).high == math.inf
    assert rate_ratio(0, 100, 4, 100).low == 0.0
    assert rate_ratio(3, 100, 3, 300).value == pytest.approx(3.0)


def test_paired_differences() -> None:
    one, two = np.array([1.0, 1.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])
    found = paired_difference(one, two)
    half = 1.959964 * math.sqrt(1 / 3) / 2  # of 0, 1, 0, 1 the standard deviation is sqrt(1/3)
    assert (found.value, found.low, found.high) == pytest.approx((0.5, 0.5 - half, 1.0))


def test_holm_s_correction() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_quantiles_of_latencies_cover_and_find() -> None:
    rng = np.random.default_rng(7)
    covered = []
    for _ in range(40):
        first, second = (rng.lognormal(5, 0.5, 2000) for _ in range(2))
        found = quantile_ratio(first, second, 0.99)
        covered.append(found.ratio.low <= 1.0 <= found.ratio.high)
    assert sum(covered) >= 31  # of 40: 95 % are 38, with a standard deviation of 1.4
    slow = quantile_ratio(2.0 * rng.lognormal(5, 0.5, 2000), rng.lognormal(5, 0.5, 2000), 0.5)
    assert 1.8 < slow.ratio.low < 2.0 < slow.ratio.high < 2.2
    assert slow.first == pytest.approx(2 * math.exp(5), rel=0.1)


def test_blocks_widen_the_interval_of_what_comes_in_bursts() -> None:
    rng = np.random.default_rng(3)
    level = np.repeat(rng.lognormal(5, 0.6, 40), 100)  # 40 moods of 100 decisions
    noise, other = rng.lognormal(0, 0.1, 4000), rng.lognormal(5, 0.1, 4000)
    ratios = [quantile_ratio(one * noise, other, 0.5).ratio for one in (level, rng.permutation(level))]
    widths = [math.log(ratio.high / ratio.low) for ratio in ratios]
    assert widths[0] > 2 * widths[1]
