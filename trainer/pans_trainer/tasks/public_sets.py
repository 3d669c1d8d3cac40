"""Public data sets: IDX files with pinned sizes and SHA-256, found in a folder or fetched.

Nothing is unpacked beyond the shape that it must have, and nothing unchecked is kept.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import make_folder, whole_file

FASHION_CLASSES = (
    *("T-shirt/top", "Trouser", "Pullover", "Dress", "Coat", "Sandal", "Shirt", "Sneaker", "Bag", "Ankle boot"),
)
_FETCH_AGAIN = "delete the file and fetch it again: `pans data fetch`"


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
    files: tuple[PinnedFile, ...]  # training images, labels, test images, labels


# training images, labels, test images, labels: the same names and shapes in both sets
_FILES = (
    ("train-images-idx3-ubyte.gz", (60000, 28, 28)),
    ("train-labels-idx1-ubyte.gz", (60000,)),
    ("t10k-images-idx3-ubyte.gz", (10000, 28, 28)),
    ("t10k-labels-idx1-ubyte.gz", (10000,)),
)


def _pinned(*sizes_and_sha256: tuple[int, str]) -> tuple[PinnedFile, ...]:
    """The four files of a set, from the size in bytes and the SHA-256 of each."""
    return tuple(
        PinnedFile(name, n_bytes, sha256, shape) for (name, shape), (n_bytes, sha256) in zip(_FILES, sizes_and_sha256)
    )


PUBLIC_SETS: Mapping[str, PublicSet] = {
    "fashion-mnist": PublicSet(
        folder="fashion-mnist",
        classes=FASHION_CLASSES,
        source="http://fashion-mnist.s3-website.eu-central-1.amazonaws.com/",
        licence="MIT, Zalando SE",
        files=_pinned(
            (26421856, "b0564c3eedabfbf835052cff8503ea422014ce006caf5b757f851416ee8300c7"),
            (29491, "0ae29f65d86684f32d1b9c85147786c547b9c6aebcaf235f0400a0cce308b056"),
            (4422079, "cc1d090a38ace84dfa1aa66e3ada7c336ef481a96936906477e6dd344da56eaa"),
            (5125, "8d3605d196f4be44669e46906da9733c8131fef761fdbfec72c424d5222f1a05"),
        ),
    ),
    "mnist": PublicSet(
        folder="mnist",
        classes=tuple("0123456789"),
        source="https://ossci-datasets.s3.amazonaws.com/mnist/",
        licence="CC BY-SA 3.0, Y. LeCun, C. Cortes and C. J. C. Burges",
        files=_pinned(
            (9630634, "db8f937d487057fb14a9f0fbe97f0bc8d311ab41b750d41e1ff37c43b9e55e19"),
            (28902, "51fc562b6747b666fbf6e84ce29d43c3cb5f9c388c664d43b33f02095313405a"),
            (1602073, "cfeddb84311ecf044fc6a5b0f6ee8a24d265d4e83e388400186eb114082f4209"),
            (4540, "e41c74e484045d39b462a7790a4af51301bd9b0b24f0154798d713ec68c45920"),
        ),
    ),
}


def data_folder(data_dir: str | Path | None) -> Path:
    """Return the folder of the public sets: `data_dir`, or what PANS_DATA names; UsageError without either."""
    chosen = data_dir or os.environ.get("PANS_DATA")
    if not chosen:
        what = "no data folder: neither --data-dir nor PANS_DATA is set"
        raise UsageError(what, remedy="`pans data fetch --data-dir FOLDER` fetches the public sets")
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
        what = f"{path} is not there"
        raise UsageError(what, remedy=f"`pans data fetch --data-dir {path.parent.parent}`, or copy it there")
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
    make_folder(path.parent)
    try:
        with urllib.request.urlopen(url, timeout=60) as answer:
            data = answer.read(pinned.n_bytes + 1)
    except OSError as error:
        raise UsageError(f"{url}: cannot be fetched: {error}", remedy=f"copy the file to {path} by hand") from error
    with whole_file(path) as beside:
        beside.write_bytes(data)
        check_pinned(beside, pinned)
    return True
