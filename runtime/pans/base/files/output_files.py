"""Creating files so that none is lost: the check of all outputs before a command begins, exclusive creation, whole files or none.

Folders of runs in `pans-runs` are named by date and time, with a link to the latest, and locked while a run writes there.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from io import FileIO
from itertools import count
from pathlib import Path

from pans.base.errors import UsageError, refusing

RUNS = Path("pans-runs")
LATEST = "latest"
NAME_CHARACTERS = 60
FORCE_REMEDY = "choose another name, or replace it with --force"
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_NO_HARD_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK, errno.EINVAL}


def user_cache() -> Path:
    """Return the folder of what pans keeps for this user, by XDG_CACHE_HOME or the system's habit; it need not exist.

    RuntimeError for a user without a home.
    """
    home = os.environ.get("XDG_CACHE_HOME") or (os.environ.get("LOCALAPPDATA") if os.name == "nt" else None)
    habit = "Library/Caches" if sys.platform == "darwin" else ".cache"
    return (Path(home) if home else Path.home() / habit) / "pans"


def own_folder(folder: Path) -> Path:
    """Return `folder`, made if need be, the links above it resolved: what lies there may be run.

    PermissionError where others could put something: another user's folder, or one that others can write to; also below a folder that
    neither this user nor root owns, or that others can write to without the sticky bit. A group of this user's own name is nobody else.
    """
    parent = folder.parent
    parent.mkdir(parents=True, exist_ok=True)
    folder = parent.resolve() / folder.name
    folder.mkdir(mode=0o700, exist_ok=True)
    if os.name == "posix":
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & _OTHERS_WRITE:
            raise PermissionError(f"{folder} is another user's, or others can write to it")
        for above in folder.parents:
            found = above.stat()
            others = found.st_mode & _OTHERS_WRITE and not found.st_mode & stat.S_ISVTX and not _only_own_group(found)
            if others or found.st_uid not in (0, os.geteuid()):
                raise PermissionError(
                    f"{folder} could be replaced by others: {above} is another user's, or others can write to it"
                )
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written to")
    return folder


def _only_own_group(found: os.stat_result) -> bool:
    """Return whether nobody but the group may write, and that is the group of this user's own name, as umask 002 goes with."""
    import grp
    import pwd

    try:
        own = grp.getgrgid(found.st_gid)
        return not found.st_mode & stat.S_IWOTH and own.gr_name == pwd.getpwuid(os.geteuid()).pw_name and not own.gr_mem
    except KeyError:  # ids without a name
        return False


def check_outputs(
    outputs: Iterable[str | Path],
    *,
    inputs: Iterable[str | Path | None] = (),
    force: bool = False,
    ours: Callable[[Path], bool] = lambda path: False,
    makes_folders: bool = False,
) -> None:
    """Check what a command is going to write; UsageError before anything is touched, and nothing stays behind.

    No output is an input (`inputs`; None and what does not exist are skipped) or another output, through links too.
    What exists is a regular file, and replaced only with `force` or where `ours` recognises it. Folders exist, or can be
    made where the command makes them (`makes_folders`), and can be written to.

    >>> check_outputs(["nowhere/notes.txt"])
    Traceback (most recent call last):
        ...
    pans.base.errors.UsageError: nowhere is not a folder
      remedy: make it first
    """
    read = {file_identity(path): path for path in inputs if path is not None and os.path.exists(path)}
    written: dict[tuple[object, ...], Path] = {}
    folders: dict[Path, None] = {}
    for path in map(Path, outputs):
        identity = file_identity(path)
        if identity in read:
            remedy = "choose another name for the output"
            raise UsageError(f"{path}: is the input {read[identity]} itself", remedy=remedy)
        if identity in written:
            raise UsageError(f"{path}: is also the output {written[identity]}", remedy="give each output its own name")
        written[identity] = path
        _check_replaceable(path, force, ours)
        folders[_folder_of(path, makes_folders)] = None
    for folder in folders:
        _check_writable(folder)


def file_identity(path: str | Path) -> tuple[object, ...]:
    """Return what two paths of one file have in common: device and inode, for a new file those of its folder and its name."""
    try:
        real = Path(path).resolve()
        try:
            found = real.stat()
            return found.st_dev, found.st_ino
        except (FileNotFoundError, NotADirectoryError):
            folder = next(one for one in real.parents if one.exists())
            found = folder.stat()
            return found.st_dev, found.st_ino, *real.relative_to(folder).parts
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: links that point at each other
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"{path}: not a usable path: {reason}", remedy="choose another name") from error


def refuse_existing(path: Path) -> UsageError:
    """Return the error for a file that would be replaced."""
    return UsageError(f"{path}: exists already", remedy=FORCE_REMEDY)


def _check_replaceable(path: Path, force: bool, ours: Callable[[Path], bool]) -> None:
    if not os.path.lexists(path):
        return
    if path.is_dir():
        raise UsageError(f"{path}: is a folder, expected the name of a file", remedy="choose another name")
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        raise UsageError(f"{path}: is not a regular file", remedy="choose another name")
    if not force and not (path.exists() and ours(path)):
        raise refuse_existing(path)


def _folder_of(path: Path, makes_folders: bool) -> Path:
    """Return the folder to be written to, or the existing one in which it will be made."""
    folder = path.parent
    while makes_folders and not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder", remedy="choose another one" if makes_folders else "make it first")
    return folder


def _check_writable(folder: Path) -> None:
    """Make a file and remove it: permissions alone do not tell of read-only or full file systems."""
    probe = folder / f".pans-{secrets.token_hex(8)}.probe"
    with refusing(f"{folder}: cannot be written to", "choose a folder that can be written to"):
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        os.unlink(probe)


def write_file(path: str | Path, data: bytes | memoryview, *, force: bool = False) -> None:
    """Write `data` to `path` whole or not at all, synced; UsageError if that fails, or if `path` exists, unless `force`.

    >>> write_file("notes.txt", b"first")
    >>> write_file("notes.txt", b"second")
    Traceback (most recent call last):
        ...
    pans.base.errors.UsageError: notes.txt: exists already
      remedy: choose another name, or replace it with --force
    """
    if not force and os.path.lexists(path):
        raise refuse_existing(Path(path))
    with whole_file(path, force=force) as beside, open(beside, "xb") as file:
        file.write(data)


def replace_file(path: str | Path, data: bytes | memoryview) -> None:
    """Write a file that this project keeps and rewrites: as `write_file`, in place of the one before."""
    write_file(path, data, force=True)


@contextmanager
def whole_file(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a name beside `path` to write to; what is there at the end is synced and becomes `path`, after an error nothing does."""
    target = Path(path)
    beside = beside_name(target)
    with refusing(f"{target}: cannot be written", "make room on that disk, or choose another place"):
        try:
            yield beside
            _sync(beside, os.O_RDWR)  # Windows syncs only what is open for writing
            if force:
                os.replace(beside, target)
            else:
                place_new(beside, target)
        except FileExistsError as error:
            raise refuse_existing(target) from error
        finally:
            beside.unlink(missing_ok=True)
    sync_folder(target.parent)


def beside_name(target: Path) -> Path:
    """Return a hidden name beside `target` that nobody else has."""
    return target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")


def place_new(beside: str | Path, target: str | Path) -> None:
    """Rename `beside` to `target`, which must not exist: FileExistsError otherwise."""
    if os.name == "nt":
        os.rename(beside, target)  # refuses what exists
        return
    try:
        os.link(beside, target)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))  # taken: what is renamed over is our own
        os.replace(beside, target)
        return
    with suppress(OSError):
        os.unlink(beside)  # both names are whole


def make_folder(folder: Path) -> None:
    """Make `folder` and those above it where they are missing, so that they survive a power cut; UsageError if that fails."""
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    with refusing(f"{folder}: the folder cannot be made", "choose a place that can be written to"):
        folder.mkdir(parents=True, exist_ok=True)
    for one in reversed(made):
        sync_folder(one.parent)


def sync_folder(folder: Path) -> None:
    """Make a new or renamed entry of `folder` survive a power cut, where the system can sync folders."""
    if os.name == "posix":
        with suppress(OSError):  # some network file systems refuse; the file itself is on the disk
            _sync(folder, os.O_RDONLY)


def _sync(path: Path, mode: int) -> None:
    handle = os.open(path, mode)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def new_run_folder(name: str, root: Path = RUNS) -> Path:
    """Make a folder of this minute's local time and `name` in `root`, as `pans-runs/2026-11-22T1412-fashion10`; `latest` points to it.

    A second one of the same minute ends in `-2`; what cannot stand in a file's name becomes `-`. UsageError where none can be made.
    """
    make_folder(root)
    _check_writable(root)
    plain = re.sub(r"[^A-Za-z0-9_.]+", "-", name)[:NAME_CHARACTERS].strip("-.") or "run"
    first = f"{datetime.now().strftime('%Y-%m-%dT%H%M')}-{plain}"
    for number in count(1):
        folder = root / (first if number == 1 else f"{first}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            break
    sync_folder(root)
    link, beside = root / LATEST, root / f".{LATEST}.{secrets.token_hex(4)}"
    if link.is_symlink() or not os.path.lexists(link):  # a file or folder of that name stays
        with suppress(OSError):  # a system without links has none
            beside.symlink_to(folder.name, target_is_directory=True)
            os.replace(beside, link)
    return folder


@contextmanager
def locked(path: Path, what: str = "", remedy: str = "choose another folder with --out") -> Iterator[None]:
    """Hold the lock file `path` until the block ends; UsageError, which names the holder's process, if another run has it.

    The lock goes when its process dies, and the file goes with the lock. Systems without flock hold nothing: there exclusive creation
    alone keeps two runs apart. `what` the lock is for is by default its folder.
    """
    try:
        import fcntl
    except ModuleNotFoundError:
        yield
        return
    with ExitStack() as held:
        try:
            while True:
                file = held.enter_context(_open_lock(path, os.O_CREAT | os.O_RDWR))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with suppress(FileNotFoundError):  # the holder before removed it between our two calls
                    if os.path.samestat(os.fstat(file.fileno()), os.lstat(path)):
                        break
            held.callback(path.unlink, missing_ok=True)
            file.truncate(0)
            file.write(f"{os.getpid()}\n".encode())
        except BlockingIOError as error:
            holder = (file.read(20) or b"").decode("ascii", "replace").strip() or "unknown"
            found = f"{what or path.parent}: another run writes here (process {holder})"
            raise UsageError(found, remedy=remedy) from error
        except OSError as error:
            raise UsageError(f"{path}: cannot be locked: {error.strerror or error}", remedy=remedy) from error
        yield


def lock_is_held(path: Path) -> bool:
    """Return whether a run holds the lock file `path`; what is there and is no lock file counts as one that is held."""
    if not os.path.lexists(path):
        return False
    try:
        import fcntl
    except ModuleNotFoundError:
        return True  # the file goes with its run there
    try:
        with _open_lock(path, os.O_RDONLY) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
    except OSError:
        return True


def _open_lock(path: Path, flags: int) -> FileIO:
    """Open a lock file; OSError for a link or another name of a file, which would be truncated, and for what is no file."""
    if path.is_symlink():  # O_NOFOLLOW refuses one that is put there meanwhile, in words of its own
        raise OSError(errno.ELOOP, "is a link, allowed: a file of its own")
    handle = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    file = FileIO(handle, "rb" if flags == os.O_RDONLY else "r+b")
    found = os.fstat(handle)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
        file.close()
        raise OSError(errno.EINVAL, "is no lock file of pans, or has another name: remove it")
    return file
