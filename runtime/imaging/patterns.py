"""The adjoint view: patterns as the object meets them, so that few patterns are changed in place of many objects.

Owns black level, flat field and gain, and the order in which they act; the geometry is sampling.py's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .model import Imaging
from .sampling import Shape, operator

F64 = NDArray[np.float64]


def levelled(imaging: Imaging, patterns: F64, shape: Shape, peak: F64 | float = 1.0) -> F64:
    """Return the light of every pattern pixel, float64 (patterns, pixels): gain * flat * (black * peak + (1 - black) * pattern).

    `peak` is the light of a full pixel, of all patterns or (patterns, 1) of each. A pattern without a lit pixel gets the black level
    too: the light is on. ValueError when the shapes differ.
    """
    light = np.asarray(patterns, np.float64)
    if light.ndim != 2 or light.shape[1] != shape[0] * shape[1]:
        raise ValueError(f"patterns are {light.shape}, allowed: (patterns, {shape[0]} * {shape[1]})")
    if imaging.flat is not None and imaging.flat.shape != shape:
        raise ValueError(f"the flat field is {imaging.flat.shape}, the patterns are {shape}")
    light = imaging.gain * (imaging.black * np.asarray(peak, np.float64) + (1.0 - imaging.black) * light)
    return light if imaging.flat is None else np.asarray(light * imaging.flat.reshape(-1))


def met(imaging: Imaging, patterns: F64, shape: Shape, peak: F64 | float = 1.0) -> F64:
    """Return patterns as the object meets them, float64 (patterns, pixels): light = met(...) @ transmission.

    The same as levelled(...) @ seen(...).T for every object; arguments as of `levelled`.
    """
    light = levelled(imaging, patterns, shape, peak)
    return light if imaging.in_place else np.asarray(light @ operator(imaging, shape))
