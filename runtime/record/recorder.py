"""Append-only recordings: everything a run saw and decided, in one file that survives a power cut.

Owns the writing, in bounded batches; reading is recording.py's. Never decides what is worth keeping
and never converts a time. `Recorder.close` returns the SHA-256 of the decision log, which a replay must give again.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pans.runtime.container import MIB, block_ends, canonical_json, file_prologue
from pans.runtime.core.decision import DECISION_DTYPE, NumberedDecisions
from pans.runtime.errors import PansError, RecordingError, UsageError
from pans.runtime.outputs import beside_name, place_new, refuse_existing, sync_folder
from pans.runtime.timing.clock import CLOCK_DTYPE
from pans.runtime.wire.frame import Messages

from .buffers import BUFFER_ROWS, ByteBuffer, RowBuffer
from .format import (
    LIMITS,
    MAGIC,
    MESSAGE,
    MESSAGE_MAX_BYTES,
    RUNS_VERSION,
    TIMING_DTYPE,
    TIMING_ROWS_MAX,
    TIMING_RUN_DTYPE,
    Kind,
    expand_timings,
    version_for,
)
from .log import LogEncoder

_MESSAGE_BUFFER_BYTES = MIB // 4
_EVENT_BUFFER_BYTES = MIB // 16
_FIRST_KINDS = (Kind.MESSAGES, Kind.DECISIONS, Kind.END)  # with them a run has begun
_COPIED_BYTES = MIB // 4  # of a block that is put together before it is written, in one call


class Recorder:
    """Writes one recording; one thread at a time. Adding buffers, a full buffer is written at once, `flush` writes the rest.

    Left by an exception or not closed at all, the recording has no END block and reads as incomplete, which it is.
    """

    def __init__(
        self, path: str | Path, header: Mapping[str, Any], *, bundle: bytes = b"", overwrite: bool = False
    ) -> None:
        """Create `path` (UsageError if it exists, unless `overwrite`) and write header and bundle to it.

        The file is there with both or not at all. One that is replaced stays until there are messages, decisions or an end to write: a
        device that refuses before that costs nobody a recording.
        `header` is JSON-able; `format_version`, `created_utc` and `bundle_sha256` are added where they are missing.
        """
        self.path = Path(path)
        self.watch_write: Callable[[int, int], None] | None = None  # told when a write began and ended, perf_counter_ns
        self.before_first: Callable[[], None] | None = (
            None  # called once, before messages, decisions or END are written
        )
        self._unplaced: Path | None = None  # where the file is until then, if it is to replace another one
        self._messages = ByteBuffer(Kind.MESSAGES, _MESSAGE_BUFFER_BYTES)
        self._commands = ByteBuffer(Kind.COMMANDS, _MESSAGE_BUFFER_BYTES)
        self._answers = ByteBuffer(Kind.ANSWERS, _EVENT_BUFFER_BYTES)
        self._events = ByteBuffer(Kind.EVENTS, _EVENT_BUFFER_BYTES)
        self._decisions = RowBuffer(Kind.DECISIONS, DECISION_DTYPE)
        self._timings = RowBuffer(Kind.TIMINGS, TIMING_DTYPE)
        self._timing_runs = RowBuffer(Kind.TIMING_RUNS, TIMING_RUN_DTYPE)
        self._in_runs = 0  # decisions in these
        # A decision goes out behind all that it is made of, so that a file that is cut off holds nothing that cannot be decided again.
        self._first = (self._commands, self._answers, self._messages, self._decisions)
        self._in_order = (*self._first, self._timings, self._timing_runs)
        self._log = LogEncoder()
        self._pack, self._pack_stamped = _packing()
        self._n_decisions = self._n_blocks = 0
        self.first_decision = 0  # of a run in parts
        self._version = version = version_for(header)
        facts = {"format_version": version, "created_utc": datetime.now(UTC).isoformat(timespec="seconds")}
        facts |= {"bundle_sha256": hashlib.sha256(bundle).hexdigest()} if bundle else {}
        text = canonical_json({**facts, **header})
        if not overwrite and os.path.lexists(self.path):
            raise refuse_existing(self.path)
        beside = beside_name(self.path)
        self._file = _create(beside, self.path)
        self._has_names = os.fstat(self._file.fileno()).st_nlink > 0  # not every file system counts them
        start, self._chain = file_prologue(MAGIC, version)
        self._end = 0
        try:
            self._write(start)
            self._write_block(Kind.HEADER, text)
            if bundle:
                self._write_block(Kind.BUNDLE, bundle)
            self.sync()
            if overwrite and os.path.lexists(self.path):
                self.before_first, self._unplaced = self._take_place, beside
                return
            _place(beside, self.path, overwrite=False)
        except BaseException:
            self._file.close()
            with suppress(OSError):
                beside.unlink(missing_ok=True)
            raise
        sync_folder(self.path.parent)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._file.closed:
            return self._drop_unplaced()
        try:
            self.keep_deleted()
            self.flush()
            self._close_file()
        except PansError:
            if error[1] is None:
                raise
        finally:
            with suppress(OSError):
                self._file.close()  # where `flush` failed
            self._drop_unplaced()

    @property
    def size_bytes(self) -> int:
        """Bytes in the file, all of them in whole blocks."""
        return self._end

    @property
    def written(self) -> tuple[int, str]:
        """Number of the decisions in the file and the SHA-256 (hex) of their log; all of them after `flush`."""
        return self._n_decisions, self._log.hexdigest()

    @property
    def n_written(self) -> int:
        """Number of the decisions in the file, for another thread too."""
        return self.first_decision + self._n_decisions

    @property
    def is_deleted(self) -> bool:
        """Whether the open file has no name any more; for another thread too."""
        try:
            return self._has_names and os.fstat(self._file.fileno()).st_nlink == 0
        except (OSError, ValueError):  # it is closed
            return False

    def keep_deleted(self) -> Path | None:
        """Go on in a copy beside the folder of a file that was deleted; return its path, None where nothing was deleted.

        A file without a name cannot be given one again (link(2) refuses it), but it can be read as long as it is open.
        """
        if not self.is_deleted:
            return None
        self.before_first = self._unplaced = None
        self.flush()
        deleted, path = self._file, self.path.absolute()
        try:
            self.path = _folder_beside(path.parent) / path.name.removeprefix(".")
            self._file = _create(self.path, self.path)
            deleted.seek(0)
            shutil.copyfileobj(deleted, self._file, MIB)
        except OSError as error:
            raise self._broken(error) from error
        finally:
            deleted.close()
        self.sync()
        return self.path

    def add_message(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """Keep one decoded device message of at most 1 MiB and the host time at which it arrived, in ns."""
        self._add_bytes(self._messages, host_ns, data)

    def add_messages(self, host_ns: int, messages: Messages, first: int, count: int) -> None:
        """Keep `count` of `messages` from place `first` on, which arrived together."""
        buffer, stop = self._messages, first + count
        while True:
            first, buffer.used = self._pack(
                messages.buffer, messages.spans, first, stop, host_ns, buffer.array, buffer.used
            )
            if first == stop:
                return
            begin, end = messages.spans[first].tolist()
            self._add_bytes(buffer, host_ns, messages.buffer[begin:end].tobytes())  # makes room
            first += 1

    def add_stamped(self, kind: Kind, data: NDArray[np.uint8], spans: NDArray[np.int64]) -> None:
        """Keep many MESSAGES, COMMANDS or ANSWERS: `spans` int64 (n, 4) are where each begins and ends in `data`, and its time in ns."""
        buffer = {Kind.MESSAGES: self._messages, Kind.COMMANDS: self._commands, Kind.ANSWERS: self._answers}[kind]
        first = 0
        while first < len(spans):
            first, buffer.used = self._pack_stamped(data, spans, first, buffer.array, buffer.used)
            if first < len(spans):
                begin, end, host_ns, _ = spans[first].tolist()
                self._add_bytes(buffer, host_ns, data[begin:end].tobytes())  # makes room
                first += 1

    def add_command(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """Keep the bytes of one command to the device and the host time at which it was sent, in ns."""
        self._add_bytes(self._commands, host_ns, data)

    def add_answer(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """Keep one decoded WELCOME, ACK or PONG of at most 1 MiB and the host time at which it arrived, in ns."""
        self._add_bytes(self._answers, host_ns, data)

    def add_decision(self, record: Sequence[Any]) -> None:
        """Keep one decision: a tuple in the order of DECISION_DTYPE."""
        if self._decisions.add(record):
            self._empty(self._decisions)

    def prepare(self, decisions: NumberedDecisions) -> None:
        """Be ready for many decisions by the same verdicts, before arming."""
        self._log.prepare(decisions)

    def add_decisions(self, many: NDArray[np.void] | NumberedDecisions) -> None:
        """Keep many decisions, rows DECISION_DTYPE (n,) or numbered; more than a buffer holds go out at once."""
        if len(many) < self._decisions.room():
            self._decisions.add_many(many.rows if isinstance(many, NumberedDecisions) else many)
            return
        n, blocks = self._decisions.used + len(many), self._blocks_of(*self._first)
        for payload in self._log.blocks(many):
            blocks += self._framed(Kind.DECISIONS, payload)
        self._write(b"".join(blocks))  # a few long writes take half the time of many short ones
        self._n_decisions += n

    def add_timing(self, record: Sequence[Any]) -> None:
        """Keep the host times of one decision: a tuple in the order of TIMING_DTYPE; not part of the log's hash."""
        self._end_runs()
        if self._timings.add(record):
            self._empty(self._timings)

    def add_timing_runs(self, runs: NDArray[np.void]) -> None:
        """Keep the host times of many decisions, TIMING_RUN_DTYPE (n,), at most 2^16 of each run."""
        if self._version < RUNS_VERSION:
            self._add_rows(self._timings, expand_timings(runs))
            return
        if self._timings.used:
            self._empty(self._timings)  # the order of time
        self._in_runs += int(runs["count"].sum())
        self._add_rows(self._timing_runs, runs)
        if self._in_runs > TIMING_ROWS_MAX // 2:
            self._end_runs()

    def _end_runs(self) -> None:
        if self._timing_runs.used:
            self._empty(self._timing_runs)

    def _add_rows(self, buffer: RowBuffer, rows: NDArray[np.void]) -> None:
        done = 0
        while done < len(rows):
            done += buffer.add_many(rows[done:])
            if not buffer.room():
                self._empty(buffer)

    def add_event(self, event: Mapping[str, Any]) -> None:
        """Keep one JSON-able event: a gap, an alarm, a late decision, a link that went away."""
        line = canonical_json(event) + b"\n"
        if len(line) > len(self._events.data):
            raise UsageError(f"an event of {len(line)} bytes, allowed at most {len(self._events.data)}")
        if len(line) > self._events.room():
            self._empty(self._events)
        self._events.add(line)

    def add_clock(self, samples: NDArray[np.void]) -> None:
        """Write clock samples, CLOCK_DTYPE (n,) of clock.py; rare, hence not buffered."""
        for start in range(0, len(samples), BUFFER_ROWS):
            part = np.ascontiguousarray(samples[start : start + BUFFER_ROWS], dtype=CLOCK_DTYPE)
            self._write_block(Kind.CLOCK, part.tobytes())

    def flush(self) -> None:
        """Write everything that is buffered to the file, in one call; it then survives the death of this process."""
        self._flush(*self._in_order, self._events)

    def flush_decisions(self) -> None:
        """Write what the decisions so far are made of, and these: as much as an action upon them needs on record before it."""
        self._empty(self._decisions)

    def _flush(self, *buffers: RowBuffer | ByteBuffer) -> None:
        n_decisions = self._decisions.used if self._decisions in buffers else 0
        if blocks := self._blocks_of(*buffers):
            self._write(b"".join(blocks))
            self._n_decisions += n_decisions

    def _blocks_of(self, *buffers: RowBuffer | ByteBuffer) -> list[bytes | memoryview]:
        """Empty buffers into the pieces of blocks, which must be written next."""
        return [piece for buffer in buffers if buffer.used for piece in self._block_of(buffer)]

    def sync(self) -> None:
        """Flush, and wait until it survives a power cut: milliseconds, never on the hot path."""
        self.flush()
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._broken(error) from error

    def close(self, summary: Mapping[str, Any]) -> str:
        """Flush, write END with `summary` (JSON-able), sync, close; return the SHA-256 (hex) of the decision log."""
        self.keep_deleted()
        self.flush()
        digest = self._log.hexdigest()
        end = {"blocks": self._n_blocks, "decisions": self._n_decisions, "decisions_sha256": digest, "summary": summary}
        self._write_block(Kind.END, canonical_json(end))
        self.sync()
        self._close_file()
        return digest

    def _close_file(self) -> None:
        """Close the file; RecordingError, which names it, where the disk fails only then."""
        try:
            self._file.close()
        except OSError as error:
            raise RecordingError(
                f"{self.path}: the disk failed when the recording was closed: {error.strerror or error}",
                remedy="check the disk, and the file with `pans verify`",
            ) from error

    def begin(self) -> None:
        """Take the place of what is replaced, if that has not been done; RecordingError if it cannot be."""
        taking, self.before_first = self.before_first, None
        try:
            if taking is not None:
                taking()
        except PansError as error:
            self._file.close()
            raise RecordingError(error.message, remedy=error.remedy) from error

    def _take_place(self) -> None:
        assert self._unplaced is not None
        _place(self._unplaced, self.path, overwrite=True)
        self._unplaced = None
        sync_folder(self.path.parent)

    def _drop_unplaced(self) -> None:
        if self._unplaced is not None:
            with suppress(OSError):
                self._unplaced.unlink(missing_ok=True)

    def _add_bytes(self, buffer: ByteBuffer, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        if len(data) > MESSAGE_MAX_BYTES:
            raise UsageError(f"a message of {len(data)} bytes, allowed at most {MESSAGE_MAX_BYTES}")
        needed = MESSAGE.size + len(data)
        if needed > buffer.room():
            self._empty(buffer)
        if needed > buffer.room():
            self._write_block(buffer.kind, MESSAGE.pack(host_ns, len(data)) + bytes(data))
            return
        MESSAGE.pack_into(buffer.data, buffer.used, host_ns, len(data))
        buffer.used += MESSAGE.size
        buffer.add(data)

    def _empty(self, buffer: RowBuffer | ByteBuffer) -> None:
        """Write a buffer to the file, and before it what must stand before it."""
        if buffer in self._in_order:
            self._flush(*self._in_order[: self._in_order.index(buffer) + 1])
        else:
            self._flush(buffer)

    def _block_of(self, buffer: RowBuffer | ByteBuffer) -> tuple[bytes | memoryview, ...]:
        if buffer is self._decisions:
            rows = self._decisions.rows[: self._decisions.used]
            self._decisions.used = 0
            return self._framed(Kind.DECISIONS, self._log.block(rows))
        if buffer is self._timing_runs:
            self._in_runs = 0
        return self._framed(buffer.kind, buffer.take())

    def _write_block(self, kind: Kind, payload: bytes | memoryview) -> None:
        pieces = self._framed(kind, payload)
        if len(payload) > _COPIED_BYTES:
            self._write(*pieces)
        else:
            self._write(b"".join(pieces))

    def _framed(self, kind: Kind, payload: bytes | memoryview) -> tuple[bytes, bytes | memoryview, bytes]:
        """Return what stands before a payload, the payload, and what stands behind it: the next block."""
        if self.before_first is not None and kind in _FIRST_KINDS:
            self.begin()
        if len(payload) > LIMITS[kind]:
            raise UsageError(f"a {kind.name} block of {len(payload)} bytes, allowed at most {LIMITS[kind]}")
        head, tail, self._chain = block_ends(kind, self._n_blocks, self._chain, payload)
        self._n_blocks += 1
        return head, payload, tail

    def _write(self, *pieces: bytes | memoryview) -> None:
        """Write one whole block (or the prologue); `_end` moves when all of it is there."""
        if self._file.closed:
            raise UsageError(f"{self.path}: this recording is closed")
        began_ns = time.perf_counter_ns()
        try:
            for piece in pieces:
                view = memoryview(piece)
                while view:
                    view = view[self._file.write(view) :]
        except OSError as error:
            raise self._broken(error) from error
        self._end += sum(len(piece) for piece in pieces)
        if self.watch_write is not None:
            self.watch_write(began_ns, time.perf_counter_ns())

    def _broken(self, error: OSError) -> RecordingError:
        """Close at the last whole block: a torn one in the middle would make everything behind it unreadable."""
        with suppress(OSError):  # otherwise the reader stops at the torn block by itself
            self._file.truncate(self._end)
        with suppress(OSError):  # the first error says what is wrong
            self._file.close()
        reason = error.strerror or str(error)
        return RecordingError(
            f"{self.path}: the recording stops after {self._end} bytes: {reason}",
            remedy="make room on the disk; what was written before is readable",
        )


def load_kernels() -> None:
    """Compile or load what a recorder needs, which it would do when it is made."""
    _packing()
    LogEncoder()


def _packing() -> tuple[Any, Any]:
    from .kernels import pack_messages, pack_stamped  # numba is loaded only by who records

    none = np.zeros(0, np.uint8)
    pack_messages(none, np.zeros((0, 2), np.int64), 0, 0, 0, none, 0)
    pack_stamped(none, np.zeros((0, 4), np.int64), 0, none, 0)
    return pack_messages, pack_stamped


def _create(beside: Path, path: Path) -> Any:
    try:
        return open(beside, "x+b", buffering=0)  # one write per block, nothing half written behind our back
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror or error}") from error


def _folder_beside(folder: Path) -> Path:
    """Make a new folder beside `folder`, which may be gone itself."""
    for number in itertools.count(1):
        kept = folder.with_name(f"{folder.name}-kept" + (f"-{number}" if number > 1 else ""))
        with suppress(FileExistsError):
            kept.mkdir(parents=True)
            return kept
    raise AssertionError


def _place(beside: Path, path: Path, overwrite: bool) -> None:
    """Give the file its name, now that what makes it readable is on the disk."""
    try:
        if overwrite:
            os.replace(beside, path)
        else:
            place_new(beside, path)
    except FileExistsError as error:
        raise refuse_existing(path) from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror or error}") from error
