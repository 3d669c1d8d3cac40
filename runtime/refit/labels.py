"""What the recorded objects were, from a CSV file: `object,label`, or `recording,object,label` for several recordings.

Owns the file's form and its checks; never reads a recording. A label is a class name of the bundle, or its number; an empty one leaves the
object out.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pans.runtime.container import read_file
from pans.runtime.errors import ConfigError

HEADS = (("object", "label"), ("recording", "object", "label"))
ROWS_MAX = 1 << 20
BYTES_MAX = 1 << 26
OBJECT_MAX = (1 << 32) - 1
_REMEDY = "write one line `object,label` per object, the label a class name or its number, empty where it is unknown"


class Labels(NamedTuple):
    """Labels by object; `by_recording` by the recording's file name, whose only key is "" where the file names none."""

    by_recording: Mapping[str, Mapping[int, int | None]]
    sha256: str

    @property
    def names_recordings(self) -> bool:
        """Whether each line names its recording."""
        return "" not in self.by_recording


def read_labels(path: Path, classes: Sequence[str]) -> Labels:
    """Return the labels in `path`; ConfigError, with the line, for a label out of range, an object twice, or another form."""
    import hashlib

    data = read_file(path, BYTES_MAX)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8: {error}", remedy=_REMEDY) from error
    rows = csv.reader(io.StringIO(text, newline=""))
    try:
        return Labels(_read(path, rows, tuple(classes)), hashlib.sha256(data).hexdigest())
    except csv.Error as error:
        raise ConfigError(f"{path}:{rows.line_num}: no CSV: {error}", remedy=_REMEDY) from error


def _read(path: Path, rows: Any, classes: tuple[str, ...]) -> dict[str, dict[int, int | None]]:
    head = tuple(word.strip() for word in next(rows, []))
    if head not in HEADS:
        allowed = " or ".join(",".join(names) for names in HEADS)
        raise ConfigError(
            f"{path}:1: the first line is {ascii(','.join(head))[:80]}, allowed: {allowed}", remedy=_REMEDY
        )
    found: dict[str, dict[int, int | None]] = {}
    for count, row in enumerate(rows):
        where = f"{path}:{rows.line_num}"
        if not row:
            continue
        if len(row) != len(head) or count >= ROWS_MAX:
            raise ConfigError(f"{where}: {len(row)} values, allowed: {len(head)}, in at most {ROWS_MAX} lines")
        recording = row[0].strip() if len(head) == 3 else ""
        object_id = _number(row[-2].strip(), where)
        mine = found.setdefault(recording, {})
        if object_id in mine:
            raise ConfigError(f"{where}: object {object_id} has a label already", remedy="name each object once")
        mine[object_id] = _label(row[-1].strip(), classes, where)
    if not any(label is not None for mine in found.values() for label in mine.values()):
        raise ConfigError(f"{path}: no object has a label", remedy=_REMEDY)
    return found


def _number(word: str, where: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 10 and int(word) <= OBJECT_MAX):
        raise ConfigError(f"{where}: the object is {ascii(word)[:40]}, allowed: whole numbers 0 to {OBJECT_MAX}")
    return int(word)


def _label(word: str, classes: tuple[str, ...], where: str) -> int | None:
    if not word:
        return None
    if word in classes:
        return classes.index(word)
    if word.isascii() and word.isdigit() and len(word) <= 6 and int(word) < len(classes):
        return int(word)
    names = ", ".join(classes[:10]) + (", ..." if len(classes) > 10 else "")
    raise ConfigError(
        f"{where}: the label is {ascii(word)[:40]}, allowed: 0 to {len(classes) - 1}, or one of {names}",
        remedy="name a class of the bundle (pans info BUNDLE lists them)",
    )
