"""A bundle and the measured table in; levels so that the object meets what the trained patterns would have shown it, out.

The light that an object x receives is linear in the levels q: x . (M^T q + c) with the measured optics, x . w with those that the bundle
was trained for. The correction makes the mean square of their difference small over images of a plain prior (mean 0.3, standard deviation
0.3, correlation exp(-distance / 3 px)): it begins with the trained patterns at their new places, rounded, then changes one level at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError
from pans.bundle.making import quantise_patterns
from pans.bundle.sensor import Bundle, frozen
from pans.instrument.optics import IDENTITY, Imaging, levelled, operator

PRIOR_MEAN, PRIOR_SD, PRIOR_REACH_PX = 0.3, 0.3, 3.0
LEAST_ON_GRID = 0.8  # of the light of the trained patterns: the rest would have to shine beyond the grid
CHANGES_MAX = 4000  # of one pattern
_PATTERNS_AT_ONCE = 512
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Correction:
    """What the correction came to: light over the wanted, and the error of a pattern's light (r.m.s. over images of the prior) relative to
    its mean light, without and with the correction, each averaged over patterns by their light.
    """

    light_kept: float
    error_before: float
    error_after: float


def corrected(
    bundle: Bundle, imaging: Imaging, trained: Imaging = IDENTITY, where: str = ""
) -> tuple[Bundle, Correction]:
    """Return `bundle` with the levels to show on the table `imaging`, of a bundle made for `trained` optics, and what that came to.

    `gain` is not corrected here: the exposure is (`Registered.applied_to`). ConfigError where more than a fifth of the
    light has its place beyond the grid.
    """
    shape, top = bundle.image_shape, bundle.levels - 1
    now, then = replace(imaging, gain=1.0), replace(trained, gain=1.0)
    task = _Task.of(now, then, shape, top)
    wanted_of = task.wanted(bundle.pattern_levels)
    on_grid = task.on_grid(wanted_of)
    if on_grid < LEAST_ON_GRID:
        raise ConfigError(
            f"{where}: on the measured table {on_grid:.0%} of the patterns' light has its place on the grid, needed {LEAST_ON_GRID:.0%}",
            remedy="align the table by hand first",
        )
    levels = np.empty_like(bundle.pattern_levels)
    for first in range(0, len(levels), _PATTERNS_AT_ONCE):
        rows = slice(first, first + _PATTERNS_AT_ONCE)
        levels[rows] = task.solve(bundle.pattern_levels[rows].astype(np.float64), wanted_of[rows])
    found = task.judged(bundle.pattern_levels, levels, wanted_of)
    return replace(bundle, pattern_levels=frozen(levels)), found


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """The quadratic form of one table: the mean square over images of (levels @ map + rest - wanted) . image."""

    map: F64  # (grid pixels, object pixels)
    rest: F64  # (object pixels,): what a pattern without a lit pixel brings
    prior: F64  # second moments of images, (object pixels, object pixels)
    form: F64  # map @ prior @ map.T
    there: F64  # (object pixels, grid pixels): where the trained pattern's light belongs on the grid
    trained: Imaging
    shape: tuple[int, int]
    top: int

    @staticmethod
    def of(now: Imaging, then: Imaging, shape: tuple[int, int], top: int) -> _Task:
        seen = operator(now, shape)
        unlit = levelled(now, np.zeros((1, seen.shape[0])), shape, float(top))[0]
        each = levelled(replace(now, black=0.0), np.ones((1, seen.shape[0])), shape)[0] * (1.0 - now.black)
        mapped, prior = each[:, None] * seen, _prior(shape)
        sharp = operator(replace(now, psf_px=0.0, flat=None), shape)  # geometry alone
        form = mapped @ prior @ mapped.T
        return _Task(mapped, unlit @ seen, prior, form, sharp.T / np.maximum(each, 0.1), then, shape, top)

    def wanted(self, levels: NDArray[np.uint16]) -> F64:
        """What the trained patterns show an object on the table that they were trained for, (patterns, object pixels)."""
        light = levelled(self.trained, levels.astype(np.float64), self.shape, float(self.top))
        return light if self.trained.in_place else np.asarray(light @ operator(self.trained, self.shape))

    def on_grid(self, wanted: F64) -> float:
        """Return the share of the wanted light that is for object pixels which the grid can reach."""
        reached = self.there.sum(axis=1)
        return float((wanted @ (reached / max(float(reached.max()), 1e-300))).sum() / wanted.sum())

    def solve(self, trained: F64, wanted: F64) -> F64:
        """Return the levels of patterns (n, pixels) that bring `wanted`."""
        levels = self._start(trained)
        slope = levels @ self.form - (wanted - self.rest) @ self.prior @ self.map.T
        return _descend(levels, slope, self.form, self.top)

    def _start(self, trained: F64) -> F64:
        moved = np.clip(trained @ self.there, 0.0, self.top)
        if self.top > 1:
            return quantise_patterns(moved, self.top + 1, float(self.top)).pattern_levels.astype(np.float64)
        count = np.rint(moved.sum(axis=1)).astype(np.int64)
        rank = np.argsort(np.argsort(-moved, axis=1), axis=1)
        return (rank < count[:, None]).astype(np.float64)

    def judged(self, before: NDArray[np.uint16], after: NDArray[np.uint16], wanted: F64) -> Correction:
        light = wanted.sum(axis=1) * PRIOR_MEAN
        errors = []
        for levels in (before, after):
            off = levels @ self.map + self.rest - wanted
            errors.append(float(np.sqrt(np.maximum(((off @ self.prior) * off).sum(axis=1), 0.0)).sum() / light.sum()))
        kept = (after @ self.map + self.rest).sum() / wanted.sum()
        return Correction(float(kept), errors[0], errors[1])


def _prior(shape: tuple[int, int]) -> F64:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].reshape(2, -1).astype(np.float64)
    distance = np.hypot(y[:, None] - y, x[:, None] - x)
    return np.asarray(PRIOR_MEAN**2 + PRIOR_SD**2 * np.exp(-distance / PRIOR_REACH_PX))


def _descend(levels: F64, slope: F64, form: F64, top: int) -> F64:
    """Change one level of each pattern at a time, or two at once, as long as that lowers the form; `slope` is half of its derivative."""
    curve = np.diag(form).copy()
    active = np.arange(len(levels))
    for _ in range(CHANGES_MAX):
        if not len(active):
            break
        some, pull = levels[active], slope[active]
        step, change = _best_steps(some, pull, curve, top)
        best = np.argmin(change, axis=1)
        rows = np.arange(len(active))
        moved, gained = step[rows, best], change[rows, best]
        pull = pull + moved[:, None] * form[best]
        some[rows, best] += moved
        # a second change with the first one made: a lit pixel that moves over is two changes, the first of which may cost
        step, change = _best_steps(some, pull, curve, top, barred=best)
        other = np.argmin(change, axis=1)
        second = np.where(change[rows, other] < 0, step[rows, other], 0.0)
        gained = gained + np.minimum(change[rows, other], 0.0)
        some[rows, other] += second
        pull += second[:, None] * form[other]
        better = gained < -1e-9 * curve.max()
        levels[active[better]], slope[active[better]] = some[better], pull[better]
        active = active[better]
    return levels


def _best_steps(
    levels: F64, slope: F64, curve: F64, top: int, barred: NDArray[np.intp] | None = None
) -> tuple[F64, F64]:
    """Return for each level the whole step that lowers the form most, at least one up or down, and what it changes (inf: none)."""
    flat = curve <= 1e-12 * curve.max()
    ideal = -slope / np.where(flat, 1.0, curve)
    step = np.rint(ideal)
    step = np.where(step == 0, np.where(ideal > 0, 1.0, -1.0), step)
    step = np.clip(step, -levels, top - levels)
    step = np.where(step == 0, np.where(levels > 0, -1.0, 1.0), step)
    change = 2 * step * slope + step * step * curve
    change[:, flat] = np.inf
    if barred is not None:
        change[np.arange(len(levels)), barred] = np.inf
    return step, change
