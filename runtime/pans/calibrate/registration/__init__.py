"""Where a known target stands before the instrument, measured through the detector itself; patterns corrected for it.

In: a target's picture and clicks of chosen patterns. Out: shift, rotation, scale, sharpness, light and a flat field, with intervals.
Start at measure.py (the two stages), then estimate.py.
"""

from .estimate import Estimate, pattern_residuals
from .file import (
    InUse,
    in_use,
    is_registration,
    load_registration,
    registration_values,
    registration_words,
    save_registration,
)
from .measure import Registration, check_estimate
from .parameters import DARK, N_GEOMETRY, PARAMETERS, flat_basis
from .target import BUILT_IN, built_in_target, read_target, target_sha256

__all__ = [
    "BUILT_IN",
    "DARK",
    "N_GEOMETRY",
    "PARAMETERS",
    "Estimate",
    "InUse",
    "Registration",
    "built_in_target",
    "check_estimate",
    "flat_basis",
    "in_use",
    "is_registration",
    "load_registration",
    "pattern_residuals",
    "read_target",
    "registration_values",
    "registration_words",
    "save_registration",
    "target_sha256",
]
