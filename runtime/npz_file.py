"""Arrays of a .npz file from a stranger: measured before anything is allocated, never unpickled.

Owns the limits and the reading; what the arrays mean is the caller's. ValueError says what cannot be, UsageError that
there is no such file.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from .container import open_regular

# RuntimeError: an encrypted member; NotImplementedError: an unknown compression
_UNREADABLE = (OSError, ValueError, EOFError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error)


def read_arrays(path: str | Path, wanted: Sequence[str], max_bytes: int) -> dict[str, NDArray[Any]]:
    """Return those of the `wanted` arrays that the file holds, after their sizes were found sane in its directory and in their headers."""
    with open_regular(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                sizes = {info.filename: info.file_size for info in archive.infolist()}
                present = [name for name in wanted if f"{name}.npy" in sizes]
                total = sum(sizes[f"{name}.npy"] for name in present)
                if total > max_bytes:
                    raise ValueError(f"holds {total} bytes of arrays, allowed are {max_bytes}")
                for name in present:
                    with archive.open(f"{name}.npy") as member:
                        _check_header(name, member, sizes[f"{name}.npy"])
            file.seek(0)
            with np.load(file, allow_pickle=False) as loaded:
                return {name: loaded[name] for name in present}
        except _UNREADABLE as error:
            raise ValueError(str(error) or type(error).__name__) from error


def _check_header(name: str, member: IO[bytes], size: int) -> None:
    version = np.lib.format.read_magic(member)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{name} is stored in npy version {version}, allowed are 1.0 and 2.0")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(member)
    claimed = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or min(shape, default=0) < 0 or claimed > size:
        raise ValueError(f"{name} claims {claimed} bytes as {dtype} {shape}, the file holds {size}")
