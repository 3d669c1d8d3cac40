"""A user's picture file as 8-bit grey, without guessing: every pixel format is scaled by its own full scale.

Owns this conversion; never resizes and never stretches contrast. Full scale of 8-bit and 1-bit pictures is white, of 16-bit ones
65535 (a 12-bit camera's file stays dark: scale it before), of floating-point ones 1.0; colours become luminance (ITU-R 601) and
transparency is ignored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import DamagedFileError, UsageError

FULL_SCALE_16 = 65535


def read_grey(path: Path, pixels_max: int) -> NDArray[np.uint8]:
    """Return the picture at `path`, uint8 (height, width).

    UsageError for more than `pixels_max` pixels, several frames, or values outside the full scale; DamagedFileError for a
    file that is no picture.
    """
    from PIL import Image

    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > pixels_max:
                raise UsageError(
                    f"{path}: {picture.width} x {picture.height} pixels, more than the {pixels_max} allowed"
                )
            frames = getattr(picture, "n_frames", 1)
            if frames != 1:
                raise UsageError(f"{path}: {frames} frames", remedy="one picture per file: save the frames apart")
            if picture.mode.startswith("I") or picture.mode == "F":
                return _scaled(path, np.asarray(picture), 1.0 if picture.mode == "F" else float(FULL_SCALE_16))
            return np.asarray(picture.convert("L"), dtype=np.uint8)
    except Image.DecompressionBombError as error:
        raise UsageError(f"{path}: {error}") from error
    except (OSError, SyntaxError, ValueError) as error:  # what damaged files make the decoders raise
        raise DamagedFileError(f"{path}: not an image that can be read: {error}") from error


def _scaled(path: Path, values: NDArray[Any], full_scale: float) -> NDArray[np.uint8]:
    low, high = float(values.min()), float(values.max())
    if not (low >= 0 and high <= full_scale):  # NaN fails it too
        raise UsageError(
            f"{path}: values from {low:g} to {high:g}, allowed: 0 to {full_scale:g}",
            remedy="scale them, or save 8 bits",
        )
    return np.asarray(np.rint(values.astype(np.float64) * (255 / full_scale)), dtype=np.uint8)
