"""One command over many inputs: the items, the journal of what is done, and one item's run in a process of its own.

Owns which words each item is run with and the rows of results; where items run is workers.py's. Each finished item is one line of the
journal, synced, so that a batch that was ended at any time goes on where it was.
"""

from __future__ import annotations

import ctypes
import glob
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from pans.runtime.errors import UsageError

FORMAT = "pans-batch 1"
ITEMS_MAX = 1_000_000
VALUES_MAX = 100_000
STDERR_CHARACTERS = 2000
_DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)


@dataclass(frozen=True, slots=True)
class Item:
    """One run of the command: its words, what is varied, and a key that changes when the words or the input file change."""

    path: str
    words: tuple[str, ...]
    varied: tuple[tuple[str, str], ...]
    key: str


def items_of(command: str, inputs: Sequence[str], vary: Sequence[str], extra: str, *, files: bool) -> list[Item]:
    """Return the items: each input with each combination of the varied options; UsageError for a pattern that nothing matches.

    `vary` holds `NAME=VALUES`, `extra` further words, in which `{path}`, `{folder}`, `{stem}` and the varied names are replaced.
    """
    options = [_values(one) for one in vary]
    paths = [path for one in inputs for path in (_matching(one) if files else [one])]
    try:
        words = shlex.split(extra)
    except ValueError as error:
        raise UsageError(f"--with {extra!r}: {error}", remedy="close its quotes") from error
    items = [
        _item(command, path, dict(zip((name for name, _ in options), chosen, strict=True)), words)
        for path in dict.fromkeys(paths)
        for chosen in product(*(values for _, values in options))
    ]
    if len(items) > ITEMS_MAX:
        raise UsageError(f"{len(items)} items, allowed at most {ITEMS_MAX}", remedy="vary fewer options at once")
    return items


def _matching(pattern: str) -> list[str]:
    found = sorted(glob.glob(pattern, recursive=True)) if glob.has_magic(pattern) else [pattern]
    missing = [path for path in found if not os.path.exists(path)]
    if not found or missing:
        raise UsageError(f"{pattern}: there is no such file", remedy="put patterns in quotes: 'runs/*/run.pansrec'")
    return found


def _values(text: str) -> tuple[str, list[str]]:
    """Read `NAME=1,2,5` or `NAME=0-9`."""
    name, is_pair, values = text.partition("=")
    name = name.removeprefix("--")
    first, is_range, last = values.partition("-")
    if is_range and first.isdecimal() and last.isdecimal() and len(last) < 10 and int(first) <= int(last):
        if int(last) - int(first) >= VALUES_MAX:
            raise UsageError(f"--vary {text}: more than {VALUES_MAX} values", remedy="vary fewer")
        return name, [str(number) for number in range(int(first), int(last) + 1)]
    found = [value for value in values.split(",") if value]
    if not is_pair or not name or not found:
        raise UsageError(f"--vary {text!r} is not NAME=VALUES", remedy="write seed=0-9, or eta=0.5,1,2")
    return name, found


def _item(command: str, path: str, chosen: Mapping[str, str], extra: Sequence[str]) -> Item:
    places = {"path": path, "folder": os.path.dirname(path) or ".", "stem": Path(path).stem, **chosen}
    words = [command, path]
    for name, value in chosen.items():
        if not any(f"{{{name}}}" in word for word in extra):
            words += [f"--{name}", value]
    words += [_filled(word, places) for word in extra]
    return Item(path, tuple(words), tuple(chosen.items()), json.dumps([words, _identity(path)]))


def _filled(word: str, places: Mapping[str, str]) -> str:
    for name, value in places.items():
        word = word.replace(f"{{{name}}}", value)
    return word


def _identity(path: str) -> list[int]:
    """Return size and time of change of a file: one that has changed is done again."""
    try:
        found = os.stat(path)
    except OSError:
        return []
    return [found.st_size, found.st_mtime_ns]


# ---- one item, in a worker ----


def run_item(words: Sequence[str], folder: str) -> dict[str, Any]:
    """Run `pans WORDS --json` in `folder`, in a process of its own, and return exit code, seconds, host, and the answer or the error."""
    began_s = time.monotonic()
    command = [sys.executable, "-m", "pans", *words, "--json"]
    row: dict[str, Any] = {"exit": None, "host": socket.gethostname(), "answer": None, "error": None}
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL, preexec_fn=_end_with_parent()
        )
    except OSError as error:
        return row | {"seconds": 0.0, "error": f"cannot be started in {folder}: {error.strerror or error}"}
    answer = _answer(done.stdout)
    fault = answer.get("error") if isinstance(answer, dict) else None
    if isinstance(fault, dict):
        row["error"], answer = str(fault.get("message")), None
    elif answer is None:
        row["error"] = done.stderr[-STDERR_CHARACTERS:].strip() or "no answer"
    return row | {"exit": done.returncode, "seconds": round(time.monotonic() - began_s, 3), "answer": answer}


def _answer(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _end_with_parent() -> Any:
    """Let the command end when its worker is killed: another worker does the item again, and two must not write one file."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl
    return lambda: prctl(_DIES_WITH_PARENT, signal.SIGKILL)


# ---- the journal ----


class Journal:
    """The results so far, one JSON object per line, of an item each."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, dict[str, Any]] = {}

    def read(self) -> None:
        """Take what is there; a last line that was cut goes. UsageError for a file that is no journal."""
        whole = 0
        with open(self.path, "rb") as file:
            for line in file:
                row = _answer(line.decode("utf-8", "replace")) if line.endswith(b"\n") else None
                if not isinstance(row, dict) or row.get("format") != FORMAT or not isinstance(row.get("key"), str):
                    break
                self.rows[row["key"]] = row
                whole += len(line)
            rest = file.read(1)
        size = self.path.stat().st_size
        if rest or (size and not whole):
            raise UsageError(f"{self.path}: is not the journal of a batch", remedy="choose another name with --out")
        os.truncate(self.path, whole)

    def add(self, item: Item, row: Mapping[str, Any]) -> dict[str, Any]:
        """Write one result and return its row."""
        full = {"format": FORMAT, "key": item.key, "item": item.path, **dict(item.varied), **row}
        line = (json.dumps(full) + "\n").encode()
        try:
            with open(self.path, "ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise UsageError(
                f"{self.path}: cannot be written: {error.strerror or error}",
                remedy="make room, then go on with --resume",
            ) from error
        self.rows[item.key] = full
        return full


def flat_rows(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows for a table: the answer's keys beside the others, one level of objects with a dot in between."""
    flat = []
    for row in rows:
        found = {key: value for key, value in row.items() if key not in ("format", "key", "answer")}
        for key, value in (row.get("answer") or {}).items():
            if isinstance(value, dict):
                found |= {f"{key}.{inner}": one for inner, one in value.items()}
            else:
                found[key if key not in found else f"answer.{key}"] = value
        flat.append(found)
    return flat
