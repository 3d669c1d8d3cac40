"""Checkpoints: the state of a training on disk, so that an interrupted one continues to the same result.

The file is torch's own and is read with `weights_only`: tensors and plain values, nothing that could run code.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import replace_file

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True, slots=True)
class Stopwatch:
    """Seconds of a training: those of the processes before this one, and its own since `began`."""

    before: float
    began: float

    def seconds(self) -> float:
        """Return the sum so far."""
        return self.before + time.perf_counter() - self.began


_WATCH: ContextVar[Stopwatch | None] = ContextVar("stopwatch of the training that is under way", default=None)


@contextmanager
def timed(path: Path, *, resume: bool) -> Iterator[Stopwatch]:
    """Yield the time of a training; the checkpoints written meanwhile hold it, and with `resume` it continues from that in `path`."""
    watch = Stopwatch(_seconds_in(path) if resume else 0.0, time.perf_counter())
    token = _WATCH.set(watch)
    try:
        yield watch
    finally:
        _WATCH.reset(token)


def _seconds_in(path: Path) -> float:
    """Return the seconds that a checkpoint tells, 0 where it tells none; what is no checkpoint is refused by who reads it."""
    try:
        seconds = torch.load(path, map_location="cpu", weights_only=True)["seconds"]
    except Exception:  # a damaged or foreign file makes torch raise almost anything
        return 0.0
    return float(seconds) if isinstance(seconds, float) and 0 <= seconds < math.inf else 0.0


def _identity(options: DataclassInstance, data_sha256: str) -> dict[str, Any]:
    plain = {key: str(value) for key, value in asdict(options).items()} | {"data": data_sha256}
    return plain | {"restarts": "1"} if "restarts" in plain else plain


def _defaults(options: DataclassInstance) -> dict[str, str]:
    """What a checkpoint means by options that its version did not have."""
    return {field.name: str(field.default) for field in fields(options) if field.default is not MISSING}


def write_checkpoint(path: Path, options: DataclassInstance, data_sha256: str, state: dict[str, Any]) -> None:
    """Write `state` (nested dicts and lists of tensors and plain values) to `path`, whole or not at all."""
    file, watch = io.BytesIO(), _WATCH.get()
    spent = {} if watch is None else {"seconds": watch.seconds()}
    torch.save({"identity": _identity(options, data_sha256), **spent, **state}, file)
    replace_file(path, file.getbuffer())


def read_checkpoint(path: Path, options: DataclassInstance, data_sha256: str) -> dict[str, Any]:
    """Return the state in `path`; UsageError unless it belongs to the same options (but restarts) and data."""
    if not path.is_file():
        raise UsageError(f"{path} is not there", remedy="leave --resume out to start anew")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        found = _defaults(options) | dict(saved["identity"])
    except Exception as error:  # a damaged or foreign file makes torch raise almost anything
        raise DamagedFileError(
            f"{path}: not a checkpoint: {error}", remedy="leave --resume out to start anew"
        ) from error
    wanted = _identity(options, data_sha256)
    differing = [f"{key} {found.get(key)} (now {value})" for key, value in wanted.items() if found.get(key) != value]
    if differing:
        raise UsageError(
            f"{path} belongs to another training: {', '.join(differing)}",
            remedy="repeat its options, or leave --resume out",
        )
    return dict(saved)
