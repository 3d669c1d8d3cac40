"""A recording in parts: each one whole and replayable by itself, chained to the one before, the oldest deleted at a cap.

Owns when a part is full, the next one's making ahead of time, the index and the cap; blocks and files are record.py's, the place in the
stream at which a part may begin is the core's (`follower.part`). A thread of its own makes, syncs, closes and deletes files, so that the
loop never waits for a disk over a rotation. A full disk: the oldest closed parts of this run go first; when none is left, writing
fails and the run ends with RecordingError, light off, every part readable.
"""

from __future__ import annotations

import hashlib
import queue
import secrets
import shutil
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pans.runtime.container import canonical_json, replace_file
from pans.runtime.core.plan import Plan
from pans.runtime.core.plan_codec import plan_chunks
from pans.runtime.errors import PansError, UsageError
from pans.runtime.wire.commands import Arm, pack_arm, pack_plan
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import Opcode, encode_command

from .recorder import Recorder

PART_EVENT = "part"
INDEX_FORMAT = "pans-parts 1"
KEEPER_GOODBYE_S = 60.0
RETRY_S = 5.0
RESERVE_PARTS = 2  # of free disk, below which the oldest parts go before their time


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


@dataclass(frozen=True, slots=True)
class PartFacts:
    """What the index says of a part that is closed."""

    name: str
    bytes: int
    first_decision: int
    decisions: int
    decisions_sha256: str
    chain_sha256: str


def part_path(first: Path, number: int) -> Path:
    """Return the path of part `number`: `run.pansrec` becomes `run-0001.pansrec`."""
    return first.with_name(f"{first.stem}-{number:04d}{first.suffix}")


def index_path(first: Path) -> Path:
    """Return the path of the index beside the parts."""
    return first.with_name(f"{first.stem}.parts.json")


def chained(chain_sha256: str, decisions_sha256: str) -> str:
    """Return the hash over all parts' logs so far: SHA-256 of the one before ("" at first) and this part's, as hex texts."""
    return hashlib.sha256(f"{chain_sha256}{decisions_sha256}".encode("ascii")).hexdigest()


def repeated_setup(plan: Plan, arm: Arm, nonce: int) -> list[bytes]:
    """Return the plan and ARM as frames of session `nonce`: with them at its beginning a part can be replayed by itself."""
    bodies = [(Opcode.LOAD_PLAN, pack_plan(chunk)) for chunk in plan_chunks(plan)] + [(Opcode.ARM, pack_arm(arm))]
    return [encode_command(number, opcode, body, nonce) for number, (opcode, body) in enumerate(bodies, 1)]


class PartedRecorder:
    """Has the Recorder's calls, on the part that is open; `next_part` goes on in another one. One thread at a time, its own aside."""

    def __init__(
        self,
        path: str | Path,
        header: Mapping[str, Any],
        limits: PartLimits,
        *,
        bundle: bytes = b"",
        overwrite: bool = False,
    ) -> None:
        """Begin part 1 beside `path` (see `part_path`); UsageError if parts are there already, unless `overwrite`: then they go."""
        self.path, self.limits = Path(path), limits
        self.run = secrets.token_hex(8)
        self.watch_write: Callable[[int, int], None] | None = None
        self.parts = 0
        self._header, self._bundle = dict(header), bundle
        self._first_decision, self._chain = 0, ""
        self._closed: deque[PartFacts] = deque()
        self._deleted = {"parts": 0, "bytes": 0, "decisions": 0}
        self._news: deque[dict[str, Any]] = deque(maxlen=100)
        self._ready: queue.SimpleQueue[Recorder] = queue.SimpleQueue()
        self._unmade = 0  # the part that could not be made, and is tried again
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._clear(overwrite)
        self._now = self._make(1)
        self._keeper = threading.Thread(target=self._keep, name="pans-keeper", daemon=True)
        self._keeper.start()
        self._begin(self._now, {"decisions": 0}, ())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._now.__exit__(kind, error, trace)
        finally:
            self._end_keeper()

    # -- the Recorder's calls ------------------------------------------------------------------------------------------

    def add_message(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """See `Recorder`."""
        self._now.add_message(host_ns, data)

    def add_messages(self, host_ns: int, messages: Messages, first: int, count: int) -> None:
        """See `Recorder`."""
        self._now.add_messages(host_ns, messages, first, count)

    def add_command(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """See `Recorder`."""
        self._now.add_command(host_ns, data)

    def add_decision(self, record: Sequence[Any]) -> None:
        """See `Recorder`."""
        self._now.add_decision(record)

    def add_decisions(self, rows: NDArray[np.void]) -> None:
        """See `Recorder`."""
        self._now.add_decisions(rows)

    def add_timing(self, record: Sequence[Any]) -> None:
        """See `Recorder`."""
        self._now.add_timing(record)

    def add_event(self, event: Mapping[str, Any]) -> None:
        """See `Recorder`."""
        self._now.add_event(event)

    def add_clock(self, samples: NDArray[np.void]) -> None:
        """See `Recorder`."""
        self._now.add_clock(samples)

    def flush_decisions(self) -> None:
        """See `Recorder`."""
        self._now.flush_decisions()

    def flush(self) -> None:
        """See `Recorder`."""
        self._now.flush()

    def close(self, summary: Mapping[str, Any]) -> str:
        """Close the last part with `summary`, wait for the others, write the index; return the hash over all logs (`chained`)."""
        digest = self._now.close(summary)
        facts = self._facts(self._now, digest)
        self._tasks.put(lambda: self._settle(facts))
        self._end_keeper()
        return facts.chain_sha256

    # -- parts ---------------------------------------------------------------------------------------------------------

    @property
    def open_path(self) -> Path:
        """The part that is being written."""
        return part_path(self.path, self.parts)

    @property
    def wants_part(self) -> bool:
        """Whether the open part is full and the next one is ready to be written."""
        return self._now.size_bytes >= self.limits.rotate_bytes and not self._ready.empty()

    def next_part(self, place: Mapping[str, Any], commands: Iterable[bytes], host_ns: int) -> None:
        """Go on in the next part, which begins at `place` (of the core); `commands` repeat the plan and ARM, so that it stands alone."""
        made, full = self._ready.get_nowait(), self._now
        full.flush()
        facts = self._facts(full, full.written[1])
        self._first_decision, self._chain = facts.first_decision + facts.decisions, facts.chain_sha256
        made.path.rename(part_path(self.path, self.parts + 1))
        made.path = part_path(self.path, self.parts + 1)
        self._now = made
        self._begin(made, place, commands, host_ns, facts)
        full.watch_write = None  # from here on it is written by the keeper, which delays nobody
        self._tasks.put(lambda: self._finish(full, facts))

    def news(self) -> list[dict[str, Any]]:
        """Return what the keeper has to say since the last call, as events."""
        news = []
        while self._news:
            news.append(self._news.popleft())
        return news

    def _begin(
        self,
        part: Recorder,
        place: Mapping[str, Any],
        commands: Iterable[bytes],
        host_ns: int = 0,
        before: PartFacts | None = None,
    ) -> None:
        self.parts += 1
        part.watch_write = self._told
        part.add_event(
            {
                "kind": PART_EVENT,
                "number": self.parts,
                "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "first_decision": self._first_decision,
                "before": None if before is None else asdict(before),
                "place": dict(place),
            }
        )
        for data in commands:
            part.add_command(host_ns, data)
        part.flush()
        number = self.parts + 1
        self._tasks.put(lambda: self._prepare(number))

    def _told(self, began_ns: int, ended_ns: int) -> None:
        if self.watch_write is not None:
            self.watch_write(began_ns, ended_ns)

    def _facts(self, part: Recorder, digest: str) -> PartFacts:
        decisions = part.written[0]
        chain = chained(self._chain, digest)
        return PartFacts(self.open_path.name, part.size_bytes, self._first_decision, decisions, digest, chain)

    # -- the keeper's thread -------------------------------------------------------------------------------------------

    def _keep(self) -> None:
        while True:
            try:
                task = self._tasks.get(timeout=RETRY_S if self._unmade else None)
                if task is None:
                    return
                task()
            except queue.Empty:
                self._prepare(self._unmade)
            except PansError as error:
                self._news.append({"kind": "parts_trouble", "message": error.message})
            except OSError as error:
                self._news.append({"kind": "parts_trouble", "message": str(error)})

    def _end_keeper(self) -> None:
        if self._keeper.is_alive():
            self._tasks.put(None)
            self._keeper.join(KEEPER_GOODBYE_S)
        while not self._ready.empty():
            unused = self._ready.get()
            unused.__exit__(None, None, None)
            unused.path.unlink(missing_ok=True)

    def _make(self, number: int) -> Recorder:
        path = part_path(self.path, number)
        header = {**self._header, "part": {"number": number, "run": self.run, "file": path.name}}
        # under a hidden name until it is begun: a part that nobody wrote to is none
        return Recorder(path if number == 1 else path.with_name(f".{path.name}.next"), header, bundle=self._bundle)

    def _prepare(self, number: int) -> None:
        self._make_room()
        try:
            self._ready.put(self._make(number))
            self._unmade = 0
        except PansError as error:  # the open part goes on; when the disk is full, its next write says so
            if not self._unmade:
                self._news.append({"kind": "parts_trouble", "message": error.message})
            self._unmade = number

    def _finish(self, full: Recorder, facts: PartFacts) -> None:
        full.close({"part_ended": "full", "next": part_path(self.path, self.parts).name})
        self._settle(PartFacts(**{**asdict(facts), "bytes": full.size_bytes}))

    def _settle(self, facts: PartFacts) -> None:
        self._closed.append(facts)
        while self.limits.keep_bytes and self._kept_bytes() > self.limits.keep_bytes and len(self._closed) > 1:
            self._delete_oldest("the cap")
        self._write_index()

    def _kept_bytes(self) -> int:
        return sum(part.bytes for part in self._closed) + self.limits.rotate_bytes  # and the open one, when it is full

    def _make_room(self) -> None:
        needed = RESERVE_PARTS * self.limits.rotate_bytes
        while len(self._closed) > 1 and shutil.disk_usage(self.path.parent).free < needed:
            self._delete_oldest("the disk is nearly full")
            self._write_index()

    def _delete_oldest(self, why: str) -> None:
        oldest = self._closed.popleft()
        self.path.with_name(oldest.name).unlink(missing_ok=True)
        for key, value in (("parts", 1), ("bytes", oldest.bytes), ("decisions", oldest.decisions)):
            self._deleted[key] += value
        self._news.append({"kind": "part_deleted", "name": oldest.name, "bytes": oldest.bytes, "why": why})

    def _write_index(self) -> None:
        index = {
            "format": INDEX_FORMAT,
            "run": self.run,
            "parts": [asdict(part) for part in self._closed],
            "deleted": dict(self._deleted),
        }
        replace_file(index_path(self.path), canonical_json(index) + b"\n")

    def _clear(self, overwrite: bool) -> None:
        pattern = f"{self.path.stem}-[0-9]*{self.path.suffix}"
        there = [*self.path.parent.glob(pattern), *self.path.parent.glob(f".{pattern}.next")]
        if there and not overwrite:
            raise UsageError(
                f"{there[0]}: parts of another run are here", remedy="choose another folder, or allow overwriting"
            )
        for old in there:
            with suppress(FileNotFoundError):
                old.unlink()


AnyRecorder = Recorder | PartedRecorder
