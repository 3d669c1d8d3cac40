"""The bytes of a run once more, through the compiled turn: what a faulty link gave to Python's turn, read from a socket by compiled code.

Owns the tape of a run and its second reading; never judges the first. `differences` says where the two are not the same, bit for bit.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.core.decision import DECISION_DTYPE, Decision, Output
from pans.runtime.core.still import Core
from pans.runtime.flow.core import FlowCore
from pans.runtime.link.base import Link
from pans.runtime.live import LiveRun
from pans.runtime.turn.engine import Limits
from pans.runtime.turn.streaming import Batch, StreamCore

from .flow_stream import FlowStream
from .reconciliation import ObservedLink

MOST_SENT = 1 << 15  # bytes in one piece through a socket whose pieces stay apart
AT_ONCE = Limits(due_ns=0)
Streamed = StreamCore | FlowStream


class TapedLink(ObservedLink):
    """An observed link that keeps what was read, piece by piece, and when it was opened again."""

    def __init__(self, link: Any) -> None:
        super().__init__(link)
        self.tape: list[tuple[str, Any]] = []

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        data = super().read(timeout_s)
        if data:
            self.tape.append(("bytes", data))
        return data

    def reopen(self) -> Link:
        """See `Link`."""
        self.tape.append(("opened", None))
        return super().reopen()

    def listen(self, run: LiveRun) -> None:
        """Keep when the core of `run` begins and ends a stream, too."""
        begin, end = run.core.begin, run.core.end

        def taped_begin(start_tick: int, n_cycles: int) -> Output:
            place = len(self.tape)
            output = begin(start_tick, n_cycles)
            self.tape[place:] = [
                ("begin", (run.connection.session.nonce, start_tick, n_cycles))
            ]  # which ends the one before
            return output

        def taped_end() -> Output:
            self.tape.append(("end", None))
            return end()

        for name, tap in (("begin", taped_begin), ("end", taped_end)):
            setattr(run.core, name, tap)


class SocketTwin:
    """A core behind the compiled turn, which reads from a socket what another core is given; `took` is how many messages it took."""

    def __init__(self, streamed: Streamed) -> None:
        self._streamed = streamed
        streamed.warm_up()  # who measures a call does not measure the compiler
        self.took = 0

    def takes(self, data: bytes, core: Core | FlowCore, decisions: Sequence[Decision]) -> str:
        """Read `data`; return where this core is not where `core` is, which made `decisions` of it, "" where they agree."""
        before = self._streamed.core.tracker.counters.messages
        rows = [batch.rows.copy() for batch in _sent(self._streamed, data)]
        again = self._streamed.core
        self.took = again.tracker.counters.messages - before
        wrong = unlike(again, core) + unlike_rows(rows, np.array(decisions, DECISION_DTYPE))
        return f"the compiled turn disagrees over {data[:100].hex()}: {'; '.join(wrong)}" if wrong else ""


def differences(
    tape: list[tuple[str, Any]], streamed: Streamed, core: Core | FlowCore, decisions: NDArray[np.void]
) -> list[str]:
    """Let `streamed` read `tape`; return where decisions, counters and tallies are not those of `core`, which read it first."""
    rows = [batch.rows.copy() for batch in _read_again(streamed, tape)]
    return [f"compiled turn: {words}" for words in unlike(streamed.core, core) + unlike_rows(rows, decisions)]


def unlike(again: Core | FlowCore, core: Core | FlowCore) -> list[str]:
    """Return in what `again`, behind the compiled turn, is not where `core` is."""
    names = ["n_decisions", "n_abstained", "completed", "last_tick", "jitter_ticks", "contradictions"]
    if isinstance(core, FlowCore):
        names += ["n_passages", "empty_frames", "dark_frames", "watched_frames"]
    compared = [(name, getattr(again, name), getattr(core, name)) for name in names]
    compared += [
        ("stream counters", again.tracker.counters, core.tracker.counters),
        ("tallies", again.tallies.tolist(), core.tallies.tolist()),
        ("place", again.tracker.position, core.tracker.position),
    ]
    if isinstance(core, FlowCore) and isinstance(again, FlowCore):
        compared.append(("empty field", again.empty_channels.tolist(), core.empty_channels.tolist()))
    return [f"{what} {one}, Python's {other}" for what, one, other in compared if one != other]


def unlike_rows(rows: list[NDArray[np.void]], decisions: NDArray[np.void]) -> list[str]:
    """Return the first row in which the compiled turn's decisions, in batches, are not `decisions`."""
    found = np.concatenate(rows) if rows else np.zeros(0, DECISION_DTYPE)
    if len(found) != len(decisions):
        return [f"decisions {len(found)}, Python's {len(decisions)}"]
    if found.tobytes() == decisions.tobytes():
        return []
    differ = np.flatnonzero(found != decisions)
    return [f"decision {differ[0]} is {found[differ[0]]}, Python's {decisions[differ[0]]}"] if differ.size else []


def _sent(streamed: Streamed, data: bytes) -> Iterator[Batch]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield from _through(streamed, data, ours, theirs)


def _through(streamed: Streamed, data: bytes, ours: socket.socket, theirs: socket.socket) -> Iterator[Batch]:
    for first in range(0, len(data), MOST_SENT):
        theirs.send(data[first : first + MOST_SENT])
        yield from streamed.listen(ours.fileno(), AT_ONCE)


def _read_again(streamed: Streamed, tape: list[tuple[str, Any]]) -> Iterator[Batch]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        for what, facts in tape:
            if what == "bytes":
                yield from _through(streamed, facts, ours, theirs)
            elif what == "opened":
                streamed.reopen()
            elif what == "begin":
                yield from streamed.begin(*facts)
            else:
                yield from streamed.end()
