"""What links the clicks of one detector: dead time, afterpulses, crosstalk between channels.

In: chances of clicks of single exposures (click_law.py). Out: chances that depend on clicks before and beside.

>>> from pans.instrument.detector import Afterpulses
>>> round(float(Afterpulses(0.05, 2.0).chance(0.1, [0.0, 0.0])), 3)
0.1
"""

from .afterpulses import LEAST_MEAN, SMALL_RATIO, Afterpulses, afterpulses_of
from .crosstalk import (
    Kernel,
    crosstalk_of,
    fired,
    seen_from_own,
    spared_by_neighbours,
    with_crosstalk,
    without_crosstalk,
)
from .dead_time import INTERVALS, STEP, DeadTime, counted_table, mean_of_most_clicks

__all__ = [
    "INTERVALS",
    "LEAST_MEAN",
    "SMALL_RATIO",
    "STEP",
    "Afterpulses",
    "DeadTime",
    "Kernel",
    "afterpulses_of",
    "counted_table",
    "crosstalk_of",
    "fired",
    "mean_of_most_clicks",
    "seen_from_own",
    "spared_by_neighbours",
    "with_crosstalk",
    "without_crosstalk",
]
