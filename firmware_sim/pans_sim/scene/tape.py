"""A tape of bars that runs through the field: which bars stand where at any time, and the light they pass.

Bar b and position error number k are functions of (seed, b) and (seed, k); the error is a running sum of those: batches change nothing.

Model: at t bar pitches after the start the window begins at bar t - 1 + e(t), so that window m (bars m to m + bars - 1, bar m at the
first pixel) is centred at about m + 1. The error e is an Ornstein-Uhlenbeck process, exact at every whole pitch and linear between. A
pixel is a box, so that light is linear between whole-pixel places; the mean over an exposure is exact at the speed that it begins with.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import njit
from pans.instrument.profile import Profile
from pans.protocol.wire import NO_OBJECT

from .cells import MAX_HALF_EXPOSURES
from .changes import Changes
from .detector import uniform_numbers
from .marks import MARK_TICK, mark_rows, no_marks, split_marks
from .moving import Tape
from .optics import photons_per_level
from .program import Exposures

BAR_STREAM, JITTER_STREAM = 24, 25
CHUNK = 4096  # bars drawn at a time
MARK_CHUNK = 256

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class BarTable:
    """What bar number i of the window sends through each pattern at each whole-pixel place.

    `light` is float64 (pixels_per_bar, bars + 1, patterns): a place is how many pixels of bar 0 have left the window; all bars together are
    full transmission. `dark` float64 (patterns,) is what dark bars pass.
    """

    def __init__(self, profile: Profile, tape: Tape, levels: NDArray[np.uint16], exposure_us: float) -> None:
        n_patterns, n_pixels = levels.shape
        width = tape.bars * tape.pixels_per_bar
        if n_pixels % width:
            raise ValueError(
                f"patterns have {n_pixels} pixels, the tape needs a multiple of {width} ({tape.bars} bars of {tape.pixels_per_bar})"
            )
        columns = levels.reshape(n_patterns, -1, width).sum(axis=1, dtype=np.float64)
        unit, t_min = photons_per_level(profile, exposure_us), profile.min_transmission
        self.dark: F64 = unit * t_min * columns.sum(axis=1)
        self.light: F64 = np.zeros((tape.pixels_per_bar, tape.bars + 1, n_patterns))
        for place in range(tape.pixels_per_bar):
            bar = (place + np.arange(width)) // tape.pixels_per_bar
            for i in range(tape.bars + 1):
                self.light[place, i] = unit * (1.0 - t_min) * columns[:, bar == i].sum(axis=1)


class TapeFlow:
    """One run's tape in front of one table; `rows` and `take_marks` may only move forward in time."""

    def __init__(self, tape: Tape, table: BarTable, exposures: Exposures, changes: Changes, seed: int) -> None:
        self._tape, self._table, self._exposures, self._changes, self._seed = tape, table, exposures, changes, seed
        self._pitch_ticks = exposures.tick_hz / tape.speed_bars_per_s
        self._first_bar = -1
        self._bits = np.zeros(0, np.uint8)
        self._errors = np.zeros(0)  # at pitch numbers _first_pitch.. after the start
        self._first_pitch = 0
        self._last_error: float | None = None
        self._marks = no_marks()
        self._n_marked = 0
        self.probability: F64 | None = None
        self._keep_from = 0  # pitch number; what lies before may be forgotten
        # a window's exposure may begin so much earlier
        self._margin = 4 + math.ceil(exposures.longest_period_ticks / self._pitch_ticks)

    def take_marks(self, before_tick: int) -> I64:
        """Return the rows (marks.py) of windows whose tick after the start is below `before_tick`, and go on to those after."""
        while not len(self._marks) or self._marks[-1, MARK_TICK] < before_tick:
            self._marks = np.concatenate([self._marks, self._marks_of(self._n_marked, MARK_CHUNK)])
            self._n_marked += MARK_CHUNK
        taken, self._marks = split_marks(self._marks, before_tick)
        return taken

    def rows(self, first: int, count: int) -> tuple[F64, I64]:
        """Expected photoelectrons of exposures first..first+count-1: float64 (rows, channels), and int64 (count,) of the row of each."""
        begins, lit = self._exposures.begins(first, count), self._exposures.lit(first, count)
        pitch = begins[[0, -1]] / self._pitch_ticks
        self._keep_from = int(pitch[0]) - 2
        self._reach(int(pitch[1] + self._exposures.exposure_ticks / self._pitch_ticks) + 3)
        start, stop = self._path(begins.astype(np.float64))
        rows = np.empty((count + 1, len(self._table.dark)))
        rows[0] = 0.0
        row_of = np.where(lit, np.arange(1, count + 1), 0)
        _fill(start, stop, self._bits, self._first_bar, self._table.light, self._table.dark, rows)
        return rows, row_of

    def _path(self, begins: F64) -> tuple[F64, F64]:
        """Where the window begins, in bars, when exposures begin and end; float64 (n,) each."""
        at = begins / self._pitch_ticks
        whole = np.floor(at)
        k = whole.astype(np.int64) - self._first_pitch
        slope = 1.0 + self._errors[k + 1] - self._errors[k]
        start = whole - 1.0 + self._errors[k] + slope * (at - whole)
        return start, start + slope * (self._exposures.exposure_ticks / self._pitch_ticks)

    def _reach(self, pitch: int) -> None:
        """Have position errors up to pitch number `pitch` and the bars that may be seen until then."""
        while self._first_pitch + len(self._errors) <= pitch + 2:
            self._draw_errors()
        while self._first_bar + len(self._bits) <= pitch + self._tape.bars + 4:
            self._draw_bars()

    def _draw_errors(self) -> None:
        first = self._first_pitch + len(self._errors)
        numbers = uniform_numbers(self._seed, first, CHUNK, 2, JITTER_STREAM)
        normal = np.sqrt(-2.0 * np.log1p(-numbers[:, 0])) * np.cos(2.0 * np.pi * numbers[:, 1])
        sigma, time_s = self._tape.jitter_bars, self._tape.jitter_time_s
        new = np.zeros(CHUNK)
        if sigma > 0:
            kept = math.exp(-1.0 / (time_s * self._tape.speed_bars_per_s))
            _autoregress(normal, kept, sigma, math.nan if self._last_error is None else self._last_error, new)
        self._last_error = float(new[-1])
        drop = max(0, min(self._keep_from, self._n_marked - self._margin) - self._first_pitch)
        self._errors = np.concatenate([self._errors[drop:], new])
        self._first_pitch += drop

    def _draw_bars(self) -> None:
        first = self._first_bar + len(self._bits)
        if len(self._tape.file_bits):
            new = self._tape.file_bits[np.arange(first, first + CHUNK) % len(self._tape.file_bits)]
        else:
            new = (uniform_numbers(self._seed, first + 1, CHUNK, 1, BAR_STREAM)[:, 0] < 0.5).astype(np.uint8)
        drop = max(0, min(self._keep_from, self._n_marked - self._margin) - 4 - self._first_bar)
        self._bits = np.concatenate([self._bits[drop:], new])
        self._first_bar += drop

    def _marks_of(self, first: int, count: int) -> I64:
        tape, exposures = self._tape, self._exposures
        self._reach(first + count + 2)
        pitches = np.arange(first, first + count + 3)
        places = pitches - 1.0 + self._errors[pitches - self._first_pitch]
        centres = np.interp(np.arange(first, first + count), places, pitches.astype(np.float64)) * self._pitch_ticks
        centred = np.maximum(exposures.begun_by(centres.astype(np.int64)) - 1, 0)
        begins = exposures.begins_of(centred)
        half = np.clip(
            exposures.begun_by((centres + 0.5 * self._pitch_ticks).astype(np.int64)) - centred, 1, MAX_HALF_EXPOSURES
        )
        rows = np.empty((count + 1, len(self._table.dark)))
        _fill(
            *self._path(begins.astype(np.float64)),
            self._bits,
            self._first_bar,
            self._table.light,
            self._table.dark,
            rows,
        )
        photons = rows[1:].sum(axis=1)
        if self._changes:
            photons *= self._changes.efficiency(exposures.seconds(begins))
        at = first - self._first_bar
        windows = np.lib.stride_tricks.sliding_window_view(self._bits[at : at + count + tape.bars - 1], tape.bars)
        wanted = np.frombuffer(tape.target.encode(), np.uint8) - 48
        inside = np.lib.stride_tricks.sliding_window_view(windows, len(wanted), axis=1)
        truths = (inside == wanted).all(axis=2).any(axis=1).astype(np.int64)
        return mark_rows(np.arange(first, first + count) % NO_OBJECT, truths, centred, begins, half, photons)


def warm_up() -> None:
    """Compile or load the kernels of this module."""
    floats = np.zeros(1)
    _autoregress(floats, 0.5, 1.0, 0.0, floats.copy())
    _fill(floats, np.ones(1), np.zeros(8, np.uint8), -1, np.zeros((1, 2, 1)), floats, np.zeros((2, 1)))


@njit(cache=True, nogil=True)
def _autoregress(normal, kept, sigma, before, out):  # type: ignore[no-untyped-def]
    """The stationary process of standard deviation `sigma` at consecutive pitches; `before` nan: it begins here."""
    fresh = sigma * np.sqrt(1.0 - kept * kept)
    for k in range(normal.size):
        out[k] = sigma * normal[k] if np.isnan(before) else kept * before + fresh * normal[k]
        before = out[k]


@njit(cache=True, nogil=True)
def _fill(start, stop, bits, first_bar, light, dark, rows):  # type: ignore[no-untyped-def]
    """Mean light of window places start..stop (bars) into rows 1..n, cut at whole pixels; between them light is linear."""
    per_bar, n_bars, n_channels = light.shape
    for t in range(start.size):
        row = rows[t + 1]
        row[:] = dark
        place, end = start[t] * per_bar, stop[t] * per_bar
        length = end - place
        while True:
            j = np.int64(np.floor(place))
            until = min(end, j + 1.0)
            share = (until - place) / length if length > 1e-9 else 1.0
            f = 0.5 * (place + until) - j
            for side in range(2):
                bar, pixel = divmod(j + side, per_bar)
                weight = share * (f if side else 1.0 - f)
                for i in range(n_bars):
                    if bits[bar - first_bar + i]:
                        for c in range(n_channels):
                            row[c] += weight * light[pixel, i, c]
            if until >= end or length <= 1e-9:
                break
            place = until
