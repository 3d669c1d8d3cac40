"""Cells in flow: when each one comes, how fast and how far off, and what light the field passes while they cross.

Everything about arrival number n is a function of (seed, n) alone, except its time, which is a running sum of such functions: batches
change nothing.

Model: a cell is centred at its arrival; its shift in pixels is velocity times the time since, from -width to +width, beyond which it
is outside. Light is exactly the mean over the exposure of the linear interpolation between whole-pixel shifts (shifts.py), at constant
velocity: motion blur is in it. Transmissions of cells that overlap add up; where the sum would exceed the fully open field in a
channel, it is cut there (in single pixels it is not). Source of the generator: detector.py.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import njit
from pans.protocol.wire import NO_OBJECT

from .changes import Changes
from .detector import uniform_numbers
from .marks import MARK_TICK, mark_rows, no_marks, split_marks
from .moving import Cells
from .program import Exposures
from .shifts import ShiftTable

ARRIVAL_STREAM = 16  # five numbers per arrival: waiting time, picture, offset, two for the velocity
CHUNK = 32  # arrivals drawn at a time: more would hold a block up
CUT_SIGMA = 4.0  # of the log-normal velocity, 6e-5 of the cells: the slowest one bounds how far ahead cells are drawn
MAX_HALF_EXPOSURES = 0xFFFF  # the field of MARK has 16 bits

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Arrivals(NamedTuple):
    """Consecutive arrivals: centre_ticks float64, speed_px (pixels per tick) float64, images int64, offsets int64 (0: the topmost)."""

    centre_ticks: F64
    speed_px: F64
    images: I64
    offsets: I64

    def after(self, n: int) -> Arrivals:
        """All but the first `n`."""
        return Arrivals(self.centre_ticks[n:], self.speed_px[n:], self.images[n:], self.offsets[n:])

    def and_then(self, later: Arrivals) -> Arrivals:
        """These and those that come after."""
        return Arrivals(
            np.concatenate([self.centre_ticks, later.centre_ticks]),
            np.concatenate([self.speed_px, later.speed_px]),
            np.concatenate([self.images, later.images]),
            np.concatenate([self.offsets, later.offsets]),
        )


class CellFlow:
    """One run's cells in front of one table; `rows` and `take_marks` may only move forward in time."""

    def __init__(self, cells: Cells, table: ShiftTable, exposures: Exposures, changes: Changes, seed: int) -> None:
        self._cells, self._table, self._exposures, self._changes, self._seed = cells, table, exposures, changes, seed
        fastest = cells.velocity_fields_per_s * table.width / exposures.tick_hz
        self._sigma = math.sqrt(math.log1p(cells.velocity_spread**2))
        self._median_px = fastest * math.exp(-0.5 * self._sigma**2)
        self._longest_half = table.width / (self._median_px * math.exp(-CUT_SIGMA * self._sigma))
        self._known = Arrivals(np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64))
        self._n_drawn = 0
        # Nothing is half in when the run starts: a usual cell takes this long from the edge to the middle.
        self._flown_ticks = table.width / fastest
        self._marks = no_marks()
        self.probability: F64 | None = None

    def take_marks(self, before_tick: int) -> I64:
        """Return the rows (marks.py) of passages whose tick after the start is below `before_tick`, and go on to those after."""
        while not len(self._marks) or self._marks[-1, MARK_TICK] < before_tick:
            self._draw_chunk()
        taken, self._marks = split_marks(self._marks, before_tick)
        return taken

    def rows(self, first: int, count: int) -> tuple[F64, I64]:
        """Expected photoelectrons of exposures first..first+count-1: float64 (rows, channels), and int64 (count,) of the row of each."""
        begins, lit = self._exposures.begins(first, count), self._exposures.lit(first, count)
        until = float(begins[-1]) + self._exposures.exposure_ticks + self._longest_half
        while not len(self._known.centre_ticks) or self._known.centre_ticks[-1] <= until:
            self._draw_chunk()
        self._forget(float(begins[0]) - self._longest_half)
        row_of = np.empty(count, np.int64)
        rows = np.empty((count + 2, self._table.sums.shape[3]))
        exposure = float(self._exposures.exposure_ticks)
        used = _fill(begins, lit, exposure, self._longest_half + 1.0, self._known, self._table, row_of, rows)
        return rows[:used], row_of

    def _forget(self, before_ticks: float) -> None:
        gone = int(np.searchsorted(self._known.centre_ticks, before_ticks))
        if gone > CHUNK:
            self._known = self._known.after(gone)

    def _draw_chunk(self) -> None:
        new = self._arrivals(self._n_drawn, CHUNK)
        self._known = self._known.and_then(new)
        self._marks = np.concatenate([self._marks, self._marks_of(self._n_drawn, new)])
        self._n_drawn += CHUNK

    def _arrivals(self, first: int, count: int) -> Arrivals:
        numbers = uniform_numbers(self._seed, first, count, 5, ARRIVAL_STREAM)
        cells, tick_hz = self._cells, self._exposures.tick_hz
        waits = -np.log1p(-numbers[:, 0]) * (tick_hz / cells.rate_hz)
        flown = np.cumsum(np.concatenate([[self._flown_ticks], waits]))[1:]
        self._flown_ticks = float(flown[-1])
        if cells.gap_s > 0:
            flowing = (cells.gap_every_s - cells.gap_s) * tick_hz
            flown = flown + np.floor(flown / flowing) * (cells.gap_s * tick_hz)
        radius = np.sqrt(-2.0 * np.log1p(-numbers[:, 3]))
        normal = np.clip(radius * np.cos(2.0 * np.pi * numbers[:, 4]), -CUT_SIGMA, CUT_SIGMA)
        speed = self._median_px * np.exp(self._sigma * normal)
        images = (numbers[:, 1] * cells.objects.n_objects).astype(np.int64)
        return Arrivals(flown, speed, images, (numbers[:, 2] * (2 * cells.offset_px + 1)).astype(np.int64))

    def _marks_of(self, first: int, arrivals: Arrivals) -> I64:
        exposures = self._exposures
        centred = np.maximum(exposures.begun_by(arrivals.centre_ticks.astype(np.int64)) - 1, 0)
        gone = exposures.begun_by(
            np.ceil(arrivals.centre_ticks + self._table.width / arrivals.speed_px).astype(np.int64)
        )
        half = np.clip(gone - centred, 1, MAX_HALF_EXPOSURES)
        begins = exposures.begins_of(centred)
        photons = np.empty(len(begins))
        _alone(begins, float(exposures.exposure_ticks), arrivals, self._table, photons)
        if self._changes:
            photons *= self._changes.efficiency(exposures.seconds(begins))
        truths = self._cells.objects.labels[arrivals.images].astype(np.int64)
        return mark_rows(np.arange(first, first + len(begins)) % NO_OBJECT, truths, centred, begins, half, photons)


def warm_up() -> None:
    """Compile or load the kernels of this module."""
    ints, floats, rows = np.zeros(1, np.int64), np.ones(1), np.zeros((3, 1))
    one = Arrivals(floats, floats, ints, ints)
    table = ShiftTable(np.zeros((1, 1, 3, 1), np.uint32), np.zeros((1, 3, 1)), 1.0, 1.0, floats, floats)
    _fill(ints, np.ones(1, np.bool_), 1.0, 1.0, one, table, ints.copy(), rows)
    _alone(ints, 1.0, one, table, floats.copy())


@njit(cache=True, nogil=True)
def _add(begin, exposure, centre, speed, sums, behind, scale_step, scale_open, row):  # type: ignore[no-untyped-def]
    """Add to `row` (patterns,) the mean light of one cell over one exposure, less the background that it hides.

    sums (shifts, patterns) of its picture at its offset. The path in pixels is cut at whole pixels; on each piece light is linear.
    """
    width = sums.shape[0] // 2
    start = (begin - centre) * speed + width
    stop = (begin + exposure - centre) * speed + width
    length = stop - start
    if stop <= 0.0 or start >= 2.0 * width:
        return
    place = max(start, 0.0)
    end = min(stop, 2.0 * width)
    while True:
        j = min(np.int64(place), 2 * width - 1)
        until = min(end, j + 1.0)
        share = (until - place) / length if length > 1e-9 else 1.0
        f = 0.5 * (place + until) - j
        for c in range(row.size):
            step = (1.0 - f) * sums[j, c] + f * sums[j + 1, c]
            row[c] += share * (scale_step * step)
        if scale_open > 0.0:
            for c in range(row.size):
                row[c] -= share * (scale_open * ((1.0 - f) * behind[j, c] + f * behind[j + 1, c]))
        if until >= end or length <= 1e-9:
            return
        place = until


@njit(cache=True, nogil=True)
def _fill(begins, lit, exposure, longest_half, arrivals, table, row_of, rows):  # type: ignore[no-untyped-def]
    """Rows of light: 0 is a dark exposure, 1 the empty field, then one for each exposure with a cell in the field; return how many.

    Nobody is in the field longer than `longest_half` ticks before or after the middle.
    """
    rows[0, :] = 0.0
    rows[1, :] = table.empty
    used = 2
    for t in range(begins.size):
        row_of[t] = 1 if lit[t] else 0
    width = table.sums.shape[2] // 2
    # Who may be in the field: the others are not looked at.
    early = np.searchsorted(arrivals.centre_ticks, begins[0] - longest_half)
    late = np.searchsorted(arrivals.centre_ticks, begins[-1] + exposure + longest_half, "right")
    for n in range(early, late):
        centre, speed = arrivals.centre_ticks[n], arrivals.speed_px[n]
        sums, behind = table.sums[arrivals.images[n], arrivals.offsets[n]], table.open_levels[arrivals.offsets[n]]
        half = width / speed
        t = np.searchsorted(begins, centre - half - exposure)
        while t < begins.size and begins[t] < centre + half:
            if lit[t]:
                if row_of[t] == 1:
                    row_of[t] = used
                    rows[used, :] = table.empty
                    used += 1
                row = rows[row_of[t]]
                _add(
                    np.float64(begins[t]),
                    exposure,
                    centre,
                    speed,
                    sums,
                    behind,
                    table.scale_step,
                    table.scale_open,
                    row,
                )
            t += 1
    for k in range(2, used):
        for c in range(table.full.size):
            rows[k, c] = min(max(rows[k, c], 0.0), table.full[c])
    return used


@njit(cache=True, nogil=True)
def _alone(begins, exposure, arrivals, table, out):  # type: ignore[no-untyped-def]
    """Photoelectrons of all channels in exposure n with arrival n alone in the field: out float64 (n,)."""
    row = np.empty(table.empty.size)
    for n in range(arrivals.centre_ticks.size):
        row[:] = table.empty
        centre, speed = arrivals.centre_ticks[n], arrivals.speed_px[n]
        sums, behind = table.sums[arrivals.images[n], arrivals.offsets[n]], table.open_levels[arrivals.offsets[n]]
        _add(np.float64(begins[n]), exposure, centre, speed, sums, behind, table.scale_step, table.scale_open, row)
        total = 0.0
        for c in range(row.size):
            total += min(max(row[c], 0.0), table.full[c])
        out[n] = total
