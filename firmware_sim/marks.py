"""What becomes messages many at a time: marks as columns, and the stamp that the device puts on all messages.

Owns the columns and how a run takes from their front; never computes what stands in them (light.py, cells.py, tape.py) and never
encodes one (frame_writer.py). Ticks count from the start of the run and never decrease.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

I64 = NDArray[np.int64]


class Stamp(NamedTuple):
    """What the device adds to messages: the sequence number of the first, the drop count of all, the session."""

    sequence: int
    drops: int
    session: int


class Marks(NamedTuple):
    """Consecutive marks, all int64 (n,) but for float64 photons: the fields of `wire.Mark` without the sequence number."""

    objects: I64
    truths: I64
    exposures: I64
    ticks: I64
    halves: I64
    photons: NDArray[np.float64]

    def split(self, n: int) -> tuple[Marks, Marks]:
        """Return the first `n` and the rest."""
        objects, truths, exposures, ticks, halves, photons = self
        first = Marks(objects[:n], truths[:n], exposures[:n], ticks[:n], halves[:n], photons[:n])
        return first, Marks(objects[n:], truths[n:], exposures[n:], ticks[n:], halves[n:], photons[n:])

    def and_then(self, later: Marks) -> Marks:
        """These and those that come after."""
        return Marks(
            np.concatenate([self.objects, later.objects]),
            np.concatenate([self.truths, later.truths]),
            np.concatenate([self.exposures, later.exposures]),
            np.concatenate([self.ticks, later.ticks]),
            np.concatenate([self.halves, later.halves]),
            np.concatenate([self.photons, later.photons]),
        )


def no_marks() -> Marks:
    """Columns without a row."""
    none = np.zeros(0, np.int64)
    return Marks(none, none, none, none, none, np.zeros(0))
