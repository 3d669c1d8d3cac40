"""The files of a recording in parts: made ahead of time, closed, indexed, and the oldest deleted at a cap, by a thread of its own.

Owns the folder, so that the loop never waits for a disk over a rotation; what stands in a part is parted_recorder.py's. A full disk: the
oldest closed parts of this run go first; when none is left, writing fails and the run ends with RecordingError, light off, every
part readable.
"""

from __future__ import annotations

import hashlib
import os
import queue
import re
import secrets
import shutil
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pans.runtime.container import canonical_json
from pans.runtime.errors import PansError, RecordingError, UsageError
from pans.runtime.outputs import place_new, refuse_existing, replace_file

from .recorder import Recorder

INDEX_FORMAT = "pans-parts 1"
INDEX_SUFFIX = ".parts.json"
LONGEST_END_S = 60.0  # that the end of a run waits for the thread
RETRY_S = 5.0
RESERVE_PARTS = 2  # of free disk, below which the oldest parts go before their time


@dataclass(frozen=True, slots=True)
class PartLimits:
    """A part is closed once it has `rotate_bytes`; closed and open ones together stay within `keep_bytes` (0: no cap)."""

    rotate_bytes: int
    keep_bytes: int = 0

    def __post_init__(self) -> None:
        if self.rotate_bytes < 1:
            raise UsageError(f"a part must hold at least 1 byte, found {self.rotate_bytes}")
        if self.keep_bytes and self.keep_bytes < 2 * self.rotate_bytes:
            raise UsageError(
                f"{self.keep_bytes} bytes are to be kept in parts of {self.rotate_bytes}",
                remedy="keep at least two parts: the open one is never deleted",
            )


@dataclass(frozen=True, slots=True)
class PartFacts:
    """What the index says of a part that is closed."""

    name: str
    bytes: int
    first_decision: int
    decisions: int
    decisions_sha256: str
    chain_sha256: str


def part_path(first: Path, number: int) -> Path:
    """Return the path of part `number`: `run.pansrec` becomes `run-0001.pansrec`."""
    return first.with_name(f"{first.stem}-{number:04d}{first.suffix}")


def index_path(first: Path) -> Path:
    """Return the path of the index beside the parts."""
    return first.with_name(f"{first.stem}{INDEX_SUFFIX}")


def chained(chain_sha256: str, decisions_sha256: str) -> str:
    """Return the hash over all parts' logs so far: SHA-256 of the one before ("" at first) and this part's, as hex texts."""
    return hashlib.sha256(f"{chain_sha256}{decisions_sha256}".encode("ascii")).hexdigest()


class PartKeeper:
    """Makes and keeps the parts beside `path`; every call returns at once but `make` and `close`."""

    def __init__(
        self, path: Path, header: Mapping[str, Any], limits: PartLimits, bundle: bytes, overwrite: bool
    ) -> None:
        self._path, self._limits = path, limits
        self._run = secrets.token_hex(8)
        self._header, self._bundle = dict(header), bundle
        self._closed: deque[PartFacts] = deque()
        self._struck: deque[Path] = deque()  # no longer in the index, not deleted yet
        self._deleted = {"parts": 0, "bytes": 0, "decisions": 0}
        self._news: deque[dict[str, Any]] = deque(maxlen=100)
        self.ready: queue.SimpleQueue[Recorder] = queue.SimpleQueue()
        self.trouble = ""  # why a full part has no END
        self.index_trouble = ""  # why the index is not the latest
        self._unmade = 0  # the part that could not be made, and is tried again
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._replaced = self._claim(overwrite)
        self._thread = threading.Thread(target=self._keep, name="pans-keeper", daemon=True)

    def start(self) -> Recorder:
        """Make part 1 and start the thread."""
        first = self._make(1)
        self._thread.start()
        return first

    def prepare(self, number: int) -> None:
        """Have part `number` made."""
        self._tasks.put(lambda: self._prepare(number))

    def finish(self, full: Recorder, facts: PartFacts, following: Path) -> None:
        """Have a part closed that is full; `following` is the next one."""
        self._tasks.put(lambda: self._finish(full, facts, following))

    def name(self, made: Recorder, number: int) -> None:
        """Give a part its own name, now that it says where it begins; RecordingError if that cannot be."""
        path = part_path(self._path, number)
        try:
            place_new(made.path, path)
        except OSError as error:
            reason = f"{path} exists" if isinstance(error, FileExistsError) else error.strerror or error
            raise RecordingError(
                f"{path}: the part cannot be begun: {reason}", remedy="the parts before it are readable"
            ) from error
        made.path = path

    def settle(self, facts: PartFacts) -> None:
        """Have a part indexed that is closed, and the oldest ones deleted above the cap."""
        self._tasks.put(lambda: self._settle(facts))

    def news(self) -> list[dict[str, Any]]:
        """Return what there is to say since the last call, as events."""
        news = []
        while self._news:
            news.append(self._news.popleft())
        return news

    def close(self) -> None:
        """Wait for what is to be done; a part that nobody wrote to goes."""
        if self._thread.is_alive():
            self._tasks.put(None)
            self._thread.join(LONGEST_END_S)
        while not self.ready.empty():
            unused = self.ready.get()
            with suppress(OSError, PansError):  # the disk is gone: it keeps its hidden name
                unused.__exit__(None, None, None)
                unused.path.unlink(missing_ok=True)

    def _keep(self) -> None:
        while True:
            try:
                task = self._tasks.get(timeout=RETRY_S if self._unmade else None)
                if task is None:
                    return
                task()
            except queue.Empty:
                self._prepare(self._unmade)
            except PansError as error:
                self._news.append({"kind": "parts_trouble", "message": error.message})
            except OSError as error:
                self._news.append({"kind": "parts_trouble", "message": str(error)})

    def _make(self, number: int) -> Recorder:
        path = part_path(self._path, number)
        header = {**self._header, "part": {"number": number, "run": self._run, "file": path.name}}
        # under a hidden name until it is begun: a part that nobody wrote to is none
        return Recorder(path.with_name(f".{path.name}.next"), header, bundle=self._bundle)

    def _prepare(self, number: int) -> None:
        self._make_room()
        try:
            self.ready.put(self._make(number))
            self._unmade = 0
        except PansError as error:  # the open part goes on; when the disk is full, its next write says so
            if not self._unmade:
                self._news.append({"kind": "parts_trouble", "message": error.message})
            self._unmade = number

    def _finish(self, full: Recorder, facts: PartFacts, following: Path) -> None:
        try:
            full.close({"part_ended": "full", "next": following.name})
        except PansError as error:
            self.trouble = error.message
            raise
        self._settle(replace(facts, bytes=full.size_bytes))

    def _settle(self, facts: PartFacts) -> None:
        self._closed.append(facts)
        while self._limits.keep_bytes and self._kept_bytes() > self._limits.keep_bytes and len(self._closed) > 1:
            self._delete_oldest("the cap")
        self._write_index()
        self._unlink_deleted()

    def _kept_bytes(self) -> int:
        return sum(part.bytes for part in self._closed) + self._limits.rotate_bytes  # and the open one, when it is full

    def _make_room(self) -> None:
        needed = RESERVE_PARTS * self._limits.rotate_bytes
        while len(self._closed) > 1 and shutil.disk_usage(self._path.parent).free < needed:
            self._delete_oldest("the disk is nearly full")
            self._write_index()
            self._unlink_deleted()

    def _delete_oldest(self, why: str) -> None:
        """Strike the oldest part off; its file goes once the index says so, so that no index ever names a file that was deleted."""
        oldest = self._closed.popleft()
        self._struck.append(self._path.with_name(oldest.name))
        for key, value in (("parts", 1), ("bytes", oldest.bytes), ("decisions", oldest.decisions)):
            self._deleted[key] += value
        self._news.append({"kind": "part_deleted", "name": oldest.name, "bytes": oldest.bytes, "why": why})

    def _unlink_deleted(self) -> None:
        while self._struck:
            self._struck.popleft().unlink(missing_ok=True)

    def _write_index(self) -> None:
        index = {
            "format": INDEX_FORMAT,
            "run": self._run,
            "parts": [asdict(part) for part in self._closed],
            "deleted": dict(self._deleted),
        }
        try:
            replace_file(index_path(self._path), canonical_json(index) + b"\n")
            self.index_trouble = ""
        except UsageError as error:
            self.index_trouble = error.message
            raise

    @property
    def replaces(self) -> bool:
        """Whether there are parts of another run, which go when this one has something to write."""
        return bool(self._replaced)

    def clear(self) -> None:
        """Remove the parts of the run before; UsageError if that cannot be."""
        while self._replaced:
            _remove(self._replaced[-1])  # the index first: it sorts behind the parts
            self._replaced.pop()

    def _claim(self, overwrite: bool) -> list[Path]:
        """Return the files that this run will replace; what was only made ahead goes at once."""
        there = files_of_parts(self._path)
        if there and not overwrite:
            raise refuse_existing(there[0])
        ahead = [old for old in there if old.name.startswith(".")]
        for old in ahead:
            _remove(old)
        return [old for old in there if old not in ahead]


def _remove(old: Path) -> None:
    try:
        old.unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"{old}: cannot be replaced: {error.strerror or error}") from error


def files_of_parts(first: Path) -> list[Path]:
    """Return the files of a recording in parts beside `first` that are there: index, parts, and one that was made ahead."""
    stem, suffix = re.escape(first.stem), re.escape(first.suffix)
    wanted = re.compile(rf"{stem}-\d{{4,}}{suffix}|\.{stem}-\d{{4,}}{suffix}\.next|{stem}\.parts\.json")
    try:
        names = sorted(name for name in os.listdir(first.parent) if wanted.fullmatch(name))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UsageError(f"{first.parent}: cannot be read: {error.strerror or error}") from error
    return [first.with_name(name) for name in names]
