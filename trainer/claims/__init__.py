"""Whether the pages of results say what their figures say.

Owns the counts in the index: how many figures are above, level and below. Never measures, and writes the index's counts alone.
"""
