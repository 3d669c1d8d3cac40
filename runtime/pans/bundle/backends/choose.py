"""A bundle in, a back end out that has answered the bundle's golden vectors: ours by name or by measurement, or another package's.

numba and onnxruntime are imported only by the back ends that need them.
"""

from __future__ import annotations

import time
from contextlib import suppress
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.console import load_offered, package_of
from pans.base.errors import UsageError, as_usage_error
from pans.bundle.automaton import DoseCap
from pans.bundle.sensor.bundle import word_means
from pans.bundle.sensor.facts import Bundle

from .onnx import OnnxDecider, PictureDecider
from .table import count_table, fits_count_table, word_table
from .verdict import Decider as Decider
from .verdict import Verdict, Verdicts, checked_counts

BACKENDS = ("auto", "table", "count-table", "sparse", "onnx", "int8", "int8-onnx", "float64", "automaton")
GROUP = "pans.backends"
MEASURED_CALLS = 200
TRIED = 64  # clicks tried before a run: enough to meet a wrong shape or range, few enough to cost nothing
CLICKS_SEED = 20250103
_LEAST = 1e-12  # of a probability, so that a score is finite


def offered_backends() -> dict[str, EntryPoint]:
    """Return the back ends of other packages by name; a name of ours cannot be used."""
    return {point.name: point for point in entry_points(group=GROUP) if point.name not in BACKENDS}


def backend_names() -> tuple[str, ...]:
    """Return every name that `make_decider` knows."""
    return (*BACKENDS, *sorted(offered_backends()))


def make_decider(
    bundle: Bundle, *, shots: int = 1, backend: str = "auto", confidence: float = 0.0, dose: DoseCap | None = None
) -> Decider:
    """Return a warmed-up back end that has answered the golden vectors of `bundle`.

    `auto` takes the table for single shots where there is one, and else the one whose median time for a decision is the least here, among
    those that answer as the float head does (`choice` says what was measured). An automaton decides by itself; with a `confidence` above 0
    it stops as soon as a class is that sure, and abstains at a leaf below it; with a `dose` it stops before it brings more light.
    UsageError for a back end that the bundle does not have or that cannot answer `shots`; DamagedFileError when it contradicts the
    golden vectors.
    """
    if backend not in BACKENDS and backend not in offered_backends():
        what = f"back end {backend!r}, allowed: {', '.join(backend_names())}"
        raise UsageError(what, remedy="install the package that offers it, if it is none of ours")
    if shots < 1:
        raise UsageError(f"shots is {shots}, allowed: 1 or more")
    if bundle.automaton is not None and backend in BACKENDS:
        return _automaton_decider(bundle, shots, backend, confidence, dose)
    if dose is not None:
        raise UsageError(f"a walk's dose, but {bundle.name} has no automaton", remedy="leave it out")
    if confidence:
        what = f"confidence is {confidence:g}, but {bundle.name} shows all its patterns before it decides"
        raise UsageError(what, remedy="leave it out, or use the bundle of an automaton and its own back end")
    if bundle.picture_shape is not None:
        if backend not in ("auto", PictureDecider.name):
            raise UsageError(f"back end {backend!r}: pictures come from the head alone", remedy="use the back end onnx")
        return PictureDecider(bundle)
    if backend == "auto":
        return _choose(bundle, shots)
    if backend in BACKENDS:
        return _make(bundle, shots, backend)
    return OfferedDecider(offered_backends()[backend], bundle, shots)


def _automaton_decider(bundle: Bundle, shots: int, backend: str, confidence: float, dose: DoseCap | None) -> Decider:
    from .automaton import AutomatonDecider, demand_one_shot

    if backend not in ("auto", AutomatonDecider.name):
        found = f"{bundle.name} has neither head nor table, its automaton decides"
        raise UsageError(f"back end {backend!r}: {found}", remedy="use the back end auto")
    demand_one_shot(shots)
    return AutomatonDecider(bundle, confidence, dose)


def _make(bundle: Bundle, shots: int, backend: str) -> Decider:
    """The back end of ours of that name, for fixed patterns among classes."""
    if backend == "table":
        table = word_table(bundle)
        table.decide(np.zeros(bundle.n_features, np.int64), shots)  # refuses other shots
        return table
    if backend == "count-table":
        return count_table(bundle, shots)
    if backend == "automaton":
        raise UsageError(f"{bundle.name} has no automaton", remedy="use the back end auto")
    if backend in ("onnx", "int8-onnx"):
        return OnnxDecider(bundle, int8=backend == "int8-onnx")
    from .int8 import Int8Decider, ReferenceDecider, SparseDecider

    return {"sparse": SparseDecider, "int8": Int8Decider, "float64": ReferenceDecider}[backend](bundle)


def _choose(bundle: Bundle, shots: int) -> Decider:
    """One look-up needs no measurement; otherwise every exact back end that can be made is timed on clicks as they come."""
    if shots == 1 and bundle.table is not None:
        table = word_table(bundle)
        table.choice = {"chosen": table.name, "why": "one look-up per decision"}
        return table
    if bundle.head_onnx is None:
        what = f"{bundle.name} has only a table of single shots, which cannot answer {shots} shots"
        raise UsageError(what, remedy="use --shots 1, or a bundle with an ONNX head")
    onnx = OnnxDecider(bundle)
    candidates: list[Any] = [onnx]
    with suppress(UsageError):  # a head that is no plain chain of layers: onnxruntime runs it
        candidates.append(_make(bundle, shots, "sparse"))
    exposures = shots * bundle.largest
    if fits_count_table(bundle.n_features, exposures) and onnx.affords((exposures + 1) ** bundle.n_features):
        candidates.append(count_table(bundle, shots))
    medians = {decider.name: median_us(decider, shots) for decider in candidates}
    best = min(candidates, key=lambda decider: medians[decider.name])
    measured = {name: round(value, 3) for name, value in medians.items()}
    best.choice = {"chosen": best.name, "why": "least median time", "p50_us": measured}
    return best


def median_us(decider: Decider, shots: int, calls: int = MEASURED_CALLS) -> float:
    """Return the median time of one decision in microseconds, over varied clicks with a fixed seed."""
    rng = np.random.default_rng(CLICKS_SEED)
    most = shots * decider.largest
    counts: NDArray[np.int64] = rng.integers(0, most + 1, size=(calls, decider.n_features))
    times: list[int] = []
    for row in counts:
        start_ns = time.perf_counter_ns()
        decider.decide(row, shots)
        times.append(time.perf_counter_ns() - start_ns)
    return float(np.median(times)) / 1000


def decide_clicks(bundle: Bundle, clicks: ArrayLike, *, shots: int = 1, backend: str = "auto") -> Verdicts:
    """Return `labels`, uint16 (n,), and `probabilities` of the winning classes, float32 (n,), for clicks of n objects: `pans.decide`.

    `clicks` are integers: words (n,) of one shot, in which bit k is pattern k's click, or counts (n, d_f) of `shots` shots; of a bundle
    that takes photon numbers, sums of those. UsageError for counts outside 0 to `shots` (times the largest number) or another shape.

    >>> from pans.bundle.sensor import load_bundle
    >>> bundle = load_bundle("fashion10")[0]
    >>> words, counts = [0b11], [[1, 1, 0, 0, 0, 0, 0, 0, 0, 0]]
    >>> decide_clicks(bundle, words).labels == decide_clicks(bundle, counts).labels
    array([ True])
    """
    d_f, largest = bundle.n_features, bundle.largest
    try:
        found = np.asarray(clicks)
    except ValueError as error:
        raise UsageError(f"clicks are no array: {error}", remedy="give the same number of counts per object") from error
    if found.size and found.dtype.kind not in "iub":
        allowed = f"integers, words (n,) or counts (n, {d_f}) from 0 to {shots * largest}"
        remedy = "give whole numbers of clicks; means times shots are counts"
        raise UsageError(f"clicks are {found.dtype} {found.shape}, allowed: {allowed}", remedy=remedy)
    found = found.astype(np.int64) if found.dtype.kind != "u" else found
    if found.ndim == 1:
        if largest > 1 or d_f > 63:
            what = "takes photon numbers" if largest > 1 else f"has {d_f} patterns, and words hold at most 63 clicks"
            raise UsageError(f"words of clicks, but {bundle.name} {what}", remedy="give counts (n, d_f)")
        if found.size and (int(found.min()) < 0 or int(found.max()) >> d_f):
            raise UsageError(f"words run from {found.min()} to {found.max()}, allowed: {d_f} bits")
        found = word_means(found, d_f).astype(np.int64)
    with as_usage_error():
        counts = checked_counts(found, shots * largest, d_f)
    return make_decider(bundle, shots=shots, backend=backend).verdicts(counts, shots)


class OfferedDecider(Decider):
    """What another package's `point` makes for `bundle`, as a `Decider`; every answer of it is checked.

    It is not compared with the golden vectors, for it may decide by other means than the head. Of photon numbers up to `largest` it gets
    the sums, and as many shots times that.
    """

    def __init__(self, point: EntryPoint, bundle: Bundle, shots: int) -> None:
        self.name, self.n_features, self.n_classes = point.name, bundle.n_features, bundle.n_classes
        self.largest = bundle.largest
        self._whose = f"back end {point.name!r} of {package_of(point)}"
        make = load_offered(point)
        try:
            self._theirs = make(bundle)
        except Exception as error:
            raise UsageError(f"{self._whose} cannot be made: {type(error).__name__}: {error}") from error
        wanted = {"name": self.name, "n_features": self.n_features, "n_classes": self.n_classes}
        for member, value in wanted.items():
            found = getattr(self._theirs, member, None)
            if found != value:
                remedy = "take the name of the entry point, and the numbers of patterns and classes of the bundle"
                raise UsageError(f"{self._whose}: its {member} is {found!r}, must be {value!r}", remedy=remedy)
        tried = np.random.default_rng(CLICKS_SEED)
        for row in tried.integers(0, shots * self.largest + 1, size=(TRIED, self.n_features)):
            self.decide(row, shots)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide one object; UsageError for an answer that is none, and for an error of the back end."""
        try:
            label, probability = self._theirs.decide(counts, shots * self.largest)
        except Exception as error:
            what = f"{self._whose} fails on the clicks {counts.tolist()}: {type(error).__name__}: {error}"
            raise UsageError(what, remedy="test it on these clicks, or run with another --backend") from error
        if not (0 <= label < self.n_classes and 0.0 <= probability <= 1.0):
            what = f"{self._whose} answers ({label}, {probability}) to the clicks {counts.tolist()}"
            raise UsageError(what, remedy=f"allowed: a label in 0..{self.n_classes - 1} and a probability in 0..1")
        return Verdict(int(label), float(probability))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return scores, float32 (n, classes), whose softmax gives the label its probability and the others equal shares."""
        labels, probabilities = self.verdicts(counts, shots)
        others = (1.0 - probabilities.astype(np.float64)) / max(self.n_classes - 1, 1)
        scores = np.repeat(np.log(np.maximum(others, _LEAST))[:, None], self.n_classes, axis=1)
        scores[np.arange(len(labels)), labels] = np.log(np.maximum(probabilities, _LEAST))
        return scores.astype(np.float32)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), of click counts, integers (n, d_f)."""
        return self.verdicts(counts, shots).labels.astype(np.int64)

    def verdicts(self, counts: ArrayLike, shots: int) -> Verdicts:
        """Return labels and probabilities of many objects, each decided alone."""
        rows = checked_counts(counts, shots * self.largest, self.n_features)
        found = np.array([self.decide(row, shots) for row in rows], np.float64).reshape(-1, 2)
        return Verdicts(found[:, 0].astype(np.uint16), found[:, 1].astype(np.float32))
