"""Where a known target stands before the instrument, measured through the single-photon detector itself; and patterns corrected for it.

Owns the estimate, the patterns that tell most, the file, and the correction of patterns before they are uploaded.
"""
