"""Whether the pages of results say what their figures say.

Owns the counts in the index (above, level, below), the numbers of the text that is written by hand, each found among the figures of the
page's JSON or declared, and the check of a whole folder, `pans reproduce check`. Never measures, and writes the index's counts alone.
"""
