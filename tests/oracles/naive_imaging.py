"""What a pattern grid meets of an object, from a rendering with 256 points per pixel: it shares nothing with runtime/imaging."""

import math

import numpy as np
from numpy.typing import NDArray

from pans.instrument.optics import Imaging

FINE, PAD = 16, 7  # points per pixel and axis; pixels around the object


def rendered(imaging: Imaging, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """The object as constant squares, looked up point by point, blurred on the fine grid by the FFT, averaged per pattern pixel."""
    rows, columns = image.shape
    # pixel k covers k - 0.5 .. k + 0.5
    fine = (np.arange((max(rows, columns) + 2 * PAD) * FINE) + 0.5) / FINE - PAD - 0.5
    down, right = np.meshgrid(fine, fine, indexing="ij")
    down, right = down - (rows - 1) / 2 - imaging.down_px, right - (columns - 1) / 2 - imaging.right_px
    up = -down
    turn = np.exp(-1j * math.radians(imaging.rotation_deg))  # the way back, clockwise
    place = (right + 1j * up) * turn / imaging.scale
    row = np.floor(-place.imag + (rows - 1) / 2 + 0.5).astype(int)
    column = np.floor(place.real + (columns - 1) / 2 + 0.5).astype(int)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    field = np.where(inside, image[row.clip(0, rows - 1), column.clip(0, columns - 1)], 0.0)
    frequency = np.fft.fftfreq(len(fine), 1 / FINE)
    low_pass = np.exp(-2 * (math.pi * imaging.psf_px * frequency) ** 2)
    field = np.fft.ifft2(np.fft.fft2(field) * low_pass[:, None] * low_pass).real
    blocks = field.reshape(len(fine) // FINE, FINE, -1, FINE).mean(axis=(1, 3))
    return blocks[PAD : PAD + rows, PAD : PAD + columns]
