"""A user's picture file as 8-bit grey, without guessing: every pixel format is scaled by its own full scale; and folders of them.

Owns this conversion; never resizes and never stretches contrast. Trainer and simulator read pictures with it; Pillow is loaded only
then. Full scale of 8-bit and 1-bit pictures is white, of 16-bit ones 65535 (a 12-bit camera's file stays dark: scale it before), of
floating-point ones 1.0; colours become luminance (ITU-R 601) and transparency is ignored.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import DamagedFileError, UsageError

FULL_SCALE_16 = 65535
LITTER = frozenset(("thumbs.db", "ehthumbs.db", "desktop.ini", "__macosx"))
PICTURE_SUFFIXES = frozenset((".png", ".tif", ".tiff", ".pgm", ".jpg", ".jpeg", ".bmp"))


class LabelledPictures(NamedTuple):
    """images uint8 (n, height, width), labels int64 (n,) into `classes`, and the SHA-256 of all pixels in their order."""

    images: NDArray[np.uint8]
    labels: NDArray[np.int64]
    classes: tuple[str, ...]
    sha256: str


def read_class_folder(folder: Path, pixels_max: int) -> LabelledPictures:
    """Return the pictures of `folder`: one folder per class, pictures of one size inside.

    What systems leave behind (names that begin with a dot, Thumbs.db, desktop.ini, __MACOSX) is passed over. UsageError for a class
    without pictures, folders within a class, pictures beside the class folders, pictures of different sizes, or for more than
    `pixels_max` pixels in all; else as `read_grey`.
    """
    entries = _entries(folder)
    classes = [entry.name for entry in entries if entry.is_dir()]
    beside = [entry for entry in entries if entry.is_file() and entry.suffix.lower() in PICTURE_SUFFIXES]
    if beside and classes:
        raise UsageError(f"{beside[0]}: a picture beside the class folders", remedy="move it into its class's folder")
    images: list[NDArray[np.uint8]] = []
    labels: list[int] = []
    digest = hashlib.sha256()
    n_pixels = 0
    for label, name in enumerate(classes):
        inside = _entries(folder / name)
        if nested := [entry for entry in inside if entry.is_dir()]:
            raise UsageError(
                f"{nested[0]}: a folder within the class folder {name!r}",
                remedy="one folder per class, the pictures directly inside: flatten it, or name the folder above the classes",
            )
        if not inside:
            raise UsageError(
                f"{folder / name}: a class folder without pictures", remedy="remove it, or put the class's pictures in"
            )
        for path in inside:
            image = read_grey(path, pixels_max - n_pixels)
            n_pixels += image.size
            if images and image.shape != images[0].shape:
                raise UsageError(
                    f"{path}: {image.shape[1]} x {image.shape[0]} pixels, the first image has "
                    f"{images[0].shape[1]} x {images[0].shape[0]}",
                    remedy="all images of a task have one size: resize them",
                )
            digest.update(image.tobytes())
            images.append(image)
            labels.append(label)
    if not images:
        raise UsageError(f"{folder}: no images in class folders", remedy="put the images of each class into a folder")
    return LabelledPictures(np.stack(images), np.array(labels), tuple(classes), digest.hexdigest())


def _entries(folder: Path) -> list[Path]:
    """What stands in `folder`, in order, without what systems leave behind."""
    return sorted(entry for entry in folder.iterdir() if entry.name[0] != "." and entry.name.lower() not in LITTER)


def read_grey(path: Path, pixels_max: int) -> NDArray[np.uint8]:
    """Return the picture at `path`, uint8 (height, width).

    UsageError for more than `pixels_max` pixels, several frames, or values outside the full scale; DamagedFileError for a
    file that is no picture.
    """
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise UsageError(f"{path}: pictures need the package pillow", remedy="pip install pillow") from error
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
                return to_8_bits(path, np.asarray(picture), 1.0 if picture.mode == "F" else float(FULL_SCALE_16))
            return np.asarray(picture.convert("L"), dtype=np.uint8)
    except Image.DecompressionBombError as error:
        raise UsageError(f"{path}: {error}") from error
    except (OSError, SyntaxError, ValueError) as error:  # what damaged files make the decoders raise
        raise DamagedFileError(
            f"{path}: not an image that can be read: {error}", remedy="repair it, or move it elsewhere"
        ) from error


def to_8_bits(where: Path, values: NDArray[Any], full_scale: float) -> NDArray[np.uint8]:
    """Return `values` (any shape), 0 to `full_scale`, as nearest of 256 grey levels; UsageError for any beyond, or not finite."""
    low, high = float(values.min()), float(values.max())
    if not (low >= 0 and high <= full_scale):  # NaN fails it too
        raise UsageError(
            f"{where}: values from {low:g} to {high:g}, allowed: 0 to {full_scale:g}",
            remedy="scale them, or save 8 bits",
        )
    return np.asarray(np.rint(values.astype(np.float64) * (255 / full_scale)), dtype=np.uint8)
