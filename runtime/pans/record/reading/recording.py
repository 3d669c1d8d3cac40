"""Reading recordings: every block checked, a cut file read up to its last whole block, memory for one block at a time.

`read_recording` returns a `Recording` or raises DamagedFileError; a cut is no damage, it is what a power cut leaves.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import html_card
from pans.base.errors import DamagedFileError, UsageError, refusing
from pans.base.files import (
    FILE_PROLOGUE,
    KIND_BYTES,
    MIB,
    Block,
    check_prologue,
    open_regular,
    parse_json_object,
    read_block,
)
from pans.base.numbers import Shown, shown
from pans.bundle.sensor import Bundle, read_bundle
from pans.decide import DECISION_DTYPE
from pans.protocol.clock import CLOCK_DTYPE
from pans.protocol.wire import Messages

from .decision_log import LogReader
from .format import (
    FORMAT_VERSION,
    LIMITS,
    MAGIC,
    MESSAGE,
    TIMING_DTYPE,
    TIMING_ROWS_MAX,
    TIMING_RUN_DTYPE,
    Kind,
    expand_timings,
)
from .recorded_facts import checked_event, checked_header, checked_summary

MESSAGES_AT_ONCE = ROWS_AT_ONCE = 1 << 14
GATHERED_BYTES = MIB // 4  # of messages at once: blocks of a slow stream have a few


@dataclass(frozen=True, slots=True)
class Recording:
    """What `read_recording` found; the accessors read the file again, one block at a time."""

    path: Path
    size: int
    header: Mapping[str, Any]
    kinds: Mapping[Kind, int]  # number of whole blocks
    n_decisions: int
    decisions_sha256: str
    complete: bool  # END is there and fits
    end_offset: int  # bytes up to the last whole block
    summary: Mapping[str, Any]  # of END; empty if incomplete
    damage: str  # "" or what is wrong behind end_offset (salvage only)
    bundle_place: tuple[int, int] | None  # begin and bytes of the bundle in the file

    @property
    def simulated(self) -> bool:
        """Whether the clicks are simulated, as the link said at the start or the device by the end."""
        return bool(self.header.get("simulated") or self.summary.get("simulated"))

    @property
    def profile_toml(self) -> str:
        """The hardware profile in the header as TOML; "" where the header has none that is a text."""
        profile = self.header.get("profile")
        text = profile.get("toml") if isinstance(profile, dict) else None
        return text if isinstance(text, str) else ""

    @property
    def virtual_time(self) -> bool:
        """Whether the run was in virtual time, in which nothing on the host takes any; of earlier recordings END alone tells."""
        device = self.summary.get("device")
        of_summary = isinstance(device, dict) and device.get("virtual_time")
        return bool(self.header.get("virtual_time") or of_summary)

    def __repr__(self) -> str:
        told = ", SIMULATED" * self.simulated + ", cut off" * (not self.complete)
        return f"<Recording {self.path.name}: {self.n_decisions} decisions{told}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: what was run, and how it ended."""
        rows = {
            "clicks are": "SIMULATED" if self.simulated else "",
            "recorded": str(self.header.get("created_utc", ""))[:19],
            "command": self.header.get("command"),
            "device": self.header.get("device_url"),
            "decisions": self.n_decisions,
            "complete": "yes" if self.complete else "no: cut off",
            "verdict": self.summary.get("verdict"),
            **{one.key: one.value(self.summary) for one in shown(Shown.CARD) if one.key != "decisions"},
            "bytes": self.size,
            "damage": self.damage,
        }
        return html_card(f"Recording {self.path.name}", rows)

    def iter_blocks(self, *wanted: Kind) -> Iterator[Block]:
        """Yield the whole blocks of these kinds (all without any), checked again; memory holds one block.

        Payloads of other kinds are passed over.
        """
        with open_regular(self.path) as file:
            for block in _blocks(file, _start(file, str(self.path)), str(self.path), wanted or None):
                if not wanted or block.kind in wanted:
                    yield block
                if block.end >= self.end_offset:
                    return

    def read(self, *wanted: Kind) -> Iterator[tuple[Kind, Any]]:
        """Yield the kind and the content of each whole block of these kinds, in order; memory holds one block.

        MESSAGES, COMMANDS and ANSWERS are (host_ns, bytes) pairs, EVENTS objects; DECISIONS, TIMINGS and CLOCK arrays of rows.
        """
        log = LogReader()
        for block in self.iter_blocks(*wanted):
            kind = Kind(block.kind)
            if kind == Kind.DECISIONS:
                yield kind, log.rows(block.payload, f"{self.path}: block {block.index}")
            elif kind == Kind.TIMINGS:
                yield kind, expand_timings(_checked_runs(block, self.path))
            elif kind == Kind.CLOCK:
                yield kind, _rows(block, CLOCK_DTYPE, self.path)
            elif kind == Kind.EVENTS:
                yield kind, _events(block, self.path)
            else:
                yield kind, _pairs(block, self.path)

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield (arrival host_ns, decoded bytes) of the device's messages, in order."""
        return (pair for _, pairs in self.read(Kind.MESSAGES) for pair in pairs)

    def commands(self) -> Iterator[tuple[int, bytes]]:
        """Yield (sent host_ns, bytes) of the commands, in order."""
        return (pair for _, pairs in self.read(Kind.COMMANDS) for pair in pairs)

    def answers(self) -> Iterator[tuple[int, bytes]]:
        """Yield (arrival host_ns, decoded bytes) of WELCOME, ACK and PONG, in order."""
        return (pair for _, pairs in self.read(Kind.ANSWERS) for pair in pairs)

    def decisions(self) -> NDArray[np.void]:
        """Return all decisions, DECISION_DTYPE (n,)."""
        return np.concatenate([np.zeros(0, DECISION_DTYPE), *self.iter_decisions()])

    def iter_decisions(self) -> Iterator[NDArray[np.void]]:
        """Yield the decisions block by block, DECISION_DTYPE (n,)."""
        return (rows for _, rows in self.read(Kind.DECISIONS))

    def timings(self) -> NDArray[np.void]:
        """Return the host times of all decisions, TIMING_DTYPE (n,)."""
        return np.concatenate([np.zeros(0, TIMING_DTYPE), *self.iter_timings()])

    def iter_timings(self) -> Iterator[NDArray[np.void]]:
        """Yield the host times block by block, TIMING_DTYPE (n,)."""
        return (rows for _, rows in self.read(Kind.TIMINGS))

    def iter_clock_samples(self) -> Iterator[NDArray[np.void]]:
        """Yield the clock samples block by block, CLOCK_DTYPE (n,)."""
        return (rows for _, rows in self.read(Kind.CLOCK))

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the events, in order."""
        return (event for _, events in self.read(Kind.EVENTS) for event in events)

    def bundle_data(self) -> bytes:
        """Return the bytes of the bundle that the run used, b"" if it was not recorded."""
        return next((block.payload for block in self.iter_blocks(Kind.BUNDLE)), b"")

    def bundle(self) -> Bundle:
        """Return the bundle that the run used; UsageError if it was not recorded."""
        if self.bundle_place is None:
            raise UsageError(f"{self.path}: the recording holds no bundle", remedy="name the bundle with --bundle")
        begin, size = self.bundle_place
        with open_regular(self.path) as file:
            file.seek(begin)
            return read_bundle(file, size, f"{self.path}: the bundle inside")[0]

    def iter_messages(self) -> Iterator[Messages]:
        """Yield the device's messages in order, those of many blocks at once, valid until the next ones."""
        from .log_kernels import message_spans  # numba is loaded only by who replays

        buffer = np.empty(GATHERED_BYTES + LIMITS[Kind.MESSAGES], np.uint8)
        spans, n, used = np.empty((MESSAGES_AT_ONCE, 2), np.int64), 0, 0
        for block in self.iter_blocks(Kind.MESSAGES):
            at, used = used, used + len(block.payload)
            buffer[at:used] = np.frombuffer(block.payload, np.uint8)
            while at < used:
                count, at = message_spans(buffer[:used], at, spans[n:])
                n += count
                if n == len(spans):
                    yield Messages(buffer, spans)
                    n = 0
                elif at < used:
                    raise _past_block(self.path, block)
            if used >= GATHERED_BYTES:
                yield Messages(buffer, spans[:n])
                n = used = 0
        yield Messages(buffer, spans[:n])


def _pairs(block: Block, path: Path) -> Iterator[tuple[int, bytes]]:
    position, payload = 0, block.payload
    while position < len(payload):
        start = position + MESSAGE.size
        host_ns, length = MESSAGE.unpack_from(payload, position) if start <= len(payload) else (0, len(payload))
        if start + length > len(payload):
            raise _past_block(path, block)
        yield host_ns, payload[start : start + length]
        position = start + length


def _events(block: Block, path: Path) -> Iterator[dict[str, Any]]:
    where = f"{path}: an event in block {block.index}"
    return (checked_event(parse_json_object(line, where), where) for line in block.payload.splitlines())


def together(some: Iterable[NDArray[np.void]]) -> Iterator[NDArray[np.void]]:
    """Yield the rows of several blocks as one array of about ROWS_AT_ONCE: blocks of a slow stream have a few rows each."""
    held: list[NDArray[np.void]] = []
    n = 0
    for rows in some:
        held.append(rows)
        n += len(rows)
        if n >= ROWS_AT_ONCE:
            yield np.concatenate(held)
            held, n = [], 0
    if n:
        yield np.concatenate(held)


def _past_block(path: Path, block: Block) -> DamagedFileError:
    return DamagedFileError(f"{path}: block {block.index}: a message reaches past its block")


def _rows(block: Block, dtype: np.dtype[np.void], path: Path) -> NDArray[np.void]:
    size = len(block.payload)
    if size % dtype.itemsize:
        raise DamagedFileError(f"{path}: block {block.index} has {size} bytes, allowed: a multiple of {dtype.itemsize}")
    return np.frombuffer(block.payload, dtype)


def _checked_runs(block: Block, path: Path) -> NDArray[np.void]:
    """Return the runs of a block that do not ask for more memory than such a block may."""
    runs = _rows(block, TIMING_RUN_DTYPE, path)
    rows = int(runs["count"].sum(dtype=np.uint64))
    if rows > TIMING_ROWS_MAX or not runs["count"].all():
        raise DamagedFileError(
            f"{path}: block {block.index} has the times of {rows} decisions in {len(runs)} runs, allowed: 1 or more in each, "
            f"{TIMING_ROWS_MAX} at most"
        )
    return runs


def _start(file: Any, where: str) -> int:
    """Read the prologue; return the checksum that seeds the first block."""
    start = file.read(FILE_PROLOGUE.size)
    if not start.startswith(MAGIC):
        start += file.read(KIND_BYTES)  # to say what it is
    return check_prologue(start, MAGIC, FORMAT_VERSION, where)


def _blocks(file: Any, chain: int, where: str, wanted: Sequence[Kind] | None = None) -> Iterator[Block]:
    index = 0
    while (block := read_block(file, index, chain, LIMITS, where, wanted)) is not None:
        yield block
        if block.kind == Kind.END:
            if rest := len(file.read(MIB)):
                raise DamagedFileError(f"{where}: {rest} bytes or more behind the END block at byte {block.end}")
            return
        index, chain = index + 1, block.chain


class _Scan:
    """What one pass over the blocks adds up to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.kinds: Counter[Kind] = Counter()
        self.header: dict[str, Any] = {}
        self.summary: dict[str, Any] | None = None
        self.end_offset = self.n_decisions = 0
        self.bundle_place: tuple[int, int] | None = None
        self.log = LogReader()

    def take(self, block: Block) -> None:
        """Account for the next block; DamagedFileError where it does not fit those before."""
        where = f"{self.path}: block {block.index}"
        kind = Kind(block.kind)
        if (kind == Kind.HEADER) != (block.index == 0) or (kind == Kind.BUNDLE and self.kinds[kind]):
            raise DamagedFileError(f"{where}: {kind.name} does not belong here")
        if kind == Kind.HEADER:
            self.header = checked_header(parse_json_object(block.payload, where), where)
        elif kind == Kind.BUNDLE:
            found, wanted = hashlib.sha256(block.payload).hexdigest(), self.header.get("bundle_sha256")
            if wanted != found:
                said = ascii(wanted)[:80]
                raise DamagedFileError(f"{where}: the bundle has the SHA-256 {found}, the header says {said}")
            self.bundle_place = block.begin, len(block.payload)
        elif kind == Kind.END:
            end = parse_json_object(block.payload, where)
            facts = {"blocks": block.index, "decisions": self.n_decisions, "decisions_sha256": self.log.hexdigest()}
            for key, value in facts.items():
                if end.get(key) != value:
                    raise DamagedFileError(f"{where}: END says {key} = {ascii(end.get(key))[:80]}, found {value}")
            self.summary = checked_summary(end.get("summary"), f"{where}: END")
        elif kind == Kind.DECISIONS:
            self.n_decisions += len(self.log.rows(block.payload, where))
        self.kinds[kind] += 1
        self.end_offset = block.end


def read_recording(path: str | Path, *, salvage: bool = False) -> Recording:
    """Check every block of `path` and return what it holds; a cut file is fine (`complete` False), an altered one is not.

    DamagedFileError names the block and its byte. With `salvage` the blocks before it are returned instead, and `damage`
    says what is wrong; only a file without a whole header still raises. UsageError if the file is not there.
    """
    scan, damage = _Scan(Path(path)), ""
    with refusing(f"{path}: cannot be read"), open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        try:
            for block in _blocks(file, _start(file, str(path)), str(path)):
                scan.take(block)
        except DamagedFileError as error:
            if not salvage or not scan.kinds:
                whole = f"{scan.kinds.total()} whole blocks before it"
                raise DamagedFileError(f"{error.message}; {whole}", remedy=error.remedy) from error
            damage = error.message
    if not scan.kinds:
        raise DamagedFileError(f"{path}: cut after {size} bytes, within its header: nothing of it can be read")
    return Recording(
        path=Path(path),
        size=size,
        header=scan.header,
        kinds=scan.kinds,
        n_decisions=scan.n_decisions,
        decisions_sha256=scan.log.hexdigest(),
        complete=scan.summary is not None and not damage,
        end_offset=scan.end_offset,
        summary=scan.summary or {},
        damage=damage,
        bundle_place=scan.bundle_place,
    )
