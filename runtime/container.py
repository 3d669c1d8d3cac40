"""What bundles and recordings have in common on disk: strict JSON, whole-or-nothing files, chained blocks.

Owns the byte framing and its limits; never knows what a part or a block means. Readers take bytes or an open file and
raise DamagedFileError; `replace_file` writes beside and renames, so that no reader ever meets half a file.
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import DamagedFileError, UsageError

MIB = 1 << 20
FILE_MAX_BYTES = 256 * MIB


def canonical_json(value: Any) -> bytes:
    """Encode `value` as JSON with sorted keys, no spaces, ASCII; ValueError for NaN, TypeError for what JSON lacks."""
    _refuse_strange(value, "")
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.encode("ascii")


def _refuse_strange(value: Any, path: str) -> None:
    """Name the first value that JSON cannot hold exactly; json itself would not say where it was."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise TypeError(f"key {key!r} at {path or 'the top'} is a {type(key).__name__}, allowed: str")
            _refuse_strange(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list | tuple):
        for position, item in enumerate(value):
            _refuse_strange(item, f"{path}[{position}]")
    elif isinstance(value, float):
        if value != value or value in (float("inf"), float("-inf")):
            raise ValueError(f"{path or 'the value'} is {value}, allowed: finite numbers")
    elif not (value is None or isinstance(value, str | int)):
        kind = type(value).__name__
        raise TypeError(f"{path or 'the value'} is a {kind}, allowed: str, int, float, bool, None, list, dict")


def parse_json_object(data: bytes, where: str) -> dict[str, Any]:
    """Decode one JSON object strictly (no NaN, no double keys); DamagedFileError otherwise."""
    try:
        value = json.loads(data.decode("utf-8"), object_pairs_hook=_without_doubles, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"{where}: the JSON text is not readable: {error}") from error
    if not isinstance(value, dict):
        raise DamagedFileError(f"{where}: expected a JSON object, found a {type(value).__name__}")
    return value


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("the same key stands twice in one object")
    return result


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a JSON number")


def read_file(path: str | Path, max_bytes: int = FILE_MAX_BYTES) -> bytes:
    """Return the bytes of `path`; UsageError when it is not there, DamagedFileError above `max_bytes`."""
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size > max_bytes:
                raise DamagedFileError(f"{path}: {size} bytes, allowed at most {max_bytes}")
            data = file.read(max_bytes + 1)  # a file that grows meanwhile, or a pipe, has no honest size
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > max_bytes:
        raise DamagedFileError(f"{path}: more than {max_bytes} bytes")
    return data


def replace_file(path: str | Path, data: bytes) -> None:
    """Write `data` to `path` whole or not at all (beside it, synced, renamed over it); UsageError if that fails."""
    target = Path(path)
    beside = target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")
    try:
        try:
            with open(beside, "xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(beside, target)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"{target}: cannot be written: {error.strerror or error}") from error
    sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Make a new or renamed entry of `folder` survive a power cut, where the system can sync folders."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        pass  # some network file systems refuse; the file itself is on the disk
    finally:
        os.close(handle)
