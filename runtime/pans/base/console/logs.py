"""Logs of a command through `logging`: a file of text or JSON lines that rotates, and stderr with priorities under systemd.

A line never makes its writer wait: a thread writes the file, behind a queue of bounded length, and what a full disk or queue costs is
counted. What the command line prints and the events of a run go to the logger `pans`; a program that imports pans may add handlers to it.
"""

from __future__ import annotations

import argparse
import json
import logging
import logging.handlers
import os
import queue
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pans.base.errors import UsageError, refusing
from pans.base.numbers.ranges import Range

from .text import one_line

LOGGER = logging.getLogger("pans")
LOGGER.addHandler(logging.NullHandler())
FORMATS = ("text", "json")
MIB = 1 << 20
ROTATE_MB, KEPT = 10.0, 5  # the file and at most five before it: 60 MiB
ROTATE = Range(0.01, 1e6)
QUEUE_LINES = 10_000
KIND_MOST, KIND_EVERY_S = 20, 60.0  # events of one kind in that time; a fault that repeats must not fill the disk
LINE_MAX = 8000
FIRST_LINE_MAX_BYTES = 1 << 16
_OTHER_NAME = "choose another name for --log-file"
_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")


def add_log_options(group: argparse._ActionsContainer) -> None:
    """Add `--log-file`, `--log-format` and `--log-rotate-mb`, of every command."""
    group.add_argument("--log-file", type=Path, metavar="FILE", help="append what happens to this file, line by line")
    group.add_argument("--log-format", choices=FORMATS, help="of the log file (default: text)")
    rotated = f"begin a new log file after N MiB and keep {KEPT} old ones (default {ROTATE_MB:g})"
    group.add_argument("--log-rotate-mb", type=ROTATE.option, metavar="N", help=rotated)


@contextmanager
def logging_of(args: argparse.Namespace) -> Iterator[None]:
    """Log to the file that the options name until the block ends; UsageError for a file that is no log of ours."""
    path: Path | None = args.log_file
    for option in ("log_format", "log_rotate_mb"):
        if path is None and getattr(args, option) is not None:
            what = f"--{option.replace('_', '-')} has no effect without a log file"
            raise UsageError(what, remedy="name one with --log-file")
    handlers: list[_FileHandler | _JournalHandler] = [_JournalHandler()] if _is_journal() else []
    if path is not None:
        lines = _json_line if args.log_format == "json" else _text_line
        handlers.append(_FileHandler(path, _Lines(lines), args.log_rotate_mb))
    if not handlers:
        yield
        return
    waiting: queue.Queue[Any] = queue.Queue(QUEUE_LINES)
    bounded = _BoundedQueue(waiting)
    bounded.addFilter(_KindLimit())
    listener = _Listener(waiting, *handlers)
    level = LOGGER.level
    LOGGER.setLevel(logging.INFO)
    LOGGER.addHandler(bounded)
    listener.start()
    try:
        yield
    finally:
        LOGGER.removeHandler(bounded)
        LOGGER.setLevel(level)
        listener.stop()
        for handler in handlers:
            handler.close()
        if lost := bounded.lost + sum(handler.lost for handler in handlers):
            print(f"pans: {lost} lines are missing from {path or 'the journal'}", file=sys.stderr)


def log_event(kind: str, facts: Mapping[str, Any], level: int = logging.INFO) -> None:
    """Log one event of a run: its kind, and facts whose names carry the units."""
    if LOGGER.isEnabledFor(level):
        LOGGER.log(level, kind, extra={"facts": dict(facts)})


def stderr_line(text: str, level: int = logging.INFO) -> str:
    """Return `text` as stderr shows it: under systemd each line begins with its priority, `<3>` to `<7>` (sd-daemon(3))."""
    if not _is_journal():
        return text
    priority = 3 if level >= logging.ERROR else 4 if level >= logging.WARNING else 6
    return "\n".join(f"<{priority}>{line}" for line in text.split("\n"))


def _is_journal() -> bool:
    """Whether stderr leads to the journal: JOURNAL_STREAM names its device and inode (systemd.exec(5))."""
    wanted = os.environ.get("JOURNAL_STREAM", "")
    if not wanted:
        return False
    try:
        found = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return wanted == f"{found.st_dev}:{found.st_ino}"


def _time_of(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")


def _message(record: logging.LogRecord) -> str:
    facts = getattr(record, "facts", {})
    return record.getMessage() + "".join(f" {key}={plain(value)}" for key, value in facts.items())


def _text_line(record: logging.LogRecord) -> str:
    return one_line(f"{_time_of(record)} {record.levelname} {_message(record)}", LINE_MAX)


def _journal_line(record: logging.LogRecord) -> str:  # the journal adds the time itself
    return stderr_line(one_line(f"pans: {_message(record)}", LINE_MAX), record.levelno)


def _json_line(record: logging.LogRecord) -> str:
    line = {"time": _time_of(record), "level": record.levelname, "message": record.getMessage()[:LINE_MAX]}
    facts = getattr(record, "facts", {})
    return json.dumps({**line, "facts": facts} if facts else line, default=plain)


class _Lines(logging.Formatter):
    def __init__(self, line_of: Callable[[logging.LogRecord], str]) -> None:
        super().__init__()
        self._line_of = line_of

    def format(self, record: logging.LogRecord) -> str:
        return self._line_of(record)


def plain(value: Any) -> Any:
    """Return numpy's scalars and arrays as JSON has them, anything else as text: the `default` of json.dumps."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


class _Counting(logging.Handler):
    """Counts the lines that cannot be written."""

    lost = 0

    def handleError(self, record: logging.LogRecord) -> None:
        self.lost += 1


class _BoundedQueue(_Counting, logging.handlers.QueueHandler):
    """Puts lines into the queue and counts those for which there is no room."""

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        return record  # it stays in this process


class _Listener(logging.handlers.QueueListener):
    def enqueue_sentinel(self) -> None:
        self.queue.put(self._sentinel)  # type: ignore[attr-defined]  # waits where the queue is full


class _KindLimit(logging.Filter):
    """Lets KIND_MOST events of a kind pass in KIND_EVERY_S; the next one says how many did not."""

    def __init__(self) -> None:
        super().__init__()
        self._passed: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()
        self._since_s = time.monotonic()

    def filter(self, record: logging.LogRecord) -> bool:
        facts = getattr(record, "facts", None)
        if facts is None:
            return True
        now_s, kind = time.monotonic(), record.msg
        if now_s - self._since_s > KIND_EVERY_S:
            self._since_s = now_s
            self._passed.clear()
        if self._passed[kind] >= KIND_MOST:
            self._left_out[kind] += 1
            return False
        self._passed[kind] += 1
        if left_out := self._left_out.pop(kind, 0):
            facts["not_logged_before"] = left_out
        return True


class _JournalHandler(_Counting, logging.StreamHandler):  # type: ignore[type-arg]
    """The events of a run on a stderr that leads to the journal, with their priorities; what the command says is there already."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self.setFormatter(_Lines(_journal_line))
        self.addFilter(lambda record: hasattr(record, "facts"))


class _FileHandler(_Counting, logging.handlers.RotatingFileHandler):
    """A log of ours, appended to; what cannot be written is counted."""

    def __init__(self, path: Path, lines: logging.Formatter, rotate_mb: float | None) -> None:
        if path.is_dir():  # `/` and `.` have no name beside which old ones could stand
            raise UsageError(f"{path}: is a folder, expected the name of a file", remedy=_OTHER_NAME)
        for old in (path, *(path.with_name(f"{path.name}.{number}") for number in range(1, KEPT + 1))):
            _check_log(old)
        most = round((ROTATE_MB if rotate_mb is None else rotate_mb) * MIB)
        try:
            super().__init__(path, maxBytes=most, backupCount=KEPT, encoding="utf-8", errors="backslashreplace")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"{path}: cannot be written to: {reason}", remedy=_OTHER_NAME) from error
        self.setFormatter(lines)

    def close(self) -> None:
        try:
            super().close()
        except OSError:  # the disk failed with the last lines
            self.lost += 1


def _check_log(path: Path) -> None:
    """Refuse to append to, or to rotate away, what is no log of ours."""
    if not os.path.lexists(path):
        return
    if not path.is_file():
        raise UsageError(f"{path}: is not a regular file", remedy=_OTHER_NAME)
    with refusing(f"{path}: cannot be read", _OTHER_NAME), open(path, "rb") as file:
        line = file.readline(FIRST_LINE_MAX_BYTES)
    if line and not is_log_line(line):
        raise UsageError(f"{path}: exists, and is not a log of pans", remedy=_OTHER_NAME)


def is_log_line(line: bytes) -> bool:
    """Return whether `line` begins a log of ours, in either form."""
    try:
        text = line.decode()
        if text.startswith("{"):
            found = json.loads(text)
            return {"time", "level", "message"} <= found.keys()
        when, level, *_ = text.split(" ")
        datetime.fromisoformat(when)
        return level in _LEVELS
    except (ValueError, RecursionError):
        return False
