"""A tape of bars in flow: its speed says when a window of bars is aligned; one decision for each bar position.

Owns the times of alignment, in whole exposures; the verdict on a window is flow.py's.
"""

from __future__ import annotations

from typing import Any

from . import flow_kernels as kernels
from .errors import UsageError
from .flow import NO_FLAGS, FlowCore, Rows
from .follower import Output, Passage
from .plan import Plan
from .record_format import DecisionFlag

Q = 32  # bits after the point of a bar's alignment, in exposures


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
        self._position = self._first_position()

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming, on state of its own."""
        super().warm_up()
        kernels.total_clicks(self._counts, 0, 0)

    def _lag(self) -> int:
        return 64 + 4 * self.frames

    def _first_position(self) -> int:
        position = max(0, -self._origin // self._pitch)
        while self._window_of(position) < 0:
            position += 1
        return position

    def _window_of(self, position: int) -> int:
        """The first exposure of the window that is centred where bar `position` is aligned."""
        middle = self._origin + position * self._pitch
        return (middle - ((self.frames - 1) << (Q - 1)) + (1 << (Q - 1))) >> Q

    def _kept_frames(self) -> int:
        return max(self.frames, self._pitch >> Q)

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
            start = self._window_of(self._position)
            last = start + self.frames - 1
            if last >= stop:
                return rows
            middle = (self._origin + self._position * self._pitch + (1 << (Q - 1))) >> Q
            end = origin_tick + last * self._period_ticks
            leave = end + (self._pitch * self._period_ticks >> (Q + 1))
            since = max(0, last + 1 - (self._pitch >> Q))
            clicks = 0 if flags else int(kernels.total_clicks(self._counts, since, last + 1))
            self._position += 1
            self._row(Passage(since, last, middle, leave, clicks), start, end, flags, rows)

    def _place(self) -> dict[str, Any] | None:
        place = super()._place()
        return None if place is None else place | {"position": self._position}

    def _go_on_from(self, place: dict[str, Any]) -> None:
        super()._go_on_from(place)
        self._position = int(place["position"])

    def _give_up(self) -> Output:
        output = super()._give_up()
        self._position = self._first_position()
        return output
