"""Files and results for people: the summary of a run, pages, verification, facts, exports.

Owns figures in words and what a file may claim; it reads recordings, bundles, profiles and calibrations, and never runs a device or
changes a file. `summarise` turns a run's result into a `Summary`, `verify_file` returns what is wrong with a file.

>>> from pans.runtime.report import verify_file
>>> verify_file("oled-qcmos").ok
True
"""

from .summary import Summary, summarise
from .verify import FileVerdict, verify_file

__all__ = ["FileVerdict", "Summary", "summarise", "verify_file"]
