"""The results of a run: figures, PASS or FAIL with its reasons, and the words for both.

>>> from pans.report.summary import summarise  # from a run's result
"""

from .summary import Summary, contradictions_of, exposure_fault, summarise, walk_figures
from .words import closing_words, lines_of, rows_of, write_markdown

__all__ = [
    "Summary",
    "closing_words",
    "contradictions_of",
    "exposure_fault",
    "lines_of",
    "rows_of",
    "summarise",
    "walk_figures",
    "write_markdown",
]
