"""What changes while a scene is watched: dark rates, light leaks, hot and dead channels, drifting efficiency, readings that shift.

A scene without changes costs nothing. Times are seconds after the run's first exposure may begin.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .detector import uniform_numbers
from .detector_model import SWITCH_STREAM, DetectorModel, first_click_probability
from .moving import ALL_CHANNELS, Change

F64 = NDArray[np.float64]
LEAST_THRESHOLD_E, MOST_THRESHOLD_E = 1e-6, 10.0  # as a click law takes it: a threshold that sinks farther stays there
SHIFT_STEP_E = 1e-3  # readings shift in whole steps of this, so that one law serves many exposures
SWITCHES = 256  # drawn at a time


class Changes:
    """The changes of one scene, for a detector of `n_channels` channels; those of other channels do nothing."""

    def __init__(self, changes: tuple[Change, ...], n_channels: int) -> None:
        self._changes = tuple(change for change in changes if change.channel < n_channels)
        self._n_channels = n_channels
        self._telegraphs = [Telegraph(change) for change in self._changes if change.kind == "telegraph"]
        self._readings_shift = bool(self._telegraphs) or any(change.kind == "threshold" for change in self._changes)

    def __bool__(self) -> bool:
        return bool(self._changes)

    @property
    def any_dead(self) -> bool:
        """Whether a channel dies at some time."""
        return any(change.kind == "dead" for change in self._changes)

    def efficiency(self, times_s: F64) -> F64:
        """What the light is multiplied by, float64 of the shape of `times_s`; never below 0."""
        factor = np.ones_like(times_s)
        for change in self._changes:
            if change.kind == "drift":
                lasted = np.clip(times_s - change.at_s, 0.0, change.for_s)
                factor *= np.maximum(1.0 + change.amount / 100 * lasted, 0.0)
        return factor

    def alive(self, times_s: F64) -> NDArray[np.bool_]:
        """Which channels can click, bool (n, channels)."""
        alive = np.ones((len(times_s), self._n_channels), np.bool_)
        for change in self._changes:
            if change.kind == "dead":
                alive[_during(change, times_s), change.channel] = False
        return alive

    def means(self, model: DetectorModel, photoelectrons: F64, times_s: F64, exposure_s: float) -> F64:
        """Photoelectrons expected, dark ones counted, float64 (n, channels); arguments as in `probability`."""
        dark = np.full(photoelectrons.shape, model.law.dark_per_exposure)
        extra = np.zeros_like(dark)
        for change in self._changes:
            channel = slice(None) if change.channel == ALL_CHANNELS else slice(change.channel, change.channel + 1)
            if change.kind == "dark":
                dark[_during(change, times_s), channel] *= change.amount
            elif change.kind in ("burst", "hot"):
                extra[_during(change, times_s), channel] += change.amount * exposure_s
        return np.asarray(photoelectrons * self.efficiency(times_s)[:, None] + extra + dark)

    def probability(self, model: DetectorModel, photoelectrons: F64, times_s: F64, exposure_s: float) -> F64:
        """Click probabilities, float64 (n, channels), of exposures that begin at `times_s` and would get `photoelectrons` (n, channels)."""
        mean = self.means(model, photoelectrons, times_s, exposure_s)
        without_dark = replace(model, law=replace(model.law, dark_per_exposure=0.0))
        if self._readings_shift:
            probability = self._shifted(without_dark, mean, times_s)
        else:
            probability = first_click_probability(without_dark, mean)
        if self.any_dead:
            probability[~self.alive(times_s)] = 0.0
        return probability

    def shifts_e(self, times_s: F64) -> F64:
        """By how much readings are lower than at the start, electrons, float64 (n, channels); asked for in the order of time."""
        shift = np.zeros((len(times_s), self._n_channels))
        for change in self._changes:
            if change.kind == "threshold":
                shift += change.amount * times_s[:, None]
        for one in self._telegraphs:
            shift[:, one.channel] -= one.offset_e * one.raised(times_s)
        return np.asarray(np.rint(shift / SHIFT_STEP_E) * SHIFT_STEP_E)

    def _shifted(self, model: DetectorModel, mean: F64, times_s: F64) -> F64:
        shift, probability = self.shifts_e(times_s), np.empty_like(mean)
        for value in np.unique(shift).tolist():
            threshold = min(MOST_THRESHOLD_E, max(LEAST_THRESHOLD_E, model.law.threshold_e + value))
            here = shift == value
            law = replace(model.law, threshold_e=threshold)
            probability[here] = first_click_probability(replace(model, law=law), mean[here])
        return probability


class Telegraph:
    """One pixel whose reading jumps between two levels, each held for an exponential time; asked in the order of time."""

    def __init__(self, change: Change) -> None:
        self.channel, self.offset_e = change.channel, change.amount
        self._seed, self._time_s = int(change.at_s), change.for_s
        self._drawn = 0
        self._switches = np.zeros(0)  # seconds; those that are over are forgotten
        self._raised = bool(uniform_numbers(self._seed, self.channel, 1, 1, SWITCH_STREAM)[0, 0] < 0.5)

    def raised(self, times_s: F64) -> NDArray[np.bool_]:
        """Whether the reading is on the higher level, bool (n,)."""
        while not len(self._switches) or self._switches[-1] <= times_s[-1]:
            first = (self.channel << 40) + (self._drawn + 1)
            waits = -np.log1p(-uniform_numbers(self._seed, first, SWITCHES, 1, SWITCH_STREAM)[:, 0]) * self._time_s
            last = self._switches[-1] if len(self._switches) else 0.0
            self._switches = np.append(self._switches, last + np.cumsum(waits))
            self._drawn += SWITCHES
        over = int(np.searchsorted(self._switches, times_s[0], "right"))
        if over:
            self._raised ^= bool(over % 2)
            self._switches = self._switches[over:]
        return np.asarray((np.searchsorted(self._switches, times_s, "right") % 2 == 1) ^ self._raised)


def _during(change: Change, times_s: F64) -> NDArray[np.bool_]:
    return (times_s >= change.at_s) & (times_s < change.at_s + change.for_s)
