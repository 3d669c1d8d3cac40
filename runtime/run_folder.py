"""Folders of runs: named by date and time, with a link to the latest, and locked while a run writes there.

Owns `pans-runs/` and the lock files; which files a run leaves there is the command's.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from .errors import UsageError
from .outputs import make_folder, sync_folder

RUNS = Path("pans-runs")
LATEST = "latest"
NAME_CHARACTERS = 60


def new_run_folder(name: str, root: Path = RUNS) -> Path:
    """Make a folder of this minute's local time and `name` in `root`, as `pans-runs/2026-11-22T1412-fashion10`; `latest` points to it.

    A second one of the same minute ends in `-2`. Whatever cannot stand in a file's name becomes `-`.
    """
    make_folder(root)
    plain = re.sub(r"[^A-Za-z0-9_.]+", "-", name)[:NAME_CHARACTERS].strip("-.") or "run"
    first = root / f"{datetime.now().strftime('%Y-%m-%dT%H%M')}-{plain}"
    folder, number = first, 1
    while True:
        try:
            folder.mkdir()
            sync_folder(root)
            break
        except FileExistsError:
            number += 1
            folder = first.with_name(f"{first.name}-{number}")
        except OSError as error:
            raise UsageError(
                f"{folder}: the folder cannot be made: {error.strerror or error}", remedy="choose a place with --out"
            ) from error
    _point(root / LATEST, folder.name)
    return folder


def _point(link: Path, name: str) -> None:
    """Let `link` point to `name`; a file or folder of that name stays, and a system without links has none."""
    if os.path.lexists(link) and not link.is_symlink():
        return
    beside = link.with_name(f".{LATEST}.{secrets.token_hex(4)}")
    with suppress(OSError):
        beside.symlink_to(name, target_is_directory=True)
        os.replace(beside, link)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock file `path` until the block ends; UsageError, which names the holder's process, if another run has it.

    The kernel gives the lock back when a process dies; the file goes with the lock. On systems without flock nothing is held: there
    exclusive creation alone keeps two runs apart.
    """
    try:
        import fcntl
    except ModuleNotFoundError:
        yield
        return
    handle = -1
    try:
        while handle < 0:
            handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise _busy(path, handle) from error
            if not _is_still(path, handle):  # the holder before removed it between our two calls
                os.close(handle)
                handle = -1
        _sign(path, handle)
    except OSError as error:
        _close(handle)
        raise UsageError(
            f"{path}: cannot be locked: {error.strerror or error}", remedy="choose another folder with --out"
        ) from error
    except UsageError:
        _close(handle)
        raise
    try:
        yield
    finally:
        with suppress(OSError):
            os.unlink(path)
        os.close(handle)


def _sign(path: Path, handle: int) -> None:
    """Write whose lock it is; where that fails the file goes."""
    try:
        os.ftruncate(handle, 0)
        os.write(handle, f"{os.getpid()}\n".encode())
    except OSError:
        with suppress(OSError):
            os.unlink(path)
        raise


def _close(handle: int) -> None:
    if handle >= 0:
        os.close(handle)


def _is_still(path: Path, handle: int) -> bool:
    mine = os.fstat(handle)
    try:
        there = os.stat(path)
    except FileNotFoundError:
        return False
    return (mine.st_dev, mine.st_ino) == (there.st_dev, there.st_ino)


def _busy(path: Path, handle: int) -> UsageError:
    holder = os.read(handle, 20).decode("ascii", "replace").strip() or "unknown"
    return UsageError(
        f"{path.parent}: another run writes here (process {holder})", remedy="choose another folder with --out"
    )
