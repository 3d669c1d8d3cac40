"""Two runs side by side: what was different, and which results differ by more than chance.

Start at comparison.py; statistics.py has the tests.

>>> from pans.report.compare import mcnemar_exact
>>> round(mcnemar_exact(1, 9), 6)
0.021484
"""

from .comparison import Comparison, Side, compare, comparison_page, comparison_words, read_side
from .statistics import mcnemar_exact

__all__ = [
    "Comparison",
    "Side",
    "compare",
    "comparison_page",
    "comparison_words",
    "mcnemar_exact",
    "read_side",
]
