"""Structural similarity of image pairs (Wang, Bovik, Sheikh and Simoncelli 2004), as the paper's release computes it.

Owns one formula, differentiable; never loads or scales an image. Images are floats in [0, 1] (data range 1).

The release's choices: an 11 x 11 Gaussian window with sigma 1.5, zero padding (windows at the edge see black outside, which
raises or lowers the edge against implementations that mirror), C1 = 0.01**2, C2 = 0.03**2, population variances, mean over
all pixels, the edge included.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pans.runtime.errors import UsageError

WINDOW_PX = 11
SIGMA_PX = 1.5
C1 = 1e-4
C2 = 9e-4


def ssim(shown: Tensor, wanted: Tensor) -> Tensor:
    """Return the SSIM of every pair of images (..., height, width) in [0, 1]: shape (...), dtype of the input.

    Differentiable in both; 1 for equal images. Use float64 where the last digits matter: the variances are differences.
    """
    return ssim_map(shown, wanted).mean(dim=(-2, -1))


def ssim_map(shown: Tensor, wanted: Tensor) -> Tensor:
    """Return the SSIM of every pixel, the shape of the images (..., height, width)."""
    if shown.shape != wanted.shape or shown.dim() < 2 or 0 in shown.shape:
        raise UsageError(
            f"images are {tuple(shown.shape)} and {tuple(wanted.shape)}, allowed: equal (..., height, width)"
        )
    if not shown.dtype.is_floating_point or shown.dtype != wanted.dtype:
        raise UsageError(f"images are {shown.dtype} and {wanted.dtype}, allowed: one floating-point type, in [0, 1]")
    x, y = (image.reshape(-1, 1, *shown.shape[-2:]) for image in (shown, wanted))
    means = _blur(torch.cat([x, y, x * x, y * y, x * y]))
    mean_x, mean_y, square_x, square_y, product = means.chunk(5)
    variances = square_x + square_y - mean_x**2 - mean_y**2
    covariance = product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * covariance + C2) / (variances + C2)
    return (luminance * structure).reshape(shown.shape)


def _blur(images: Tensor) -> Tensor:
    """Gaussian means of (n, 1, height, width) with zeros outside; the window is a product, so it runs along one axis each."""
    offset = torch.arange(WINDOW_PX, dtype=torch.float64) - WINDOW_PX // 2
    weight = torch.exp(-(offset**2) / (2 * SIGMA_PX**2))
    weight = (weight / weight.sum()).to(images)
    half = WINDOW_PX // 2
    along_rows = torch.nn.functional.conv2d(images, weight.reshape(1, 1, -1, 1), padding=(half, 0))
    return torch.nn.functional.conv2d(along_rows, weight.reshape(1, 1, 1, -1), padding=(0, half))
