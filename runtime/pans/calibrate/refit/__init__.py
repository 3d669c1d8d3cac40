"""A bundle fitted to the instrument by the clicks of labelled objects: what decides, and what is shown.

In: recordings and labels, or an open device. Out: a bundle with a corrected table, head or automaton, chosen by held-out log loss.
Start at choosing.py; evidence.py has the mathematics, tune.py the search on the device. numpy only.
"""

from .choosing import FOLDS, OLD, PER_CLASS_MIN, Judged, Refitted, choose, judge, kinds_for
from .clicks import Labelled, labelled_clicks, read_labels
from .evidence import evidence_of, log_softmax
from .rebuild import Rows, chain_onnx, rebuilt, rows_of
from .tune import Cost, Move, Tuning, scene_size

__all__ = [
    "FOLDS",
    "OLD",
    "PER_CLASS_MIN",
    "Cost",
    "Judged",
    "Labelled",
    "Move",
    "Refitted",
    "Rows",
    "Tuning",
    "chain_onnx",
    "choose",
    "evidence_of",
    "judge",
    "kinds_for",
    "labelled_clicks",
    "log_softmax",
    "read_labels",
    "rebuilt",
    "rows_of",
    "scene_size",
]
