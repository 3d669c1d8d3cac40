"""Optics between projector and object: shift, rotation, magnification, blur, black level, gain, flat field, bleaching.

In: facts of the table (`Imaging`, or text as `--optics` spells it) and objects or patterns as arrays. Out: the light that a pattern gets
through an object. Start at model.py. numpy only.

>>> import numpy as np
>>> from pans.instrument.optics import Imaging, seen
>>> seen(Imaging(right_px=1.0), np.array([[1.0, 0.5, 0.0, 0.0]]), (2, 2))
array([[0., 1., 0., 0.]])
"""

from .bleaching import NO_BLEACHING, Bleaching, bleached, bleaching_of, mean_left
from .model import IDENTITY, Imaging, Tolerance, checked_flat, imaging_of, is_spec, tolerance_of
from .sampling import levelled, met, operator, seen

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
