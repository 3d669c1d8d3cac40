"""Afterpulses: how the clicks of an exposure raise the chance of those after it.

Owns the law of one family of traps, exposure by exposure; under steady light stationary.py has it without approximation. Never draws.

Every detection (photoelectron, dark count or afterpulse) fills traps, which release a Poisson number of carriers, a = -log(1 - p) in the
mean: p is the chance that at least one comes. Each comes after an exponential delay of mean tau; a carrier starts a detection like any
other where the detector is on, and is lost where it is off (Haitz 1965; Cova, Lacaita and Ripamonti, IEEE Electron Device Letters 12, 685,
1991, measure the delays). Detections are then a Hawkes process with an exponential kernel (Hawkes, Biometrika 58, 83, 1971).

The memory e is the mean number of carriers that the next exposure will see of traps filled before it. With the exposure as unit of time,
q = 1 - exp(-1/tau), and m the exposure's own mean (-log of the chance that it is silent without memory):

- it clicks with 1 - exp(-m - e), exactly, if e is known;
- in silence e falls by exp(-(1 + pause)/tau), exactly;
- a click adds the mean of what its detections leave, given that there is one. From dX/dt = -(1 - a) X/tau + a m for the mean X of carriers
  still to come, X(1) = X(0) exp(-(1 - a)/tau) + a m tau/(1 - a) (1 - exp(-(1 - a)/tau)): the difference from X(0) exp(-1/tau), over the
  chance of a click. That the number of detections in a click spreads about this mean is left out (of order a^2).

A gated detector is off in the pause; one that stays on also detects there, in the same light, and fills traps. Without a time
constant every carrier comes in the next exposure, whatever the number of detections: p is then the chance of its click.
Dead time shortens the sight of what comes within it: p counts the carriers that come after it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.instrument.profile import Profile
from pans.runtime.instrument.profile_schema import FREE_RUNNING

F64 = NDArray[np.float64]
MOST_PROBABLE = 0.6  # -log(1 - p) stays below 1: beyond it every detection would cause more than one
LEAST_DARK = 1e-9  # chance of a dark click, below which none is told from another
LEAST_MEAN = 1e-300  # of an exposure; below it there is no click that could fill a trap


@dataclass(frozen=True)
class Afterpulses:
    """One family of traps: chance of an afterpulse, its time constant and the pause between exposures, both in exposures.

    `time` 0: all in the next exposure. ValueError for what is out of range.
    """

    probability: float
    time: float = 0.0
    pause: float = 0.0
    free_running: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= (MOST_PROBABLE if self.time else 1 - 1e-9):
            most = f"{MOST_PROBABLE:g}" if self.time else "below 1"
            raise ValueError(f"afterpulse probability {self.probability:g}, allowed: from 0 to {most}")
        for name, value in (("time constant", self.time), ("pause", self.pause)):
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
        return math.exp(-1 / self.time) * self._through_pause if self.time else 0.0

    @cached_property
    def steps(self) -> tuple[float, float, float, float]:
        """What a click adds: `fixed + (per_mean m + per_memory e) / chance`; `in_pause m` comes in any case."""
        if not self.time:
            return self.carriers, 0.0, 0.0, 0.0
        slow = (1 - self.carriers) / self.time
        per_mean = self.carriers / slow * -math.expm1(-slow)
        per_memory = (math.exp(-slow) - math.exp(-1 / self.time)) / self.seen
        kept = self.seen * self._through_pause
        in_pause = self.seen * self.carriers / slow * -math.expm1(-slow * self.pause) if self.free_running else 0.0
        return 0.0, kept * per_mean, kept * per_memory, in_pause

    @property
    def _through_pause(self) -> float:
        return math.exp(-(1 - self.carriers if self.free_running else 1) * self.pause / self.time)

    def chance(self, first: ArrayLike, memory: ArrayLike) -> F64:
        """Return the chance of a click, float64, from `first`, that without memory, and `memory` (shapes that broadcast)."""
        first = np.asarray(first, np.float64)
        return np.asarray(first - (1 - first) * np.expm1(-np.asarray(memory, np.float64)))

    def gain(self, mean: ArrayLike, memory: ArrayLike) -> F64:
        """Return what a click adds to the memory, beyond its decay; `mean` is -log(1 - first)."""
        fixed, per_mean, per_memory, _ = self.steps
        if fixed:
            return np.asarray(np.broadcast_to(fixed, np.broadcast_shapes(np.shape(mean), np.shape(memory))))
        mean, memory = np.asarray(mean, np.float64), np.asarray(memory, np.float64)
        chance = np.maximum(-np.expm1(-(mean + memory)), LEAST_MEAN)
        return np.asarray((per_mean * mean + per_memory * memory) / chance)

    def after(self, mean: ArrayLike, memory: ArrayLike, clicks: ArrayLike) -> F64:
        """Return the memory after an exposure; `clicks` 0 or 1, or the chance of one for what is left in the mean."""
        mean, memory = np.asarray(mean, np.float64), np.asarray(memory, np.float64)
        kept = self.decay * memory + self.steps[3] * mean
        return np.asarray(kept + np.asarray(clicks) * self.gain(mean, memory))

    def after_silences(self, count: int) -> float:
        """Return what `count` silent, dark exposures leave of a memory."""
        return self.decay**count

    def exposures_seen(self, dark: float) -> int:
        """Return behind how many exposures after a click its afterpulses come less often than a tenth of `dark`, a chance per exposure."""
        if not self.time:
            return int(self.probability > 0)
        first = self.carriers * self.seen
        least = max(dark, LEAST_DARK) / 10
        if first <= least or not self.decay:
            return int(first > least)
        return math.ceil(math.log(first / least) / -math.log(self.decay))

    def memory_by_last(self, rates: F64, rounds: int = 3) -> F64:
        """Return the mean memory before each of `rates` (slots,), shares of clicks in a cycle that repeats, float64 (slots, 2).

        The columns are those after a silent slot and after a click.
        """
        found, mean_memory = np.zeros((len(rates), 2)), 0.0
        for _ in range(rounds):
            for slot, rate in enumerate(np.minimum(rates, 1 - 1e-9).tolist()):
                mean = max(0.0, -math.log1p(-rate) - mean_memory)
                silent = self.decay * mean_memory + self.steps[3] * mean
                clicked = silent + float(self.gain(mean, mean_memory))
                found[(slot + 1) % len(rates)] = silent, clicked
                mean_memory = (1 - rate) * silent + rate * clicked
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
    )
