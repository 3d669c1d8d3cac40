"""Training of fixed patterns or passive optics through an instrument.

A task, a profile and `Options` come in, a `Trained` model goes out. Start with `loop.py`; `exact_search.py` solves small tasks exactly.
"""

from .head_fit import fit_head
from .loop import EpochReport, Run, Trained, train

__all__ = ["EpochReport", "Run", "Trained", "fit_head", "train"]
