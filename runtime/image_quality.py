"""How good a picture is: SSIM and mean squared error against the true one, and the pictures of a recording.

Owns these figures in numpy; never trains (trainer/ssim.py is the differentiable twin) and never draws. SSIM is that of the paper's
release: 11 x 11 Gaussian window, sigma 1.5, zeros outside, C1 = 1e-4, C2 = 9e-4, data range 1, mean over all pixels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import UsageError

WINDOW_PX = 11
SIGMA_PX = 1.5
C1, C2 = 1e-4, 9e-4

F64 = NDArray[np.float64]


class Likeness(NamedTuple):
    """SSIM and mean squared error of every picture, float64 (n,)."""

    ssim: F64
    mse: F64


def likeness(pictures: NDArray[np.floating[Any]], truth: NDArray[np.uint8]) -> Likeness:
    """Compare pictures, floats in [0, 1] (n, height, width), with true images, uint8 of the same shape."""
    if pictures.shape != truth.shape or truth.dtype != np.uint8 or pictures.ndim != 3:
        raise UsageError(
            f"pictures are {pictures.shape}, the true images {truth.dtype} {truth.shape}: allowed are equal shapes, uint8"
        )
    shown, wanted = pictures.astype(np.float64), truth / 255.0
    return Likeness(ssim(shown, wanted), ((shown - wanted) ** 2).mean(axis=(1, 2)))


def ssim(x: F64, y: F64) -> F64:
    """Return the mean SSIM of image pairs, float64 (n, height, width) in [0, 1]; 1 for equal images."""
    mean_x, mean_y = _blur(x), _blur(y)
    variances = _blur(x * x) + _blur(y * y) - mean_x**2 - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * covariance + C2) / (variances + C2)
    return np.asarray((luminance * structure).mean(axis=(1, 2)))


def _blur(images: F64) -> F64:
    """Gaussian means with zeros outside; the window is a product, so it runs along one axis after the other."""
    half = WINDOW_PX // 2
    weight = np.exp(-(np.arange(-half, half + 1) ** 2) / (2 * SIGMA_PX**2))
    weight /= weight.sum()
    for axis in (1, 2):
        edge = [(0, 0)] * 3
        edge[axis] = (half, half)
        padded = np.pad(images, edge)
        size = images.shape[axis]
        images = sum(w * padded.take(range(i, i + size), axis=axis) for i, w in enumerate(weight))
    return images
