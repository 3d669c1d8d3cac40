"""Files and results for people: the summary of a run, pages, verification, facts, exports.

What comes in are a run's result, recordings, bundles, profiles and calibrations; what goes out are figures, words and files for other
tools. The verdict of a run (PASS or FAIL, a sentence for each fault) is made in summary.py; words.py has the closing lines, verify.py what
a file may claim. Start with `summarise` and `verify_file`.

>>> from pans.runtime.report.verify import verify_file
>>> verify_file("oled-qcmos").ok
True
"""

from .summary import Summary, summarise

__all__ = ["Summary", "summarise"]
