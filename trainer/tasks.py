"""Tasks: labelled 8-bit images, from pinned public files or from a user's own.

Owns the reading of IDX, .npz and class folders, with checksums and limits, and the split into training and held-out objects;
never trains and never shows an image. `load_task` returns a `Task` whose images are uint8 (n, height, width): 0 is black.

A user's file or folder without a test part is split by position: every fifth object is held out.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import urllib.request
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import DamagedFileError, UsageError

FILE_MAX_BYTES = 1 << 30
IMAGES_MAX_BYTES = 1 << 30
HOLD_OUT_EVERY = 5
FASHION_CLASSES = (
    *("T-shirt/top", "Trouser", "Pullover", "Dress", "Coat", "Sandal", "Shirt", "Sneaker", "Bag", "Ankle boot"),
)


@dataclass(frozen=True, slots=True)
class PinnedFile:
    """One public file: its name, size and SHA-256, where it can be had, and the shape that it must hold."""

    name: str
    n_bytes: int
    sha256: str
    shape: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class PublicSet:
    """A public data set of four IDX files in the folder `folder`."""

    folder: str
    classes: tuple[str, ...]
    source: str  # the files' names are appended
    licence: str
    files: tuple[PinnedFile, PinnedFile, PinnedFile, PinnedFile]  # training images, labels, test images, labels


PUBLIC_SETS: Mapping[str, PublicSet] = {
    "fashion-mnist": PublicSet(
        folder="fashion-mnist",
        classes=FASHION_CLASSES,
        source="http://fashion-mnist.s3-website.eu-central-1.amazonaws.com/",
        licence="MIT, Zalando SE",
        files=(
            PinnedFile(
                "train-images-idx3-ubyte.gz",
                26421856,
                "b0564c3eedabfbf835052cff8503ea422014ce006caf5b757f851416ee8300c7",
                (60000, 28, 28),
            ),
            PinnedFile(
                "train-labels-idx1-ubyte.gz",
                29491,
                "0ae29f65d86684f32d1b9c85147786c547b9c6aebcaf235f0400a0cce308b056",
                (60000,),
            ),
            PinnedFile(
                "t10k-images-idx3-ubyte.gz",
                4422079,
                "cc1d090a38ace84dfa1aa66e3ada7c336ef481a96936906477e6dd344da56eaa",
                (10000, 28, 28),
            ),
            PinnedFile(
                "t10k-labels-idx1-ubyte.gz",
                5125,
                "8d3605d196f4be44669e46906da9733c8131fef761fdbfec72c424d5222f1a05",
                (10000,),
            ),
        ),
    ),
    "mnist": PublicSet(
        folder="mnist",
        classes=tuple("0123456789"),
        source="https://ossci-datasets.s3.amazonaws.com/mnist/",
        licence="CC BY-SA 3.0, Y. LeCun, C. Cortes and C. J. C. Burges",
        files=(
            PinnedFile(
                "train-images-idx3-ubyte.gz",
                9630634,
                "db8f937d487057fb14a9f0fbe97f0bc8d311ab41b750d41e1ff37c43b9e55e19",
                (60000, 28, 28),
            ),
            PinnedFile(
                "train-labels-idx1-ubyte.gz",
                28902,
                "51fc562b6747b666fbf6e84ce29d43c3cb5f9c388c664d43b33f02095313405a",
                (60000,),
            ),
            PinnedFile(
                "t10k-images-idx3-ubyte.gz",
                1602073,
                "cfeddb84311ecf044fc6a5b0f6ee8a24d265d4e83e388400186eb114082f4209",
                (10000, 28, 28),
            ),
            PinnedFile(
                "t10k-labels-idx1-ubyte.gz",
                4540,
                "e41c74e484045d39b462a7790a4af51301bd9b0b24f0154798d713ec68c45920",
                (10000,),
            ),
        ),
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class Objects:
    """Labelled images: uint8 (n, height, width) and int64 (n,)."""

    images: NDArray[np.uint8]
    labels: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Objects to train on and objects held out; `sha256` names the data, `split` says how the held-out ones were chosen."""

    name: str
    classes: tuple[str, ...]
    train: Objects
    test: Objects
    sha256: str
    split: str

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.train.images.shape[1:]
        return int(height), int(width)

    @property
    def split_here(self) -> bool:
        """Whether the data had no test part of its own, and every fifth object was held out here."""
        return self.split == _SPLIT_BY_POSITION

    def everything(self) -> Objects:
        """All objects, in the order of their file where the split was made here."""
        if not self.split_here:
            images = np.concatenate([self.train.images, self.test.images])
            return Objects(images, np.concatenate([self.train.labels, self.test.labels]))
        n = len(self.train) + len(self.test)
        held_out = _held_out(n)
        images = np.empty((n, *self.image_shape), dtype=np.uint8)
        labels = np.empty(n, dtype=np.int64)
        images[~held_out], labels[~held_out] = self.train.images, self.train.labels
        images[held_out], labels[held_out] = self.test.images, self.test.labels
        return Objects(images, labels)


_SPLIT_BY_POSITION = f"every {HOLD_OUT_EVERY}th object held out"
_SPLIT_OF_FILE = "the test part of the data"


def load_task(name_or_path: str, data_dir: str | Path | None = None) -> Task:
    """Return the public set of that name, or the .npz file or folder of class folders at that path.

    `data_dir` (default: the environment variable PANS_DATA) holds the folders of the public sets. UsageError says what
    is missing or unfit, DamagedFileError which file is not the pinned one.
    """
    if name_or_path in PUBLIC_SETS:
        return _load_public(name_or_path, data_folder(data_dir))
    path = Path(name_or_path)
    if path.is_dir():
        return _load_folder(path)
    if path.is_file() and path.suffix == ".npz":
        return _load_npz(path)
    raise UsageError(
        f"task {name_or_path!r} is neither one of {', '.join(PUBLIC_SETS)}, nor a .npz file, nor a folder",
        remedy="a .npz file holds `images` uint8 (n, height, width) and `labels`; a folder holds one folder per class",
    )


def data_folder(data_dir: str | Path | None) -> Path:
    """Return the folder of the public sets: `data_dir`, or what PANS_DATA names; UsageError without either."""
    chosen = data_dir or os.environ.get("PANS_DATA")
    if not chosen:
        raise UsageError(
            "no data folder: neither --data-dir nor PANS_DATA is set",
            remedy="`pans data fetch --data-dir FOLDER` fetches the public sets",
        )
    return Path(chosen)


def read_idx(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return the unsigned bytes of a gzipped IDX file of exactly `shape`; nothing is unpacked beyond that size."""
    n_dims = len(shape)
    n_bytes = 4 + 4 * n_dims + int(np.prod(shape))
    try:
        with gzip.open(path, "rb") as file:
            data = file.read(n_bytes + 1)
    except (OSError, EOFError) as error:
        raise DamagedFileError(f"{path}: cannot be unpacked: {error}") from error
    header = bytes([0, 0, 8, n_dims]) + b"".join(size.to_bytes(4, "big") for size in shape)
    if len(data) != n_bytes or not data.startswith(header):
        raise DamagedFileError(f"{path}: not an IDX file of unsigned bytes of shape {shape}")
    return np.frombuffer(data, np.uint8, offset=len(header)).reshape(shape)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_pinned(path: Path, pinned: PinnedFile) -> None:
    """Raise UsageError if the file is not there, DamagedFileError if it is not byte for byte the pinned one."""
    if not path.is_file():
        raise UsageError(
            f"{path} is not there", remedy=f"`pans data fetch --data-dir {path.parent.parent}`, or copy it there"
        )
    size = path.stat().st_size
    if size != pinned.n_bytes:
        raise DamagedFileError(f"{path}: {size} bytes, the pinned file has {pinned.n_bytes}", remedy=_FETCH_AGAIN)
    found = file_sha256(path)
    if found != pinned.sha256:
        raise DamagedFileError(f"{path}: SHA-256 {found}, pinned is {pinned.sha256}", remedy=_FETCH_AGAIN)


def fetch(url: str, path: Path, pinned: PinnedFile) -> bool:
    """Fetch `url` to `path` unless the pinned file is there; True if it was fetched. Nothing unchecked is ever kept."""
    if path.is_file():
        check_pinned(path, pinned)
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    try:
        with urllib.request.urlopen(url, timeout=60) as answer:
            beside.write_bytes(answer.read(pinned.n_bytes + 1))
        check_pinned(beside, pinned)
        os.replace(beside, path)
    except OSError as error:
        raise UsageError(f"{url}: cannot be fetched: {error}", remedy=f"copy the file to {path} by hand") from error
    finally:
        beside.unlink(missing_ok=True)
    return True


_FETCH_AGAIN = "delete the file and fetch it again: `pans data fetch`"


def _load_public(name: str, folder: Path) -> Task:
    public = PUBLIC_SETS[name]
    arrays = []
    for pinned in public.files:
        path = folder / public.folder / pinned.name
        check_pinned(path, pinned)
        arrays.append(read_idx(path, pinned.shape))
    digest = hashlib.sha256("".join(pinned.sha256 for pinned in public.files).encode()).hexdigest()
    train = Objects(arrays[0], arrays[1].astype(np.int64))
    test = Objects(arrays[2], arrays[3].astype(np.int64))
    return Task(name, public.classes, train, test, digest, _SPLIT_OF_FILE)


def _load_npz(path: Path) -> Task:
    """`images` and `labels`, or `train_images`, `train_labels`, `test_images`, `test_labels`; `classes` if there are names."""
    arrays = _read_npz(path)
    parts = [f"{part}_{kind}" for part in ("train", "test") for kind in ("images", "labels")]
    if all(part in arrays for part in parts):
        train = _objects(path, arrays["train_images"], arrays["train_labels"])
        test = _objects(path, arrays["test_images"], arrays["test_labels"])
        split = _SPLIT_OF_FILE
    elif "images" in arrays and "labels" in arrays:
        train, test = _split(path, _objects(path, arrays["images"], arrays["labels"]))
        split = _SPLIT_BY_POSITION
    else:
        raise UsageError(
            f"{path}: holds {', '.join(sorted(arrays)) or 'nothing'}",
            remedy=f"name the arrays `images` and `labels`, or {', '.join(parts)}",
        )
    n_classes = int(max(train.labels.max(), test.labels.max())) + 1
    classes = tuple(str(name) for name in arrays.get("classes", np.arange(n_classes)).ravel())
    return _checked(Task(path.stem, classes, train, test, file_sha256(path), split), path)


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    if path.stat().st_size > FILE_MAX_BYTES:
        raise UsageError(f"{path}: {path.stat().st_size} bytes, allowed at most {FILE_MAX_BYTES}")
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(item.file_size for item in archive.infolist())
        if unpacked > IMAGES_MAX_BYTES:
            raise UsageError(f"{path}: unpacks to {unpacked} bytes, allowed at most {IMAGES_MAX_BYTES}")
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise DamagedFileError(f"{path}: cannot be read: {error}") from error


def _load_folder(folder: Path) -> Task:
    """One folder per class, images of one size inside; colours become grey."""
    from PIL import Image

    classes = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    images: list[NDArray[np.uint8]] = []
    labels: list[int] = []
    digest = hashlib.sha256()
    n_bytes = 0
    for label, name in enumerate(classes):
        for path in sorted(entry for entry in (folder / name).iterdir() if entry.is_file()):
            try:
                with Image.open(path) as picture:
                    n_bytes += picture.width * picture.height
                    if n_bytes > IMAGES_MAX_BYTES:
                        raise UsageError(f"{folder}: more than {IMAGES_MAX_BYTES} pixels")
                    image = np.asarray(picture.convert("L"), dtype=np.uint8)
            except OSError as error:
                raise DamagedFileError(f"{path}: not an image that can be read: {error}") from error
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
    train, test = _split(folder, _objects(folder, np.stack(images), np.array(labels)))
    return _checked(
        Task(folder.resolve().name, tuple(classes), train, test, digest.hexdigest(), _SPLIT_BY_POSITION), folder
    )


def _objects(where: Path, images: NDArray[Any], labels: NDArray[Any]) -> Objects:
    if images.dtype != np.uint8 or images.ndim != 3 or 0 in images.shape:
        raise UsageError(f"{where}: images are {images.dtype} {images.shape}, allowed: uint8 (n, height, width)")
    if labels.shape != (len(images),) or not np.issubdtype(labels.dtype, np.integer):
        raise UsageError(f"{where}: labels are {labels.dtype} {labels.shape}, allowed: integers ({len(images)},)")
    return Objects(images, labels.astype(np.int64))


def _split(where: Path, objects: Objects) -> tuple[Objects, Objects]:
    if len(objects) < 2 * HOLD_OUT_EVERY:
        raise UsageError(f"{where}: {len(objects)} objects, needed are {2 * HOLD_OUT_EVERY} or more")
    held_out = _held_out(len(objects))
    train = Objects(objects.images[~held_out], objects.labels[~held_out])
    return train, Objects(objects.images[held_out], objects.labels[held_out])


def _held_out(n: int) -> NDArray[np.bool_]:
    return np.arange(n) % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1


def _checked(task: Task, where: Path) -> Task:
    labels = np.concatenate([task.train.labels, task.test.labels])
    n_classes = len(task.classes)
    if task.test.images.shape[1:] != task.train.images.shape[1:]:
        raise UsageError(f"{where}: training and test images differ in size")
    if n_classes < 2 or labels.min() < 0 or labels.max() >= n_classes:
        raise UsageError(f"{where}: labels from {labels.min()} to {labels.max()} for {n_classes} classes")
    return task
