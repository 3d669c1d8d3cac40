"""Where a known target stands before the instrument, measured through the single-photon detector itself; and patterns corrected for it.

A target's picture and the clicks under chosen patterns come in; shift, rotation, scale, sharpness, light and a flat field with intervals
go out, into a file, and with a bundle the levels to show instead. Start reading in measure.py (the two stages), then estimate.py.
"""
