"""Passive sensing: 8-bit images in, the light that passive optics send to every detector out.

Full scale (grey 255) is amplitude 1 and intensity 1; nothing is normalised per image or per batch, so that no object depends on another.
Coherent: light = |W x|**2 of fields x, W real or complex (Ma et al., passive PANS). Incoherent: light = W x of intensities x, W at least 0.

The fibre is the one of the paper's release: 2-D Fourier transform, a fixed 28 x 28 mask of phases uniform in [0, 2 pi), inverse
transform. With orthonormal transforms it is unitary. The seed of the mask is the release's, 42, but which generator drew it is not known:
OURS is numpy's RandomState(42), whose stream numpy has frozen for good.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import UsageError
from pans.base.numbers import Range

Light = Literal["transmission", "field", "intensity"]
Optics = Literal["none", "mmf"]
LIGHTS = ("transmission", "field", "intensity")
OPTICS = ("none", "mmf")
FIBRE_SIDE_PX = 28
MASK_SEED = 42

# Photoelectrons of one pixel, or of one of its levels, in one exposure: from where 2**22 pixels at 65 535 levels give one in 10**8
# exposures to far beyond what a single-photon detector counts.
LIGHT_RANGE = Range(1e-20, 1e9)
EXPOSURE_US_RANGE = Range(1e-3, 1e9)
MATRIX_MAX = 1e6  # of an entry of W; passive optics that conserve light have singular values of at most 1
KINDS = ("coherent", "incoherent")
_SCATTERED_AT_ONCE = 4096
_IMAGES_AT_ONCE, _VALUES_AT_ONCE = 2048, 1 << 21  # of float64 copies: 16 MiB, twice that where they are complex


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
        what = f"images for the fibre are {images.dtype} {images.shape}"
        raise UsageError(what, remedy=f"allowed: uint8 (n, {FIBRE_SIDE_PX}, {FIBRE_SIDE_PX})")
    turn = np.exp(1j * phase_mask(seed))
    out = np.empty(images.shape, np.complex64)
    for start in range(0, len(images), _SCATTERED_AT_ONCE):
        entrance = images[start : start + _SCATTERED_AT_ONCE] / 255.0
        out[start : start + _SCATTERED_AT_ONCE] = np.fft.ifft2(np.fft.fft2(entrance) * turn)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Analyser:
    """A passive sensor's optics; `matrix` is read-only, float32 or (coherent only) complex64, (d_f, pixels)."""

    kind: str  # of KINDS
    matrix: NDArray[Any]
    light: str  # what grey is, of incident.LIGHTS
    optics: str  # between the scene and the sensor, of incident.OPTICS
    full_scale_photoelectrons: float  # of one pixel at grey 255 in one exposure, detector efficiency included
    exposure_us: float

    def photoelectrons(self, images: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Return photoelectrons per exposure, float64 (n, d_f), of images uint8 (n, height, width); ValueError if they do not fit."""
        n_pixels = self.matrix.shape[1]
        if images.dtype != np.uint8 or images.ndim != 3 or images.shape[1] * images.shape[2] != n_pixels:
            raise ValueError(f"images are {images.dtype} {images.shape}, the sensor sees uint8 of {n_pixels} pixels")
        out = np.empty((len(images), len(self.matrix)))
        detectors = max(1, _VALUES_AT_ONCE // n_pixels)
        objects = min(_IMAGES_AT_ONCE, max(1, _VALUES_AT_ONCE // n_pixels))
        for first in range(0, len(self.matrix), detectors):
            part = self.matrix[first : first + detectors]
            wide = part.T.astype(np.complex128 if np.iscomplexobj(part) else np.float64)
            for start in range(0, len(images), objects):
                seen = images[start : start + objects]
                out[start : start + objects, first : first + detectors] = self._through(seen, wide)
        return out * self.full_scale_photoelectrons

    def _through(self, images: NDArray[np.uint8], wide: NDArray[Any]) -> NDArray[np.float64]:
        """Light of images behind the columns of `wide` (pixels, detectors), where 1 is full scale."""
        if self.kind == "coherent":
            field = incident_field(images, self.light, self.optics).reshape(len(images), -1) @ wide
            return np.asarray(field.real**2 + field.imag**2)
        light = incident_intensity(images, self.light, self.optics).reshape(len(images), -1).astype(np.float64)
        return np.asarray(light @ wide)

    def reaching(self, images: NDArray[np.uint8]) -> float:
        """Return the photoelectrons per object of `images`, on average, that must reach optics which give what W gives, at least."""
        light = 0.0
        for start in range(0, len(images), _IMAGES_AT_ONCE):
            field = incident_field(images[start : start + _IMAGES_AT_ONCE], self.light, self.optics)
            light += float(np.square(np.abs(field)).sum(dtype=np.float64))
        return amplification(self.kind, self.matrix) * self.full_scale_photoelectrons * light / len(images)

    @property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of everything that decides on the light: two sensors that agree in it measure the same."""
        facts = (self.kind, self.light, self.optics, repr(self.full_scale_photoelectrons), str(self.matrix.dtype))
        digest = hashlib.sha256("\n".join(facts).encode())
        digest.update(np.ascontiguousarray(self.matrix).data)
        return digest.hexdigest()


def amplification(kind: str, matrix: NDArray[Any]) -> float:
    """Return how much light optics with this W (d_f, pixels) give at most for light of 1, in float64.

    Coherent: the largest singular value squared. Incoherent: the largest sum of a column. Above 1, W makes light that no passive optics
    make: a real device gives the same from that many times the light.
    """
    if kind == "incoherent":
        return float(matrix.sum(axis=0, dtype=np.float64).max())
    wide = matrix.astype(np.complex128 if np.iscomplexobj(matrix) else np.float64)
    return float(np.linalg.norm(wide, ord=2)) ** 2


def check_analyser(analyser: Analyser) -> None:
    """Raise ValueError, with what, found and allowed, for optics that cannot be."""
    matrix, kind = analyser.matrix, analyser.kind
    for name, found, allowed in (("kind", kind, KINDS), ("light", analyser.light, LIGHTS)):
        if found not in allowed:
            raise ValueError(f"{name} is {ascii(found)[:80]}, allowed: {', '.join(allowed)}")
    if analyser.optics not in OPTICS:
        raise ValueError(f"optics is {ascii(analyser.optics)[:80]}, allowed: {', '.join(OPTICS)}")
    complex_field = matrix.dtype == np.complex64
    if matrix.ndim != 2 or not (matrix.dtype == np.float32 or (complex_field and kind == "coherent")):
        allowed_types = "float32 or complex64" if kind == "coherent" else "float32"
        raise ValueError(f"the matrix is {matrix.dtype} {matrix.shape}, allowed: {allowed_types} (d_f, pixels)")
    parts = (matrix.real, matrix.imag) if complex_field else (matrix,)
    if not all(part.min() >= -MATRIX_MAX and part.max() <= MATRIX_MAX for part in parts):
        raise ValueError(f"the matrix holds numbers that are not finite, or beyond {MATRIX_MAX:g}")
    if kind == "incoherent" and matrix.min() < 0:
        raise ValueError(f"the matrix goes down to {matrix.min():g}: an intensity cannot be negative")
    for name, allowed_range in (("full_scale_photoelectrons", LIGHT_RANGE), ("exposure_us", EXPOSURE_US_RANGE)):
        allowed_range.checked(getattr(analyser, name), name)
