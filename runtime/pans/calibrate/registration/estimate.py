"""Clicks under known patterns in; the most likely place of a known target, its intervals and the misfit out.

Pure functions of arrays. The likelihood is that of the click law with light and dark counts as unknowns; read noise, threshold,
dead time and afterpulses are the profile's. The search begins on a grid over shifts and rotations, 1 px and 2.5 degrees apart; the best few
are followed by Fisher scoring, so that a target whose structure is coarser than a step is not missed. Intervals (95 %) are those of
the Fisher information at the estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import CHI2_95, chi2_tail
from pans.calibrate.estimate import SATURATED, Counts

from .parameters import DARK, FLAT, PARAMETERS, PSF_SEEN_FROM, Bench

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
SHIFTS = np.arange(-3.0, 3.5, 1.0)
ROTATIONS = np.arange(-5.0, 5.5, 2.5)
PSF_START = 0.7
STARTS, FIRST_STEPS, STEPS_MAX = 3, 3, 40
SETTLED = 1e-4  # gain of the log likelihood in a step: of about 0.01 standard errors
LEAST_EXPECTED = 5.0  # clicks, and silent exposures, of a group in Pearson's sum


class Observed(NamedTuple):
    """Groups of exposures that are alike, (g,) each: the row of `patterns` (pixels) that was shown (-1: dark), clicks of exposures,
    and the log probability that nothing but light and dark counts fired them.
    """

    patterns: F64
    pattern: I64
    clicks: I64
    exposures: I64
    log_other: F64

    @staticmethod
    def of(patterns: F64, counts: Counts) -> Observed:
        """Return what was counted under `patterns`, levels (patterns, pixels)."""
        some = counts.exposures > 0
        return Observed(
            patterns, counts.pattern[some], counts.clicks[some], counts.exposures[some], counts.log_other[some]
        )

    def joined(self, other: Observed) -> Observed:
        """Return both measurements as one."""
        moved = np.where(other.pattern < 0, -1, other.pattern + len(self.patterns))
        columns = (np.concatenate(pair) for pair in zip(self[2:], other[2:]))
        return Observed(np.vstack([self.patterns, other.patterns]), np.append(self.pattern, moved), *columns)

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Which groups showed a pattern."""
        return self.pattern >= 0


@dataclass(frozen=True, slots=True)
class Estimate:
    """The most likely vector (parameters.py), its covariance (13, 13), and how well it explains the counts.

    `chi2` is Pearson's over `degrees`; `p_value` the chance of more if the model is right.
    """

    values: F64
    covariance: F64
    log_likelihood: float
    chi2: float
    degrees: int
    clicks: int
    exposures: int

    @property
    def errors(self) -> F64:
        """Standard errors of the vector, float64 (13,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def p_value(self) -> float:
        """The chance of more than `chi2` if the model is right."""
        return chi2_tail(self.chi2, self.degrees)

    def intervals(self) -> F64:
        """95 % intervals of `PARAMETERS`, float64 (12, 2); what cannot be negative begins at 0."""
        half = math.sqrt(CHI2_95) * self.errors[:DARK]
        ends = np.stack([self.values[:DARK] - half, self.values[:DARK] + half], axis=1)
        for index, one in enumerate(PARAMETERS):
            if one.name in ("psf_px", "black", "gain"):
                ends[index] = np.maximum(ends[index], 0.0)
            if one.name == "psf_px" and ends[index, 0] <= PSF_SEEN_FROM:
                ends[index, 0] = 0.0
        return ends


class Library:
    """The target's appearance at every place of the coarse search: made once for a target, used for any patterns and counts."""

    def __init__(self, bench: Bench, shifts: F64 = SHIFTS, rotations: F64 = ROTATIONS) -> None:
        grid = np.stack(np.meshgrid(shifts, shifts, rotations, indexing="ij"), axis=-1).reshape(-1, 3)
        rest = np.tile([1.0, PSF_START], (len(grid), 1))
        self.geometry: F64 = np.hstack([grid, rest])
        self.appearance: F64 = np.array([bench.appearance(row) for row in self.geometry])


def estimate(bench: Bench, observed: Observed, library: Library | None = None, start: F64 | None = None) -> Estimate:
    """Return the most likely vector; `start` is a vector to begin at, in the place of the search in `library`.

    ValueError where no exposure with light clicked, or every one did.
    """
    lit = observed.lit
    if not observed.clicks[lit].any() or (observed.clicks[lit] == observed.exposures[lit]).all():
        raise ValueError(f"{'every' if observed.clicks[lit].any() else 'no'} exposure with light clicked")
    fit = _Fit(bench, observed)
    starts = [start] if start is not None else coarse(bench, observed, library or Library(bench))
    tried = [fit.climb(vector, FIRST_STEPS) for vector in starts]
    vector, value = fit.climb(max(tried, key=lambda one: one[1])[0], STEPS_MAX)
    chi2, cells = fit.misfit(vector)
    return Estimate(
        vector,
        fit.covariance(vector),
        value,
        chi2,
        max(1, cells - DARK - 1),
        int(observed.clicks.sum()),
        int(observed.exposures.sum()),
    )


def coarse(bench: Bench, observed: Observed, library: Library, count: int = STARTS) -> list[F64]:
    """Return the `count` best vectors of the search: at every place, light and background are fitted to the means that the clicks tell."""
    lit = observed.lit
    rows, means = observed.pattern[lit], _means_of_shares(bench, observed)[lit]
    shapes = observed.patterns @ library.appearance.T * bench.photons_per_level
    shapes = shapes[rows]  # (groups, places)
    weight = observed.exposures[lit] / np.maximum(means, np.median(means) / 10)  # variance of a mean, nearly
    mean_x, mean_y = weight @ shapes / weight.sum(), weight @ means / weight.sum()
    x, y = shapes - mean_x, means - mean_y
    xy, xx = (weight * y) @ x, weight @ (x * x)
    slope = np.maximum(xy, 0.0) / xx
    rest = (weight * y) @ y - slope * xy
    dark = -math.log1p(-observed.clicks[~lit].sum() / (observed.exposures[~lit].sum() + 1))
    result = []
    for place in np.argsort(rest)[:count]:
        gain = max(float(slope[place]), 0.02)
        whole = gain * bench.photons_per_level * (bench.levels - 1) * library.appearance[place].sum()
        black = (float(mean_y - slope[place] * mean_x[place]) - dark) / whole
        fixed = [gain, min(max(black, 1e-5), 0.02), *np.zeros(len(FLAT)), dark]
        result.append(np.concatenate([library.geometry[place], fixed]))
    return result


def _means_of_shares(bench: Bench, observed: Observed) -> F64:
    """The mean photoelectrons that each group's share of clicks tells by itself, float64 (g,)."""
    grid = np.expm1(np.linspace(0.0, math.log1p(SATURATED), 2000))
    log_miss = bench.model.log_miss(grid)
    share = (observed.clicks + 0.25) / (observed.exposures + 0.5)
    return np.interp(-(np.log1p(-share) - observed.log_other), -log_miss, grid)


class _Fit:
    """The likelihood of one measurement."""

    def __init__(self, bench: Bench, observed: Observed) -> None:
        self.bench, self.observed = bench, observed
        self.patterns = np.vstack([observed.patterns, np.zeros(observed.patterns.shape[1])])
        self.row = np.where(observed.lit, observed.pattern, len(observed.patterns))
        self.low = np.array([one.low for one in PARAMETERS] + [0.0])
        self.high = np.array([one.high for one in PARAMETERS] + [10.0])

    def log_miss(self, vector: F64) -> F64:
        """Return the log probability of no click in each group."""
        means = self.bench.means(vector, self.patterns)
        means[-1] = max(vector[DARK], _LEAST_DARK)
        return self.bench.model.log_miss(means)[self.row] + self.observed.log_other

    def value(self, vector: F64) -> float:
        """Return the log likelihood without binomial constants."""
        log_miss, clicks, exposures = self.log_miss(vector), self.observed.clicks, self.observed.exposures
        return float((clicks * np.log(-np.expm1(log_miss)) + (exposures - clicks) * log_miss).sum())

    def scores(self, vector: F64) -> tuple[F64, F64]:
        """Return the slope of the log likelihood (13,) and the expected information (13, 13)."""
        means, slopes = self.bench.slopes(vector, self.patterns)
        means[-1], slopes[-1, :DARK] = max(vector[DARK], _LEAST_DARK), 0.0
        miss_slopes = (self.bench.model.log_miss_slope(means)[:, None] * slopes)[self.row]
        log_miss = self.bench.model.log_miss(means)[self.row] + self.observed.log_other
        clicks, exposures = self.observed.clicks, self.observed.exposures
        odds = np.exp(log_miss) / -np.expm1(log_miss)
        score = (exposures - clicks) - clicks * odds
        return score @ miss_slopes, (miss_slopes * (exposures * odds)[:, None]).T @ miss_slopes

    def climb(self, vector: F64, steps: int) -> tuple[F64, float]:
        """Return the vector after at most `steps` steps of Fisher scoring, and its log likelihood."""
        vector = np.clip(vector, self.low, self.high)
        value = self.value(vector)
        for _ in range(steps):
            score, information = self.scores(vector)
            moved = self._step(vector, value, score, information)
            if moved is None:
                break
            gained, (vector, value) = moved[1] - value, moved
            if gained < SETTLED:
                break
        return vector, value

    def _step(self, vector: F64, value: float, score: F64, information: F64) -> tuple[F64, float] | None:
        """Return the first of ever shorter, ever more damped steps that gains; None where none does."""
        free = ~(((vector <= self.low) & (score < 0)) | ((vector >= self.high) & (score > 0)))
        free &= np.diag(information) > 0
        for damping in (0.0, 0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3):
            step = np.zeros_like(vector)
            part = information[np.ix_(free, free)]
            step[free] = np.linalg.lstsq(part + damping * np.diag(np.diag(part)), score[free], rcond=1e-14)[0]
            step *= min(1.0, float((_STRIDE / np.maximum(np.abs(step), 1e-300)).min()))
            there = np.clip(vector + step, self.low, self.high)
            height = self.value(there)
            if height > value:
                return there, height
        return None

    def covariance(self, vector: F64) -> F64:
        """Return the inverse of the information, (13, 13); what the data do not tell has a large finite variance."""
        _, information = self.scores(vector)
        scale = np.sqrt(np.maximum(np.diag(information), 1e-30))
        scaled = information / np.outer(scale, scale) + 1e-13 * np.eye(len(vector))
        return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))

    def misfit(self, vector: F64) -> tuple[float, int]:
        """Return Pearson's chi-square over groups with enough expected clicks and silences, and their number."""
        clicks, exposures, chance = self.observed.clicks, self.observed.exposures, -np.expm1(self.log_miss(vector))
        expected, variance = exposures * chance, exposures * chance * (1 - chance)
        enough = np.minimum(expected, exposures - expected) >= LEAST_EXPECTED
        return float(((clicks - expected)[enough] ** 2 / variance[enough]).sum()), int(enough.sum())


_LEAST_DARK = 1e-9  # photoelectrons per exposure
_STRIDE = np.array([0.8, 0.8, 2.0, 0.03, 0.4, math.inf, 0.02, 0.3, 0.3, 0.3, 0.3, 0.3, math.inf])  # most in one step


def pattern_residuals(bench: Bench, observed: Observed, vector: F64) -> tuple[F64, F64, F64]:
    """Return of every pattern the expected and the measured share of clicks, and their difference in standard errors, float64 (patterns,).

    Exposures behind a click and behind none are taken together.
    """
    lit, n = observed.lit, len(observed.patterns)
    row, exposures = observed.pattern[lit], observed.exposures[lit]
    chance = -np.expm1(bench.model.log_miss(bench.means(vector, observed.patterns))[row] + observed.log_other[lit])
    of_groups = (exposures, observed.clicks[lit], exposures * chance, exposures * chance * (1 - chance))
    shown, clicks, expected, variance = (np.bincount(row, values, n) for values in of_groups)
    shown = np.maximum(shown, 1.0)
    return expected / shown, clicks / shown, (clicks - expected) / np.sqrt(np.maximum(variance, 1e-12))
