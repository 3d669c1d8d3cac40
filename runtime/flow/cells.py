"""Cells in flow: onset, best window and release of each, and whether it was one cell or two.

Owns what is done with the passages that kernels.py finds; the verdict on a window is core.py's.
"""

from __future__ import annotations

import numpy as np

from pans.runtime.core.decision import DecisionFlag, Output, Passage, Rows
from pans.runtime.core.plan import Plan

from . import kernels
from .core import NO_FLAGS, FlowCore


class CellCore(FlowCore):
    """Cells: found by the sum of clicks over a few frames, decided in the window nearest to the centroid of their clicks."""

    def _prepare(self, plan: Plan) -> None:
        self._limits = np.array([*self.limits[:8], self._dark_cycle], np.int64)

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming, on state of its own."""
        super().warm_up()
        state, spare = np.zeros_like(self._state), np.zeros_like(self.dark_channels)
        kernels.scan(0, self._words, self._counts, self._limits, state, spare, self._passages)
        kernels.has_two_maxima(self._counts, 0, -1, 1, 1)

    def _kept_frames(self) -> int:
        return 2 * self.limits.longest

    def _settle(self, stop: int, end_tick: int, found: int) -> Output:
        rows, origin_tick = Rows(), end_tick - (stop - 1) * self._period_ticks
        while True:
            for row in self._passages[:found].tolist():
                self._passed(row, origin_tick, rows)
            if self._state[kernels.NEXT] >= stop:
                return rows.output()
            found = kernels.scan(
                stop, self._words, self._counts, self._limits, self._state, self.empty_channels, self._passages
            )

    def _passed(self, row: list[int], origin_tick: int, rows: Rows) -> None:
        """Turn one row of the kernel into a decision; exposure e ended at `origin_tick` + e periods."""
        first, last, centre, clicks, broken, _ = row
        flags = NO_FLAGS
        if broken & kernels.BROKEN:
            flags = DecisionFlag.GAP
        elif broken & kernels.TOO_LONG or last - first >= self.limits.longest or self._is_double(first, last):
            flags = DecisionFlag.COINCIDENCE
        start = self._best_window(centre)
        passage = Passage(first, last, (centre + 128) >> 8, origin_tick + last * self._period_ticks, clicks)
        end = origin_tick + (start + self.frames - 1) * self._period_ticks
        self._row(passage, start, end, flags, rows)

    def _is_double(self, first: int, last: int) -> bool:
        limits = self.limits
        return bool(kernels.has_two_maxima(self._counts, first, last, limits.valley_frames, limits.valley_sigma2))

    def _best_window(self, centre: int) -> int:
        """The first exposure of the window centred at `centre` / 256; beside a dark frame, the nearest one without."""
        start = (centre - 128 * (self.frames - 1) + 128) >> 8
        if self._dark_cycle:
            dark = start + self._dark_cycle - 1 - start % self._dark_cycle  # the first dark frame from there on
            if dark < start + self.frames:
                back, ahead = start + self.frames - dark, dark + 1 - start
                start += -back if back < ahead else ahead
        return max(0, min(start, int(self._state[kernels.NEXT]) - self.frames))

    def _close(self) -> Output:
        rows = Rows()
        state = self._state
        if state[kernels.STATE] == kernels.OPEN:
            first, last = int(state[kernels.FIRST]), int(state[kernels.NEXT]) - 1
            passage = Passage(first, last, (first + last) // 2, self.last_tick, int(state[kernels.CLICKS]))
            self._row(passage, max(0, last + 1 - self.frames), self.last_tick, DecisionFlag.INCOMPLETE, rows)
            state[kernels.STATE] = kernels.IDLE
        return rows.output()
