"""The decision back ends behind one call, chosen by measurement when a bundle is loaded.

Owns the choice and its reasons; never counts clicks (core/window.py) and never abstains (core/still.py). `make_decider` returns a back
end that has been held against the bundle's golden vectors before it answers anything. What a decision is stands in verdict.py, the back
ends in table.py, mlp.py and onnx.py; numba and onnxruntime are imported only by those that need them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import DoseCap
from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError

from .names import BACKENDS as BACKENDS
from .names import backend_names, offered_backends
from .offered import CLICKS_SEED, OfferedDecider
from .onnx import OnnxDecider as OnnxDecider
from .onnx import PictureDecider
from .photons import PhotonDecider
from .table import CountTableDecider, fits_count_table
from .table import TableDecider as TableDecider
from .verdict import Decider as Decider
from .verdict import Verdict as Verdict
from .verdict import softmax_winner as softmax_winner

MEASURED_CALLS = 200


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
        raise UsageError(
            f"back end {backend!r}, allowed: {', '.join(backend_names())}",
            remedy="install the package that offers it, if it is none of ours",
        )
    if shots < 1:
        raise UsageError(f"shots is {shots}, allowed: 1 or more")
    if bundle.automaton is not None and backend in BACKENDS:
        return _automaton_decider(bundle, shots, backend, confidence, dose)
    if dose is not None:
        raise UsageError(f"a walk's dose, but {bundle.name} has no automaton", remedy="leave it out")
    if confidence:
        raise UsageError(
            f"confidence is {confidence:g}, but {bundle.name} shows all its patterns before it decides",
            remedy="leave it out, or use the bundle of an automaton and its own back end",
        )
    if bundle.picture_shape is not None:
        if backend not in ("auto", PictureDecider.name):
            raise UsageError(f"back end {backend!r}: pictures come from the head alone", remedy="use the back end onnx")
        return PictureDecider(bundle)
    if bundle.largest == 1:
        return _fixed_decider(bundle, shots, backend)
    return PhotonDecider(_fixed_decider(bundle, shots * bundle.largest, backend), bundle.largest)


def _fixed_decider(bundle: Bundle, shots: int, backend: str) -> Decider:
    """The back end of fixed patterns that answers counts of 0 to `shots`: of photon numbers `shots` is times the largest of them."""
    if backend == "auto":
        return _choose(bundle, shots)
    if backend in BACKENDS:
        return _make(bundle, shots, backend)
    return OfferedDecider(offered_backends()[backend], bundle, shots)


def _automaton_decider(bundle: Bundle, shots: int, backend: str, confidence: float, dose: DoseCap | None) -> Decider:
    from .automaton import AutomatonDecider, demand_one_shot

    if backend not in ("auto", AutomatonDecider.name):
        raise UsageError(
            f"back end {backend!r}: {bundle.name} has neither head nor table, its automaton decides",
            remedy="use the back end auto",
        )
    demand_one_shot(shots)
    return AutomatonDecider(bundle, confidence, dose)


def _make(bundle: Bundle, shots: int, backend: str) -> Decider:
    if backend == "table":
        return _table_decider(bundle, shots)
    if backend == "count-table":
        return CountTableDecider(bundle, shots)
    if backend == "automaton":
        raise UsageError(f"{bundle.name} has no automaton", remedy="use the back end auto")
    if backend in ("onnx", "int8-onnx"):
        return OnnxDecider(bundle, int8=backend == "int8-onnx")
    from . import mlp as decide_mlp

    makers: dict[str, Callable[[Bundle], Decider]] = {
        "sparse": decide_mlp.SparseDecider,
        "int8": decide_mlp.Int8Decider,
        "float64": decide_mlp.ReferenceDecider,
    }
    return makers[backend](bundle)


def _choose(bundle: Bundle, shots: int) -> Decider:
    """One look-up needs no measurement; otherwise every exact back end that can be made is timed on clicks as they come."""
    if shots == bundle.largest and bundle.table is not None:
        table = TableDecider(bundle)
        table.choice = {"chosen": table.name, "why": "one look-up per decision"}
        return table
    if bundle.head_onnx is None:
        raise UsageError(
            f"{bundle.name} has only a table of single shots, which cannot answer {shots // bundle.largest} shots",
            remedy="use --shots 1, or a bundle with an ONNX head",
        )
    onnx = OnnxDecider(bundle)
    candidates: list[Decider] = [onnx]
    with suppress(UsageError):  # a head that is no plain chain of layers: onnxruntime runs it
        candidates.append(_make(bundle, shots, "sparse"))
    if fits_count_table(bundle.n_features, shots) and onnx.affords((shots + 1) ** bundle.n_features):
        candidates.append(CountTableDecider(bundle, shots))
    medians = {decider.name: median_us(decider, shots) for decider in candidates}
    best = min(candidates, key=lambda decider: medians[decider.name])
    measured = {name: round(value, 3) for name, value in medians.items()}
    best.choice = {"chosen": best.name, "why": "least median time", "p50_us": measured}  # type: ignore[attr-defined]
    return best


def median_us(decider: Decider, shots: int, calls: int = MEASURED_CALLS) -> float:
    """Return the median time of one decision in microseconds, over varied clicks with a fixed seed."""
    rng = np.random.default_rng(CLICKS_SEED)
    counts: NDArray[np.int64] = rng.integers(0, shots + 1, size=(calls, decider.n_features))
    times: list[int] = []
    for row in counts:
        start_ns = time.perf_counter_ns()
        decider.decide(row, shots)
        times.append(time.perf_counter_ns() - start_ns)
    return float(np.median(times)) / 1000


def _table_decider(bundle: Bundle, shots: int) -> TableDecider:
    if bundle.table is None:
        raise UsageError(f"{bundle.name} has no table ({bundle.n_features} patterns)", remedy="use the back end onnx")
    if shots != bundle.largest:
        raise UsageError(
            f"the table answers single shots, not {shots // bundle.largest}",
            remedy="use the back end onnx, or one shot",
        )
    return TableDecider(bundle)
