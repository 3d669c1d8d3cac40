"""What passes in a flow, in plain loops from the definition: onsets and releases of cells, and when a tape's bars are aligned.

Owns the definitions alone; they share no code with the host's kernels. Exposures are put in one by one, in order.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from pans.runtime.core.plan import Plan
from pans.runtime.flow.settings import BACKGROUND_BITS, FlowLimits, FlowSettings


class PassageTruth(NamedTuple):
    """A passage as it must be found: its exposures, where its clicks are centred, how many they are, and what spoils it."""

    first: int
    last: int
    centre: float
    clicks: int
    broken: bool
    too_long: bool


class Passages:
    """Finds cells in a stream from its beginning: an onset is a sum over the last frames, and so is a release."""

    def __init__(self, limits: FlowLimits) -> None:
        self._limits = limits
        self._background = limits.background / (1 << BACKGROUND_BITS)
        self._window: deque[int] = deque(maxlen=limits.onset_frames)  # empty behind a frame that never came
        self._now = self._whole_since = self._not_before = 0
        self._first = -1
        self._light: list[int] = []  # of the open passage, frame by frame
        self._broken = self._blind = False

    @property
    def is_open(self) -> bool:
        """Whether an object is in the field."""
        return self._first >= 0

    def put(self, clicks: int | None) -> PassageTruth | None:
        """Take the clicks of the next exposure, 0 of a dark one and None of one that never came; return what ends with it."""
        now, width = self._now, self._limits.onset_frames
        self._now += 1
        if clicks is None:
            self._window.clear()
            self._whole_since = now + 1
            self._broken |= self.is_open
            if self.is_open:
                self._light.append(0)
            return None
        self._window.append(clicks)
        total = sum(self._window) if len(self._window) == width else None
        quiet = total is not None and total <= self._limits.release_clicks
        if self.is_open:
            self._light.append(clicks)
            too_long = now - self._first >= 2 * self._limits.longest
            return self._ended(now - width if quiet else now, too_long=not quiet) if quiet or too_long else None
        if self._blind:
            self._blind = not quiet
        elif total is not None and total >= self._limits.onset_clicks and now >= self._not_before:
            self._first, self._light = now - width + 1, list(self._window)
            self._broken = self._first - self._whole_since < width
        return None

    def _ended(self, last: int, *, too_long: bool) -> PassageTruth:
        light = [clicks - self._background for clicks in self._light]
        total = sum(light)
        centre = sum(place * clicks for place, clicks in enumerate(light)) / total if total > 0 else -1.0
        if total <= 0:
            centre = (last - self._first) / 2
        found = PassageTruth(
            self._first, last, self._first + min(max(centre, 0.0), len(light)), sum(self._light), self._broken, too_long
        )
        self._first, self._broken, self._blind = -1, False, too_long
        self._not_before = self._now + self._limits.refractory
        return found


class Bars:
    """When the windows of a tape are aligned that goes as fast as it is said to: `start` is the first exposure of position `number`."""

    def __init__(self, settings: FlowSettings, plan: Plan, frames: int) -> None:
        period_us = plan.slot_period_ticks * plan.tick_us
        self.pitch = 1e6 / settings.bars_per_s / period_us  # exposures from one position to the next
        self._origin = (settings.first_bar * 1e6 / settings.bars_per_s - plan.exposure_us / 2) / period_us
        self._half = (frames - 1) / 2

    def start(self, number: int) -> float:
        """Not yet rounded."""
        return self._origin + number * self.pitch - self._half
