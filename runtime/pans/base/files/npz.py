"""Arrays of a .npz file from a stranger: measured before anything is allocated, never unpickled.

ValueError says what cannot be, UsageError that there is no such file. What the arrays mean is for the caller.
"""

from __future__ import annotations

import io
import math
import os
import sys
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from .container import open_regular

SMALL_BYTES, EXPANSION = 64 << 20, 100  # arrays that a short file may hold, and of a longer one how many times its size
# RuntimeError: an encrypted member; NotImplementedError: an unknown compression
_UNREADABLE = (OSError, ValueError, EOFError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error)


def read_arrays(path: str | Path, wanted: Sequence[str] | None, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Return those of the `wanted` arrays (None: all) that the file holds, after their sizes were checked in directory and headers.

    At most `max_bytes` are unpacked, and of a file that was made to fill the memory, a thousand times its size, far less.
    """
    with open_regular(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                sizes = {info.filename: info.file_size for info in archive.infolist()}
                stored = [name.removesuffix(".npy") for name in sizes if name.endswith(".npy")]
                present = [name for name in stored if wanted is None or name in wanted]
                total = sum(sizes[f"{name}.npy"] for name in present)
                if total > max_bytes:
                    raise ValueError(f"holds {total} bytes of arrays, allowed are {max_bytes}")
                if total > max(SMALL_BYTES, EXPANSION * os.fstat(file.fileno()).st_size):
                    found = f"{total >> 20} MiB of arrays, {EXPANSION} times the file or more, allowed are {SMALL_BYTES >> 20} MiB"
                    raise ValueError(f"unpacks to {found}; numpy.savez, which does not compress, can store any")
                for name in present:
                    with archive.open(f"{name}.npy") as member:
                        _check_header(name, member, sizes[f"{name}.npy"])
            file.seek(0)
            with np.load(file, allow_pickle=False) as loaded:
                return {name: _checked_text(name, loaded[name]) for name in present}
        except _UNREADABLE as error:
            raise ValueError(str(error) or type(error).__name__) from error


def _checked_text(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return an array; ValueError for one of texts with numbers that are no characters, of which Python cannot make a str."""
    if array.dtype.kind == "U" and array.dtype.itemsize:
        codes = np.ascontiguousarray(array).view(array.dtype.byteorder.replace("|", "=") + "u4")
        if codes.max(initial=0) > sys.maxunicode:
            raise ValueError(f"{name} holds the character {codes.max()}, allowed: 0 to {sys.maxunicode}")
    return array


def npz_bytes(**arrays: Any) -> bytes:
    """Return arrays as the bytes of a compressed .npz file."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def _check_header(name: str, member: IO[bytes], size: int) -> None:
    shape, _, dtype = npy_header(name, member)
    claimed = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or claimed > size:
        raise ValueError(f"{name} claims {claimed} bytes as {dtype} {shape}, the file holds {size}")


def npy_header(name: str, file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, column-major order and dtype of the .npy array that `file` begins with; ValueError for whatever cannot be."""
    try:
        version = np.lib.format.read_magic(file)
    except ValueError as error:  # in Python's words
        raise ValueError(f"{name} does not begin as a .npy array does") from error
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{name} is stored in npy version {version}, allowed are 1.0 and 2.0")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, fortran, dtype = read_header(file)
    except Exception as error:  # numpy hands the text to Python's parser and tokenizer, with the errors of both
        raise ValueError(f"{name} has a header that cannot be read") from error
    if any(isinstance(size, bool) or size < 0 for size in shape):
        raise ValueError(f"{name} has the shape {shape}, allowed: whole numbers from 0")
    return shape, fortran, dtype
