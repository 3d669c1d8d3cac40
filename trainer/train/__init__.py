"""Training through an instrument: the loop, its schedule, its data, checkpoints, and exact searches for small tasks.

Owns the way from random patterns to whole projector levels and a finished head, within a budget of light; never sees the held-out
objects (but `history.follow`, which measures and does not choose) and never writes a bundle.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .head_fit import fit_head
    from .loop import EpochReport, Run, Trained, train

__all__ = ["EpochReport", "Run", "Trained", "fit_head", "train"]

__getattr__ = lazy_names(
    __name__,
    {
        "fit_head": ".head_fit",
        "EpochReport": ".loop",
        "Run": ".loop",
        "Trained": ".loop",
        "train": ".loop",
    },
)
