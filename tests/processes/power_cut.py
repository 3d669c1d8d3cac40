"""What a power cut leaves of a folder, at every moment of a command: made of the journal that storage_faults.c wrote.

A file has the content of its last fsync, a folder the names of its last fsync; what came after is lost, or only a part of it. `states`
gives, after every call that changes what may be found, the files of three disks: one that keeps what was synced and no more, one on
which names and lengths reach the disk before the data (a file is cut to what was synced), and one that fills the rest of such a file with
zeros.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

_ENTRY = struct.Struct("<c7xQQIIII")
Files = dict[str, bytes]


class Entry(NamedTuple):
    """One call: W(rite), S(ync of a file), D (sync of a folder), T(runcate), C(reate), L(ink), R(ename), U(nlink), M(ake a folder)."""

    what: str
    inode: int
    size: int
    path: str
    to: str
    content: bytes


@dataclass(slots=True, eq=False)
class _File:
    synced: bytes = b""
    size: int = 0


@dataclass(slots=True)
class _Disk:
    """Names and files as the process sees them, and which of the names are durable."""

    folder: str
    names: dict[str, _File] = field(default_factory=dict)
    durable: dict[str, _File] = field(default_factory=dict)
    folders: set[str] = field(default_factory=set)  # those that are durable
    made: set[str] = field(default_factory=set)  # folders that may not be
    numbers: dict[int, _File] = field(default_factory=dict)

    def take(self, entry: Entry) -> None:
        what, path = entry.what, entry.path
        if what == "C":
            known = self.names.get(path)
            if known is None:
                known = self.names[path] = self.numbers[entry.inode] = _File()
            known.size = entry.size
        elif what in "WT" and entry.inode in self.numbers:
            self.numbers[entry.inode].size = entry.size
        elif what == "S" and entry.inode in self.numbers:
            self.numbers[entry.inode].synced = entry.content
        elif what in "LR" and path in self.names:
            self.names[entry.to] = self.names[path] if what == "L" else self.names.pop(path)
        elif what == "U":
            self.names.pop(path, None)
        elif what == "M":
            self.made.add(path)
        elif what == "D":
            self._sync_names(path)

    def _sync_names(self, folder: str) -> None:
        self.durable = {path: file for path, file in self.durable.items() if str(Path(path).parent) != folder}
        self.durable |= {path: file for path, file in self.names.items() if str(Path(path).parent) == folder}
        self.folders |= {made for made in self.made if str(Path(made).parent) == folder}

    def strict(self) -> Files:
        kept = {path: file.synced for path, file in self.durable.items() if self._is_reachable(path)}
        return {self._name(path): data for path, data in kept.items()}

    def names_first(self) -> Files:
        return {self._name(path): file.synced[: file.size] for path, file in self.names.items()}

    def zeros(self) -> Files:
        return {self._name(path): file.synced[: file.size].ljust(file.size, b"\0") for path, file in self.names.items()}

    def _is_reachable(self, path: str) -> bool:
        above = [str(parent) for parent in Path(path).parents if len(str(parent)) > len(self.folder)]
        return all(parent in self.folders for parent in above)

    def _name(self, path: str) -> str:
        return path[len(self.folder) + 1 :]


def read_journal(path: Path) -> Iterator[Entry]:
    """Yield the calls of a command, in order."""
    data, at = path.read_bytes(), 0
    while at < len(data):
        what, inode, size, *lengths = _ENTRY.unpack_from(data, at)
        at += _ENTRY.size
        pieces = []
        for length in lengths[:3]:
            pieces.append(data[at : at + length])
            at += length
        yield Entry(what.decode(), inode, size, pieces[0].decode(), pieces[1].decode(), pieces[2])


def disk_of(folder: Path) -> _Disk:
    """Return the disk before a command: all of it durable."""
    disk = _Disk(str(folder))
    for path in folder.rglob("*"):
        if path.is_dir():
            disk.folders.add(str(path))
        elif path.is_file():
            data = path.read_bytes()
            file = disk.numbers[path.stat().st_ino] = _File(data, len(data))
            disk.names[str(path)] = disk.durable[str(path)] = file
    return disk


def states(disk: _Disk, journal: Path) -> list[tuple[str, Files]]:
    """Return the different states of the disk after a power cut at any moment, with words that say which; the last is that of the end."""
    found: list[tuple[str, Files]] = []
    for number, entry in enumerate(read_journal(journal), 1):
        disk.take(entry)
        where = f"call {number} ({entry.what} {Path(entry.to or entry.path).name})"
        for kind, files in (("zeros", disk.zeros()), ("names first", disk.names_first()), ("strict", disk.strict())):
            if not any(files == known for _, known in found[-3:]):
                found.append((f"{kind} after {where}", files))
    found.append(("strict at the end", disk.strict()))
    return found
