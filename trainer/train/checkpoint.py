"""Checkpoints: the state of a training on disk, so that an interrupted one goes on to the same result.

Owns the file and the check that it belongs to this training; never knows what the state means. A checkpoint is a .npz: one
array per tensor, and a JSON text, `tree`, that says where each belongs. Nothing in it can run code.
"""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pans.runtime.errors import DamagedFileError, UsageError
from pans.trainer.options import Options

_ARRAY, _NUMBERED = "@array", "@numbered"  # marks in the tree: an array's name; a dict whose keys are whole numbers


def _identity(options: Options, data_sha256: str) -> dict[str, Any]:
    plain = {key: str(value) for key, value in asdict(replace(options, restarts=1)).items()}
    return plain | {"data": data_sha256}


def write_checkpoint(path: Path, options: Options, data_sha256: str, state: dict[str, Any]) -> None:
    """Write `state` (nested dicts and lists of tensors and plain values) to `path`, whole or not at all."""
    arrays: dict[str, NDArray[Any]] = {}
    tree = _flatten({"identity": _identity(options, data_sha256), **state}, arrays)
    arrays["tree"] = np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8)
    beside = path.with_name(path.name + ".part")
    with open(beside, "wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    os.replace(beside, path)


def read_checkpoint(path: Path, options: Options, data_sha256: str) -> dict[str, Any]:
    """Return the state in `path`; UsageError unless it belongs to the same options (but restarts) and data."""
    if not path.is_file():
        raise UsageError(f"{path} is not there", remedy="leave --resume out to start anew")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            saved = _unflatten(json.loads(arrays["tree"].tobytes()), arrays)
        found = saved["identity"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
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


def _flatten(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return `value` as what JSON holds; its tensors go to `arrays`."""
    if isinstance(value, torch.Tensor):
        name = f"a{len(arrays)}"
        arrays[name] = value.detach().cpu().numpy()
        return {_ARRAY: name}
    if isinstance(value, dict):
        inside = {str(key): _flatten(item, arrays) for key, item in value.items()}
        return {_NUMBERED: inside} if value and all(isinstance(key, int) for key in value) else inside
    if isinstance(value, list | tuple):
        return [_flatten(item, arrays) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a checkpoint cannot hold {type(value).__name__}")


def _unflatten(tree: Any, arrays: Any) -> Any:
    if isinstance(tree, list):
        return [_unflatten(item, arrays) for item in tree]
    if not isinstance(tree, dict):
        return tree
    if _ARRAY in tree:
        return torch.from_numpy(arrays[tree[_ARRAY]])
    if _NUMBERED in tree:
        return {int(key): _unflatten(item, arrays) for key, item in tree[_NUMBERED].items()}
    return {key: _unflatten(item, arrays) for key, item in tree.items()}
