"""Folders of runs in `pans-runs`: named by date and time, with a link to the latest, and locked while a run writes there."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from itertools import count
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
    first = f"{datetime.now().strftime('%Y-%m-%dT%H%M')}-{plain}"
    for number in count(1):
        folder = root / (first if number == 1 else f"{first}-{number}")
        try:
            folder.mkdir()
            break
        except FileExistsError:
            continue
        except OSError as error:
            what = f"{folder}: the folder cannot be made: {error.strerror or error}"
            raise UsageError(what, remedy="choose a place with --out") from error
    sync_folder(root)
    link, beside = root / LATEST, root / f".{LATEST}.{secrets.token_hex(4)}"
    if link.is_symlink() or not os.path.lexists(link):  # a file or folder of that name stays
        with suppress(OSError):  # a system without links has none
            beside.symlink_to(folder.name, target_is_directory=True)
            os.replace(beside, link)
    return folder


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
    remedy = "choose another folder with --out"
    with ExitStack() as held:
        try:
            while True:
                file = held.enter_context(open(os.open(path, os.O_CREAT | os.O_RDWR, 0o666), "r+b", buffering=0))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with suppress(FileNotFoundError):  # the holder before removed it between our two calls
                    if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                        break
            held.callback(_removed, path)
            file.truncate(0)
            file.write(f"{os.getpid()}\n".encode())
        except BlockingIOError as error:
            holder = file.read(20).decode("ascii", "replace").strip() or "unknown"
            what = f"{path.parent}: another run writes here (process {holder})"
            raise UsageError(what, remedy=remedy) from error
        except OSError as error:
            raise UsageError(f"{path}: cannot be locked: {error.strerror or error}", remedy=remedy) from error
        yield


def _removed(path: Path) -> None:
    with suppress(OSError):
        os.unlink(path)
