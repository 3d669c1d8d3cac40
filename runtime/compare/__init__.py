"""Two runs side by side: what was different about them, and whether their results differ by more than chance.

Owns the tests and their words. It reads recordings, folders of runs and summaries; it never runs anything and never changes a file.

>>> from pans.runtime.compare import mcnemar_exact
>>> round(mcnemar_exact(1, 9), 6)
0.021484
"""

from .comparison import Comparison, compare
from .side import Side, read_side
from .statistics import mcnemar_exact

__all__ = ["Comparison", "Side", "compare", "mcnemar_exact", "read_side"]
