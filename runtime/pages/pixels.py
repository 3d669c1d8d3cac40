"""Numbers as shades of blue, one pixel each, as PNG bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.grey_png import png_bytes

SHADES = 255
# Ends and middle of the scale, RGB: light to dark blue, so that more is darker on paper too.
BLUES = np.array([(238, 243, 250), (94, 148, 205), (8, 38, 92)], np.float64)


def heat_png(values: ArrayLike, low: float, high: float) -> bytes:
    """Return numbers (height, width) as shades from `low` to `high`; NaN is transparent."""
    numbers = np.asarray(values, np.float64)
    share = np.clip((numbers - low) / max(high - low, 1e-300), 0.0, 1.0)
    index = np.where(np.isnan(numbers), 0, 1 + np.nan_to_num(share) * (SHADES - 1)).round().astype(np.uint8)
    return png_bytes(index, palette())


def palette() -> NDArray[np.uint8]:
    """Return the colours of heat_png, uint8 (256, 3); number 0 is that of NaN."""
    at = np.linspace(0.0, 1.0, SHADES)
    colours = np.stack([np.interp(at, (0.0, 0.5, 1.0), BLUES[:, channel]) for channel in range(3)], axis=1)
    return np.vstack([np.zeros((1, 3)), colours]).round().astype(np.uint8)
