"""What the kernel of a call gets of a `still.Core`, or of any core that receives every message itself.

The state, the windows and the marks are the core's own; the rows are of one call. `Core.steps` makes it; decide/kernel/calls.py calls the
kernel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pans.bundle.backends import NO_LABEL, Decider
from pans.decide.decision import DECISION_DTYPE, DecisionFlag
from pans.decide.plan.marks import Marks
from pans.protocol.tracker import StreamTracker
from pans.protocol.wire import Mark

from . import kernels
from .kernels import DecisionTables, IdleArrays
from .tables import finite_labels
from .windows import DecisionWindows

ROWS_PER_CALL = 1 << 17  # decisions of one call, beside those of a block; a megabyte per 18 000
COUNTS_PER_CALL = 1 << 21  # counts of theirs that a back end is asked for: 16 MiB

Rows = npt.NDArray[np.void]


class CoreState:
    """What the kernel continues of a still.Core, of which it has the parts; all memory is allocated here, before arming."""

    def __init__(
        self,
        tracker: StreamTracker,
        marks: Marks,
        windows: DecisionWindows,
        tables: DecisionTables,
        decider: Decider,
        shots: int,
    ) -> None:
        self.windows, self.tables = windows, tables
        self._tracker, self._known = tracker, marks
        self._decider, self._shots = decider, shots
        asked = 0 if self.decides else decider.n_features
        rows_max = 2 * self.block_rows + min(ROWS_PER_CALL, COUNTS_PER_CALL // max(asked, 1))
        # Filled by the kernel alone; `Kernel.warm_up` touches it.
        self._rows: Rows = np.empty(rows_max, DECISION_DTYPE)
        self._counts = np.empty((rows_max if asked else 0, decider.n_features), np.int64)
        self._marks = windows.walk.marks
        self.walk = windows.walk._replace(tables=tables, rows=self._rows, counts=self._counts)

    @property
    def takes(self) -> bool:
        """Whether the kernel may take the core's messages."""
        return self._tracker.open

    @property
    def decides(self) -> bool:
        """Whether the kernel gives the labels, too: with a table or an automaton. Else `rows` asks the back end for many at once."""
        return bool(self.tables.labels.size)

    @property
    def block_rows(self) -> int:
        """Most decisions of one block."""
        return self.windows.block_rows

    def begin(self, session: int) -> None:
        """Follow the stream of `session`, from where the core stands: its marks are known, others forgotten."""
        self.walk.state["session"] = session
        self._marks.objects[:] = -1
        for mark in self._known.latest():
            self.remember(mark)

    def remember(self, mark: Mark) -> None:
        """Know a mark from here on."""
        slot = mark.object_index % kernels.MARK_SLOTS
        self._marks.objects[slot], self._marks.truths[slot] = mark.object_index, mark.truth
        self._marks.photons[slot] = mark.photons

    def photons_of(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return the expected photoelectrons of one shot on each of objects (n,), float32 (n,), NaN where no mark told them."""
        slots = numbers & (kernels.MARK_SLOTS - 1)  # a power of two
        return np.where(self._marks.objects[slots] == numbers, self._marks.photons[slots], np.float32(np.nan))

    def rows(self, first: int, stop: int) -> Rows:
        """Return the rows from `first` to `stop`; those that the kernel could not decide get their verdicts here, all at once."""
        rows = self._rows[first:stop]
        if self.decides or not len(rows):
            return rows
        whole = np.flatnonzero(rows["flags"] == 0)
        labels, probabilities = finite_labels(*self._decider.verdicts(self._counts[first + whole], self._shots))
        rows["label"][whole], rows["probability"][whole] = labels, probabilities
        silent = labels == NO_LABEL
        why = np.where(probabilities > 0, int(DecisionFlag.AMBIGUOUS), int(DecisionFlag.NOT_FINITE))
        rows["flags"][whole[silent]] = why[silent] | int(DecisionFlag.ABSTAINED)
        self.walk.state["n_abstained"] += int(silent.sum())
        return rows


class IdleSteps:
    """What the kernel has of a core (a Follower) that takes every message itself: it only receives and checks."""

    takes, decides, block_rows = False, False, 1

    def __init__(self, core: Any) -> None:
        self.walk = IdleArrays(core.state, np.zeros(1, DECISION_DTYPE), core.tracker.heard)

    def begin(self, session: int) -> IdleSteps:
        """Receive messages of `session`."""
        self.walk.state["session"] = session
        return self

    def rows(self, first: int, stop: int) -> Rows:
        """Return no rows."""
        return self.walk.rows[:0]
