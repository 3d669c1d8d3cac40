"""The decision back ends behind one call: a table of all click words, or the ONNX head.

Owns the way from clicks to a label and its probability; never counts clicks (window.py) and never abstains (core.py).
`make_decider` chooses a back end and holds it against the bundle's golden vectors before it answers anything.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .bundle import Bundle, golden_violation
from .errors import DamagedFileError, UsageError
from .head import open_head

BACKENDS = ("auto", "table", "onnx")
WARM_UP_CALLS = 500
_CHUNK_ROWS = 65536


class Verdict(NamedTuple):
    """A label and the softmax probability of its class; probability 0.0 says that the scores were not finite."""

    label: int
    probability: float


class Decider(Protocol):
    """One back end, ready to answer; ties go to the lowest label."""

    @property
    def name(self) -> str:
        """`table` or `onnx`."""

    @property
    def n_features(self) -> int:
        """Number of patterns, d_f."""

    @property
    def n_classes(self) -> int:
        """Number of classes."""

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide one object from its clicks per pattern, int64 (d_f,), 0..shots, over `shots` shots."""

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the scores, float32 (n, classes), of click counts, integers (n, d_f)."""

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), of click counts, integers (n, d_f)."""


def make_decider(bundle: Bundle, *, shots: int = 1, backend: str = "auto") -> Decider:
    """Return a warmed-up back end that has answered the golden vectors of `bundle`.

    `auto` takes the table for single shots where there is one, else the ONNX head. UsageError for a back end that the
    bundle does not have or that cannot answer `shots`; DamagedFileError when it contradicts the golden vectors.
    """
    if backend not in BACKENDS:
        raise UsageError(f"back end {backend!r}, allowed: {', '.join(BACKENDS)}")
    if shots < 1:
        raise UsageError(f"shots is {shots}, allowed: 1 or more")
    if backend == "table" or (backend == "auto" and shots == 1 and bundle.table is not None):
        return _table_decider(bundle, shots)
    if bundle.head_onnx is None:
        raise UsageError(
            f"{bundle.name} has only a table of single clicks, which cannot answer {shots} shots",
            remedy="use --shots 1, or a bundle with an ONNX head",
        )
    return OnnxDecider(bundle)


def _table_decider(bundle: Bundle, shots: int) -> TableDecider:
    if bundle.table is None:
        raise UsageError(f"{bundle.name} has no table ({bundle.n_features} patterns)", remedy="use the back end onnx")
    if shots != 1:
        raise UsageError(f"the table answers single shots, not {shots}", remedy="use the back end onnx, or one shot")
    return TableDecider(bundle)


def softmax_winner(scores: NDArray[np.float32]) -> Verdict:
    """Return label and probability of one row of scores, float32 (classes,), by a stable log-sum-exp in float64."""
    wide = scores.astype(np.float64)
    label = int(wide.argmax())
    best = float(wide[label])
    if not math.isfinite(best):  # argmax finds a NaN first
        return Verdict(label, 0.0)
    return Verdict(label, 1.0 / float(np.exp(wide - best).sum()))  # the winner itself adds 1


class TableDecider:
    """Every click word's label and probability, computed once: a decision is one look-up (K = 1 only, exactly the head)."""

    name = "table"

    def __init__(self, bundle: Bundle) -> None:
        if bundle.table is None:
            raise UsageError(f"{bundle.name} has no table")
        self.n_features = bundle.n_features
        self.n_classes = bundle.n_classes
        self._scores = bundle.table
        self._weights = 1 << np.arange(self.n_features, dtype=np.int64)
        self.labels: NDArray[Any]  # (2**d_f,), uint8 up to 256 classes, else uint16
        self.probabilities: NDArray[np.float32]  # (2**d_f,), of the winning class
        self.labels, self.probabilities = _winners(bundle.table)
        binary = ((bundle.golden_means == 0) | (bundle.golden_means == 1)).all(axis=1)
        found = self.scores_batch(bundle.golden_means[binary].astype(np.int64), 1)
        _demand_golden(self.name, found, bundle.golden_scores[binary], bundle)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from single clicks, int64 (d_f,); UsageError for anything but zeros and ones of one shot."""
        if shots != 1 or int(counts @ counts) != int(counts.sum()):  # c * c == c only for 0 and 1
            raise UsageError(f"the table answers single shots of 0 or 1, not {counts.tolist()} of {shots}")
        return self.decide_word(int(counts @ self._weights))

    def decide_word(self, word: int) -> Verdict:
        """Decide from a packed click word (bit i is pattern i), 0 <= word < 2**d_f; IndexError beyond."""
        return Verdict(int(self.labels[word]), float(self.probabilities[word]))

    def decide_words(self, words: NDArray[Any], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return the labels (n,), dtype of `labels`, of uint32 or uint64 click words (n,), written to `out` if given."""
        from .decide_kernels import label_words

        if words.dtype not in (np.uint32, np.uint64) or words.ndim != 1:
            raise UsageError(f"click words are {words.dtype} {words.shape}, allowed: uint32 or uint64 (n,)")
        result = np.empty(len(words), dtype=self.labels.dtype) if out is None else out
        if result.shape != words.shape or result.dtype != self.labels.dtype:
            allowed = f"{self.labels.dtype} {words.shape}"
            raise UsageError(f"out is {result.dtype} {result.shape}, allowed: {allowed}")
        bad = label_words(self.labels, words, result)
        if bad >= 0:
            raise UsageError(f"click word {int(words[bad])} at {bad}, allowed: below {1 << self.n_features}")
        return result

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the table's rows, float32 (n, classes), for single clicks (n, d_f)."""
        return self._scores[self._index(counts, shots)]

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), for single clicks (n, d_f)."""
        return self.labels[self._index(counts, shots)].astype(np.int64)

    def _index(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        if shots != 1:
            raise UsageError(f"the table answers single shots, not {shots}", remedy="use the back end onnx")
        return _checked_counts(counts, shots, self.n_features) @ self._weights


class OnnxDecider:
    """The ONNX head on one thread; a single decision runs through buffers that are bound once."""

    name = "onnx"

    def __init__(self, bundle: Bundle) -> None:
        import onnxruntime

        if bundle.head_onnx is None:
            raise UsageError(f"{bundle.name} has no ONNX head")
        self.n_features = bundle.n_features
        self.n_classes = bundle.n_classes
        self._head = open_head(bundle.head_onnx, bundle.n_features, bundle.n_classes, bundle.name)
        self._input = np.zeros((1, bundle.n_features), dtype=np.float32)
        self._output = np.zeros((1, bundle.n_classes), dtype=np.float32)
        self._means, self._scores = self._input[0], self._output[0]
        self._run = self._head.session.run_with_iobinding
        self._binding = self._head.session.io_binding()
        make = onnxruntime.OrtValue.ortvalue_from_numpy  # on the CPU a view of the array, not a copy
        self._binding.bind_ortvalue_input(self._head.input_name, make(self._input))
        self._binding.bind_ortvalue_output(self._head.output_name, make(self._output))
        self._check_golden(bundle)
        for _ in range(WARM_UP_CALLS):
            self._run(self._binding)

    def _check_golden(self, bundle: Bundle) -> None:
        """Hold the batch path and the bound path against the golden vectors: they are different code in onnxruntime."""
        found = self._head.scores(bundle.golden_means)
        _demand_golden(self.name, found, bundle.golden_scores, bundle)
        for row, means in enumerate(bundle.golden_means):
            self._means[:] = means
            self._run(self._binding)
            found[row] = self._scores
        _demand_golden(f"{self.name} (single decisions)", found, bundle.golden_scores, bundle)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,); the caller answers for 0 <= counts <= shots and shots >= 1."""
        np.divide(counts, np.float32(shots), out=self._means, casting="same_kind", dtype=np.float32)
        self._run(self._binding)
        return softmax_winner(self._scores)

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the head's scores, float32 (n, classes), for click counts (n, d_f)."""
        means = _checked_counts(counts, shots, self.n_features).astype(np.float32) / np.float32(shots)
        return self._head.scores(means)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), for click counts (n, d_f)."""
        return self.scores_batch(counts, shots).argmax(axis=1).astype(np.int64)


def _checked_counts(counts: ArrayLike, shots: int, n_features: int) -> NDArray[np.int64]:
    values = np.asarray(counts)
    if values.ndim != 2 or values.shape[1] != n_features or not np.issubdtype(values.dtype, np.integer):
        raise UsageError(f"counts are {values.dtype} {values.shape}, allowed: integers (n, {n_features})")
    if shots < 1:
        raise UsageError(f"shots is {shots}, allowed: 1 or more")
    if values.size and (int(values.min()) < 0 or int(values.max()) > shots):
        raise UsageError(f"counts run from {values.min()} to {values.max()}, allowed: 0 to {shots}")
    return values.astype(np.int64)


def _winners(table: NDArray[np.float32]) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Labels and winning probabilities of all rows, in pieces so that float64 copies stay small."""
    labels = np.empty(len(table), dtype=np.uint8 if table.shape[1] <= 256 else np.uint16)
    probabilities = np.empty(len(table), dtype=np.float32)
    for start in range(0, len(table), _CHUNK_ROWS):
        wide = table[start : start + _CHUNK_ROWS].astype(np.float64)
        labels[start : start + _CHUNK_ROWS] = wide.argmax(axis=1)
        wide -= wide.max(axis=1, keepdims=True)
        probabilities[start : start + _CHUNK_ROWS] = 1.0 / np.exp(wide).sum(axis=1)
    return labels, probabilities


def _demand_golden(name: str, found: NDArray[np.float32], golden: NDArray[np.float32], bundle: Bundle) -> None:
    difference = golden_violation(found, golden)
    if difference:
        raise DamagedFileError(
            f"{bundle.name}: the back end {name} contradicts the golden vectors of the bundle: {difference}",
            remedy="export the bundle again, or check the onnxruntime installation of this machine",
        )
