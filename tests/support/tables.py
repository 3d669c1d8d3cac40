"""Tables of known optics as vectors of a registration."""

from __future__ import annotations

from typing import Any

import numpy as np

from pans.runtime.imaging import Imaging
from pans.runtime.registration.parameters import GEOMETRY


def vector_of(imaging: Imaging, flat: Any = (0.0,) * 5, dark: float = 0.0) -> np.ndarray:
    """The facts in `imaging` but for its flat field, which is given by its coefficients; then the dark photoelectrons."""
    facts = imaging.numbers()
    geometry = [facts[one.name] for one in GEOMETRY]
    return np.array([*geometry, facts["gain"], facts["black"], *flat, dark])
