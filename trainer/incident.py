"""What light reaches a passive encoder, from the 8-bit images of a task: field amplitudes or intensities, at a fixed scale.

Owns the meaning of grey levels for passive sensing; never an encoder and never the modulator of active sensing (see
`pans.runtime.clicks.object_transmission`). Full scale (grey 255) is amplitude 1 and intensity 1; nothing is normalised per image or
per batch, so that no object depends on another. How many photons full scale stands for is the encoder's matter.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .task_mmf import scatter

Light = Literal["transmission", "field", "intensity"]
Optics = Literal["none", "mmf"]


def incident_field(
    images: NDArray[np.uint8], light: Light, optics: Optics = "none"
) -> NDArray[np.float32] | NDArray[np.complex64]:
    """Return field amplitudes (n, height, width) for a coherent encoder, float32, or complex64 behind a fibre.

    `light` says what grey / 255 is: an amplitude (`field`), or an intensity or transmission, whose square root with flat
    phase is taken. `optics` "mmf" sends amplitudes of 28 x 28 pixels through the multimode fibre of task_mmf.py.
    """
    if optics == "mmf":
        return scatter(images)
    amplitude = (images / np.float32(255)).astype(np.float32)
    return amplitude if light == "field" else np.sqrt(amplitude)


def incident_intensity(images: NDArray[np.uint8], light: Light, optics: Optics = "none") -> NDArray[np.float32]:
    """Return intensities (n, height, width), float32, for an incoherent encoder: the squared modulus of the field."""
    field = incident_field(images, light, optics)
    return (field.real**2 + field.imag**2).astype(np.float32) if np.iscomplexobj(field) else np.square(field)
