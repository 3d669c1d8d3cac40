"""Dead time of a detector of which an exposure asks only whether it clicked: what is left of the mean when a click before blinds it.

Nothing within an exposure can suppress its first click: what counts is the rest of the dead time that a detection
of the exposure before, or of the pause between, carries over. The law is the stationary share of silent exposures, P0, under steady light.
It is given as the *counted mean* -log P0, which takes the mean's place in a click law, and holds to 0.002 where exposures are of about
equal light. Where dim and bright ones alternate, as in automata, it errs by up to `unequal_error`: at 30 photoelectrons 0.003 for a reach r
of 0.028 exposures, 0.017 for 0.1 (paralysable: 0.003 for 0.020, 0.27 for 0.1). How exposures depend on each other
is left out: after a silent one a gated, non-paralysable detector is awake, and its chance is 1 - exp(-mean).

With the exposure as unit of time, mean m, dead time f, pause g, a = m f, and r = f - g the reach into the next exposure (gated; r = f
where the detector stays on in the pause, or there is none):

- A non-paralysable detector that stays on is a renewal process of intervals f + Exp(m). Its forward recurrence time exceeds 1 with
  P0 = exp(-m (1 - f)) / (1 + a), or (1 + m (f - 1)) / (1 + a) where f > 1 (Cox, Renewal Theory, 1962, on recurrence times).
- A gated one begins an exposure blind for d with the density w(d), 0 < d <= r, of a detection at 1 - r + d in the exposure before:
  P0 = exp(-m) (1 + integral of w(d) (exp(m d) - 1)). Detections after d have the density h(s) = sum_n m (m s_n)^n / n! exp(-m s_n) with
  s_n = s - n f > 0, and w is what repeats itself: w(d) = (1 - integral of w) h(1 - r + d) + integral of w(e) h(1 - r + d - e).
- A paralysable one detects a photon that follows the one before by more than f. From a photon on, nothing is detected until t with
  q(t) = sum_k (-1)^k exp(-k a) (m (t - k f))^k / k! over k f < t; with u the first photon of the exposure and its forerunner less than r
  before, P0 = exp(-m) + integral over u from 0 to r of m (exp(-m u) - exp(-m r)) q(1 - u). With f > 1 it detects at most once in an
  exposure: free-running, P0 = 1 - m exp(-a).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]
LARGEST_MEAN = 1e6
INTERVALS = 2048  # of the table, equal in log(1 + mean): interpolation errs by less than 1e-5 of the mean
STEP = math.log1p(LARGEST_MEAN) / INTERVALS
STEADY_BELOW = 0.3  # dead time of an exposure; until there w is m / (1 + a) as without a pause, P0 within 3e-5
SOLVED_TO = 30.0  # mean; beyond, P0 falls as it does without a pause
CANCELS_FROM = 18.0  # m exp(-a), above which the alternating series errs by more than LEAST_SILENT / 10
LEAST_SILENT = 1e-7  # P0, below which it falls at its rate of decay
_CELLS, _NODES = 96, 64  # of w, and of the integral over u


@dataclass(frozen=True, slots=True)
class DeadTime:
    """Dead time and the pause between two exposures, both in exposures; without a pause, gated and free-running are the same."""

    dead: float = 0.0
    pause: float = 0.0
    free_running: bool = False
    paralysable: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.pause < math.inf:
            raise ValueError(f"the pause must be finite and at least 0, found {self.pause}")
        if not 0 <= self.dead <= 1 + self.pause:
            raise ValueError(f"the dead time must be from 0 to 1 + the pause = {1 + self.pause:g}, found {self.dead}")

    @property
    def reach(self) -> float:
        """For how long, at most, an exposure is blind because of what came before it."""
        return self.dead if self.free_running else max(0.0, self.dead - self.pause)


NO_DEAD_TIME = DeadTime()


def counted_mean(dead_time: DeadTime, mean: ArrayLike) -> F64:
    """Return -log of the share of silent exposures at `mean` photoelectrons (any shape, at least 0), float64 of its shape."""
    mean = np.asarray(mean, np.float64)
    if not dead_time.reach:
        return mean
    table = counted_table(dead_time)
    return np.asarray(mean * np.interp(np.log1p(mean), _MARKS, table))


@lru_cache(maxsize=64)
def mean_of_most_clicks(dead_time: DeadTime) -> float:
    """Return the mean beyond which more light clicks less often, as it does where it paralyses; inf where there is none."""
    if not (dead_time.reach and dead_time.paralysable):
        return math.inf
    mean = np.expm1(_MARKS)
    return float(mean[np.argmax(mean * counted_table(dead_time))])


def unequal_error(dead_time: DeadTime, brightest: float) -> float:
    """Return by how much the chance of a click can be off where exposures of 0 to `brightest` photoelectrons come in any order.

    The law takes each exposure to follow its like. Against that stand the two extremes: one behind a dark exposure, which begins awake, and
    one behind the brightest, of which detections fill the reach r before the next exposure with the density w = m / (1 + m f) (of photons,
    where they paralyse). A third is added, more where they paralyse,
    for what clicks of neighbouring exposures say of each other: up to 0.003 this is not below what
    single events give (tests/runtime/instrument/detector/test_laws.py).
    """
    mean = np.append(np.geomspace(1e-3, max(brightest, 2e-3), 200), np.linspace(0, brightest, 200)[1:])
    silent, awake, reach = np.exp(-counted_mean(dead_time, mean)), np.exp(-mean), dead_time.reach
    if dead_time.paralysable:
        blind = (np.arange(_CELLS) + 0.5) / _CELLS * min(reach, 1.0)
        density = brightest * np.exp(-brightest * (min(reach, 1.0) - blind))
        blinded = (np.expm1(mean[:, None] * blind) @ density) * (blind[1] - blind[0]) * np.exp(mean * dead_time.dead)
    else:
        blinded = (np.expm1(mean * reach) / mean - reach) * brightest / (1 + brightest * dead_time.dead)
    after_bright = np.minimum(awake * (1 + blinded), 1.0)
    off = float(max((silent - awake).max(), (after_bright - silent).max()))
    return (1.6 if dead_time.paralysable else 1.35) * off


@lru_cache(maxsize=64)
def counted_table(dead_time: DeadTime) -> F64:
    """Return counted over true mean at `log(1 + mean)` = 0, STEP, 2 STEP, ... up to LARGEST_MEAN, float64 (INTERVALS + 1,), read-only."""
    mean = np.expm1(_MARKS[1:])
    law = _paralysable if dead_time.paralysable else _non_paralysable
    table = np.append(1.0, law(dead_time, mean) / mean)
    table.flags.writeable = False
    return table


_MARKS = STEP * np.arange(INTERVALS + 1)


def _non_paralysable(dead_time: DeadTime, mean: F64) -> F64:
    dead, reach = dead_time.dead, dead_time.reach
    if reach == dead:
        if dead <= 1:
            return np.asarray(mean * (1 - dead) + np.log1p(mean * dead))
        return np.asarray(np.log1p(mean * dead) - np.log1p(mean * (dead - 1)))
    if dead <= STEADY_BELOW:
        left = np.exp(-mean * reach)
        return np.asarray(mean * (1 - reach) - np.log(left + (1 - left * (1 + mean * reach)) / (1 + mean * dead)))
    solved = mean[mean <= SOLVED_TO]
    counted = np.array([_gated(one, dead, reach) for one in solved.tolist()])
    beyond = mean[len(solved) :]
    growth = (beyond - solved[-1]) * (1 - reach) + np.log((1 + beyond * dead) / (1 + solved[-1] * dead))
    return np.append(counted, counted[-1] + growth)


def _gated(mean: float, dead: float, reach: float) -> float:
    """The counted mean from w, by the midpoint rule on equal cells; the term of no detection before, which jumps, by its integral."""
    width = reach / _CELLS
    blind = np.asarray((np.arange(_CELLS) + 0.5) * width, np.float64)
    since = 1 - reach + blind[:, None] - blind[None, :]
    ends = [np.exp(-mean * np.maximum(since + side * width, 0.0)) for side in (-0.5, 0.5)]
    after = ends[0] - ends[1] + _detections(since, mean, dead, 1) * width
    awake = _detections(1 - reach + blind, mean, dead, 0)
    density = np.linalg.solve(np.eye(_CELLS) - after + awake[:, None] * width, awake)
    return mean - math.log1p(float(density @ np.expm1(mean * blind)) * width)


def _detections(since: F64, mean: float, dead: float, least: int) -> F64:
    """h: the density of detections, per exposure, so long after the detector awoke, with at least so many detections between."""
    density = np.zeros_like(since)
    for n in range(least, math.ceil(1 / dead) + 1):
        rest = mean * np.maximum(since - n * dead, 0.0)
        density += np.where(since >= n * dead, mean * rest**n / math.factorial(n) * np.exp(-rest), 0.0)
    return density


def _paralysable(dead_time: DeadTime, mean: F64) -> F64:
    dead, reach = dead_time.dead, dead_time.reach
    flux = mean * np.exp(-mean * dead)
    counted = _decay(mean * dead) / dead
    sums = flux <= CANCELS_FROM
    # where it stays on through a pause, a detection needs a photon in this exposure and none in `dead` before it
    silent = 1 - flux[sums] if reach > 1 else _silent(mean[sums], dead, reach)
    counted[sums] = np.where(silent > LEAST_SILENT, -np.log(np.maximum(silent, LEAST_SILENT)), counted[sums])
    return np.asarray(counted)


def _silent(mean: F64, dead: float, reach: float) -> F64:
    """P0 of a paralysable detector, with exp(-m u) as the variable of the integral: Gauss-Legendre."""
    at, weight = np.polynomial.legendre.leggauss(_NODES)
    last = -np.expm1(-mean * reach)
    passed = 0.5 * last[:, None] * (1 + at)  # 1 - exp(-m u)
    first = -np.log1p(-passed) / mean[:, None]
    waits = 1 - np.exp(-mean[:, None] * (reach - first))
    quiet = waits * _undetected(1 - first, mean[:, None], dead)
    return np.asarray(np.exp(-mean) + 0.5 * last * (quiet @ weight))


def _undetected(until: F64, mean: F64, dead: float) -> F64:
    """q: the chance that nothing is detected so long after a photon."""
    total = np.ones_like(until)
    term_sign = 1.0
    for k in range(1, math.ceil(1 / dead) + 1):
        term_sign = -term_sign
        rest = np.maximum(until - k * dead, 0.0) * mean * np.exp(-mean * dead)
        if not rest.any():
            break
        total += term_sign * np.exp(k * np.log(np.maximum(rest, 1e-300)) - math.lgamma(k + 1)) * (rest > 0)
    return total


def _decay(a: F64) -> F64:
    """The rate at which silence decays, times the dead time: the smaller root of y exp(-y) = a exp(-a)."""
    low, high = np.zeros_like(a), np.ones_like(a)
    wanted = a * np.exp(-a)
    for _ in range(50):
        middle = 0.5 * (low + high)
        above = middle * np.exp(-middle) >= wanted
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return high
