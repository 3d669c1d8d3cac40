"""Where the object stands on the pattern grid and how sharply it is seen: the optics between projector and object as numbers.

Owns the model (shift, rotation, magnification, blur, black level, gain, flat field), the linear map from an object to what the pattern
grid meets of it, the spelling of `--optics`, and what bleaching leaves of a sample. Numpy only; never reads a profile, never draws a click.

>>> import numpy as np
>>> from pans.runtime.imaging import Imaging, seen
>>> seen(Imaging(right_px=1.0), np.array([[1.0, 0.5, 0.0, 0.0]]), (2, 2))
array([[0., 1., 0., 0.]])
"""

from .bleaching import NO_BLEACHING, Bleaching, bleached, bleaching_of, mean_left
from .model import IDENTITY, Imaging, checked_flat
from .patterns import levelled, met
from .sampling import operator, seen
from .spec import Tolerance, imaging_of, is_spec, tolerance_of

__all__ = [
    "IDENTITY",
    "NO_BLEACHING",
    "Bleaching",
    "Imaging",
    "Tolerance",
    "bleached",
    "bleaching_of",
    "checked_flat",
    "imaging_of",
    "is_spec",
    "levelled",
    "mean_left",
    "met",
    "operator",
    "seen",
    "tolerance_of",
]
