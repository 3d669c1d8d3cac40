"""Every click word, or every vector of click counts, decided beforehand: counts in, a row of the table out.

A table is exactly the head that it was made from: no decision differs, ever.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.errors import UsageError
from pans.bundle.heads.head import open_head
from pans.bundle.sensor.facts import Bundle, words_among

from .verdict import Decider, LookUp, Verdict, Verdicts, checked_counts, demand_golden, softmax_winners

COUNT_TABLE_ROWS_MAX = 1 << 16  # of a table that is made when a bundle is loaded: a fraction of a second


class TableDecider(Decider):
    """Scores, label and probability of every vector of counts 0..`exposures`: (exposures+1)**d_f rows, channel 0 the lowest digit."""

    def __init__(
        self, scores: NDArray[np.float32], exposures: int, shots: int = 1, choice: Mapping[str, Any] | None = None
    ) -> None:
        """`scores` float32 (rows, classes) of counts over `shots` shots; `choice` says why this back end was chosen."""
        self.name = "table" if shots == 1 else "count-table"
        self.choice = choice or {}
        self.scores, self.exposures, self.shots, self.n_classes = scores, exposures, shots, scores.shape[1]
        self.n_features = n_features_of(len(scores), exposures + 1)
        self.radix: NDArray[np.int64] = (exposures + 1) ** np.arange(self.n_features, dtype=np.int64)
        self.labels: NDArray[Any]  # (rows,), uint16; of single clicks uint8 up to 256 classes
        self.probabilities: NDArray[np.float32]  # (rows,), of the winning class
        wide, self.probabilities = softmax_winners(scores)
        self.labels = wide.astype(np.uint8) if exposures == 1 and self.n_classes <= 256 else wide
        self.look_up = LookUp(self.labels, self.probabilities, self.radix)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); UsageError for other shots, or counts that no row has."""
        if shots != self.shots:
            self._refuse(shots)
        if self.exposures == 1:
            inside = int(counts @ counts) == int(counts.sum())  # c * c == c only for 0 and 1
        else:
            inside = int(counts.min()) >= 0 and int(counts.max()) <= self.exposures
        if not inside:
            raise UsageError(f"the table answers numbers of 0 to {self.exposures}, not {counts.tolist()}")
        row = int(counts @ self.radix)
        return Verdict(int(self.labels[row]), float(self.probabilities[row]))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the table's rows, float32 (n, classes), for click counts (n, d_f)."""
        return self.scores[self._rows(counts, shots)]

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), for click counts (n, d_f)."""
        return self.labels[self._rows(counts, shots)].astype(np.int64)

    def verdicts(self, counts: ArrayLike, shots: int) -> Verdicts:
        """Return labels and probabilities for click counts (n, d_f)."""
        rows = self._rows(counts, shots)
        return Verdicts(self.labels[rows].astype(np.uint16), self.probabilities[rows])

    def _rows(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        if shots != self.shots:
            self._refuse(shots)
        return checked_counts(counts, self.exposures, self.n_features) @ self.radix

    def _refuse(self, shots: int) -> None:
        what = "single shots" if self.shots == 1 else f"{self.shots} shots"
        raise UsageError(f"the table answers {what}, not {shots}", remedy="use the back end onnx, or one shot")


def word_table(bundle: Bundle) -> TableDecider:
    """Return the bundle's own table, which answers single shots; UsageError without one, DamagedFileError as `demand_golden`."""
    if bundle.table is None:
        raise UsageError(f"{bundle.name} has no table ({bundle.n_features} patterns)", remedy="use the back end onnx")
    found = TableDecider(bundle.table, bundle.largest)
    single, rows = words_among(bundle.golden_means, bundle.outcomes)
    demand_golden(found.name, found.scores[rows], bundle.golden_scores[single], bundle)
    return found


def count_table(bundle: Bundle, shots: int, rows_max: int = COUNT_TABLE_ROWS_MAX) -> TableDecider:
    """Return the head's answers to every vector of counts over `shots` shots; UsageError without a head, or for too many rows."""
    exposures, d_f = shots * bundle.largest, bundle.n_features
    if bundle.head_onnx is None:
        raise UsageError(f"{bundle.name} has no ONNX head to make a table of counts from")
    if not fits_count_table(d_f, exposures, rows_max):
        rows = (exposures + 1) ** d_f
        what = f"a table of counts for {shots} shots of {d_f} patterns"
        raise UsageError(f"{what} has {rows:.3g} rows, allowed {rows_max}")
    head = open_head(bundle.head_onnx, d_f, bundle.n_classes, bundle.name)
    demand_golden("count-table", head.scores(bundle.golden_means), bundle.golden_scores, bundle)
    radix = (exposures + 1) ** np.arange(d_f, dtype=np.int64)
    counts = np.arange((exposures + 1) ** d_f, dtype=np.int64)[:, None] // radix % (exposures + 1)
    found = TableDecider(head.scores(counts.astype(np.float32) / np.float32(exposures)), exposures, shots)
    found.name = "count-table"
    return found


def fits_count_table(n_features: int, exposures: int, rows_max: int = COUNT_TABLE_ROWS_MAX) -> bool:
    """Whether (exposures+1)**n_features rows are at most `rows_max`, decided without forming the number."""
    return n_features * np.log2(exposures + 1) <= np.log2(rows_max) + 1e-9


def n_features_of(rows: int, base: int) -> int:
    """Return d_f of a table of base**d_f `rows`."""
    n = 0
    while base**n < rows:
        n += 1
    return n
