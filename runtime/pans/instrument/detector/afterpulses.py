"""Afterpulses: how the clicks of an exposure raise the chance of those after it.

`Afterpulses` is the law of one family of traps, exposure by exposure. A test compares it with sums over all histories in steady light.

Every detection (photoelectron, dark count or afterpulse) fills traps, which release a Poisson number of carriers, a = -log(1 - p) in the
mean: p is the chance that at least one comes. Each comes after an exponential delay of mean tau; a carrier starts a detection like any
other where the detector is on, and is lost where it is off (Haitz 1965; Cova, Lacaita and Ripamonti, IEEE Electron Device Letters 12, 685,
1991, measure the delays). Detections are then a Hawkes process with an exponential kernel (Hawkes, Biometrika 58, 83, 1971).

The carriers X still to come are random: how many detections an exposure held is not seen, only whether it clicked. The memory is the mean
and the variance of X given the clicks, of a gamma distribution of which the exposures to come see what follows. With the exposure as unit
of time, q = 1 - exp(-1/tau), and m the exposure's own mean (-log of the chance that it is silent without memory):

- it is silent with exp(-m) E[exp(-q X)] = exp(-m) (1 + q V/X)^(-X^2/V), mean X and variance V;
- silence leaves a gamma distribution again, of mean X exp(-1/tau) / (1 + q V/X);
- whatever happens, mean and variance change by linear equations: dX/dt = -(1 - a) X/tau + a m, and
  dV/dt = -2 (1 - a) V/tau + a^2 (m + X/tau). What a click leaves is what remains of these when silence is taken away, exactly.

Only the third moment is an approximation. Against single events (tests/oracles/single_events.py) chances of clicks, and of clicks in both
of two exposures, hold to 0.003 where p is at most `HOLDS_TO`, for 0.01 to 30 photoelectrons in any order, dark exposures among them.

A gated detector is off in the pause; one that stays on also detects there, in the same light, and fills traps. Without a time
constant every carrier comes in the next exposure, whatever the number of detections: p is then the chance of its click.
Dead time f lets m / (1 + f m) of m photoelectrons fill traps (Cox, Renewal Theory, 1962; the variance of their number is m / (1 + f m)^3).
p counts the carriers that come after it. That it delays them, and hides afterpulses from each other, is left out: `blinded_error`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.instrument.profile import Profile
from pans.instrument.profile_schema import FREE_RUNNING

F64 = NDArray[np.float64]
MOST_PROBABLE = 0.6  # -log(1 - p) stays below 1: beyond it every detection would cause more than one
HOLDS_TO = 0.3  # p with a time constant, up to which the law errs by at most 0.003
# A memory that grows by less than this part per exposure is steady; time constants beyond so many exposures are cut short.
STEADY_CHANGE, STEADY_ROUNDS = 1e-4, 1000
LEAST_DARK = 1e-9  # chance of a dark click, below which none is told from another
SMALL_RATIO = 1e-7  # below it log(1 + r)/r is 1 - r/2
LEAST_MEAN = 1e-300  # of an exposure or a memory; below it there is none


@dataclass(frozen=True)
class Afterpulses:
    """One family of traps: chance of an afterpulse, its time constant and the pause between exposures, both in exposures.

    `time` 0: all in the next exposure. ValueError for what is out of range.
    """

    probability: float
    time: float = 0.0
    pause: float = 0.0
    free_running: bool = False
    dead: float = 0.0  # dead time of a detection, in exposures

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= (MOST_PROBABLE if self.time else 1 - 1e-9):
            most = f"{MOST_PROBABLE:g}" if self.time else "below 1"
            raise ValueError(f"afterpulse probability {self.probability:g}, allowed: from 0 to {most}")
        for name, value in (("time constant", self.time), ("pause", self.pause), ("dead time", self.dead)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} {value:g}, allowed: finite and at least 0")

    def __bool__(self) -> bool:
        return self.probability > 0

    @cached_property
    def carriers(self) -> float:
        """a: mean number of carriers that a detection sets free."""
        return -math.log1p(-self.probability)

    @cached_property
    def seen(self) -> float:
        """q: part of the carriers still to come that comes within an exposure."""
        return -math.expm1(-1 / self.time) if self.time else 1.0

    @cached_property
    def decay(self) -> float:
        """Part of the memory that a silent exposure and its pause leave, in the mean."""
        return math.exp(-1 / self.time) * self.flow(self.pause, on=self.free_running)[0] if self.time else 0.0

    def flow(self, duration: float, *, on: bool = True) -> tuple[float, float, float, float]:
        """Return how mean X and variance V change in `duration`, of which no click is known: (E, B, C, D).

        X becomes E X + B m and V becomes E^2 V + C m + D X, in a light of m per exposure; all 0 without a time constant.
        """
        if not self.time:
            return 0.0, 0.0, 0.0, 0.0
        if not on:
            return math.exp(-duration / self.time), 0.0, 0.0, 0.0
        a, slow = self.carriers, (1 - self.carriers) / self.time
        kept, gone = math.exp(-slow * duration), -math.expm1(-slow * duration)
        one, two = gone / slow, gone * (1 + kept) / (2 * slow)  # integrals of exp(-s t) and of its square
        between = a * a * kept * one / self.time
        return kept, a * one, a * a * two / (1 - a) - between * a / (1 - a) * self.time, between

    @cached_property
    def steps(self) -> tuple[float, ...]:
        """The numbers of `after`, 11: those of `flow` through an exposure, through the pause, q, exp(-1/tau), and what a click leaves
        without a time constant."""
        exposed = self.flow(1.0)
        paused = self.flow(self.pause, on=self.free_running) if self.time else (1.0, 0.0, 0.0, 0.0)
        return (
            *exposed,
            *paused,
            self.seen,
            math.exp(-1 / self.time) if self.time else 0.0,
            0.0 if self.time else self.carriers,
        )

    def blinded_error(self, brightest: float) -> float:
        """Return by how much dead time and afterpulses together put the chance of a click off, after at most `brightest` photoelectrons.

        Fitted to single events while it is below 0.01: 0.55 a f m / (1 + f m).
        """
        return 0.55 * self.carriers * self.dead * brightest / (1 + self.dead * brightest) if self.time else 0.0

    def sight(self, memory: ArrayLike) -> F64:
        """Return -log of the chance that nothing of `memory` (2, ...), mean and variance, comes in the next exposure, (...)."""
        x, variance = np.asarray(memory, np.float64)
        ratio = self.seen * variance / np.maximum(x, LEAST_MEAN)
        wide = np.maximum(ratio, SMALL_RATIO)
        return np.asarray(self.seen * x * np.where(ratio > SMALL_RATIO, np.log1p(wide) / wide, 1 - ratio / 2))

    def chance(self, first: ArrayLike, memory: ArrayLike) -> F64:
        """Return the chance of a click, float64, from `first`, that without memory, and `memory` (2, ...), mean and variance."""
        first = np.asarray(first, np.float64)
        return np.asarray(first - (1 - first) * np.expm1(-self.sight(memory)))

    def after(self, mean: ArrayLike, memory: ArrayLike, clicks: ArrayLike) -> F64:
        """Return the memory (2, ...) after an exposure of `mean` = -log(1 - first) and its pause; `clicks` are 0 or 1."""
        m, (x, variance) = np.asarray(mean, np.float64), np.asarray(memory, np.float64)
        found, varied = m / (1 + self.dead * m), m / (1 + self.dead * m) ** 3
        to_x, of_m, spread_m, spread_x, *pause, seen, kept, fixed = self.steps
        fewer = 1 / (1 + seen * variance / np.maximum(x, LEAST_MEAN))
        silent_x, silent_v = x * kept * fewer, variance * (kept * fewer) ** 2
        chance = np.maximum(-np.expm1(-(m + self.sight(memory))), LEAST_MEAN)
        more_x = of_m * found + x * (to_x - kept) + x * kept * (1 - fewer)
        more_v = spread_m * varied + spread_x * x + variance * (to_x**2 - (kept * fewer) ** 2)
        added = more_x / chance + fixed  # what a click leaves more than silence, of the mean and of the mean square
        squares = silent_v + silent_x**2 + (more_v + more_x * (2 * silent_x + more_x)) / chance
        clicked = np.asarray(clicks) > 0
        x = silent_x + np.where(clicked, added, 0.0)
        left = np.maximum(squares - (silent_x + added - fixed) ** 2, 0.0)
        variance = np.where(clicked, left, silent_v)
        to_x, of_m, spread_m, spread_x = pause
        variance = to_x**2 * variance + spread_m * varied + spread_x * x
        return np.stack(np.broadcast_arrays(to_x * x + of_m * found, variance))

    def in_the_dark(self, memory: ArrayLike, periods: int = 1) -> F64:
        """Return the memory (2, ...) after so many dark exposures with their pauses, of whose clicks nothing is known."""
        x, variance = np.asarray(memory, np.float64)
        to_x, spread = self.dark_flow(periods)
        return np.stack([to_x * x, to_x**2 * variance + spread * x])

    def dark_flow(self, periods: int) -> tuple[float, float]:
        """Return E and D as in `flow`, of so many dark exposures with their pauses."""
        kept, spread = 1.0, 0.0
        for part in (self.flow(1.0), self.flow(self.pause, on=self.free_running)) * periods:
            kept, spread = kept * part[0], part[0] ** 2 * spread + part[3] * kept
        return kept, spread

    def mixed(self, weights: F64, memory: F64, axis: int | tuple[int, ...] = 0) -> F64:
        """Return the memory (2, ...) of all of `memory` (2, ...) together, with `weights` (...), over the `axis` of these."""
        total = np.maximum(weights.sum(axis=axis), LEAST_MEAN)
        if not self.time:  # one number: its chance of silence is kept, which is all that counts
            silent = (weights * np.exp(-memory[0])).sum(axis=axis) / total
            x = -np.log(np.where(silent > 0, silent, 1.0))
            return np.stack([x, np.zeros_like(x)])
        x = (weights * memory[0]).sum(axis=axis) / total
        squares = (weights * (memory[1] + memory[0] ** 2)).sum(axis=axis) / total
        return np.stack([x, np.maximum(squares - x**2, 0.0)])

    def exposures_seen(self, dark: float) -> int:
        """Return behind how many exposures after a click its afterpulses come less often than a tenth of `dark`, a chance per exposure."""
        if not self.time:
            return int(self.probability > 0)
        first = self.carriers * self.seen
        least = max(dark, LEAST_DARK) / 10
        if first <= least or not self.decay:
            return int(first > least)
        return math.ceil(math.log(first / least) / -math.log(self.decay))

    def chance_after_clicks(self, dark: float, brightest: float) -> float:
        """Return the highest chance that a dark exposure clicks right after a click, whatever came before.

        `dark` is its chance without memory. Every exposure before is taken to have clicked in `brightest` photoelectrons.
        """
        mean, memory = brightest - math.log1p(-dark), np.zeros(2)
        for _ in range(STEADY_ROUNDS):
            before, memory = memory[0], self.after(mean, memory, 1)
            if memory[0] <= before * (1 + STEADY_CHANGE):
                break
        return float(self.chance(dark, memory))

    def sight_by_last(self, rates: F64, rounds: int = 3) -> F64:
        """Return what afterpulses add to -log of silence in each slot of a cycle with the shares of clicks `rates`, float64 (slots, 2).

        The columns are those after a silent slot and after a click.
        """
        found, memory = np.zeros((len(rates), 2)), np.zeros(2)
        for _ in range(rounds if self else 0):
            for slot, rate in enumerate(np.minimum(rates, 1 - 1e-9).tolist()):
                mean = max(0.0, -math.log1p(-rate) - float(self.sight(memory)))
                both = np.stack([self.after(mean, memory, clicked) for clicked in (0, 1)], axis=1)
                found[(slot + 1) % len(rates)] = self.sight(both)
                memory = self.mixed(np.array([1 - rate, rate]), both)
        return found


def afterpulses_of(profile: Profile, exposure_us: float) -> Afterpulses:
    """Return what the profile's detector does in exposures of `exposure_us` microseconds; false where it has none."""
    detector = profile.detector
    if detector.afterpulse_time_us is None:
        return Afterpulses(detector.afterpulse_probability)
    return Afterpulses(
        detector.afterpulse_probability,
        detector.afterpulse_time_us / exposure_us,
        profile.exposure.readout_us / exposure_us,
        detector.between_exposures == FREE_RUNNING,
        detector.dead_time_ns * 1e-3 / exposure_us,
    )
