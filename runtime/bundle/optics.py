"""The optics of a passive sensor: from what an object shows to the photoelectrons of every detector.

Owns the facts of a passive encoder (its matrix W, what grey means, how much light full scale is, the exposure) and what they do to
light; never detects. Nothing is shown and nothing is uploaded in passive sensing: W is glass, or a hologram, in front of the detectors.

Coherent: light = |W x|**2 of fields x, W real or complex (Ma et al., passive PANS). Incoherent: light = W x of intensities x, W at least 0.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.ranges import Range

from .incident import LIGHTS, OPTICS, incident_field, incident_intensity

# Photoelectrons of one pixel, or of one of its levels, in one exposure: from where 2**22 pixels at 65 535 levels give one in 10**8
# exposures to far beyond what a single-photon detector counts.
LIGHT_RANGE = Range(1e-20, 1e9)
EXPOSURE_US_RANGE = Range(1e-3, 1e9)
MATRIX_MAX = 1e6  # of an entry of W; passive optics that conserve light have singular values of at most 1
KINDS = ("coherent", "incoherent")
_AT_ONCE = 2048


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
        wide = self.matrix.T.astype(np.complex128 if np.iscomplexobj(self.matrix) else np.float64)
        out = np.empty((len(images), len(self.matrix)))
        for start in range(0, len(images), _AT_ONCE):
            part = images[start : start + _AT_ONCE]
            if self.kind == "coherent":
                field = incident_field(part, self.light, self.optics).reshape(len(part), -1) @ wide
                out[start : start + _AT_ONCE] = field.real**2 + field.imag**2
            else:
                out[start : start + _AT_ONCE] = (
                    incident_intensity(part, self.light, self.optics).reshape(len(part), -1).astype(np.float64) @ wide
                )
        return out * self.full_scale_photoelectrons

    @property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of everything that decides on the light: two sensors that agree in it measure the same."""
        facts = (self.kind, self.light, self.optics, repr(self.full_scale_photoelectrons), str(self.matrix.dtype))
        digest = hashlib.sha256("\n".join(facts).encode())
        digest.update(np.ascontiguousarray(self.matrix).tobytes())
        return digest.hexdigest()


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
