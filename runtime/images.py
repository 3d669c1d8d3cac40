"""Pictures of a user as 8-bit grey (`read_grey`), labelled sets of them (`read_labelled`), how alike two pictures are (`likeness`), and
patterns as PNG and back (`levels_png`, `read_grey_png`).

Nothing is resized and no contrast stretched. Full scale of 8-bit and 1-bit pictures is white, of 16-bit ones 65535 (a 12-bit camera's file
stays dark: scale it before), of floating-point ones 1.0; colours become luminance (ITU-R 601), transparency is ignored. Pillow is loaded
only for a picture. SSIM is that of the paper's release: 11 x 11 Gaussian window, sigma 1.5, zeros outside, C1 = 1e-4, C2 = 9e-4, data
range 1, mean over all pixels.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zlib
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .container import MIB, open_regular
from .errors import DamagedFileError, PansError, UsageError
from .npz_file import read_arrays

WINDOW_PX = 11
SIGMA_PX = 1.5
C1, C2 = 1e-4, 9e-4

F64 = NDArray[np.float64]
FULL_SCALE_16 = 65535
LABELLED_MAX_BYTES = 1024 * MIB
FAULTS_SHOWN = 5  # of each kind in a folder; the rest is counted
# kinds of fault, in the order in which they are reported: damaged files are the fewest
KINDS_OF_FAULT = ("cannot be read", "hold what is not accepted", "have another size", "are in the wrong place")
DAMAGED, STRANGE, SIZE, PLACE = KINDS_OF_FAULT
PILLOW_REMEDY = "pip install pillow"
PNG_END, PNG_SIDE_MAX, PNG_TOPS = (
    b"IEND\xaeB`\x82",
    1 << 14,
    {"L": 255, "I;16B": 65535},
)  # how Pillow calls 8 and 16 bits
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

    What systems leave behind (names that begin with a dot, Thumbs.db, desktop.ini, __MACOSX) is passed over. UsageError, which lists
    all faults at once: a class without pictures, folders within a class, pictures beside the class folders, pictures of different sizes,
    files that are no pictures (see `read_grey`), or more than `pixels_max` pixels in all.
    """
    entries = _entries(folder)
    classes = [entry.name for entry in entries if entry.is_dir()]
    found = _Found(pixels_max)
    beside = [entry for entry in entries if entry.is_file() and entry.suffix.lower() in PICTURE_SUFFIXES]
    if classes:
        remedy = "move it into its class's folder"
        for one in beside:
            found.fault(PLACE, UsageError(f"{one}: a picture beside the class folders", remedy=remedy))
    for label, name in enumerate(classes):
        found.take_class(folder / name, label)
    if not found.images and not found.faults:
        raise UsageError(f"{folder}: no images in class folders", remedy="put the images of each class into a folder")
    if found.faults:
        raise _all_of(folder, found.faults)
    return LabelledPictures(np.stack(found.images), np.array(found.labels), tuple(classes), found.digest.hexdigest())


class _Found:
    """The pictures of a folder as they are read, and what is wrong with it."""

    def __init__(self, pixels_max: int) -> None:
        self.images: list[NDArray[np.uint8]] = []
        self.labels: list[int] = []
        self.faults: dict[str, list[PansError]] = {}  # by kind
        self.digest = hashlib.sha256()
        self._pixels_left = pixels_max
        self._first = ""  # the picture whose size all others must have

    def fault(self, kind: str, error: PansError) -> None:
        """Keep one fault."""
        self.faults.setdefault(kind, []).append(error)

    def take_class(self, folder: Path, label: int) -> None:
        """Read the pictures of one class."""
        inside = _entries(folder)
        remedy = "one folder per class, the pictures directly inside: flatten it, or name the folder above the classes"
        nested = [entry for entry in inside if entry.is_dir()]
        for one in nested:
            self.fault(PLACE, UsageError(f"{one}: a folder within the class folder {folder.name!r}", remedy=remedy))
        if not inside:
            remedy = "remove it, or put the class's pictures in"
            self.fault(PLACE, UsageError(f"{folder}: a class folder without pictures", remedy=remedy))
        for path in inside:
            if not path.is_dir():
                self._take(path, label)

    def _take(self, path: Path, label: int) -> None:
        try:
            image = read_grey(path, self._pixels_left)
        except PansError as error:
            if error.remedy == PILLOW_REMEDY:  # it holds for all of them
                raise
            self.fault(DAMAGED if isinstance(error, DamagedFileError) else STRANGE, error)
            return
        self._pixels_left -= image.size
        if self.images and image.shape != self.images[0].shape:
            size, first = (f"{one.shape[1]} x {one.shape[0]}" for one in (image, self.images[0]))
            words = f"{path}: {size} pixels, the first image ({self._first}) has {first}"
            self.fault(SIZE, UsageError(words, remedy="all images of a task have one size: resize them"))
            return
        self._first = self._first or path.name
        self.digest.update(image.tobytes())
        self.images.append(image)
        self.labels.append(label)


def _all_of(folder: Path, faults: dict[str, list[PansError]]) -> PansError:
    """Return one error: a table of the kinds of fault with their counts, then some faults of each kind."""
    of_kind = {kind: faults[kind] for kind in KINDS_OF_FAULT if kind in faults}
    every = [fault for found in of_kind.values() for fault in found]
    if len(every) == 1:
        return every[0]
    lines = [f"{folder}: {len(every)} faults"]
    if len(of_kind) > 1:
        lines += [f"{len(found):>7}  {kind}" for kind, found in of_kind.items()]
    for kind, found in of_kind.items():
        lines += [f"{kind}:", *(f"  {fault.message}" for fault in found[:FAULTS_SHOWN])]
        lines += [f"  and {len(found) - FAULTS_SHOWN} more"] if len(found) > FAULTS_SHOWN else []
    remedies = "; ".join(dict.fromkeys(fault.remedy for fault in every if fault.remedy))
    return UsageError("\n".join(lines), remedy=remedies)


def _entries(folder: Path) -> list[Path]:
    """What stands in `folder`, in order, without what systems leave behind."""
    return sorted(entry for entry in folder.iterdir() if entry.name[0] != "." and entry.name.lower() not in LITTER)


def read_grey(path: Path, pixels_max: int) -> NDArray[np.uint8]:
    """Return the picture at `path`, uint8 (height, width).

    UsageError for more than `pixels_max` pixels, several frames, or values outside the full scale; DamagedFileError for a
    file that is no picture.
    """
    Image = _pillow(f"{path}: pictures need")
    try:
        with open_regular(path) as file, Image.open(file) as picture:
            if picture.width * picture.height > pixels_max:
                size = f"{picture.width} x {picture.height} pixels, more than the {pixels_max} allowed"
                raise UsageError(f"{path}: {size}", remedy="make the images smaller, or fewer")
            frames = getattr(picture, "n_frames", 1)
            if frames != 1:
                raise UsageError(f"{path}: {frames} frames", remedy="one picture per file: save the frames apart")
            if picture.mode.startswith("I") or picture.mode == "F":
                return to_8_bits(path, np.asarray(picture), 1.0 if picture.mode == "F" else float(FULL_SCALE_16))
            return np.asarray(picture.convert("L"), dtype=np.uint8)
    except Image.DecompressionBombError as error:
        raise UsageError(f"{path}: {error}", remedy="make the image smaller") from error
    except (OSError, SyntaxError, ValueError) as error:  # what damaged files make the decoders raise
        remedy = "repair it, or move it elsewhere"
        raise DamagedFileError(f"{path}: not an image that can be read: {error}", remedy=remedy) from error


def _pillow(what: str = "a picture needs") -> Any:
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise UsageError(f"{what} the package pillow", remedy=PILLOW_REMEDY) from error
    return Image


# ---- patterns as PNG ----


def grey_png(grey: NDArray[np.unsignedinteger[Any]]) -> bytes:
    """Return a grey picture, uint8 or uint16 (height, width), as PNG; UsageError without Pillow."""
    stream = io.BytesIO()
    _pillow().fromarray(grey).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def levels_png(levels: NDArray[np.unsignedinteger[Any]], count: int) -> bytes:
    """Return levels (height, width), each below `count`, as PNG with the highest level white: 8 bits for up to 256 levels, else 16."""
    top, kind = (255, np.uint8) if count <= 256 else (65535, np.uint16)
    return grey_png(np.rint(levels * (top / max(count - 1, 1))).astype(kind))


def read_grey_png(data: bytes, where: str) -> NDArray[np.float64]:
    """Return a plain grey PNG (8 or 16 bits, not interlaced) as float64 (height, width), white 1.

    DamagedFileError for any other; its size is checked before anything is unpacked. UsageError without Pillow.
    """
    image = _pillow()
    try:
        if not data.endswith(PNG_END):
            raise ValueError("it does not end as a PNG does")
        image.open(io.BytesIO(data), formats=("PNG",)).verify()  # its checksums, which reading alone passes over
        picture = image.open(io.BytesIO(data), formats=("PNG",))
        coding, extra = picture.tile[0][3], picture.info.keys() & {"transparency", "interlace"}
        if max(picture.size) > PNG_SIDE_MAX or coding not in PNG_TOPS or extra:
            found = f"{picture.width} x {picture.height} pixels, {coding} {' '.join(sorted(extra))}"
            raise ValueError(f"{found}, allowed: {PNG_SIDE_MAX} each, 8 or 16 bits of grey, nothing else")
        return np.asarray(picture, np.float64) / PNG_TOPS[coding]
    except (
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        struct.error,
        zlib.error,
        image.DecompressionBombError,
    ) as error:
        remedy = "save it as 8-bit or 16-bit grey, without transparency"
        raise DamagedFileError(f"{where}: not a readable grey PNG: {error}", remedy=remedy) from error


def to_8_bits(where: Path, values: NDArray[Any], full_scale: float) -> NDArray[np.uint8]:
    """Return `values` (any shape), 0 to `full_scale`, as nearest of 256 grey levels; UsageError for any beyond, or not finite."""
    low, high = float(values.min()), float(values.max())
    if not (low >= 0 and high <= full_scale):  # NaN fails it too
        found = f"{where}: values from {low:g} to {high:g}, allowed: 0 to {full_scale:g}"
        raise UsageError(found, remedy="scale them, or save 8 bits")
    return np.asarray(np.rint(values.astype(np.float64) * (255 / full_scale)), dtype=np.uint8)


def shipped_scene(name: str) -> Path | None:
    """Return the file of the simulator's scene of that name, None where there is none."""
    try:
        found = resources.files("pans.firmware_sim") / "scenes" / f"{name}.npz"  # its files, not its code
    except ModuleNotFoundError:
        return None
    return Path(str(found)) if "/" not in name and found.is_file() else None


def read_labelled(name: str) -> LabelledPictures:
    """Return images uint8 (n, h, w), labels int64 (n,) and class names ("" for unnamed ones); UsageError says what is wrong."""
    path = Path(name)
    if path.is_dir():
        return read_class_folder(path, LABELLED_MAX_BYTES)
    path = path if path.exists() else shipped_scene(name) or path
    try:
        arrays = read_arrays(path, ("images", "labels", "classes"), LABELLED_MAX_BYTES)
    except ValueError as error:
        raise UsageError(
            f"{path}: no file of labelled images: {error}",
            remedy="name a .npz file with images and labels, a folder of class folders, or a shipped scene",
        ) from error
    images, labels = arrays.get("images", np.zeros(0)), arrays.get("labels", np.zeros(0))
    if images.dtype != np.uint8 or images.ndim != 3 or not images.size or labels.shape != images.shape[:1]:
        raise UsageError(
            f"{path}: images {images.dtype} {images.shape}, labels {labels.dtype} {labels.shape}, "
            "allowed: uint8 (n, height, width), integers (n,)",
            remedy="save them with numpy.savez(FILE, images=, labels=)",
        )
    if labels.dtype.kind not in "iu":
        raise UsageError(f"{path}: labels are {labels.dtype}, allowed: integers")
    classes = tuple(str(name) for name in arrays.get("classes", np.zeros(0, str)).ravel())
    return LabelledPictures(images, labels.astype(np.int64), classes, "")


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
