"""Maximum likelihood under the click law: the photon level, the dark rate and the non-uniformity behind counts of clicks.

`fit_light` takes counts at known drives (lit levels of a pattern on a clear field) and returns the maximum and its intervals,
where the likelihood has fallen by what 95 % allow. The estimate is of photoelectrons per level and exposure: flux, transmission and
efficiency together; clicks cannot tell them apart.

Model: an exposure of drive s has mean `mu = s theta + delta`, of which dead time leaves the counted mean (dead_time.py); it stays
silent with the click law's probability, times (1 - p_ap) after a click, times what crosstalk leaves. Afterpulsing, crosstalk,
dead time, read noise and threshold are the profile's; they are not fitted. Intervals by profile likelihood: right to second
order, one-sided at 0 and at saturation, where Wald's break down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import CHI2_95, Z_95, bisect, chi2_quantile, chi2_tail
from pans.instrument.click_law import ClickLaw, log_no_click
from pans.instrument.detector import mean_of_most_clicks

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
SATURATED = 60.0  # photoelectrons: from here on every exposure clicks, whatever the law
_FLOOR = 1e-14  # photoelectrons per exposure: less is none
_STEPS_MAX = 200
LEVEL, DARK = 0, 1  # the two parameters


class Counts(NamedTuple):
    """Exposures that are alike, (g,) each: drive in levels, clicks (int64) of exposures (int64), the log probability that
    nothing but light and dark counts fired it (float64), and the number of the pattern (-1: dark).
    """

    drive: F64
    clicks: I64
    exposures: I64
    log_other: F64
    pattern: I64


class Interval(NamedTuple):
    """A maximum-likelihood estimate with its 95 % interval; `high` is inf where the data set no bound."""

    value: float
    low: float
    high: float


class LightFit(NamedTuple):
    """Photoelectrons per level and exposure, dark photoelectrons per exposure, both with intervals, and the log likelihood."""

    level: Interval
    dark: Interval
    log_likelihood: float


class Spread(NamedTuple):
    """Non-uniformity of patterns: relative standard deviation (random effects) with its interval, and the test that there is
    none.
    """

    relative: Interval
    p_value: float
    patterns: int
    mean: Interval  # of the patterns' levels relative to the fit's: what the mean pattern has


@dataclass(frozen=True, slots=True)
class CountModel:
    """What of the detector is taken as known: the law without its dark counts.

    Light beyond the most clicks that a paralysed detector gives is taken as that light: clicks cannot tell the two apart.
    """

    law: ClickLaw

    def log_miss(self, mean: F64) -> F64:
        """Log probability that `mean` photoelectrons (any shape, up to some hundreds) leave the exposure silent."""
        return log_no_click(self.law, np.minimum(mean, mean_of_most_clicks(self.law.dead_time)))

    def log_miss_slope(self, mean: F64) -> F64:
        """Its derivative by a central difference, right to about 1e-6: steps and variances need no more."""
        step = np.maximum(1e-5 * mean, 1e-10)
        low = np.maximum(mean - step, 0.0)
        return np.asarray((self.log_miss(mean + step) - self.log_miss(low)) / (mean + step - low))


def log_likelihood(counts: Counts, model: CountModel, level: float, dark: float) -> float:
    """Return the log likelihood without its binomial constants; -inf where the rates forbid what was seen."""
    log_miss = model.log_miss(counts.drive * level + dark) + counts.log_other
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = np.where(counts.clicks > 0, counts.clicks * np.log(-np.expm1(log_miss)), 0.0)
    return float((hits + (counts.exposures - counts.clicks) * log_miss).sum())


def fit_light(counts: Counts, model: CountModel) -> LightFit:
    """Return the photon level and the dark rate that make `counts` most likely, with their 95 % intervals.

    ValueError without lit exposures. All silent: the level is 0 and `high` bounds it; all clicked: the level is inf and `low`
    bounds it.
    """
    counts = _merged(counts)
    lit = counts.drive > 0
    if not counts.exposures[lit].sum():
        raise ValueError("no exposure with light: nothing to estimate a photon level from")
    top = SATURATED / float(counts.drive[lit].min())
    fit = _Profile(counts, model, top)
    level, dark, best = fit.maximum()
    silent, full = not counts.clicks[lit].any(), bool((counts.clicks[lit] == counts.exposures[lit]).all())
    low = 0.0 if silent else fit.bound(LEVEL, level, best, upward=False)
    high = math.inf if full else fit.bound(LEVEL, level, best, upward=True)
    no_dark = best - fit.height(DARK, _FLOOR) < 0.5 * CHI2_95
    dark_low = 0.0 if no_dark else fit.bound(DARK, dark, best, upward=False)
    dark_high = fit.bound(DARK, dark, best, upward=True)
    shown_level = 0.0 if silent else math.inf if full else level
    return LightFit(
        Interval(shown_level, low, high), Interval(0.0 if dark <= 2 * _FLOOR else dark, dark_low, dark_high), best
    )


def _merged(counts: Counts) -> Counts:
    """Add up what is alike but for the number of its pattern."""
    keys, own = np.unique(np.column_stack([counts.drive, counts.log_other]), axis=0, return_inverse=True)
    clicks, exposures = np.zeros(len(keys), np.int64), np.zeros(len(keys), np.int64)
    np.add.at(clicks, own.ravel(), counts.clicks)
    np.add.at(exposures, own.ravel(), counts.exposures)
    return Counts(keys[:, 0], clicks, exposures, keys[:, 1], np.full(len(keys), -1))


class _Profile:
    """The likelihood of one data set in level and dark rate: its maximum, and its height along one with the other at its best."""

    def __init__(self, counts: Counts, model: CountModel, top: float) -> None:
        self.counts, self.model, self.tops = counts, model, (top, SATURATED)
        self._warm: dict[int, float] = {}  # where a parameter was best last time

    def maximum(self) -> tuple[float, float, float]:
        """Return level, dark and log likelihood at the maximum."""
        counts, lit = self.counts, self.counts.drive > 0
        n_dark, k_dark = int(counts.exposures[~lit].sum()), int(counts.clicks[~lit].sum())
        dark = -math.log1p(-min(k_dark, n_dark - 0.5) / n_dark) if n_dark and k_dark else _FLOOR
        drive = float(np.average(counts.drive[lit], weights=counts.exposures[lit]))
        share = counts.clicks[lit].sum() / counts.exposures[lit].sum()
        level = min(max(-math.log1p(-min(share, 1 - 1e-9)) - dark, 1e-3) / drive, self.tops[0])
        (level, dark), value = self._climb((level, dark), (LEVEL, DARK))
        return level, dark, value

    def height(self, fixed: int, value: float) -> float:
        """Return the height where LEVEL or DARK is `value` and the other one at its best."""
        other = 1 - fixed
        begin = min(max(self._warm.get(other, _FLOOR), _FLOOR), self.tops[other])
        at = (value, begin) if fixed == LEVEL else (begin, value)
        if log_likelihood(self.counts, self.model, *at) == -math.inf:
            begin = 1e-3 * (1.0 if other == DARK else self.tops[LEVEL])
            at = (value, begin) if fixed == LEVEL else (begin, value)
        at, height = self._climb(at, (other,))
        self._warm[other] = at[other]
        return height

    def bound(self, which: int, best_at: float, best: float, *, upward: bool) -> float:
        """Return where twice the fall from `best` is the 95 % quantile of chi-square(1), on one side of the maximum."""

        def fall(log_x: float) -> float:
            return 2.0 * (best - self.height(which, math.exp(log_x))) - CHI2_95

        inside, reach = math.log(max(best_at, _FLOOR)), 0.02 if upward else -0.02
        while fall(inside + reach) < 0:
            inside, reach = inside + reach, 2.0 * reach
            if inside > 40 or inside < math.log(_FLOOR):
                return math.inf if upward else 0.0
        outside = inside + reach
        low, high, side = fall(inside), fall(outside), 0
        for _ in range(60):  # regula falsi with the Illinois correction
            middle = (inside * high - outside * low) / (high - low)
            value = fall(middle)
            if abs(value) < 1e-7 or abs(outside - inside) < 1e-12:
                return math.exp(middle)
            if value > 0:
                outside, high = middle, value
                low, side = (0.5 * low if side == 1 else low), 1
            else:
                inside, low = middle, value
                high, side = (0.5 * high if side == -1 else high), -1
        return math.exp(0.5 * (inside + outside))

    def _climb(self, at: tuple[float, float], free: tuple[int, ...]) -> tuple[tuple[float, float], float]:
        """Go from `at` to the maximum in the `free` parameters by Fisher scoring; return where it is and its height."""
        value = log_likelihood(self.counts, self.model, *at)
        for _ in range(_STEPS_MAX):
            moved = self._higher(at, self._step(at, free), value)
            if moved is None:
                break
            gain = moved[1] - value
            at, value = moved
            if gain < 1e-10 * (1 + 1e-3 * abs(value)):
                break
        return at, value

    def _higher(self, at: tuple[float, float], step: F64, value: float) -> tuple[tuple[float, float], float] | None:
        """Return the first point along `step` that is higher, or None; no parameter falls by more than nine tenths at once."""
        for halving in range(40):
            level, dark = (
                min(max(x + part, 0.1 * x, _FLOOR), top) if part else x
                for x, part, top in zip(at, (step * 0.5**halving).tolist(), self.tops)
            )
            found = log_likelihood(self.counts, self.model, level, dark)
            if found > value:
                return (level, dark), found
        return None

    def _step(self, at: tuple[float, float], free: tuple[int, ...]) -> F64:
        """The scoring step (2,); in one parameter where the other is fixed, or where data cannot tell the two apart."""
        score, information = self._scores(*at)
        if len(free) == 2:
            determinant = information[0, 0] * information[1, 1] - information[0, 1] ** 2
            at_floor = at[DARK] <= _FLOOR and score[DARK] < 0
            if not at_floor and determinant > 1e-14 * information[0, 0] * information[1, 1]:
                return np.asarray(np.linalg.solve(information, score), np.float64)
        step, one = np.zeros(2), free[0]
        step[one] = score[one] / information[one, one] if information[one, one] > 0 else 0.0
        return step

    def _scores(self, level: float, dark: float) -> tuple[F64, F64]:
        """Score (2,) and expected information (2, 2) in level and dark."""
        counts, mean = self.counts, self.counts.drive * level + dark
        log_miss = self.model.log_miss(mean) + counts.log_other
        p = np.maximum(-np.expm1(log_miss), 1e-300)
        q = np.maximum(np.exp(log_miss), 1e-300)
        slope = -q * self.model.log_miss_slope(mean)
        weight = slope / (p * q)
        residual = weight * (counts.clicks - counts.exposures * p)
        load = counts.exposures * weight * slope
        score = np.array([residual @ counts.drive, residual.sum()])
        cross = load @ counts.drive
        return score, np.array([[load @ counts.drive**2, cross], [cross, load.sum()]])


def fit_spread(counts: Counts, model: CountModel, level: float, dark: float) -> Spread:
    """Return the non-uniformity of the patterns: is each one's light what its drive says, times one common level?

    Each pattern's own level is fitted, relative to `level`; patterns that were always or never seen say nothing and are left
    out. The spread is Paule and Mandel's estimate, its interval the Q profile (Viechtbauer, Statistics in Medicine 26, 2007),
    the test Cochran's Q."""
    log_levels, variances = _pattern_levels(counts, model, level, dark)
    n = len(log_levels)
    if n < 3:
        return Spread(Interval(0.0, 0.0, math.inf), 1.0, n, Interval(1.0, 0.0, math.inf))

    def heterogeneity(tau2: float) -> float:
        weights = 1.0 / (variances + tau2)
        centre = weights @ log_levels / weights.sum()
        return float(weights @ (log_levels - centre) ** 2)

    def spread_at(q: float) -> float:
        """The tau at which the heterogeneity is q; it falls with tau."""
        if heterogeneity(0.0) <= q:
            return 0.0
        high = 1.0
        while heterogeneity(high) > q:
            high *= 4.0
        return math.sqrt(bisect(lambda tau2: q - heterogeneity(tau2), 0.0, high))

    tau = spread_at(n - 1.0)
    ends = spread_at(chi2_quantile(0.975, n - 1)), spread_at(chi2_quantile(0.025, n - 1))
    weights = 1.0 / (variances + tau * tau)
    centre, half = float(weights @ log_levels / weights.sum()), Z_95 / math.sqrt(weights.sum())
    mean = Interval(math.exp(centre), math.exp(centre - half), math.exp(centre + half))
    return Spread(Interval(tau, *ends), chi2_tail(heterogeneity(0.0), n - 1), n, mean)


def _pattern_levels(counts: Counts, model: CountModel, level: float, dark: float) -> tuple[F64, F64]:
    """Log of each pattern's level relative to `level` and its variance, both (patterns that say something,), by scoring all at
    once.
    """
    lit = counts.pattern >= 0
    _, own = np.unique(counts.pattern[lit], return_inverse=True)
    drive, clicks, exposures = counts.drive[lit], counts.clicks[lit], counts.exposures[lit]
    n_patterns = int(own.max()) + 1
    seen, shown = np.bincount(own, clicks, n_patterns), np.bincount(own, exposures, n_patterns)
    log_levels, information = np.zeros(n_patterns), np.ones(n_patterns)
    for _ in range(30):
        light = drive * level * np.exp(log_levels)[own]
        log_miss = model.log_miss(light + dark) + counts.log_other[lit]
        p, q = np.maximum(-np.expm1(log_miss), 1e-300), np.maximum(np.exp(log_miss), 1e-300)
        slope = -q * model.log_miss_slope(light + dark) * light  # with respect to the log of the level
        score = np.bincount(own, slope / (p * q) * (clicks - exposures * p), n_patterns)
        information = np.maximum(np.bincount(own, exposures * slope**2 / (p * q), n_patterns), 1e-300)
        step = np.clip(score / information, -1.0, 1.0)
        log_levels = np.clip(log_levels + step, -8.0, 8.0)
        if np.abs(step).max() < 1e-10:
            break
    telling = (seen > 0) & (seen < shown) & (information > 1e-6)
    return log_levels[telling], 1.0 / information[telling]
