"""What changes while a scene is watched: dark rates, light leaks, hot and dead channels, drifting efficiency.

Owns how declared changes add up at a given time; never draws a click and never reads a file (scene_file.py). A scene without changes
never comes here: nothing declared costs nothing. Times are seconds after the run's first exposure may begin.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .detector_model import DetectorModel, first_click_probability
from .moving import ALL_CHANNELS, Change

F64 = NDArray[np.float64]


class Changes:
    """The changes of one scene, for a detector of `n_channels` channels; those of other channels do nothing."""

    def __init__(self, changes: tuple[Change, ...], n_channels: int) -> None:
        self._changes = tuple(change for change in changes if change.channel < n_channels)
        self._n_channels = n_channels

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

    def probability(self, model: DetectorModel, photoelectrons: F64, times_s: F64, exposure_s: float) -> F64:
        """Click probabilities, float64 (n, channels), of exposures that begin at `times_s` and would get `photoelectrons` (n, channels)."""
        dark = np.full(photoelectrons.shape, model.law.dark_per_exposure)
        extra = np.zeros_like(dark)
        for change in self._changes:
            channel = slice(None) if change.channel == ALL_CHANNELS else slice(change.channel, change.channel + 1)
            if change.kind == "dark":
                dark[_during(change, times_s), channel] *= change.amount
            elif change.kind in ("burst", "hot"):
                extra[_during(change, times_s), channel] += change.amount * exposure_s
        mean = photoelectrons * self.efficiency(times_s)[:, None] + extra + dark
        without_dark = replace(model, law=replace(model.law, dark_per_exposure=0.0))
        probability = first_click_probability(without_dark, mean)
        if self.any_dead:
            probability[~self.alive(times_s)] = 0.0
        return probability


def _during(change: Change, times_s: F64) -> NDArray[np.bool_]:
    return (times_s >= change.at_s) & (times_s < change.at_s + change.for_s)
