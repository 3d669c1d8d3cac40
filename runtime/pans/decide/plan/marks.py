"""The marks of the latest objects of one stream: which class each is of, when it came, how much light it sends."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pans.protocol.wire import MARK_DTYPE, Mark

MAX_MARKS = 4096  # objects that are remembered; a run may see any number
Rows = npt.NDArray[np.void]


class Marks:
    """At most MAX_MARKS objects; an object that is marked again is as young as a new one.

    Marks arrive as rows of MARK_DTYPE and become `Mark`s only when somebody asks for them.
    """

    def __init__(self) -> None:
        self._rows: Rows = np.empty(2 * MAX_MARKS, MARK_DTYPE)
        self._objects: npt.NDArray[np.int64] = np.empty(len(self._rows), np.int64)
        self._n = 0
        self.following = 0  # above the numbers of all objects that are remembered

    def __len__(self) -> int:
        return len(self._latest())

    def add(self, mark: Mark) -> None:
        """Remember one mark."""
        row = np.zeros(1, MARK_DTYPE)
        row["seq"], row["object_index"], row["truth"], row["exposure_index"], row["tick"], row["photons"] = mark[:6]
        row["half_exposures"] = mark.half_exposures
        self.add_rows(row)

    def add_rows(self, rows: Rows) -> None:
        """Remember marks, MARK_DTYPE (n,), in the order of arrival."""
        for first in range(0, len(rows), MAX_MARKS):
            some = rows[first : first + MAX_MARKS]
            if self._n + len(some) > len(self._rows):
                self.keep(MAX_MARKS)
            here = slice(self._n, self._n + len(some))
            self._rows[here], self._objects[here] = some, some["object_index"]
            self._n += len(some)
            self.following = max(self.following, int(some["object_index"].max()) + 1)

    def get(self, number: int) -> Mark | None:
        """Return the mark of object `number`, None where it is not remembered."""
        if number >= self.following:
            return None
        objects = self._objects[: self._n]
        found = np.flatnonzero(objects == number)
        if not len(found):
            return None
        newer = objects[found[-1] + 1 :]
        if len(newer) >= MAX_MARKS and len(np.unique(newer)) >= MAX_MARKS:
            return None
        return mark_of(self._rows[found[-1]])

    def photons_of(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return the expected photoelectrons of one shot on each of objects (n,), float32 (n,), NaN where no mark is remembered."""
        marks = [self.get(number) for number in numbers.tolist()]
        return np.array([np.nan if mark is None else mark.photons for mark in marks], np.float32)

    def latest(self) -> list[Mark]:
        """Return the marks that are remembered, the oldest first."""
        return [mark_of(row) for row in self._latest()]

    def keep(self, most: int) -> None:
        """Forget all but the latest `most`."""
        kept = self._latest()
        kept = kept[max(0, len(kept) - most) :].copy()
        self._n = len(kept)
        self._rows[: self._n], self._objects[: self._n] = kept, kept["object_index"]
        self.following = self.following if len(kept) else 0

    def _latest(self) -> Rows:
        """Return the latest row of each object that is remembered."""
        rows, objects = self._rows[: self._n], self._objects[: self._n]
        if not (np.diff(objects) > 0).all():  # some object was marked again
            _, from_the_end = np.unique(objects[::-1], return_index=True)
            rows = rows[np.sort(self._n - 1 - from_the_end)]
        return rows[-MAX_MARKS:]


def mark_of(row: np.void) -> Mark:
    """Return the mark that stands in a row of MARK_DTYPE."""
    seq, number, truth, half, exposure, tick, photons = row.item()[4:]
    return Mark(seq, number, truth, exposure, tick, photons, half)


def unknown_photons(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
    """Return NaN for each of objects (n,), whose light nobody told, float32 (n,)."""
    return np.full(len(numbers), np.nan, np.float32)
