"""The names of the parts of one recording, `run-0001.pansrec` and so on for `run.pansrec`, and the hash over all their logs."""

from __future__ import annotations

import hashlib
import os
import re
from glob import escape
from pathlib import Path

from pans.runtime.errors import UsageError

NUMBER_DIGITS_MAX = 10  # the index of a block is a u32, and a part has several


def part_path(first: Path, number: int) -> Path:
    """Return the path of part `number`: `run.pansrec` becomes `run-0001.pansrec`."""
    return first.with_name(f"{first.stem}-{number:04d}{first.suffix}")


def part_number(path: Path) -> int | None:
    """Return the number in the name of a part: 12 for `run-0012.pansrec`; None for other names."""
    digits = path.stem.rpartition("-")[2]
    return int(digits) if digits.isdecimal() and len(digits) <= NUMBER_DIGITS_MAX else None


def stem_of(path: Path) -> str:
    """Return what the parts of one run have in common: `run` for `run-0012.pansrec`."""
    return path.stem.rpartition("-")[0]


def chained(chain_sha256: str, decisions_sha256: str) -> str:
    """Return the hash over all parts' logs so far: SHA-256 of the one before ("" at first) and this part's, as hex texts."""
    return hashlib.sha256(f"{chain_sha256}{decisions_sha256}".encode("ascii")).hexdigest()


def find_parts(place: str | Path) -> list[Path]:
    """Return the parts in the folder `place`, or those of the recording `place`, in order."""
    folder, stem = Path(place), "*"
    if not folder.is_dir():
        folder, stem = folder.parent, escape(folder.stem)
    found = [path for path in folder.glob(f"{stem}-[0-9]*.pansrec") if part_number(path) is not None]
    return sorted(found, key=lambda path: (stem_of(path), part_number(path)))


def is_of_parts(path: str | Path) -> bool:
    """Say whether `path` stands for a recording in parts: a folder, or the name of a recording of which only parts are there."""
    return Path(path).is_dir() or (not Path(path).exists() and bool(find_parts(path)))


def parts_in(place: str | Path) -> list[Path]:
    """As `find_parts`; UsageError if there are none."""
    if paths := find_parts(place):
        return paths
    raise UsageError(f"{place}: no parts of a recording are here", remedy="parts are named like run-0001.pansrec")


def files_of_parts(first: Path) -> list[Path]:
    """Return the parts of the recording `first`, and those that were made ahead and never begun: a later run replaces them."""
    stem, suffix = re.escape(first.stem), re.escape(first.suffix)
    wanted = re.compile(rf"{stem}-\d{{4,}}{suffix}|\.{stem}-\d{{4,}}{suffix}\.[0-9a-f]+\.partial")
    try:
        names = sorted(name for name in os.listdir(first.parent) if wanted.fullmatch(name))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UsageError(f"{first.parent}: cannot be read: {error.strerror or error}") from error
    return [first.with_name(name) for name in names]
