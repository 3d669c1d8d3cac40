"""`Turn`: one connection's compiled turns, from bytes to rows, for a core whose steps are compiled.

Owns the arrays between Python and the kernels, and the hand-over of the core's state in each call; never opens, records or judges. `run`
says why it ended; what came stands in properties that are valid until the next `run`. A call that goes on in another thread (lasting.py)
is begun by `lasting`; the properties then show one bank at a time, `show_bank`, and when it has ended the rest, `show_rest`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from pans.runtime.core import stream_kernels as core_kernels
from pans.runtime.core.follower import Follower
from pans.runtime.wire.bulk import CHUNK_BYTES, BulkDecoder
from pans.runtime.wire.messages import Mark, MessageType, decode_mark
from pans.runtime.wire.schema import HEADER

from . import rings as ring
from .rings import I64, U8, Decoder, Drive, Rings, make_rings, no_drive

NO_END = 1 << 62


class Limits(NamedTuple):
    """When a call ends though all is ordinary: see rings.py's control for the columns."""

    due_ns: int = NO_END
    patience_ns: int = 0
    eager_ns: int = 0
    budget: int = NO_END
    floor_ns: int = 0


class Counts(NamedTuple):
    """What a call reports, or one of its banks, in the order of rings.py's control."""

    errno: int
    unsent: int
    heard_ns: int
    steps: int
    messages: int
    answers: int
    shows: int
    notes: int
    arrivals: int
    kept: int


class Steps(Protocol):
    """The compiled steps of a core (core.bulk_steps.BulkSteps, flow.steps.FlowSteps): they lend its state to kernels and take it back.

    `walk` is a tuple of arrays of its own class, for which kinds.py has the kernels; its `state` begins with the columns of
    core/stream_kernels.py, its `rows` are decisions. `block_rows` are most of one block; `decides`: kernels give each label at once.
    """

    @property
    def core(self) -> Follower: ...

    @property
    def walk(self) -> Any: ...

    @property
    def decides(self) -> bool: ...

    @property
    def block_rows(self) -> int: ...

    def load(self) -> None: ...

    def store(self, reported: I64 | None = None) -> None: ...

    def labelled(self, n: int, first: int = 0) -> npt.NDArray[np.void]: ...


NO_LIMITS = Limits()
_NOTHING = Counts(*[0] * len(Counts._fields))
_MARK = int(MessageType.MARK)
_FIRST = 3  # of the counts, the first that says up to where a ring is used


class Turn:
    """The turns of `steps` on what `decoder` decodes; all memory is allocated here, before arming."""

    def __init__(self, steps: Steps, decoder: BulkDecoder, drive: Drive | None = None) -> None:
        from .kernels import turn  # numba is loaded only by who decides in bulk

        self.steps, self.decoder = steps, decoder
        self.rings: Rings = make_rings(len(steps.walk.state))
        self.counts = self.first = _NOTHING  # how much there is, and where in the rings it begins
        self._row, self._n_rows = 0, 0
        self._kernel = turn
        self._fed = self._nothing = (np.zeros(0, np.uint8), np.zeros((0, 2), np.int64))
        self._drive = no_drive() if drive is None else drive
        self.control: I64 = np.zeros(ring.N_CONTROL, np.int64)
        self.reported = self.control  # what it was when what is shown was all that had come
        self.state: I64 = steps.walk.state  # of the walk, likewise
        self.control[ring.FD] = self.control[ring.WAKE_FD] = -1
        self.control[ring.BLOCK_ROWS] = steps.block_rows
        self.control[ring.SENT_EXPOSURE] = self.control[ring.SENT_STATE] = -1
        self._scratch: I64 = np.zeros(4, np.int64)
        self._decoder = Decoder(*decoder.arrays)
        self._walk = steps.walk

    def warm_up(self) -> None:
        """Compile or load the kernels, before arming; nothing is read and nothing changes."""
        from .shared import READY, ask

        self.run()
        ask(self.control, READY)

    def drives(self, drive: Drive) -> None:
        """Name the states of walks by `drive` from here on."""
        self._drive = drive

    def run(self, fd: int = -1, limits: Limits = NO_LIMITS) -> int:
        """Take what is decoded, then read from `fd` (-1: nothing) until `limits`; return why it ended (rings.WHY)."""
        return self._call(self._nothing, fd, limits)

    def _call(self, fed: tuple[U8, I64], fd: int, limits: Limits) -> int:
        self._prepare(fd, limits)
        ended = self._kernel(*fed, self._decoder, self._walk, self._drive, self.rings, self.control, self._scratch)
        self._show(0, 1, self.control, self._walk.state)
        return int(ended)

    def _prepare(self, fd: int, limits: Limits) -> None:
        control, steps = self.control, self.steps
        if fd >= 0:
            control[ring.FD] = fd
        control[ring.READS : ring.BUDGET + 1] = (fd >= 0, *limits[:4])
        control[ring.FLOOR_NS] = limits.floor_ns
        control[ring.OPEN] = steps.core.tracker.open
        control[ring.LASTING : ring.TAIL + 1] = 0
        control[ring.URGENT] = 0
        steps.load()

    def _show(self, bank: int, banks: int, reported: I64, state: I64) -> None:
        """Let the properties show `bank` of `banks`, and bring the core to where its `state` is."""
        self._look_at(bank, banks, reported, state)
        if self.counts.messages:
            self.steps.store(state)

    def _look_at(self, bank: int, banks: int, reported: I64, state: I64) -> None:
        self.reported, self.state = reported, state
        self._row = len(self._walk.rows) // banks * bank
        self._n_rows = int(state[core_kernels.N_ROWS]) - self._row
        self.first, self.counts = _NOTHING, Counts(*reported[ring.ERRNO :].tolist())
        if bank:
            self.first = Counts(*[0] * _FIRST, *[len(part) // banks * bank for part in self._parts])
            self.counts = Counts(*[count - begin for count, begin in zip(self.counts, self.first)])

    # -- a call that goes on -------------------------------------------------------------------------------------------

    @property
    def can_last(self) -> bool:
        """Whether a call may go on: each decision is the kernel's, and a bank holds those of any block."""
        return self.steps.decides and len(self._walk.rows) // ring.N_BANKS >= self.control[ring.BLOCK_ROWS]

    def lasting(self, fd: int, floor_ns: int) -> Callable[[], int]:
        """Return the call that reads `fd` and goes on until it is stopped or something is not ordinary; then only may others be made.

        `fd` -1: nothing is read and it ends at once.
        """
        self._prepare(fd, Limits(floor_ns=floor_ns))
        control = self.control
        control[ring.LASTING], control[ring.PUBLISH_NS] = 1, 0
        arguments = (*self._nothing, self._decoder, self._walk, self._drive, self.rings, control, self._scratch)
        return lambda: int(self._kernel(*arguments))

    def show_bank(self) -> None:
        """Show the next bank of a call that goes on, which has been published."""
        bank = int(self.control[ring.TAIL]) % ring.N_BANKS
        self._show(bank, ring.N_BANKS, self.rings.heads[bank], self.rings.states[bank])

    @contextmanager
    def shown_ahead(self, banks: int) -> Iterator[None]:
        """Let the properties show the published bank so many behind the next one meanwhile; the core stays where it is."""
        before = self.reported, self.state, self._row, self._n_rows, self.first, self.counts
        bank = (int(self.control[ring.TAIL]) + banks) % ring.N_BANKS
        self._look_at(bank, ring.N_BANKS, self.rings.heads[bank], self.rings.states[bank])
        try:
            yield
        finally:
            self.reported, self.state, self._row, self._n_rows, self.first, self.counts = before

    def show_rest(self) -> None:
        """Show the bank that a call, now ended, has not published; all others have been taken."""
        bank = int(self.control[ring.HEAD]) % ring.N_BANKS
        self._show(bank, ring.N_BANKS, self.control, self._walk.state)
        self.control[ring.STOP] = 0

    def feed(self, chunks: Sequence[tuple[int, bytes]]) -> int:
        """Take what was read elsewhere: one read or more, each with the time at which it came.

        Returns why it ended; `feed_on` goes on behind what ended it, until ALL_TAKEN.
        """
        times_ns, datas = zip(*chunks)
        if max(map(len, datas)) > CHUNK_BYTES:
            return self.feed([(at_ns, piece) for at_ns, data in chunks for piece in self.decoder.pieces(data)])
        reads = np.empty((len(datas), 2), np.int64)
        reads[:, 0], reads[:, 1] = tuple(map(len, datas)), times_ns
        self._fed = np.frombuffer(bytearray().join(datas), np.uint8), reads  # put together once, and writable
        self.control[ring.NEXT_READ : ring.READ_AT + 1] = 0
        return self.feed_on()

    def feed_on(self) -> int:
        """Go on with what `feed` was given."""
        return self._call(self._fed, -1, NO_LIMITS)

    def decoded(self, n_bodies: int, arrival_ns: int) -> int:
        """Take the bodies that the decoder has found in what it was given last."""
        self.control[ring.PLACE : ring.ARRIVAL_NS + 1] = (0, n_bodies, arrival_ns)
        return self.run()

    def stop(self) -> None:
        """End a call that is under way in another thread, and those that follow, at once."""
        self.control[ring.STOP] = 1

    # -- what came -----------------------------------------------------------------------------------------------------

    @property
    def arrival_ns(self) -> int:
        """When the bytes were read that were decoded last."""
        return int(self.control[ring.ARRIVAL_NS])

    @property
    def left(self) -> I64:
        """The spans of the decoder's bodies that have not been taken, int64 (n, 2)."""
        place, n = self.control[ring.PLACE : ring.N_BODIES + 1].tolist()
        return self._decoder.bodies[place:n]

    def skip(self, bodies: int = 1) -> None:
        """Count bodies that the caller has taken."""
        self.control[ring.PLACE] += bodies

    @property
    def rows(self) -> npt.NDArray[np.void]:
        """The decisions of the call, DECISION_DTYPE (n,), in order."""
        return self.steps.labelled(self._n_rows, self._row)

    @property
    def place(self) -> slice:
        """Where `rows` stand in the walk's, and what the walk has beside them."""
        return slice(self._row, self._row + self._n_rows)

    @property
    def blocks(self) -> I64:
        """When each block came, was decoded, decided and kept, and what had come up to it: rings.py's steps (n, N_STEP)."""
        return self._part(self.rings.steps, self.first.steps, self.counts.steps)

    @property
    def messages(self) -> I64:
        """Where the stream messages of the call stand in `kept`: rings.py's spans (n, 4)."""
        return self._part(self.rings.messages, self.first.messages, self.counts.messages)

    @property
    def answers(self) -> I64:
        """Where the acknowledgements stand in `kept`."""
        return self._part(self.rings.answers, self.first.answers, self.counts.answers)

    @property
    def shows(self) -> I64:
        """Where the commands stand in `kept` that were sent."""
        return self._part(self.rings.shows, self.first.shows, self.counts.shows)

    @property
    def notes(self) -> I64:
        """The waits for bytes: rings.py's notes (n, 4)."""
        return self._part(self.rings.notes, self.first.notes, self.counts.notes)

    @property
    def arrivals(self) -> I64:
        """When bytes were read, int64 (n,)."""
        return self._part(self.rings.arrivals, self.first.arrivals, self.counts.arrivals)

    @staticmethod
    def _part(part: I64, first: int, count: int) -> I64:
        return part[first : first + count]

    @property
    def _parts(self) -> tuple[npt.NDArray[Any], ...]:
        """The rings in the order of the counts."""
        rings = self.rings
        return rings.steps, rings.messages, rings.answers, rings.shows, rings.notes, rings.arrivals, rings.kept

    @property
    def kept(self) -> U8:
        """The bytes that `messages`, `answers` and `shows` speak of."""
        return self.rings.kept

    def bytes_of(self, span: npt.NDArray[Any]) -> bytes:
        """Return what stands at one row of `messages`, `answers` or `shows`."""
        return self.kept[int(span[ring.BEGIN]) : int(span[ring.END])].tobytes()

    def marks(self) -> list[Mark]:
        """Return the marks among `messages`, in order."""
        found = self.messages
        spans = found[found[:, ring.WHAT] == _MARK, : ring.END + 1].tolist()
        return [decode_mark(self.kept[begin + HEADER.size : end].tobytes()) for begin, end in spans]
