"""Pictures of a user as 8-bit grey (`read_grey`), labelled sets of them (`read_labelled`), how alike two pictures are (`likeness`), and
patterns as PNG and back (`levels_png`, `read_grey_png`).

No contrast is stretched. Full scale of 8-bit and 1-bit pictures is white, of 16-bit ones 65535 (a 12-bit camera's file stays dark: scale it
before), of floating-point ones 1.0; colours become luminance (ITU-R 601), what is transparent becomes black, and pictures are turned as
their EXIF data say. A folder of photos of any size becomes images of one (`Reading`): the mean over each pixel's area where they shrink,
bilinear where they grow, the aspect ratio kept. One picture at a time is held at its full size. Pillow is loaded only to read a picture.
SSIM is that of the paper's release: 11 x 11 Gaussian window, sigma 1.5, zeros outside, C1 = 1e-4, C2 = 9e-4, data range 1, mean over all
pixels.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import resources
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import DamagedFileError, PansError, UsageError

from .container import MIB, open_regular
from .npz import read_arrays

WINDOW_PX = 11
SIGMA_PX = 1.5
C1, C2 = 1e-4, 9e-4

F64 = NDArray[np.float64]
FULL_SCALE_16 = 65535
LABELLED_MAX_BYTES = 1024 * MIB
PICTURE_PIXELS_MAX = 1 << 26  # of one picture, 67 million
PICTURE_BYTES_MAX = 256 * MIB  # to unpack one and make it grey; with torch, training then stays below 600 MiB
STRIP_ROWS = 64  # rows that are converted at a time, where a copy of the whole picture would double the memory
# What is opened, by content: Pillow knows some forty more formats, of which one starts another program and several have decoders that
# take damaged files for sound ones. BMP, GIF, PNG and PPM are unpacked row by row; for the others see `_bytes_to_unpack`.
FORMATS = ("BMP", "GIF", "JPEG", "PNG", "PPM", "TIFF", "WEBP")
# Per pixel, beside the picture: three canvases of RGBA; all coefficients of a progressive JPEG, 16 bits of 3 colours.
WEBP_BYTES, PROGRESSIVE_BYTES = 12, 6
TIFF_BITS, TIFF_STRIP_ROWS, TIFF_TILE_WIDTH, TIFF_TILE_ROWS = 258, 278, 322, 323  # tags
SIDE_PX = 32  # longer side of images that are made from photos, unless another is asked for
LEAST_CUT = 0.01  # of the area: less is rounding to whole pixels, and is not told
SMALL_SIDE_PX = 64  # pictures of one size that is no larger stay as they are
FAULTS_SHOWN = 5  # of each kind in a folder; the rest is counted
# kinds of fault, in the order in which they are reported: damaged files are the fewest
DAMAGED, STRANGE, TWICE = "cannot be read", "hold what is not accepted", "stand in two classes"
SIZE, PLACE = "have another size", "are in the wrong place"
KINDS_OF_FAULT = (DAMAGED, STRANGE, TWICE, SIZE, PLACE)
SKIPPED = (DAMAGED, STRANGE, TWICE)  # faults of single files
PILLOW_REMEDY = "pip install pillow"
PNG_END, PNG_SIDE_MAX = b"IEND\xaeB`\x82", 1 << 14
PNG_TOPS = {"L": 255, "I;16B": 65535}  # how Pillow calls 8 and 16 bits
LITTER = frozenset(("thumbs.db", "ehthumbs.db", "desktop.ini", "__macosx"))
PICTURE_SUFFIXES = frozenset((".png", ".tif", ".tiff", ".pgm", ".jpg", ".jpeg", ".bmp"))
EXIF_ORIENTATION, EXIF_ON_ITS_SIDE = 0x0112, 5  # a tag, and its values from which on width and height change places
# what was done to pictures, as it is told
GREYED, BLACKENED, SCALED, TURNED, ENLARGED, CUT, PADDED = (
    *("from colour to grey", "with transparent parts, now black", "of 16 bits or more, scaled by their full scale"),
    *("turned as their EXIF data say", "enlarged", "cut at the edges", "padded with black"),
)
CUT_WORDS = ", cut to their mean aspect ratio (--fit pad keeps all)"


class LabelledPictures(NamedTuple):
    """images uint8 (n, height, width), labels int64 (n,) into `classes`, and the SHA-256 of all pixels in their order.

    `account` tells what was read from a folder.
    """

    images: NDArray[np.uint8]
    labels: NDArray[np.int64]
    classes: tuple[str, ...]
    sha256: str
    account: Account | None = None


@dataclass(frozen=True, slots=True)
class Reading:
    """How photos of a folder become images of one size.

    `side` is that of the longer side in pixels; 0 leaves pictures of one size as they are, and None does so where they are small, else
    takes 32. The aspect ratio is the mean one of the pictures: what lies beyond is cut, or with `pad` all is kept before black. With
    `skip_bad` files that cannot be taken are passed over. A picture that is there twice is taken once.
    """

    side: int | None = None
    pad: bool = False
    skip_bad: bool = False


@dataclass(slots=True)
class Account:
    """What was read from a folder: numbers of files by class, reasons by file, and what was done to the pictures."""

    size: str = ""  # of the images, and where it is from
    classes: dict[str, Counter[str]] = field(default_factory=dict)  # files, taken, resized, duplicates, refused
    refused: dict[str, str] = field(default_factory=dict)  # path: why
    duplicates: dict[str, str] = field(default_factory=dict)  # path: of which
    done: Counter[str] = field(default_factory=Counter)
    cut: list[float] = field(default_factory=list)  # share of its area that was cut, of each cut picture

    def lines(self) -> list[str]:
        """Return the account as a table of the classes, and sentences."""
        columns = "files", "taken", "resized", "duplicates", "refused"
        width = min(30, max(5, *(len(name) for name in self.classes)))
        lines = [f"  {'class':<{width}}" + "".join(f"{name:>12}" for name in columns)]
        for name, counts in self.classes.items():
            lines.append(f"  {name[:30]:<{width}}" + "".join(f"{counts[column]:>12}" for column in columns))
        done = [f"{number} {what}" for what, number in self.done.items()]
        if self.cut:
            done.append(
                f"of those cut {sum(self.cut) / len(self.cut):.0%} of the area on average, at most {max(self.cut):.0%}"
            )
        lines += [f"  {line}" for line in (self.size, "; ".join(done)) if line]
        for what, found in (("refused", self.refused), ("duplicate", self.duplicates)):
            lines += [f"  {what}: {path}: {why}" for path, why in list(found.items())[:FAULTS_SHOWN]]
            lines += [f"  and {len(found) - FAULTS_SHOWN} more {what}"] if len(found) > FAULTS_SHOWN else []
        return lines

    def as_json(self) -> dict[str, Any]:
        """Return the account as plain values."""
        classes = {name: dict(counts) for name, counts in self.classes.items()}
        return {
            "size": self.size,
            "classes": classes,
            "refused": self.refused,
            "duplicates": self.duplicates,
            "done": dict(self.done),
        }


def read_class_folder(folder: Path, pixels_max: int, reading: Reading | None = None) -> LabelledPictures:
    """Return the pictures of `folder`: one folder per class, pictures of one size inside, or of any that `reading` makes one.

    What systems leave behind (names that begin with a dot, Thumbs.db, desktop.ini, __MACOSX) is passed over. UsageError, which lists
    all faults at once: a class without pictures, folders within a class, pictures beside the class folders, pictures of different sizes,
    files that are no pictures (see `read_grey`), one picture in two classes, or more than `pixels_max` pixels in all.
    """
    entries = _entries(folder)
    classes = [entry.name for entry in entries if entry.is_dir()]
    found = _Found(folder, pixels_max, reading)
    beside = [entry for entry in entries if entry.is_file() and entry.suffix.lower() in PICTURE_SUFFIXES]
    if classes:
        remedy = "move it into its class's folder"
        for one in beside:
            found.fault(PLACE, UsageError(f"{one}: a picture beside the class folders", remedy=remedy))
    files = [(path, label) for label, name in enumerate(classes) for path in found.files_of(folder / name)]
    found.take(files, classes)
    skipping = reading is not None and reading.skip_bad
    faults = {kind: of for kind, of in found.faults.items() if not (skipping and kind in SKIPPED)}
    if not found.images and not faults:
        raise UsageError(f"{folder}: no images in class folders", remedy="put the images of each class into a folder")
    if faults:
        raise _all_of(folder, faults, can_skip=reading is not None)
    images, labels = np.stack(found.images), np.array(found.labels)
    digest = hashlib.sha256(images.data).hexdigest()
    return LabelledPictures(images, labels, tuple(classes), digest, found.account)


class _Found:
    """The pictures of a folder as they are read, and what is wrong with it."""

    def __init__(self, folder: Path, pixels_max: int, reading: Reading | None) -> None:
        self.images: list[NDArray[np.uint8]] = []
        self.labels: list[int] = []
        self.faults: dict[str, list[PansError]] = {}  # by kind
        self.account = Account()
        self._folder, self._pixels_left, self._reading = folder, pixels_max, reading
        self._first = ""  # the picture whose size all others must have
        self._seen: dict[bytes, tuple[Path, int]] = {}  # by content
        self._doubtful: dict[bytes, list[int]] = {}  # classes of contents that stand in several

    def fault(self, kind: str, error: PansError, path: Path | None = None) -> None:
        """Keep one fault, of the file at `path` or of the folder."""
        self.faults.setdefault(kind, []).append(error)
        if path is not None:
            self.account.refused[str(path.relative_to(self._folder))] = error.message.removeprefix(f"{path}: ")

    def files_of(self, folder: Path) -> list[Path]:
        """Return the files of one class."""
        inside = _entries(folder)
        remedy = "one folder per class, the pictures directly inside: flatten it, or name the folder above the classes"
        for one in (entry for entry in inside if entry.is_dir()):
            self.fault(PLACE, UsageError(f"{one}: a folder within the class folder {folder.name!r}", remedy=remedy))
        if not inside:
            remedy = "remove it, or put the class's pictures in"
            self.fault(PLACE, UsageError(f"{folder}: a class folder without pictures", remedy=remedy))
        return [path for path in inside if not path.is_dir()]

    def take(self, files: list[tuple[Path, int]], classes: list[str]) -> None:
        """Read the pictures, with their classes."""
        self.account.classes = {name: Counter() for name in classes}
        target = self._target(files)
        digests = []
        for path, label in files:
            counts = self.account.classes[classes[label]]
            counts["files"] += 1
            try:
                image, digest, done = _read(path, self._pixels_left, target, self._reading)
            except PansError as error:
                if error.remedy == PILLOW_REMEDY:  # it holds for all of them
                    raise
                counts["refused"] += 1
                self.fault(DAMAGED if isinstance(error, DamagedFileError) else STRANGE, error, path)
                continue
            if self._again(path, label, digest, classes, counts):
                continue
            self._pixels_left -= image.size
            if self.images and image.shape != self.images[0].shape:
                size, first = (f"{one.shape[1]} x {one.shape[0]}" for one in (image, self.images[0]))
                words = f"{path}: {size} pixels, the first image ({self._first}) has {first}"
                remedy = f"make them one size: `pans data scene {self._folder} --resize {SIDE_PX} -o FILE.npz`"
                self.fault(SIZE, UsageError(words, remedy=remedy))
                continue
            self._first = self._first or path.name
            self.images.append(image)
            self.labels.append(label)
            digests.append(digest)
            counts["taken"] += 1
            counts["resized"] += RESIZED in done
            self.account.cut += [share for share in done.values() if share]
            self.account.done.update(what for what in done if what != RESIZED)
        for place in reversed([i for i, digest in enumerate(digests) if digest in self._doubtful]):
            counts = self.account.classes[classes[self.labels[place]]]
            counts.update(taken=-1, refused=1)
            del self.images[place], self.labels[place]

    def _again(self, path: Path, label: int, digest: bytes, classes: list[str], counts: Counter[str]) -> bool:
        """Return whether this content was there before, and note it."""
        if self._reading is None:
            return False
        first, before = self._seen.setdefault(digest, (path, label))
        if first == path:
            return False
        if before == label:
            counts["duplicates"] += 1
            self.account.duplicates[str(path.relative_to(self._folder))] = str(first.relative_to(self._folder))
            return True
        counts["refused"] += 1
        remedy = "leave it in the class it belongs to"
        self.fault(TWICE, UsageError(f"{path}: the same picture as {first}, of another class", remedy=remedy), path)
        self.account.refused[str(first.relative_to(self._folder))] = f"the same picture as {path}, of another class"
        self._doubtful.setdefault(digest, []).append(label)
        return True

    def _target(self, files: list[tuple[Path, int]]) -> tuple[int, int] | None:
        """Return height and width of the images, None where pictures stay as they are; from the headers of the files alone."""
        reading = self._reading
        if reading is None:
            return None
        sizes: Counter[tuple[int, int]] = Counter()
        for path, _ in files:
            try:
                with _opened(path, shrinks=True) as picture:
                    sizes[_turned_size(picture)] += 1
            except PansError as error:
                if error.remedy == PILLOW_REMEDY:
                    raise
        largest = max((max(size) for size in sizes), default=0)
        if reading.side == 0 or (reading.side is None and len(sizes) == 1 and largest <= SMALL_SIDE_PX) or not sizes:
            return None
        side = reading.side or SIDE_PX
        aspect = sum(number * math.log(w / h) for (h, w), number in sizes.items()) / sizes.total()
        height, width = (max(1, round(side * math.exp(min(0.0, way)))) for way in (-aspect, aspect))
        which = f"--resize {side}" if reading.side else f"by default; --resize N for another, up to {largest}"
        ends = (f"{w} x {h}" for h, w in (pick(sizes, key=math.prod) for pick in (min, max)))
        from_ = " to ".join(dict.fromkeys(ends))
        beyond = "" if len(sizes) == 1 else ", padded to their mean aspect ratio" if reading.pad else CUT_WORDS
        self.account.size = f"images of {width} x {height} pixels ({which}) from {from_}{beyond}"
        return height, width


def _all_of(folder: Path, faults: dict[str, list[PansError]], *, can_skip: bool) -> PansError:
    """Return one error: a table of the kinds of fault with their counts, then some faults of each kind."""
    of_kind = {kind: faults[kind] for kind in KINDS_OF_FAULT if kind in faults}
    every = [fault for found in of_kind.values() for fault in found]
    skip = ["--skip-bad passes over such files"] if can_skip and any(kind in SKIPPED for kind in of_kind) else []
    remedies = "; ".join(dict.fromkeys([*(fault.remedy for fault in every if fault.remedy), *skip]))
    if len(every) == 1:
        return type(every[0])(every[0].message, remedy=remedies)
    lines = [f"{folder}: {len(every)} faults"]
    if len(of_kind) > 1:
        lines += [f"{len(found):>7}  {kind}" for kind, found in of_kind.items()]
    for kind, found in of_kind.items():
        lines += [f"{kind}:", *(f"  {fault.message}" for fault in found[:FAULTS_SHOWN])]
        lines += [f"  and {len(found) - FAULTS_SHOWN} more"] if len(found) > FAULTS_SHOWN else []
    return UsageError("\n".join(lines), remedy=remedies)


def _entries(folder: Path) -> list[Path]:
    """What stands in `folder`, in order, without what systems leave behind."""
    return sorted(entry for entry in folder.iterdir() if entry.name[0] != "." and entry.name.lower() not in LITTER)


def read_grey(path: Path, pixels_max: int) -> NDArray[np.uint8]:
    """Return the picture at `path`, uint8 (height, width).

    UsageError for more than `pixels_max` pixels, several frames, or values outside the full scale; DamagedFileError for a
    file that is no picture.
    """
    return _read(path, pixels_max, None, None)[0]


RESIZED = "resized"
_Done = dict[str, float]  # what was done to a picture; of a cut the share of its area, else 0


@contextmanager
def _opened(path: Path, *, shrinks: bool) -> Iterator[Any]:
    """Yield the picture of Pillow at `path`, its pixels not yet unpacked; errors of the decoders become ours.

    UsageError, before anything is unpacked, for one that takes too much memory; a JPEG that `shrinks` is unpacked as grey.
    """
    Image = _pillow(f"{path}: pictures need")
    try:
        with open_regular(path) as file, warnings.catch_warnings():
            if (size := os.fstat(file.fileno()).st_size) > PICTURE_BYTES_MAX:  # some decoders read the file at once
                found = f"{path}: {size >> 20} MiB, allowed: {PICTURE_BYTES_MAX >> 20} MiB"
                raise UsageError(found, remedy="make the image smaller, or compress it")
            # Pillow warns of damage, with its own lines of code, and of a size that is above the limit here.
            warnings.simplefilter("ignore")
            with Image.open(file, formats=FORMATS) as picture:
                _demand_small(path, picture, shrinks)
                yield picture
    except PansError:
        raise
    except Image.UnidentifiedImageError as error:
        what, remedy = (
            f"not a picture, or cut; allowed: {', '.join(FORMATS)}",
            "convert or repair it, or move it elsewhere",
        )
        raise DamagedFileError(f"{path}: {what}", remedy=remedy) from error
    except Image.DecompressionBombError as error:
        raise UsageError(f"{path}: {error}", remedy="make the image smaller") from error
    except Exception as error:
        # A damaged file makes the decoders raise anything: IndexError, struct.error, RuntimeError, MemoryError.
        what, remedy = str(error) or type(error).__name__, "repair it, or move it elsewhere"
        raise DamagedFileError(f"{path}: not an image that can be read: {what}", remedy=remedy) from error


def _pillow(what: str = "a picture needs") -> Any:
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise UsageError(f"{what} the package pillow", remedy=PILLOW_REMEDY) from error
    return Image


def _turned_size(picture: Any) -> tuple[int, int]:
    """Height and width of a picture of Pillow, turned as its EXIF data say."""
    on_its_side = picture.getexif().get(EXIF_ORIENTATION, 1) >= EXIF_ON_ITS_SIDE
    return (picture.width, picture.height) if on_its_side else (picture.height, picture.width)


def _read(
    path: Path, pixels_max: int, target: tuple[int, int] | None, reading: Reading | None
) -> tuple[NDArray[np.uint8], bytes, _Done]:
    """Return a picture as 8-bit grey of the size `target` (height, width; None: as it is), the digest of its content, and what was done."""
    with _opened(path, shrinks=target is not None) as picture:
        if picture.width * picture.height > pixels_max and target is None:
            raise _too_large(path, picture, f"more than the {pixels_max} allowed", "make the images smaller, or fewer")
        frames = getattr(picture, "n_frames", 1)
        if frames != 1:
            raise UsageError(f"{path}: {frames} frames", remedy="one picture per file: save the frames apart")
        done: _Done = {}
        if target is not None and picture.mode == "RGB":
            # a JPEG is then unpacked as grey, at a part of its size that is still larger
            picture.draft("L", (4 * target[1], 4 * target[0]))
            done |= {GREYED: 0.0} if picture.mode == "L" else {}
        grey = _turned(picture.getexif().get(EXIF_ORIENTATION, 1), _grey(path, picture, done), done)
        digest = hashlib.sha256(f"{grey.mode} {grey.size}".encode())
        for _, strip in _strips(grey):
            digest.update(strip.tobytes())
        if target is not None and grey.size != target[::-1]:
            if target[0] * target[1] > pixels_max:
                raise UsageError(
                    f"{path}: too many images for the memory allowed", remedy="a smaller --resize, or fewer"
                )
            grey = _fitted(grey, target, pad=reading is not None and reading.pad, done=done)
        image = np.empty(grey.size[::-1], np.uint8)
        for top, strip in _strips(grey):
            image[top : top + len(strip)] = np.rint(strip)
        return image, digest.digest(), done


def _too_large(path: Path, picture: Any, more: str, remedy: str) -> UsageError:
    return UsageError(f"{path}: {picture.width} x {picture.height} pixels, {more}", remedy=remedy)


def _demand_small(path: Path, picture: Any, shrinks: bool) -> None:
    """Raise UsageError for a picture of Pillow that takes too much memory to unpack."""
    pixels = picture.width * picture.height
    if pixels > PICTURE_PIXELS_MAX:
        raise _too_large(path, picture, f"more than the {PICTURE_PIXELS_MAX} allowed", "make the images smaller")
    each = 2 if shrinks and (picture.format, picture.mode) == ("JPEG", "RGB") else _bytes_per_pixel(picture)
    needed = pixels * each + _bytes_beside(picture)
    if needed > PICTURE_BYTES_MAX:
        more = f"of {picture.format} {picture.mode} take {needed >> 20} MiB, allowed: {PICTURE_BYTES_MAX >> 20}"
        raise _too_large(path, picture, more, "make it smaller, or save it as PNG of 8-bit grey")


def _bytes_beside(picture: Any) -> int:
    """Most bytes that the decoder of a picture of Pillow holds beside the picture itself."""
    pixels = picture.width * picture.height
    if picture.format == "WEBP":
        return pixels * WEBP_BYTES
    if picture.format == "JPEG" and picture.info.get("progressive"):
        return pixels * PROGRESSIVE_BYTES
    if picture.format == "TIFF":  # one strip or tile, which may be larger than the picture
        tags = picture.tag_v2
        rows, width = min(picture.height, tags.get(TIFF_STRIP_ROWS, picture.height)), picture.width
        if TIFF_TILE_ROWS in tags:
            rows, width = tags[TIFF_TILE_ROWS], tags.get(TIFF_TILE_WIDTH, width)
        return int(rows) * int(width) * max(1, sum(tags.get(TIFF_BITS, (1,))) // 8)
    return 0


def _bytes_per_pixel(picture: Any) -> int:
    """Bytes per pixel of a picture as Pillow keeps it, and of what `_grey` makes of it."""
    if picture.mode.startswith("I") or picture.mode == "F":
        return (2 if picture.mode.startswith("I;16") else 4) + 4
    kept = 1 if picture.mode in ("1", "L", "P") else 4
    return kept + (kept < 4) * 4 + 3 if picture.has_transparency_data else kept + 1


def _strips(picture: Any) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield a picture of Pillow as arrays of some rows, with the first row of each."""
    for top in range(0, picture.height, STRIP_ROWS):
        yield top, np.asarray(picture.crop((0, top, picture.width, min(top + STRIP_ROWS, picture.height))))


def _grey(path: Path, picture: Any, done: _Done) -> Any:
    """A picture of Pillow as grey, 0 to 255: of mode L, or F where it has more levels."""
    from PIL import Image, ImageChops

    if picture.mode.startswith("I") or picture.mode == "F":
        full_scale = 1.0 if picture.mode == "F" else float(FULL_SCALE_16)
        _demand_within(path, (values for _, values in _strips(picture)), full_scale)
        done[SCALED] = 0.0
        grey = Image.new("F", picture.size)
        for top, values in _strips(picture):
            grey.paste(Image.fromarray((values * (255 / full_scale)).astype(np.float32)), (0, top))
        return grey
    if picture.mode not in ("1", "L", "LA", "La"):
        done[GREYED] = 0.0
    if not picture.has_transparency_data:
        return picture.convert("L")
    whole = picture if picture.mode == "RGBA" else picture.convert("RGBA")
    grey, clear = whole.convert("L"), whole.getchannel("A")
    if clear.getextrema()[0] == 255:
        return grey
    done[BLACKENED] = 0.0
    return ImageChops.multiply(grey, clear)


def _turned(orientation: int, grey: Any, done: _Done) -> Any:
    """A picture of Pillow turned by the EXIF `orientation`."""
    from PIL.Image import Transpose as Way

    ways = (
        Way.FLIP_LEFT_RIGHT,
        Way.ROTATE_180,
        Way.FLIP_TOP_BOTTOM,
        Way.TRANSPOSE,
        Way.ROTATE_270,
        Way.TRANSVERSE,
        Way.ROTATE_90,
    )
    if orientation - 2 not in range(len(ways)):
        return grey
    done[TURNED] = 0.0
    return grey.transpose(ways[orientation - 2])


def _fitted(grey: Any, target: tuple[int, int], *, pad: bool, done: _Done) -> Any:
    """A picture of Pillow at the size `target` (height, width): its middle, or with `pad` all of it before black."""
    from PIL import Image

    (height, width), (w, h) = target, grey.size
    scale = (min if pad else max)(width / w, height / h)
    size = max(1, min(width, round(w * scale))), max(1, min(height, round(h * scale)))
    box_w, box_h = (w, h) if pad else (min(w, width / scale), min(h, height / scale))
    left, top = (w - box_w) / 2, (h - box_h) / 2
    way = Image.Resampling.BOX if scale <= 1 else Image.Resampling.BILINEAR
    fitted = grey.resize(size, way, box=(left, top, left + box_w, top + box_h))
    done[RESIZED] = 0.0
    if scale > 1:
        done[ENLARGED] = 0.0
    if pad and size != (width, height):
        done[PADDED] = 0.0
        whole = Image.new(grey.mode, (width, height), 0)
        whole.paste(fitted, ((width - size[0]) // 2, (height - size[1]) // 2))
        return whole
    if (share := 1 - box_w * box_h / (w * h)) > LEAST_CUT:
        done[CUT] = share
    return fitted


def _demand_within(where: Path, parts: Iterable[NDArray[Any]], full_scale: float) -> None:
    """Raise UsageError for values beyond 0 to `full_scale`, or not finite."""
    ends = np.array([(values.min(), values.max()) for values in parts], np.float64)
    low, high = ends[:, 0].min(), ends[:, 1].max()  # NaN where one is
    if not (low >= 0 and high <= full_scale):  # NaN fails it too
        found = f"{where}: values from {low:g} to {high:g}, allowed: 0 to {full_scale:g}"
        raise UsageError(found, remedy="scale them, or save 8 bits")


def to_8_bits(where: Path, values: NDArray[Any], full_scale: float) -> NDArray[np.uint8]:
    """Return `values` (any shape), 0 to `full_scale`, as nearest of 256 grey levels; UsageError for any beyond, or not finite."""
    _demand_within(where, [values], full_scale)
    return np.asarray(np.rint(values.astype(np.float64) * (255 / full_scale)), dtype=np.uint8)


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
        # Pillow names the open file by its address there
        why = "it is no PNG" if isinstance(error, image.UnidentifiedImageError) else error
        raise DamagedFileError(f"{where}: not a readable grey PNG: {why}", remedy=remedy) from error


def shipped_scene(name: str) -> Path | None:
    """Return the file of a scene of that name in a package of the entry points `pans.scenes`, None where there is none."""
    for point in entry_points(group="pans.scenes"):
        found = resources.files(point.module) / "scenes" / f"{name}.npz"
        if "/" not in name and found.is_file():
            return Path(str(found))
    return None


def scene_arrays(path: Path, most: int) -> dict[str, NDArray[Any]]:
    """Return `images` of a .npz file, uint8 (n, height, width) and not empty, with its `labels` and `classes` if there are any.

    UsageError for another file, or for arrays of more than `most` bytes together.
    """
    remedy = "write a scene with numpy.savez(FILE, images=, labels=, classes=)"
    try:
        arrays = read_arrays(path, ("images", "labels", "classes"), most)
    except ValueError as error:
        raise UsageError(f"{path}: not a readable scene: {error}", remedy=remedy) from error
    images = arrays.get("images", np.zeros(0))
    if images.dtype != np.uint8 or images.ndim != 3 or not images.size:
        found = f"{images.dtype} {images.shape}" if "images" in arrays else "no array `images`"
        raise UsageError(
            f"{path}: images must be uint8 (objects, height, width) and not empty, found {found}", remedy=remedy
        )
    return arrays


def read_labelled(name: str) -> LabelledPictures:
    """Return images uint8 (n, h, w), labels int64 (n,) and class names ("" for unnamed ones); UsageError says what is wrong."""
    path = Path(name)
    if path.is_dir():
        return read_class_folder(path, LABELLED_MAX_BYTES)
    path = path if path.exists() else shipped_scene(name) or path
    arrays = scene_arrays(path, LABELLED_MAX_BYTES)
    images, labels = arrays["images"], arrays.get("labels", np.zeros(0))
    if labels.dtype.kind not in "iu" or labels.shape != images.shape[:1]:
        found = f"labels are {labels.dtype} {labels.shape}"
        raise UsageError(f"{path}: {found}, allowed: integers, one for each of {len(images)} images")
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
