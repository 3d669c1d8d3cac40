"""Append-only recordings: everything a run saw and decided, in one file or in parts, which survive a power cut.

What is added is buffered; full buffers and `flush` write blocks to a `RecordingFile`. `Recorder.close` returns the SHA-256 of the decision
log, which a replay must give again (reading: recording.py).
"""

from __future__ import annotations

import os
import secrets
import shutil
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import PansError, RecordingError, UsageError, refusing
from pans.base.files import MIB, canonical_json, refuse_existing
from pans.decide import DECISION_DTYPE
from pans.decide.plan import Plan, plan_commands
from pans.protocol.clock import CLOCK_DTYPE
from pans.protocol.wire import Arm, Opcode, encode_command, pack_command
from pans.record.reading.decision_log import LogEncoder
from pans.record.reading.format import MESSAGE, MESSAGE_MAX_BYTES, PART_EVENT, TIMING_ROWS_MAX, TIMING_RUN_DTYPE, Kind
from pans.record.reading.parts import chained, files_of_parts, part_path
from pans.record.reading.recording_file import RecordingFile

BUFFER_ROWS = 4096
RESERVE_PARTS = 2  # of free disk, below which the oldest parts are deleted before their time
RETRY_S = 5.0  # after a part could not be made
_MESSAGE_BUFFER_BYTES = MIB // 4
_EVENT_BUFFER_BYTES = MIB // 16
_FIRST_KINDS = (Kind.MESSAGES, Kind.DECISIONS, Kind.END)  # with them a run has begun


@dataclass(frozen=True, slots=True)
class PartLimits:
    """A part is closed once it has `rotate_bytes`; closed and open ones together stay within `keep_bytes` (0: no cap)."""

    rotate_bytes: int
    keep_bytes: int = 0

    def __post_init__(self) -> None:
        if self.rotate_bytes < 1:
            raise UsageError(f"a part must hold at least 1 byte, found {self.rotate_bytes}")
        if self.keep_bytes and self.keep_bytes < 2 * self.rotate_bytes:
            raise UsageError(
                f"{self.keep_bytes} bytes are to be kept in parts of {self.rotate_bytes}",
                remedy="keep at least two parts: the open one is never deleted",
            )


def repeated_setup(plan: Plan, arm: Arm, nonce: int) -> list[bytes]:
    """Return plan, states and ARM as frames of session `nonce`: with them at its beginning a part can be replayed by itself."""
    bodies = [*plan_commands(plan), (Opcode.ARM, pack_command(arm))]
    return [encode_command(number, opcode, body, nonce) for number, (opcode, body) in enumerate(bodies, 1)]


class _Buffer:
    """Preallocated bytes that are emptied into a block."""

    def __init__(self, size: int) -> None:
        self.data = np.full(size, 0, np.uint8)  # touched, which np.zeros leaves to the first use
        self.used = 0

    @property
    def room(self) -> int:
        return len(self.data) - self.used

    def add(self, *pieces: bytes | bytearray | memoryview) -> None:
        for piece in pieces:
            self.data.data[self.used : self.used + len(piece)] = piece
            self.used += len(piece)

    def empty(self) -> bytes:
        data = self.data[: self.used].tobytes()
        self.used = 0
        return data


class Recorder:
    """Writes one recording, in parts where `limits` are given; one thread at a time.

    Left by an exception or not closed at all, the recording has no END block and reads as incomplete, which it is.
    """

    def __init__(
        self,
        path: str | Path,
        header: Mapping[str, Any],
        *,
        bundle: bytes = b"",
        overwrite: bool = False,
        limits: PartLimits | None = None,
    ) -> None:
        """Create `path`, or part 1 next to it (`part_path`); UsageError if it exists, unless `overwrite`.

        Header and bundle are in the file, or it is not there. What is replaced stays until there are messages, decisions or an end to
        write: a device that refuses before that costs nobody a recording. `header` is JSON-able; `format_version`, `created_utc` and
        `bundle_sha256` are added where they are missing.
        """
        self.path, self.limits = Path(path), limits
        # called with when a write began and ended, perf_counter_ns
        self.watch_write: Callable[[int, int], None] | None = None
        self.parts = 0  # 0: one file
        self._header = {"created_utc": datetime.now(UTC).isoformat(timespec="seconds"), **header}
        # In this order: a decision is written behind all that it is made of, so that a file that is cut off holds nothing that cannot be
        # decided again.
        self._buffers = {
            Kind.COMMANDS: _Buffer(_MESSAGE_BUFFER_BYTES),
            Kind.ANSWERS: _Buffer(_EVENT_BUFFER_BYTES),
            Kind.MESSAGES: _Buffer(_MESSAGE_BUFFER_BYTES),
            Kind.DECISIONS: _Buffer(BUFFER_ROWS * DECISION_DTYPE.itemsize),
            Kind.TIMINGS: _Buffer(BUFFER_ROWS * TIMING_RUN_DTYPE.itemsize),
            Kind.EVENTS: _Buffer(_EVENT_BUFFER_BYTES),
        }
        self._timed = 0  # decisions in the buffer of times
        self._pack = _packing()
        self._replaced = self._files_in_the_way(overwrite)
        self._closed: deque[dict[str, Any]] = deque()  # what the next part says of each
        self._deleted = Counter(parts=0, bytes=0, decisions=0)
        self._chain = self._trouble = ""
        self._news: list[dict[str, Any]] = []
        self._finishing: list[Future[None]] = []
        self._kept: Path | None = None  # the open file, continued elsewhere: its folder was deleted
        self._run, self._bundle = secrets.token_hex(8), bundle
        if limits is None:
            self.open_file = RecordingFile(self.path, self._header, bundle)
        else:
            # files are made and closed by another thread, so that the loop never waits for a disk over a rotation
            self._worker = ThreadPoolExecutor(1, "pans-parts")
            self.open_file = self._make_part(1)
        try:
            if limits is not None:
                self._begin_part({"decisions": 0}, (), 0, None)
                self._make_next()
                self.open_file.sync()  # a part with a name says where it begins; later ones cannot be waited for (`parts.part_of`)
            if not self._replaced:
                self.open_file.take_name()
        except BaseException:
            self._abandon()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        try:
            if not self.open_file.is_closed:
                self.keep_deleted()
                self.flush()
                self.open_file.close()
        except PansError:
            if error[1] is None:
                raise
        finally:
            self._abandon()

    @property
    def n_written(self) -> int:
        """Number of the decisions on disk, for another thread too."""
        return self.open_file.first_decision + self.open_file.n_decisions

    def keep_deleted(self) -> Path | None:
        """Continue in a copy next to the folder of a file that was deleted; return its path, None where nothing was deleted.

        Parts that were closed before cannot be kept.
        """
        if not self.open_file.is_deleted:
            return None
        self._replaced = []
        self.flush()
        self.open_file.keep_deleted()
        self._kept = self.open_file.path
        if not self.parts:
            self.path = self._kept
        return self._kept

    def add_message(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """Keep one decoded device message of at most 1 MiB and the host time at which it arrived, in ns."""
        self._add_bytes(Kind.MESSAGES, host_ns, data)

    def add_command(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """Keep the bytes of one command to the device and the host time at which it was sent, in ns."""
        self._add_bytes(Kind.COMMANDS, host_ns, data)

    def add_answer(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """Keep one decoded WELCOME, ACK or PONG of at most 1 MiB and the host time at which it arrived, in ns."""
        self._add_bytes(Kind.ANSWERS, host_ns, data)

    def add_stamped(self, kind: Kind, data: NDArray[np.uint8], spans: NDArray[np.int64]) -> None:
        """Keep many MESSAGES, COMMANDS or ANSWERS: `spans` int64 (n, 4) are where each begins and ends in `data`, and its time in ns."""
        buffer, first = self._buffers[kind], 0
        while first < len(spans):
            first, buffer.used = self._pack(data, spans, first, buffer.data, buffer.used)
            if first < len(spans):
                begin, end, host_ns, _ = spans[first].tolist()
                self._add_bytes(kind, host_ns, data[begin:end].tobytes())  # makes room
                first += 1

    def add_decisions(self, many: NDArray[np.void]) -> None:
        """Keep decisions, rows DECISION_DTYPE (n,); more than a buffer holds are written at once."""
        buffer = self._buffers[Kind.DECISIONS]
        if many.nbytes < buffer.room:
            buffer.add(many.tobytes())
            return
        n, blocks = buffer.used // DECISION_DTYPE.itemsize + len(many), self._blocks_of(Kind.DECISIONS)
        for payload in self.open_file.log.blocks(many):
            blocks += self._framed(Kind.DECISIONS, payload)
        self._write(b"".join(blocks))  # a few long writes take half the time of many short ones
        self.open_file.n_decisions += n

    def add_timing_runs(self, runs: NDArray[np.void]) -> None:
        """Keep the host times of decisions, TIMING_RUN_DTYPE (n,), at most 2^16 of each run; not part of the log's hash."""
        for start in range(0, len(runs), BUFFER_ROWS):
            some = runs[start : start + BUFFER_ROWS]
            if some.nbytes > self._buffers[Kind.TIMINGS].room:
                self._flush(Kind.TIMINGS)
            self._buffers[Kind.TIMINGS].add(some.tobytes())
            self._timed += int(some["count"].sum())
        if self._timed > TIMING_ROWS_MAX // 2:
            self._flush(Kind.TIMINGS)

    def add_event(self, event: Mapping[str, Any]) -> None:
        """Keep one JSON-able event: a gap, an alarm, a late decision, a link that went away."""
        line, buffer = canonical_json(event) + b"\n", self._buffers[Kind.EVENTS]
        if len(line) > len(buffer.data):
            raise UsageError(f"an event of {len(line)} bytes, allowed at most {len(buffer.data)}")
        if len(line) > buffer.room:
            self._write(*self._framed(Kind.EVENTS, buffer.empty()))
        buffer.add(line)

    def add_clock(self, samples: NDArray[np.void]) -> None:
        """Write clock samples, CLOCK_DTYPE (n,) of clock.py; rare, hence not buffered."""
        for start in range(0, len(samples), BUFFER_ROWS):
            part = np.ascontiguousarray(samples[start : start + BUFFER_ROWS], dtype=CLOCK_DTYPE)
            self._write(b"".join(self._framed(Kind.CLOCK, part.tobytes())))

    def flush(self) -> None:
        """Write everything that is buffered to the file, in one call; it then survives the death of this process."""
        self._flush(Kind.EVENTS)

    def flush_decisions(self) -> None:
        """Write what the decisions so far are made of, and these: as much as an action upon them needs on record before it."""
        self._flush(Kind.DECISIONS)

    def sync(self) -> None:
        """Flush, and wait until it survives a power cut: milliseconds, never on the hot path."""
        self.flush()
        self.open_file.sync()

    def close(self, summary: Mapping[str, Any]) -> str:
        """Flush, write END with `summary` (JSON-able), sync, close; return the SHA-256 (hex) of the decision log.

        Of parts it is the hash over all their logs (`chained`), and RecordingError says that one of them has no END.
        """
        self.keep_deleted()
        self.flush()
        self.replace_old()
        digest = self.open_file.finish(summary)
        if not self.parts:
            return digest
        self._worker.shutdown(wait=True)
        self._note_finished()
        if self._trouble and self._kept is None:
            raise RecordingError(
                f"the run has ended, and its recording is not whole: {self._trouble}",
                remedy="verify the folder of parts",
            )
        return chained(self._chain, digest)

    # -- parts ---------------------------------------------------------------------------------------------------------

    _worker: ThreadPoolExecutor
    _next: Future[RecordingFile]  # the part that is made ahead
    _tried_s: float

    @property
    def wants_part(self) -> bool:
        """Whether the open part is full and the next one has been made; a deleted one is the last (`keep_deleted`)."""
        if self.limits is None or self.open_file.size_bytes < self.limits.rotate_bytes or self.open_file.is_deleted:
            return False
        if not self._next.done():
            return False
        if (error := self._next.exception()) is None:
            return True
        if time.monotonic() - self._tried_s > RETRY_S:  # the open part continues; on a full disk its next write says so
            self._news.append({"kind": "parts_trouble", "message": str(error)})
            self._make_next()
        return False

    def next_part(self, place: Mapping[str, Any], commands: Iterable[bytes], host_ns: int) -> None:
        """Continue in the next part, which begins at `place` (of the core); `commands` repeat the plan and ARM, so that it stands alone."""
        self.replace_old()
        self.flush()
        full, made = self.open_file, self._next.result()
        digest = full.log.hexdigest()
        self._chain = chained(self._chain, digest)
        facts = {
            "name": full.path.name,
            "bytes": full.size_bytes,
            "first_decision": full.first_decision,
            "decisions": full.n_decisions,
            "decisions_sha256": digest,
            "chain_sha256": self._chain,
        }
        made.first_decision, self.open_file = self.n_written, made
        self._closed.append(facts)
        struck = self._strike_oldest()
        self._begin_part(place, commands, host_ns, facts)
        try:
            made.take_name()
        except UsageError as error:
            raise RecordingError(
                f"{made.path}: the part cannot be begun: {error.message}", remedy="the parts before it are readable"
            ) from error
        self._finishing.append(self._worker.submit(_finish_part, full, made.path.name, struck))
        self._make_next()

    def news(self) -> list[dict[str, Any]]:
        """Return what has happened to the parts since the last call, as events."""
        self._note_finished()
        news, self._news = self._news, []
        return news

    def replace_old(self) -> None:
        """Take the place of what is replaced, if that has not been done; RecordingError if it cannot be."""
        if self.open_file.has_name:
            return
        try:
            for old in self._replaced if self.parts else ():
                _remove(old)
            self.open_file.take_name(overwrite=bool(self._replaced))
            self._replaced = []
        except PansError as error:
            self.open_file.discard()
            raise RecordingError(error.message, remedy=error.remedy) from error

    def _files_in_the_way(self, overwrite: bool) -> list[Path]:
        """Return the files that this recording will replace; what was only made ahead is deleted at once."""
        there = [self.path] if os.path.lexists(self.path) else []
        there += [] if self.limits is None else files_of_parts(self.path)
        if there and not overwrite:
            raise refuse_existing(there[0])
        for ahead in (one for one in there if one.name.startswith(".")):
            _remove(ahead)
        return [one for one in there if not one.name.startswith(".")]

    def _begin_part(
        self, place: Mapping[str, Any], commands: Iterable[bytes], host_ns: int, before: Mapping[str, Any] | None
    ) -> None:
        self.parts += 1
        self.add_event(
            {
                "kind": PART_EVENT,
                "number": self.parts,
                "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "first_decision": self.open_file.first_decision,
                "before": before,
                "deleted": dict(self._deleted),
                "place": dict(place),
            }
        )
        for data in commands:
            self.add_command(host_ns, data)
        self._write(*self._framed(Kind.EVENTS, self._buffers[Kind.EVENTS].empty()))  # a part begins with it
        self.flush()

    def _make_part(self, number: int) -> RecordingFile:
        path = part_path(self.path, number)
        header = {**self._header, "part": {"number": number, "run": self._run, "file": path.name}}
        return RecordingFile(path, header, self._bundle)

    def _make_next(self) -> None:
        self._tried_s = time.monotonic()
        self._next = self._worker.submit(self._make_part, self.parts + 1)

    def _strike_oldest(self) -> list[Path]:
        """Return the parts to delete, so that those that stay keep within the limits; the part that begins now says how many are gone."""
        assert self.limits is not None
        struck, free = [], shutil.disk_usage(self.path.parent).free
        while len(self._closed) > 1:
            kept = sum(part["bytes"] for part in self._closed) + self.limits.rotate_bytes
            too_many = 0 < self.limits.keep_bytes < kept
            if not too_many and free >= RESERVE_PARTS * self.limits.rotate_bytes:
                break
            why = "the cap" if too_many else "the disk is nearly full"
            oldest = self._closed.popleft()
            free += oldest["bytes"]
            self._deleted.update(parts=1, bytes=oldest["bytes"], decisions=oldest["decisions"])
            self._news.append({"kind": "part_deleted", "name": oldest["name"], "bytes": oldest["bytes"], "why": why})
            struck.append(self.path.with_name(oldest["name"]))
        return struck

    def _note_finished(self) -> None:
        """Look at what the other thread has done."""
        for done in [one for one in self._finishing if one.done()]:
            self._finishing.remove(done)
            if (error := done.exception()) is not None:
                self._trouble = getattr(error, "message", str(error))
                self._news.append({"kind": "parts_trouble", "message": self._trouble})

    def _abandon(self) -> None:
        """Leave nothing behind that has no name."""
        self.open_file.discard()
        if self.limits is not None:
            self._worker.shutdown(wait=True)
            with suppress(Exception):  # it could not be made
                self._next.result().discard()

    # -- blocks --------------------------------------------------------------------------------------------------------

    def _add_bytes(self, kind: Kind, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        if len(data) > MESSAGE_MAX_BYTES:
            raise UsageError(f"a message of {len(data)} bytes, allowed at most {MESSAGE_MAX_BYTES}")
        head, buffer = MESSAGE.pack(host_ns, len(data)), self._buffers[kind]
        if (needed := len(head) + len(data)) > buffer.room:
            self._flush(kind)
        if needed > buffer.room:
            self._write(*self._framed(kind, head + bytes(data)))
        else:
            buffer.add(head, data)

    def _flush(self, last: Kind) -> None:
        """Write the buffers up to `last` to the file."""
        before = self._buffers[Kind.DECISIONS].used
        if blocks := self._blocks_of(last):
            self._write(b"".join(blocks))
            self.open_file.n_decisions += (before - self._buffers[Kind.DECISIONS].used) // DECISION_DTYPE.itemsize

    def _blocks_of(self, last: Kind) -> list[bytes | memoryview]:
        """Empty the buffers up to `last` into the pieces of blocks, which must be written next."""
        pieces: list[bytes | memoryview] = []
        for kind, buffer in self._buffers.items():
            if buffer.used:
                data = buffer.empty()
                if kind == Kind.DECISIONS:
                    data = self.open_file.log.block(np.frombuffer(data, DECISION_DTYPE))
                elif kind == Kind.TIMINGS:
                    self._timed = 0
                pieces += self._framed(kind, data)
            if kind == last:
                break
        return pieces

    def _framed(self, kind: Kind, payload: bytes | memoryview) -> tuple[bytes, bytes | memoryview, bytes]:
        if kind in _FIRST_KINDS:
            self.replace_old()
        return self.open_file.framed(kind, payload)

    def _write(self, *pieces: bytes | memoryview) -> None:
        began_ns = time.perf_counter_ns()
        self.open_file.write(*pieces)
        if self.watch_write is not None:
            self.watch_write(began_ns, time.perf_counter_ns())


def load_kernels() -> None:
    """Compile or load what a recorder needs, which it would do when it is made."""
    _packing()
    LogEncoder()


def _packing() -> Any:
    from pans.record.reading.log_kernels import pack_stamped  # numba is loaded only by who records

    none = np.zeros(0, np.uint8)
    pack_stamped(none, np.zeros((0, 4), np.int64), 0, none, 0)
    return pack_stamped


def _finish_part(full: RecordingFile, following: str, struck: list[Path]) -> None:
    """Write END to a full part, and delete the oldest ones."""
    try:
        full.finish({"part_ended": "full", "next": following})
    finally:
        full.discard()
        for path in struck:
            path.unlink(missing_ok=True)


def _remove(old: Path) -> None:
    with refusing(f"{old}: cannot be replaced"):
        old.unlink(missing_ok=True)
