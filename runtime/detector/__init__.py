"""What links the exposures of one detector: afterpulses of the clicks before.

The simulator has code of its own for them, and a program in tests/independent counts single events.

>>> from pans.runtime.detector import Afterpulses
>>> round(float(Afterpulses(0.05, 2.0).chance(0.1, [0.0, 0.0])), 3)
0.1
"""

from .afterpulses import Afterpulses, afterpulses_of

__all__ = ["Afterpulses", "afterpulses_of"]
