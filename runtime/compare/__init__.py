"""Two runs side by side: what was different about them, and whether their results differ by more than chance.

What comes in are recordings, folders of runs or summaries; what goes out are findings with their tests, as text, JSON or a page. Start
with comparison.py; statistics.py has the tests.

>>> from pans.runtime.compare import mcnemar_exact
>>> round(mcnemar_exact(1, 9), 6)
0.021484
"""

from .comparison import Comparison, Side, compare, comparison_page, comparison_words, read_side
from .statistics import mcnemar_exact

__all__ = ["Comparison", "Side", "compare", "comparison_page", "comparison_words", "mcnemar_exact", "read_side"]
