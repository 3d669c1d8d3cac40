"""What a bundle decides on held-out objects, against photons. It needs numpy and the runtime alone. All figures are SIMULATED.

A bundle and a task come in, accuracy with clicks, photons and illumination goes out. Start with `held_out.py`, then `accuracy.py` (fixed
patterns) and `walks.py` (automata).
"""

from pans_trainer.options import Conditions

from .accuracy import Light, Measured, MeasuredPictures, light_of
from .held_out import evaluate, measure
from .walks import MeasuredWalks

__all__ = ["Conditions", "Light", "Measured", "MeasuredPictures", "MeasuredWalks", "evaluate", "light_of", "measure"]
