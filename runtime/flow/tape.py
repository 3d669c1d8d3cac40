"""A tape of bars in flow: its speed says when a window of bars is aligned; one decision for each bar position.

Owns the times of alignment, in whole numbers; the verdict on a window is core.py's.

With `track` above 0 the times follow the tape by its clicks, in a phase-locked loop of second order that is directed by decisions: a
channel whose bar changes from one window to the next tells when, by how many of the exposures in between were lit. Bars that come
on are seen too early, since little light is enough for a click, and bars that go off too late by as much; the mean of both
is the edge. Each edge moves the next window by 2^-track of what it is off and the pitch by 2^-(2 track + 2): critical damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.runtime.core.decision import DecisionFlag, Output, Passage, Rows
from pans.runtime.core.plan import Plan
from pans.runtime.errors import UsageError

from . import columns, kernels
from .core import NO_FLAGS, FlowCore
from .settings import Q

_PART = (1 << Q) - 1
_LARGEST = 1 << 61  # of a bar's ticks, in 2^-Q


class TapeCore(FlowCore):
    """A tape of bars: its speed says when a window of bars is aligned; one decision for each bar position."""

    def _prepare(self, plan: Plan) -> None:
        settings = self.settings
        period_us = plan.slot_period_ticks * plan.tick_us
        self._pitch = round((1 << Q) * 1e6 / settings.bars_per_s / period_us)
        self._origin = round(
            (1 << Q) * (settings.first_bar * 1e6 / settings.bars_per_s - plan.exposure_us / 2) / period_us
        )
        if self._pitch < self.frames << Q:
            raise UsageError(
                f"a bar passes in {self._pitch / (1 << Q):.3g} frames, a decision takes {self.frames}",
                remedy="fewer shots, shorter exposures or a slower tape",
            )
        self._nominal_pitch = self._pitch
        self._edges = np.zeros(kernels.N_EDGES, np.int64)
        if settings.track and self._pitch < (self.frames + 2) << Q:
            raise UsageError(
                f"a bar passes in {self._pitch / (1 << Q):.3g} frames: following the tape needs two beside those of the decision",
                remedy="shorter exposures, or track = 0",
            )
        self._begin()

    def _begin(self) -> None:
        self._pitch = self._nominal_pitch
        self._position = self._first_position()
        self._middle = self._origin + self._position * self._pitch
        self._before = -1  # first exposure of the window before, whose bars are known; -1: there is none
        self._before_middle = 0

    def lend(self, state: npt.NDArray[np.int64]) -> None:
        """See FlowCore."""
        state[columns.MIDDLE], state[columns.MIDDLE_PART] = self._middle >> Q, self._middle & _PART
        state[columns.PITCH], state[columns.NOMINAL_PITCH] = self._pitch, self._nominal_pitch
        state[columns.TRACK], state[columns.POSITION] = self.settings.track, self._position
        state[columns.BEFORE], state[columns.BEFORE_MIDDLE] = self._before, self._before_middle >> Q
        state[columns.BEFORE_PART] = self._before_middle & _PART

    def take_back(self, state: Sequence[int]) -> None:
        """See FlowCore."""
        self._middle = (state[columns.MIDDLE] << Q) + state[columns.MIDDLE_PART]
        self._pitch, self._position = state[columns.PITCH], state[columns.POSITION]
        self._before = state[columns.BEFORE]
        self._before_middle = (state[columns.BEFORE_MIDDLE] << Q) + state[columns.BEFORE_PART]

    @property
    def excluded(self) -> str:
        """See FlowCore."""
        if self._nominal_pitch * self._period_ticks >= _LARGEST:
            return "a bar takes longer than compiled code can count"
        return super().excluded

    @property
    def bars_per_s(self) -> float:
        """The tape's speed: as it was said, or as it was last found."""
        return self.settings.bars_per_s * self._nominal_pitch / self._pitch

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming, on state of its own."""
        super().warm_up()
        kernels.total_clicks(self._counts, 0, 0)
        kernels.count_edges(self._words, self._counts, 0, 1, 1, self._edges)

    def _lag(self) -> int:
        return 64 + 4 * self.frames

    def _first_position(self) -> int:
        position = max(0, -self._origin // self._pitch)
        while self._window_of(self._origin + position * self._pitch) < 0:
            position += 1
        return position

    def _window_of(self, middle: int) -> int:
        """The first exposure of the window that is centred at `middle`, in 2^-Q exposures."""
        return (middle - ((self.frames - 1) << (Q - 1)) + (1 << (Q - 1))) >> Q

    def _kept_frames(self) -> int:
        return max(self.frames, self._pitch >> Q) + (2 * self.frames + 2 if self.settings.track else 0)

    def _settle(self, stop: int, end_tick: int, found: int) -> Output:
        rows = self._decided(stop, end_tick - (stop - 1) * self._period_ticks, NO_FLAGS)
        self._state[kernels.NEXT] = stop
        return rows.output()

    def _lose(self, stop: int, tick: int) -> Output:
        return self._decided(stop, tick - stop * self._period_ticks, DecisionFlag.GAP).output()

    def _decided(self, stop: int, origin_tick: int, flags: DecisionFlag) -> Rows:
        """Decide on every position whose window ends before `stop`; exposure e ended at `origin_tick` + e periods."""
        rows = Rows()
        while True:
            start = self._window_of(self._middle)
            last = start + self.frames - 1
            if last >= stop:
                return rows
            middle = (self._middle + (1 << (Q - 1))) >> Q
            end = origin_tick + last * self._period_ticks
            leave = end + (self._pitch * self._period_ticks >> (Q + 1))
            since = max(0, last + 1 - (self._pitch >> Q))
            clicks = 0 if flags else int(kernels.total_clicks(self._counts, since, last + 1))
            self._position += 1
            if self.settings.track:
                self._follow(start, lost=bool(flags))
            self._middle += self._pitch
            self._row(Passage(since, last, middle, leave, clicks), start, end, flags, rows)

    def _follow(self, start: int, *, lost: bool) -> None:
        """Correct phase and pitch by the bars that changed between the window before and the one at `start`, if they are known."""
        before, before_middle, frames = self._before, self._before_middle, self.frames
        self._before, self._before_middle = -1 if lost else start, self._middle
        if lost or before < 0:
            return
        kernels.count_edges(self._words, self._counts, before, start, frames, self._edges)
        up, down, lit_up, lit_down, missing = self._edges.tolist()
        if not up or not down or missing:
            return
        between = (before + frames - 1 + start) << (Q - 1)  # the middle of the exposures in between
        found = between + ((lit_down * up - lit_up * down) << Q) // (2 * up * down)
        off = found - (before_middle + self._middle) // 2
        limit = self._pitch >> 2
        off = min(max(off, -limit), limit)
        self._middle += off >> self.settings.track
        pitch = self._pitch + (off >> (2 * self.settings.track + 2))
        reach = self._nominal_pitch >> 3
        self._pitch = min(max(pitch, self._nominal_pitch - reach), self._nominal_pitch + reach)

    def _place(self) -> dict[str, Any] | None:
        place = super()._place()
        if place is None:
            return None
        loop = {"middle": self._middle, "pitch": self._pitch, "before": [self._before, self._before_middle]}
        return place | {"position": self._position} | (loop if self.settings.track else {})

    def _go_on_from(self, place: dict[str, Any]) -> None:
        super()._go_on_from(place)
        self._position = int(place["position"])
        self._middle = self._origin + self._position * self._pitch
        if self.settings.track:
            self._middle, self._pitch = int(place["middle"]), int(place["pitch"])
            self._before, self._before_middle = (int(one) for one in place["before"])

    def _give_up(self) -> Output:
        output = super()._give_up()
        self._begin()
        return output
