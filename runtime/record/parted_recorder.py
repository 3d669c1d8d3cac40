"""A recording in parts: each one whole and replayable by itself, chained to the one before.

Owns when a part is full and how the next one begins; blocks and files are recorder.py's, the folder is part_keeper.py's, and the place
in the stream at which a part may begin is the core's (`follower.part`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pans.runtime.core.decision import NumberedDecisions
from pans.runtime.core.plan import Plan
from pans.runtime.core.plan_codec import plan_commands
from pans.runtime.errors import PansError, RecordingError
from pans.runtime.wire.commands import Arm, pack_arm
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import Opcode, encode_command

from .format import Kind
from .part_keeper import PartFacts, PartKeeper, PartLimits, chained, part_path
from .recorder import Recorder

PART_EVENT = "part"


def repeated_setup(plan: Plan, arm: Arm, nonce: int) -> list[bytes]:
    """Return plan, states and ARM as frames of session `nonce`: with them at its beginning a part can be replayed by itself."""
    bodies = [*plan_commands(plan), (Opcode.ARM, pack_arm(arm))]
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
        """Begin part 1 beside `path` (see `part_path`); UsageError if parts are there already.

        With `overwrite` they go when there are messages, decisions or an end to write.
        """
        self.path, self.limits = Path(path), limits
        self.watch_write: Callable[[int, int], None] | None = None
        self.parts = 0
        self._is_kept = False  # elsewhere: its folder was deleted
        self._chain = ""
        self.keeper = PartKeeper(self.path, header, limits, bundle, overwrite)
        self.open_part = self.keeper.start()
        try:
            self._begin({"decisions": 0}, ())
            self.open_part.sync()  # a part with a name says where it begins; later ones cannot be waited for (`parts.part_of`)
            if self.keeper.replaces:
                self.open_part.before_first = self._take_place
            else:
                self.keeper.name(self.open_part, 1)
        except PansError:
            with suppress(OSError, PansError):
                self.__exit__(None, None, None)
                self.open_part.path.unlink()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        try:
            self.open_part.__exit__(*error)
        finally:
            self.keeper.close()
            if self.open_part.before_first is not None:
                with suppress(OSError):
                    self.open_part.path.unlink(missing_ok=True)

    # -- the Recorder's calls ------------------------------------------------------------------------------------------

    def add_message(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """See `Recorder`."""
        self.open_part.add_message(host_ns, data)

    def add_messages(self, host_ns: int, messages: Messages, first: int, count: int) -> None:
        """See `Recorder`."""
        self.open_part.add_messages(host_ns, messages, first, count)

    def add_stamped(self, kind: Kind, data: NDArray[np.uint8], spans: NDArray[np.int64]) -> None:
        """See `Recorder`."""
        self.open_part.add_stamped(kind, data, spans)

    def add_command(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """See `Recorder`."""
        self.open_part.add_command(host_ns, data)

    def add_answer(self, host_ns: int, data: bytes | bytearray | memoryview) -> None:
        """See `Recorder`."""
        self.open_part.add_answer(host_ns, data)

    def add_decision(self, record: Sequence[Any]) -> None:
        """See `Recorder`."""
        self.open_part.add_decision(record)

    def prepare(self, decisions: NumberedDecisions) -> None:
        """See `Recorder`."""
        self.open_part.prepare(decisions)

    def add_decisions(self, many: NDArray[np.void] | NumberedDecisions) -> None:
        """See `Recorder`."""
        self.open_part.add_decisions(many)

    def add_timing(self, record: Sequence[Any]) -> None:
        """See `Recorder`."""
        self.open_part.add_timing(record)

    def add_timing_runs(self, runs: NDArray[np.void]) -> None:
        """See `Recorder`."""
        self.open_part.add_timing_runs(runs)

    def add_event(self, event: Mapping[str, Any]) -> None:
        """See `Recorder`."""
        self.open_part.add_event(event)

    def add_clock(self, samples: NDArray[np.void]) -> None:
        """See `Recorder`."""
        self.open_part.add_clock(samples)

    def flush_decisions(self) -> None:
        """See `Recorder`."""
        self.open_part.flush_decisions()

    def flush(self) -> None:
        """See `Recorder`."""
        self.open_part.flush()

    @property
    def n_written(self) -> int:
        """See `Recorder`."""
        return self.open_part.n_written

    @property
    def is_deleted(self) -> bool:
        """See `Recorder`."""
        return self.open_part.is_deleted

    def keep_deleted(self) -> Path | None:
        """See `Recorder`; of the parts that were closed before nothing can be kept."""
        kept = self.open_part.keep_deleted()
        self._is_kept = self._is_kept or kept is not None
        return kept

    def close(self, summary: Mapping[str, Any]) -> str:
        """Close the last part with `summary`, wait for the others, write the index; return the hash over all logs (`chained`)."""
        self.keep_deleted()
        facts = self._facts(self.open_part, self.open_part.close(summary))
        if not self._is_kept:  # the index is for the folder that is gone
            self.keeper.settle(facts)
        self.keeper.close()
        if not self._is_kept and (trouble := self.keeper.trouble or self.keeper.index_trouble):
            raise RecordingError(
                f"the run has ended, and its recording is not whole: {trouble}", remedy="verify the folder of parts"
            )
        return facts.chain_sha256

    # -- parts ---------------------------------------------------------------------------------------------------------

    @property
    def open_path(self) -> Path:
        """The part that is being written."""
        return part_path(self.path, self.parts)

    @property
    def wants_part(self) -> bool:
        """Whether the open part is full and the next one is ready to be written; a deleted one is the last (`keep_deleted`)."""
        part = self.open_part
        return part.size_bytes >= self.limits.rotate_bytes and not self.keeper.ready.empty() and not part.is_deleted

    def next_part(self, place: Mapping[str, Any], commands: Iterable[bytes], host_ns: int) -> None:
        """Go on in the next part, which begins at `place` (of the core); `commands` repeat the plan and ARM, so that it stands alone."""
        full = self.open_part
        full.begin()
        full.flush()
        made = self.keeper.ready.get_nowait()
        facts = self._facts(full, full.written[1])
        made.first_decision, self._chain = facts.first_decision + facts.decisions, facts.chain_sha256
        self.open_part = made
        self._begin(place, commands, host_ns, facts)
        self.keeper.name(made, self.parts)
        full.watch_write = None  # from here on it is written by the keeper, which delays nobody
        self.keeper.finish(full, facts, self.open_path)

    def _take_place(self) -> None:
        self.keeper.clear()
        self.keeper.name(self.open_part, 1)

    def _begin(
        self, place: Mapping[str, Any], commands: Iterable[bytes], host_ns: int = 0, before: PartFacts | None = None
    ) -> None:
        self.parts += 1
        part = self.open_part
        part.watch_write = self._told
        part.add_event(
            {
                "kind": PART_EVENT,
                "number": self.parts,
                "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "first_decision": part.first_decision,
                "before": None if before is None else asdict(before),
                "place": dict(place),
            }
        )
        for data in commands:
            part.add_command(host_ns, data)
        part.flush()
        self.keeper.prepare(self.parts + 1)

    def _told(self, began_ns: int, ended_ns: int) -> None:
        if self.watch_write is not None:
            self.watch_write(began_ns, ended_ns)

    def _facts(self, part: Recorder, digest: str) -> PartFacts:
        decisions = part.written[0]
        chain = chained(self._chain, digest)
        return PartFacts(self.open_path.name, part.size_bytes, part.first_decision, decisions, digest, chain)
