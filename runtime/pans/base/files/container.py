"""What bundles and recordings have in common on disk: strict JSON, reading within limits, chained blocks.

Readers take bytes or an open file and raise DamagedFileError; files are created by outputs.py. What a part or a block means is for the
caller. Progress over a long file is reported within `watching_blocks`.
"""

from __future__ import annotations

import json
import os
import re
import stat
import struct
import zlib
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from pans.base.errors import DamagedFileError, UsageError, refusing

MIB = 1 << 20
FILE_MAX_BYTES = 64 * MIB  # of a bundle: its arrays, its sessions and the program stay below 400 MiB together
JSON_DEPTH_MAX = 64  # our own headers need about six
JSON_VALUES_MAX = 1 << 18  # values take up to 250 bytes each once they are read

BlockWatcher = Callable[[str, int, int, int], None]
_watchers: list[BlockWatcher] = []


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
    """Decode one JSON object strictly; DamagedFileError otherwise.

    Strictly: no NaN, no number beyond float64 or 64 bits, no double keys, at most JSON_DEPTH_MAX levels and JSON_VALUES_MAX values.
    """
    try:
        _demand_few(data)
        value = json.loads(
            data.decode("utf-8"),
            object_pairs_hook=_without_doubles,
            parse_constant=_refuse_constant,
            parse_float=_finite,
            parse_int=_within_64_bits,
        )
        if isinstance(value, dict):
            _demand_flat(value)
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"{where}: the JSON text is not readable: {error}") from error
    if not isinstance(value, dict):
        raise DamagedFileError(f"{where}: expected a JSON object, found a {type(value).__name__}")
    return value


def _demand_few(data: bytes) -> None:
    """Refuse, before anything is made of it, a text that would become far larger in memory; commas within texts count too."""
    values = sum(data.count(mark) for mark in (b",", b"[", b"{"))
    if values > JSON_VALUES_MAX:
        raise ValueError(f"{values} values, allowed at most {JSON_VALUES_MAX}")


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("the same key stands twice in one object")
    return result


def _finite(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise ValueError(f"{text[:40]} is beyond the range of float64")
    return value


def _within_64_bits(text: str) -> int:
    value = int(text) if len(text) <= 20 else 1 << 64
    if not -(1 << 63) <= value < 1 << 64:
        raise ValueError(f"{text[:40]} is a whole number beyond 64 bits")
    return value


def _demand_flat(value: Any) -> None:
    """Refuse what is nested deeper than anything that we write: later readers go through it by recursion."""
    level, depth = [value], 0
    while level := [
        item
        for one in level
        for item in (one.values() if isinstance(one, dict) else one)
        if isinstance(item, dict | list)
    ]:
        depth += 1
        if depth >= JSON_DEPTH_MAX:
            raise ValueError(f"nested more than {JSON_DEPTH_MAX} deep")


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a JSON number")


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file for reading; UsageError for anything else: a folder, a FIFO or a device would hang or never end."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else error
        raise UsageError(f"{path}: cannot be read: {reason}", remedy="check the path and its permissions") from error
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        kind = next((words for test, words in _NO_FILES.items() if test(mode)), "no file")
        raise UsageError(f"{path}: cannot be read: it is {kind}, allowed: a regular file", remedy="name a file")
    return os.fdopen(handle, "rb")


_NO_FILES = {
    stat.S_ISDIR: "a folder",
    stat.S_ISFIFO: "a pipe",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
    stat.S_ISSOCK: "a socket",
}


def read_file(path: str | Path, max_bytes: int = FILE_MAX_BYTES) -> bytes:
    """Return the bytes of `path`; UsageError when it is not there, DamagedFileError above `max_bytes`."""
    with refusing(f"{path}: cannot be read", "check the disk"), open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            what, taker = other_kind(file.read(KIND_BYTES))
            found = f", it is {what}" if what else ""
            raise DamagedFileError(f"{path}: {size} bytes{found}, allowed at most {max_bytes}", remedy=taker)
        data = file.read(max_bytes + 1)  # the file may grow meanwhile
    if len(data) > max_bytes:
        raise DamagedFileError(f"{path}: more than {max_bytes} bytes")
    return data


# ---- a file of another kind ----

_KINDS = {  # by its first bytes: what a file is, and what takes it
    "bundle": (rb"PANSBNDL", "a bundle", "`pans run BUNDLE` and `pans evaluate BUNDLE` take it"),
    "recording": (rb"PANSRECD", "a recording", "`pans replay`, `pans report`, `pans verify` and `pans info` take it"),
    "scene": (
        rb"PK\x03\x04",
        "a .npz archive",
        "labelled images are a scene (--device 'sim:PROFILE?scene=FILE') or a task of `pans train`",
    ),
    "array": (rb"\x93NUMPY", "a .npy array", "`pans bundle` takes patterns and tables"),
    "picture": (
        rb"\x89PNG|\xff\xd8\xff|II\*\0|MM\0\*",
        "a picture",
        "put pictures into class folders for `pans train FOLDER`",
    ),
    "calibration": (rb'\s*\{[^\0]*"format":\s*"pans-calibration"', "a calibration", "give it with --calibration"),
    "registration": (rb'\s*\{[^\0]*"format":\s*"pans-registration"', "a registration", "give it with --registration"),
    "profile": (rb"[^\0]*^\[(?:projector|detector)\]", "a hardware profile", "give it with --profile"),
    "TOML": (
        rb"(?:[ \t]*(?:#[^\n\0]*)?\r?\n)*[ \t]*(?:\[[\w.\" -]+\]|[\w.\"-]+\s*=\s*\S)",
        "TOML text",
        "a hardware profile goes to --profile, options of a run to --config, a flow to --flow",
    ),
}
KIND_BYTES = 1 << 16  # the sections of a profile stand within its first bytes


def other_kind(data: bytes, *allowed: str) -> tuple[str, str]:
    """Return what a file that should be one of the `allowed` kinds is instead, and what takes it; ("", "") where it is not plain.

    >>> other_kind(b"PANSRECD", "bundle")[0]
    'a recording'
    """
    start = data[:KIND_BYTES]
    for kind, (pattern, words, taker) in _KINDS.items():
        if re.match(pattern, start, re.MULTILINE):
            return ("", "") if kind in allowed else (words, taker)
    return "", ""


# ---- chained blocks: an append-only file in which every byte is covered, readable up to where it was cut ----

FILE_PROLOGUE = struct.Struct("<8sII")  # magic, version, CRC-32 of both
_BLOCK_HEADER = struct.Struct("<IIB3xI")  # payload length, block index, kind, CRC-32 of these 12 bytes
_CRC = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class Block:
    """One whole block; `end` is the file offset behind it, `chain` the checksum that seeds the next block."""

    index: int
    kind: int
    payload: bytes
    end: int
    chain: int

    @property
    def begin(self) -> int:
        """The file offset of the payload."""
        return self.end - _CRC.size - len(self.payload)


def file_prologue(magic: bytes, version: int) -> tuple[bytes, int]:
    """Return the first 16 bytes of a block file and the checksum that seeds its first block."""
    start = FILE_PROLOGUE.pack(magic, version, 0)[:-4]
    chain = zlib.crc32(start)
    return start + _CRC.pack(chain), chain


def check_prologue(data: bytes, magic: bytes, version: int, where: str) -> int:
    """Return the checksum that seeds the first block; DamagedFileError for a foreign, cut, altered or newer file."""
    if data[: len(magic)] != magic[: len(data)]:
        what, taker = other_kind(data)
        kind = f"it is {what}" if what else f"it starts with the bytes {data[:8].hex(' ')}, expected {magic.decode()}"
        raise DamagedFileError(f"{where}: not a recording: {kind}", remedy=taker)
    if len(data) < FILE_PROLOGUE.size:
        raise DamagedFileError(f"{where}: cut after {len(data)} bytes, nothing of it can be read")
    _, found, crc = FILE_PROLOGUE.unpack_from(data)
    if zlib.crc32(data[: FILE_PROLOGUE.size - 4]) != crc:
        raise DamagedFileError(f"{where}: altered within its first {FILE_PROLOGUE.size} bytes")
    if found != version:
        remedy = "use the pans-runtime that wrote it"
        raise DamagedFileError(f"{where}: format version {found}, allowed: {version}", remedy=remedy)
    return int(crc)


def block_ends(kind: int, index: int, chain: int, payload: bytes | memoryview) -> tuple[bytes, bytes, int]:
    """Return what stands before and behind a block's payload, and the next chain value; nothing of the payload is copied."""
    start = _BLOCK_HEADER.pack(len(payload), index, kind, 0)[:-4]
    header_crc = zlib.crc32(start, chain)
    payload_crc = zlib.crc32(payload, header_crc)
    return start + _CRC.pack(header_crc), _CRC.pack(payload_crc), payload_crc


def read_block(
    file: BinaryIO, index: int, chain: int, limits: Mapping[int, int], where: str, wanted: Container[int] | None = None
) -> Block | None:
    """Return the block at the file's position, or None where the file was cut (or ends); DamagedFileError if altered.

    `limits` maps each allowed kind to its largest payload in bytes; nothing is read beyond it. The payload of a kind that is not
    `wanted` (None: all are) is passed over: it is empty, and has not been checked.
    """
    begin, head = file.tell(), file.read(_BLOCK_HEADER.size)
    if len(head) < _BLOCK_HEADER.size:
        return None
    length, found_index, kind, header_crc = _BLOCK_HEADER.unpack(head)
    place = f"{where}: block {index} at byte {begin}"
    if zlib.crc32(head[:-4], chain) != header_crc:
        if not any(head) and _only_zeros_follow(file):
            return None  # a power cut after the file had grown, before its data reached the disk
        raise DamagedFileError(f"{place}: altered or out of order (its header does not fit its checksum)")
    if found_index != index or any(head[9:12]) or kind not in limits:
        raise DamagedFileError(f"{place}: index {found_index}, kind {kind}, allowed: index {index}, a known kind")
    if length > limits[kind]:
        raise DamagedFileError(f"{place}: {length} bytes of kind {kind}, allowed at most {limits[kind]}")
    passed_over = wanted is not None and kind not in wanted
    payload = b"" if passed_over else file.read(length)
    if passed_over:
        file.seek(length, os.SEEK_CUR)
    tail = file.read(_CRC.size)
    if len(tail) < _CRC.size:
        return None
    payload_crc: int = _CRC.unpack(tail)[0]
    if not passed_over and payload_crc != zlib.crc32(payload, header_crc):
        raise DamagedFileError(f"{place}: altered (its payload of {length} bytes does not fit its checksum)")
    end = begin + len(head) + length + len(tail)
    for watcher in _watchers:
        watcher(where, id(file), end, os.fstat(file.fileno()).st_size)
    return Block(index, kind, payload, end, payload_crc)


def last_block(file: BinaryIO, wanted: int, chain: int, limits: Mapping[int, int], where: str) -> Block | None:
    """Return the first block of kind `wanted` from the file's position on, None if the file does not end with it.

    `chain` seeds the block at the file's position. Payloads before the wanted block are passed over, so that no bytes in them are taken
    for a block. DamagedFileError if the wanted block was altered.
    """
    index = 0
    while len(head := file.read(_BLOCK_HEADER.size)) == _BLOCK_HEADER.size:
        length, _, kind, header_crc = _BLOCK_HEADER.unpack(head)
        if zlib.crc32(head[:-4], chain) != header_crc or length > limits.get(kind, 0):
            return None
        if kind == wanted:
            file.seek(-_BLOCK_HEADER.size, os.SEEK_CUR)
            block = read_block(file, index, chain, limits, where)
            return None if file.read(1) else block
        file.seek(length, os.SEEK_CUR)
        index, chain = index + 1, int.from_bytes(file.read(_CRC.size), "little")
    return None


def skim_blocks(file: BinaryIO, wanted: int, limits: Mapping[int, int]) -> Iterator[bytes]:
    """Yield the payloads of the blocks of kind `wanted` after the prologue, as far as they seem to be blocks: nothing is checked."""
    file.seek(FILE_PROLOGUE.size)
    while len(head := file.read(_BLOCK_HEADER.size)) == _BLOCK_HEADER.size:
        length, _, kind, _ = _BLOCK_HEADER.unpack(head)
        if length > limits.get(kind, 0):
            return
        if kind == wanted:
            yield file.read(length)
            length = 0
        file.seek(length + _CRC.size, 1)


@contextmanager
def watching_blocks(watcher: BlockWatcher) -> Iterator[None]:
    """Call `watcher` after every block that is read within the context: (file, number of the pass over it, bytes so far, size in bytes)."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def _only_zeros_follow(file: BinaryIO) -> bool:
    while chunk := file.read(MIB):
        if chunk.count(0) != len(chunk):
            return False
    return True
