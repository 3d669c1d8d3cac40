"""The tests behind `pans compare`: against published examples, and against the draws that they speak of."""

import itertools
import math
from collections import Counter
from math import comb

import numpy as np
import pytest

from pans.report.compare import statistics


@pytest.mark.parametrize(
    ("first", "second", "p"), [(1, 9, 22 / 1024), (5, 5, 1.0), (0, 0, 1.0), (0, 6, 2 / 64), (8, 2, 112 / 1024)]
)
def test_mcnemar_is_the_sign_test_of_discordant_pairs(first: int, second: int, p: float) -> None:
    assert statistics.mcnemar_exact(first, second) == pytest.approx(p)
    assert statistics.mcnemar_exact(second, first) == statistics.mcnemar_exact(first, second)


def share_of_draws(right_1: int, n_1: int, right_2: int, n_2: int) -> float:
    """Draw in every possible way which objects are right: the share of draws whose first sample is no likelier than the one seen."""
    total = right_1 + right_2
    drawn = Counter(sum(one < n_1 for one in right) for right in itertools.combinations(range(n_1 + n_2), total))
    return sum(often for often in drawn.values() if often <= drawn[right_1]) / drawn.total()


def test_fisher_against_all_draws_and_the_lady_who_tasted_tea() -> None:
    assert statistics.fisher_exact(3, 4, 1, 4) == pytest.approx(34 / 70)
    for right_1, right_2 in itertools.product(range(8), range(6)):
        wanted = share_of_draws(right_1, 7, right_2, 5)
        assert statistics.fisher_exact(right_1, 7, right_2, 5) == pytest.approx(wanted)
    # scipy 1.17.1, stats.fisher_exact([[900, 100], [800, 200]])
    assert statistics.fisher_exact(900, 1000, 800, 1000) == pytest.approx(4.14623062e-10, rel=1e-8)


def test_newcombe_s_published_example() -> None:
    found = statistics.newcombe_difference(56, 70, 48, 80)  # Newcombe 1998, table II, example (a), method 10
    assert (found.value, round(found.low, 4), round(found.high, 4)) == (pytest.approx(0.2), 0.0524, 0.3339)
    assert math.isnan(statistics.newcombe_difference(0, 0, 1, 2).value)


def test_poisson_counts_of_equal_exposure_are_a_fair_coin() -> None:
    assert statistics.poisson_rates(9, 50, 1, 50) == pytest.approx(22 / 1024)
    assert statistics.poisson_rates(0, 50, 0, 70) == 1.0
    # 3 or 4 of 4 clicks in a quarter of the exposures, twice
    assert statistics.poisson_rates(3, 10, 1, 30) == pytest.approx(26 / 256)


def test_the_test_of_rates_alarms_no_more_often_than_it_says() -> None:
    for n, share in ((12, 0.3), (40, 0.5), (25, 0.9)):
        weights = [comb(n, k) * share**k * (1 - share) ** (n - k) for k in range(n + 1)]
        ps = [statistics.poisson_rates(k, round(1000 * share), n - k, round(1000 * (1 - share))) for k in range(n + 1)]
        assert 0 < sum(w for w, p in zip(weights, ps) if p <= 0.05) <= 0.05


def test_the_ratio_of_rates_has_the_interval_of_clopper_and_pearson() -> None:
    found = statistics.rate_ratio(5, 100, 5, 100)
    assert found.value == 1.0
    assert found.low == pytest.approx(0.1871 / 0.8129, rel=1e-3)  # 5 of 10: 0.1871 to 0.8129
    assert found.high == pytest.approx(0.8129 / 0.1871, rel=1e-3)
    assert statistics.rate_ratio(4, 100, 0, 100).high == math.inf
    assert statistics.rate_ratio(0, 100, 4, 100).low == 0.0
    assert statistics.rate_ratio(3, 100, 3, 300).value == pytest.approx(3.0)


def test_paired_differences() -> None:
    one, two = np.array([1.0, 1.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])
    found = statistics.paired_difference(one, two, 1.0)
    half = 1.959964 * math.sqrt(1 / 3) / 2  # of 0, 1, 0, 1 the standard deviation is sqrt(1/3)
    assert (found.value, found.low, found.high) == pytest.approx((0.5, 0.5 - half, 1.0))
    assert statistics.paired_difference(one, two).high == pytest.approx(0.5 + half)


def test_holm_s_correction() -> None:
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([]) == []
    assert statistics.holm([0.9, 0.8]) == [1.0, 1.0]


def test_quantiles_of_latencies_cover_and_find() -> None:
    rng = np.random.default_rng(7)
    covered = []
    for _ in range(40):
        first, second = (rng.lognormal(5, 0.5, 2000) for _ in range(2))
        found = statistics.quantile_ratio(first, second, 0.99)
        covered.append(found.ratio.low <= 1.0 <= found.ratio.high)
    assert sum(covered) >= 31  # of 40: 95 % are 38, with a standard deviation of 1.4
    slow = statistics.quantile_ratio(2.0 * rng.lognormal(5, 0.5, 2000), rng.lognormal(5, 0.5, 2000), 0.5)
    assert 1.8 < slow.ratio.low < 2.0 < slow.ratio.high < 2.2
    assert slow.first == pytest.approx(2 * math.exp(5), rel=0.1)


def test_blocks_widen_the_interval_of_what_comes_in_bursts() -> None:
    rng = np.random.default_rng(3)
    level = np.repeat(rng.lognormal(5, 0.6, 40), 100)  # 40 moods of 100 decisions
    noise, other = rng.lognormal(0, 0.1, 4000), rng.lognormal(5, 0.1, 4000)
    ratios = [statistics.quantile_ratio(one * noise, other, 0.5).ratio for one in (level, rng.permutation(level))]
    widths = [math.log(ratio.high / ratio.low) for ratio in ratios]
    assert widths[0] > 2 * widths[1]
