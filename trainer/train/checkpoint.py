"""Checkpoints: the state of a training on disk, so that an interrupted one goes on to the same result.

Owns the file and the check that it belongs to this training; never knows what the state means. The file is torch's own and is read
with `weights_only`: tensors and plain values, nothing that could run code.
"""

from __future__ import annotations

import io
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.outputs import replace_file

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def _identity(options: DataclassInstance, data_sha256: str) -> dict[str, Any]:
    plain = {key: str(value) for key, value in asdict(options).items()} | {"data": data_sha256}
    return plain | {"restarts": "1"} if "restarts" in plain else plain


def write_checkpoint(path: Path, options: DataclassInstance, data_sha256: str, state: dict[str, Any]) -> None:
    """Write `state` (nested dicts and lists of tensors and plain values) to `path`, whole or not at all."""
    file = io.BytesIO()
    torch.save({"identity": _identity(options, data_sha256), **state}, file)
    replace_file(path, file.getbuffer())


def read_checkpoint(path: Path, options: DataclassInstance, data_sha256: str) -> dict[str, Any]:
    """Return the state in `path`; UsageError unless it belongs to the same options (but restarts) and data."""
    if not path.is_file():
        raise UsageError(f"{path} is not there", remedy="leave --resume out to start anew")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        found = dict(saved["identity"])
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
