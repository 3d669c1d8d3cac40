"""From clicks to a label and its probability, or to a picture: the back ends behind one call, `make_decider`.

A back end answers the bundle's golden vectors before it answers anything else. Scores that are not finite come back with probability 0.
Start at verdict.py (`Decider`, `Verdict`), then choose.py. A new back end is a file here, a name in `BACKENDS` and a line in `_make` of
choose.py, and one in `_choose` if `auto` may choose it; one of another package is an entry point (`pans.backends`).

>>> import numpy as np
>>> from pans.bundle.backends import make_decider
>>> from pans.bundle.sensor import load_bundle
>>> decider = make_decider(load_bundle("fashion10")[0], backend="table")
>>> decider.decide(np.array([1, 0] * 5), shots=1).label == int(decider.decide_batch([[1, 0] * 5], 1)[0])
True
"""

from typing import TYPE_CHECKING

from pans.base import loaded_later

from .choose import BACKENDS, backend_names, decide_clicks, make_decider
from .onnx import OnnxDecider, PictureDecider
from .table import TableDecider, count_table, fits_count_table, n_features_of
from .verdict import (
    NO_LABEL,
    Decider,
    Verdict,
    Verdicts,
    checked_counts,
    log_evidence,
    softmax_winner,
)

if TYPE_CHECKING:
    from .automaton import AutomatonDecider, leaf_verdicts, walked_within
    from .expectation import ExpectedWalk, expected_walk, pattern_light
    from .int8 import SparseDecider, bundle_layers

__all__ = [
    "BACKENDS",
    "NO_LABEL",
    "AutomatonDecider",
    "Decider",
    "ExpectedWalk",
    "OnnxDecider",
    "PictureDecider",
    "SparseDecider",
    "TableDecider",
    "Verdict",
    "Verdicts",
    "backend_names",
    "bundle_layers",
    "checked_counts",
    "count_table",
    "decide_clicks",
    "expected_walk",
    "fits_count_table",
    "leaf_verdicts",
    "log_evidence",
    "make_decider",
    "n_features_of",
    "pattern_light",
    "softmax_winner",
    "walked_within",
]

__getattr__ = loaded_later(__name__, "automaton", "expectation", "int8")
