"""What links the clicks of one detector: afterpulses of the exposures before, crosstalk between channels.

What comes in are chances of clicks of single exposures (instrument/click_law.py); what goes out are those that follow from clicks before
and beside. limits.py says where the laws stop holding. Start with afterpulses.py. Dead time is in
instrument/dead_time.py.

>>> from pans.runtime.detector import Afterpulses
>>> round(float(Afterpulses(0.05, 2.0).chance(0.1, [0.0, 0.0])), 3)
0.1
"""

from .afterpulses import Afterpulses, afterpulses_of

__all__ = ["Afterpulses", "afterpulses_of"]
