"""Small pictures as PNG bytes (W3C PNG, third edition): grey values, and numbers as shades of blue, one pixel per number."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

SHADES = 255
# Ends and middle of the scale, RGB: light to dark blue, so that more is darker on paper too.
BLUES = np.array([(238, 243, 250), (94, 148, 205), (8, 38, 92)], np.float64)


def png(grey: ArrayLike) -> bytes:
    """Return uint8 (height, width) as a PNG file, 0 black and 255 white."""
    pixels = np.ascontiguousarray(grey, np.uint8)
    return _file(pixels, 0)


def heat_png(values: ArrayLike, low: float, high: float) -> bytes:
    """Return numbers (height, width) as shades from `low` to `high`; NaN is transparent."""
    numbers = np.asarray(values, np.float64)
    share = np.clip((numbers - low) / max(high - low, 1e-300), 0.0, 1.0)
    index = np.where(np.isnan(numbers), 0, 1 + np.nan_to_num(share) * (SHADES - 1)).round().astype(np.uint8)
    return _file(index, 3, palette())


def palette() -> NDArray[np.uint8]:
    """Return the colours of heat_png, uint8 (256, 3); number 0 is that of NaN."""
    at = np.linspace(0.0, 1.0, SHADES)
    colours = np.stack([np.interp(at, (0.0, 0.5, 1.0), BLUES[:, channel]) for channel in range(3)], axis=1)
    return np.vstack([np.zeros((1, 3)), colours]).round().astype(np.uint8)


def _file(pixels: NDArray[np.uint8], kind: int, colours: NDArray[np.uint8] | None = None) -> bytes:
    height, width = pixels.shape
    rows = np.zeros((height, width + 1), np.uint8)  # each row begins with its filter: none
    rows[:, 1:] = pixels
    parts = [_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0))]
    if colours is not None:
        parts += [_chunk(b"PLTE", colours.tobytes()), _chunk(b"tRNS", b"\0")]
    parts += [_chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)), _chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
