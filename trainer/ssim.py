"""Structural similarity of image pairs (Wang, Bovik, Sheikh and Simoncelli 2004), as the paper's release computes it.

Owns one formula, differentiable; never loads or scales an image. Images are floats in [0, 1] (data range 1).

The release's choices: an 11 x 11 Gaussian window with sigma 1.5, zero padding (windows at the edge see black outside, which
raises or lowers the edge against implementations that mirror), C1 = 0.01**2, C2 = 0.03**2, population variances, mean over
all pixels, the edge included.
"""

from __future__ import annotations

import functools
import math

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
    x, y = (image.reshape(-1, *shown.shape[-2:]) for image in (shown, wanted))
    means = _blur(torch.cat([x, y, x * x, y * y, x * y]))
    mean_x, mean_y, square_x, square_y, product = means.chunk(5)
    variances = square_x + square_y - mean_x**2 - mean_y**2
    covariance = product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * covariance + C2) / (variances + C2)
    return (luminance * structure).reshape(shown.shape)


def _blur(images: Tensor) -> Tensor:
    """Gaussian means of (n, height, width) with zeros outside: the window is a product, one matrix for the rows, one for the columns.

    Many small pictures are 20 times as fast this way as by a convolution of one channel, forward and backward.
    """
    height, width = images.shape[-2:]
    return _window(height).to(images) @ (images @ _window(width).to(images))


@functools.lru_cache(maxsize=8)
def _window(size: int) -> Tensor:
    """The window as a symmetric matrix (size, size), float64: row i holds its weights around pixel i, cut off at the edge."""
    half = WINDOW_PX // 2
    weight = [math.exp(-(offset**2) / (2 * SIGMA_PX**2)) for offset in range(-half, half + 1)]
    matrix = torch.zeros(size, size, dtype=torch.float64, device="cpu")
    for offset in range(max(-half, 1 - size), min(half, size - 1) + 1):
        matrix.diagonal(offset).fill_(weight[offset + half] / math.fsum(weight))
    return matrix
