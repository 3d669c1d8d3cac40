"""Tables as back ends: every click word, or every vector of click counts, decided beforehand.

Owns the way from clicks to a row and the winners of all rows; never evaluates a head while it decides. A table is exactly the head
that it was made from: no decision differs, ever.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.bundle.facts import words_among
from pans.runtime.bundle.head import open_head
from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError

from .verdict import Verdict, Verdicts, checked_counts, demand_golden, softmax_winners

COUNT_TABLE_ROWS_MAX = 1 << 16  # of a table that is made when a bundle is loaded: a fraction of a second


class CountTable:
    """Scores, label and probability of every vector of counts 0..`shots`: (shots+1)**d_f rows, channel 0 the lowest digit."""

    name: str

    def __init__(self, scores: NDArray[np.float32], shots: int, choice: Mapping[str, Any]) -> None:
        """`scores` float32 (rows, classes); `choice` says why this back end was taken."""
        self.choice = choice
        self.scores, self.shots, self.n_classes = scores, shots, scores.shape[1]
        self.n_features = n_features_of(len(scores), shots + 1)
        self.radix: NDArray[np.int64] = (shots + 1) ** np.arange(self.n_features, dtype=np.int64)
        self.labels: NDArray[Any]  # (rows,), uint16; of single shots uint8 up to 256 classes
        self.probabilities: NDArray[np.float32]  # (rows,), of the winning class
        wide, self.probabilities = softmax_winners(scores)
        self.labels = wide.astype(np.uint8) if shots == 1 and self.n_classes <= 256 else wide

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); the caller answers for 0 <= counts <= shots."""
        self._check(shots)
        row = int(counts @ self.radix)
        return Verdict(int(self.labels[row]), float(self.probabilities[row]))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the table's rows, float32 (n, classes), for click counts (n, d_f)."""
        return self.scores[self._index(counts, shots)]

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), for click counts (n, d_f)."""
        return self.labels[self._index(counts, shots)].astype(np.int64)

    def verdicts(self, counts: ArrayLike, shots: int) -> Verdicts:
        """Return labels and probabilities for click counts (n, d_f)."""
        index = self._index(counts, shots)
        return Verdicts(self.labels[index].astype(np.uint16), self.probabilities[index])

    def _check(self, shots: int) -> None:
        if shots != self.shots:
            raise UsageError(f"this table of counts answers {self.shots} shots, not {shots}")

    def _index(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        self._check(shots)
        return checked_counts(counts, shots, self.n_features) @ self.radix


class TableDecider(CountTable):
    """Every click word's label and probability, computed once: a decision is one look-up (K = 1 only, exactly the head)."""

    name = "table"

    def __init__(self, bundle: Bundle) -> None:
        if bundle.table is None:
            raise UsageError(f"{bundle.name} has no table")
        super().__init__(bundle.table, bundle.largest, {})
        single, rows = words_among(bundle.golden_means, bundle.outcomes)
        demand_golden(self.name, self.scores[rows], bundle.golden_scores[single], bundle)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from single clicks, int64 (d_f,); UsageError for anything but zeros and ones of one shot.

        Of photon numbers `shots` is the largest of them (photons.py), and they are 0 to that many.
        """
        if shots != 1 or self.shots != 1:
            self._check(shots)
            if int(counts.min()) < 0 or int(counts.max()) > shots:
                raise UsageError(f"the table answers numbers of 0 to {shots}, not {counts.tolist()}")
        elif int(counts @ counts) != int(counts.sum()):  # c * c == c only for 0 and 1
            raise UsageError(f"the table answers single shots of 0 or 1, not {counts.tolist()} of {shots}")
        return self.decide_word(int(counts @ self.radix))

    def decide_word(self, word: int) -> Verdict:
        """Decide from a packed click word (bit i is pattern i), a row of the table; IndexError beyond."""
        return Verdict(int(self.labels[word]), float(self.probabilities[word]))

    def decide_words(self, words: NDArray[Any], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return the labels (n,), dtype of `labels`, of uint16, uint32 or uint64 click words (n,), written to `out` if given."""
        if words.dtype not in (np.uint16, np.uint32, np.uint64) or words.ndim != 1:
            raise ValueError(f"click words are {words.dtype} {words.shape}, allowed: uint16, uint32 or uint64 (n,)")
        result = np.empty(len(words), dtype=self.labels.dtype) if out is None else out
        if result.shape != words.shape or result.dtype != self.labels.dtype:
            allowed = f"{self.labels.dtype} {words.shape}"
            raise ValueError(f"out is {result.dtype} {result.shape}, allowed: {allowed}")
        from .kernels import label_words  # numba is loaded only for those who have words in bulk

        bad = label_words(self.labels, words, result)
        if bad >= 0:
            raise ValueError(f"click word {int(words[bad])} at {bad}, allowed: below {len(self.labels)}")
        return result

    def _check(self, shots: int) -> None:
        if shots != self.shots:
            raise UsageError(
                f"the table answers single shots, not {shots / self.shots:g}", remedy="use the back end onnx"
            )


class CountTableDecider(CountTable):
    """The head's answer to every vector of counts 0..K, (K+1)^d_f rows, made when the bundle is loaded."""

    name = "count-table"

    def __init__(self, bundle: Bundle, shots: int, rows_max: int = COUNT_TABLE_ROWS_MAX) -> None:
        if bundle.head_onnx is None:
            raise UsageError(f"{bundle.name} has no ONNX head to make a table of counts from")
        if not fits_count_table(bundle.n_features, shots, rows_max):
            rows = (shots + 1) ** bundle.n_features
            raise UsageError(
                f"a table of counts for {shots} shots of {bundle.n_features} patterns has {rows:.3g} rows, allowed {rows_max}"
            )
        head = open_head(bundle.head_onnx, bundle.n_features, bundle.n_classes, bundle.name)
        demand_golden(self.name, head.scores(bundle.golden_means), bundle.golden_scores, bundle)
        radix = (shots + 1) ** np.arange(bundle.n_features, dtype=np.int64)
        counts = np.arange((shots + 1) ** bundle.n_features, dtype=np.int64)[:, None] // radix % (shots + 1)
        super().__init__(head.scores(counts.astype(np.float32) / np.float32(shots)), shots, {})


def fits_count_table(n_features: int, shots: int, rows_max: int = COUNT_TABLE_ROWS_MAX) -> bool:
    """Whether (shots+1)**n_features rows are at most `rows_max`, decided without forming the number."""
    return n_features * np.log2(shots + 1) <= np.log2(rows_max) + 1e-9


def n_features_of(rows: int, base: int) -> int:
    """Return d_f of a table of base**d_f `rows`."""
    n = 0
    while base**n < rows:
        n += 1
    return n
