"""Marks as rows, many at a time, and the stamp that the device puts on all messages.

Ticks count from the start of the run and never decrease.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

I64 = NDArray[np.int64]
MARK_OBJECT, MARK_TRUTH, MARK_EXPOSURE, MARK_TICK, MARK_HALF, MARK_PHOTONS, N_MARK_COLUMNS = range(7)


class Stamp(NamedTuple):
    """What the device adds to messages: the sequence number of the first, the drop count of all, the session."""

    sequence: int
    drops: int
    session: int


def mark_rows(objects: I64, truths: I64, exposures: I64, ticks: I64, halves: I64, photons: NDArray[np.float64]) -> I64:
    """Consecutive marks, int64 (n, N_MARK_COLUMNS): `wire.Mark` without sequence number; photons as the bits of float64."""
    rows = np.empty((len(ticks), N_MARK_COLUMNS), np.int64)
    for column, values in enumerate((objects, truths, exposures, ticks, halves, photons.view(np.int64))):
        rows[:, column] = values
    return rows


def no_marks() -> I64:
    """No row."""
    return np.zeros((0, N_MARK_COLUMNS), np.int64)


def split_marks(rows: I64, before_tick: int) -> tuple[I64, I64]:
    """Return the marks whose tick is below `before_tick`, and the rest."""
    n = int(np.searchsorted(rows[:, MARK_TICK], before_tick))
    return rows[:n], rows[n:]
