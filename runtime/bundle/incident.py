"""What light reaches a passive sensor, from 8-bit images: field amplitudes or intensities, at a fixed scale.

Owns the meaning of grey levels for passive sensing and the optics in front of the sensor (a multimode fibre); never the sensor's own
optics (optics.py) and never the modulator of active sensing (`clicks.object_transmission`). Full scale (grey 255) is amplitude 1
and intensity 1; nothing is normalised per image or per batch, so that no object depends on another.

The fibre is the one of the paper's release: 2-D Fourier transform, a fixed 28 x 28 mask of phases uniform in [0, 2 pi), inverse
transform. It is linear and loses nothing (with orthonormal transforms it is unitary). The seed of the mask is the release's, 42, but which
generator drew it is not known: OURS is numpy's RandomState(42), whose stream numpy has frozen for good.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import UsageError

Light = Literal["transmission", "field", "intensity"]
Optics = Literal["none", "mmf"]
LIGHTS = ("transmission", "field", "intensity")
OPTICS = ("none", "mmf")
FIBRE_SIDE_PX = 28
MASK_SEED = 42
_AT_ONCE = 4096


def incident_field(
    images: NDArray[np.uint8], light: str, optics: str = "none"
) -> NDArray[np.float32] | NDArray[np.complex64]:
    """Return field amplitudes (n, height, width) for a coherent encoder, float32, or complex64 behind a fibre.

    `light` says what grey / 255 is: an amplitude (`field`), or an intensity or transmission, whose square root with flat
    phase is taken. `optics` "mmf" sends amplitudes of 28 x 28 pixels through the multimode fibre.
    """
    if optics == "mmf":
        return scatter(images)
    amplitude = (images / np.float32(255)).astype(np.float32)
    return amplitude if light == "field" else np.sqrt(amplitude)


def incident_intensity(images: NDArray[np.uint8], light: str, optics: str = "none") -> NDArray[np.float32]:
    """Return intensities (n, height, width), float32, for an incoherent encoder: the squared modulus of the field."""
    field = incident_field(images, light, optics)
    return (field.real**2 + field.imag**2).astype(np.float32) if np.iscomplexobj(field) else np.square(field)


def phase_mask(seed: int = MASK_SEED) -> NDArray[np.float64]:
    """Return the fibre's phases in radians, float64 (28, 28), uniform in [0, 2 pi)."""
    return np.random.RandomState(seed).uniform(0, 2 * np.pi, (FIBRE_SIDE_PX, FIBRE_SIDE_PX))


def scatter(images: NDArray[np.uint8], seed: int = MASK_SEED) -> NDArray[np.complex64]:
    """Return the field at the end of the fibre, complex64 (n, 28, 28), of images uint8 (n, 28, 28); sum |E|^2 is kept."""
    if images.dtype != np.uint8 or images.ndim != 3 or images.shape[1:] != (FIBRE_SIDE_PX, FIBRE_SIDE_PX):
        raise UsageError(
            f"images for the fibre are {images.dtype} {images.shape}",
            remedy=f"allowed: uint8 (n, {FIBRE_SIDE_PX}, {FIBRE_SIDE_PX})",
        )
    turn = np.exp(1j * phase_mask(seed))
    out = np.empty(images.shape, np.complex64)
    for start in range(0, len(images), _AT_ONCE):
        entrance = images[start : start + _AT_ONCE] / 255.0
        out[start : start + _AT_ONCE] = np.fft.ifft2(np.fft.fft2(entrance) * turn)
    return out
