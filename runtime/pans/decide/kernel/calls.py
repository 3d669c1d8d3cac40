"""`Kernel`: the calls of one connection's kernel, from bytes to rows.

`run` and `feed` say why a call ended; what came stands in properties that are valid until the next call. stream_core.py drives a core by
it without a live run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from pans.decide.follower import Standing
from pans.protocol.wire import CHUNK_BYTES, MARK_DTYPE, Frame, FrameDecoder, Messages, MessageType, unpack_body

from . import arrays as ring
from .arrays import I64, U8, Decoder, Drive, Rings, make_rings, no_drive

NO_END = 1 << 62
Bytes = bytes | bytearray | memoryview | U8


class Limits(NamedTuple):
    """When a call ends though all is ordinary: see arrays.py's control for the columns."""

    due_ns: int = NO_END
    patience_ns: int = 0
    eager_ns: int = 0
    budget: int = NO_END
    floor_ns: int = 0


class Counts(NamedTuple):
    """What a call reports, in the order of arrays.py's control: where each ring and the rows end, `rows`, the exposure that comes next."""

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
    rows: int
    following: int
    told: int
    ended: int


class Steps(Protocol):
    """The compiled steps of a core (still/kernel_state.CoreState, flow/core.FlowCore).

    `walk` is a tuple of arrays of its own class, for which receive.py chooses the kernel; its `state` is the record of the core
    (decide/core_state.py), its `rows` are decisions. `block_rows` are most of one block. `takes`: messages may be
    taken now; `decides`: the kernel gives each label at once.
    """

    @property
    def walk(self) -> Any: ...

    @property
    def takes(self) -> bool: ...

    @property
    def decides(self) -> bool: ...

    @property
    def block_rows(self) -> int: ...

    def rows(self, first: int, stop: int) -> npt.NDArray[np.void]: ...


NO_LIMITS = Limits()
_NOTHING = Counts._make([0] * len(Counts._fields))
PAGE_BYTES = 4096
BATCH_NS = 50_000_000  # for so long blocks are gathered: accounting costs the same for one block as for twenty
PS_PER_US = 1_000_000
BATCH_MESSAGES = 512  # at once from so many on: an eighth of the receive window


class Kernel:
    """The calls of `steps` on what `decoder` decodes; all memory is allocated here, before arming.

    `rows`, `blocks`, `messages` and the like give what a call brought, or a batch that `receive_batch` returned; they are valid until
    the next call, or until `release`.
    """

    def __init__(self, steps: Steps, decoder: FrameDecoder, drive: Drive | None = None) -> None:
        from .receive import turn  # numba is loaded only by who decides in bulk

        self.steps, self.decoder = steps, decoder
        self.rings: Rings = make_rings()
        self.begin = self.end = _NOTHING
        self._kernel = turn
        self._fed = self._nothing = (np.zeros(0, np.uint8), np.zeros((0, 2), np.int64))
        self._open = 1  # control[OPEN] of a call while the stream is open
        self._drive = no_drive() if drive is None else drive
        self.control: I64 = np.zeros(ring.N_CONTROL, np.int64)
        self.control[ring.FD], self.control[ring.HALVES] = -1, 1
        self.control[ring.BLOCK_ROWS] = steps.block_rows
        self.control[ring.SENT_EXPOSURE] = self.control[ring.SENT_STATE] = -1
        self.reported = self.control  # or what that was when a batch was handed over
        self._scratch: I64 = np.zeros(4, np.int64)
        self._decoder = Decoder(*decoder.arrays)
        self._walk = steps.walk

    def warm_up(self) -> None:
        """Compile or load the kernels and touch each page that they fill, before arming; nothing is read and nothing changes."""
        for array in (*self.rings, self._walk.rows, *self._decoder):
            pages = array.reshape(-1).view(np.uint8)[::PAGE_BYTES]
            pages |= 0  # writes what is there
        self.run()

    def drives(self, drive: Drive) -> None:
        """Name the states of walks by `drive` from here on."""
        self._drive = drive

    def run(self, fd: int = -1, limits: Limits = NO_LIMITS) -> int:
        """Process what is decoded, then read from `fd` (-1: nothing) until `limits`; return why it ended (arrays.WHY)."""
        return self._call(self._nothing, fd, limits)

    def _call(self, fed: tuple[U8, I64], fd: int, limits: Limits) -> int:
        control = self.control
        if fd >= 0:
            control[ring.FD] = fd
        control[ring.READS : ring.BUDGET + 1] = (fd >= 0, *limits[:4])
        control[ring.FLOOR_NS], control[ring.OPEN] = limits.floor_ns, self._open * self.steps.takes
        ended = self._kernel(*fed, self._decoder, self._walk, self._drive, self.rings, control, self._scratch)
        self._report(control)
        return int(ended)

    def _report(self, control: I64) -> None:
        """Take over what a call, or a batch, says of itself."""
        self.reported, self.end = control, Counts._make(control[ring.ERRNO :].tolist())
        first, row = control[[ring.FIRST, ring.FIRST_ROW]].tolist()
        kept = int(control[ring.HALF]) * (ring.KEPT_BYTES // int(control[ring.HALVES]))
        self.begin = Counts._make((0, 0, 0, *[first] * 6, kept, row, 0, 0, 0))

    # -- in a thread of its own ----------------------------------------------------------------------------------------

    def serve(self, fd: int, wake_fd: int, tell_fd: int) -> None:
        """Read `fd`, decide and answer until `stop`, in the thread of the caller, without the interpreter.

        `wake_fd` is the end of a pipe that is read, `tell_fd` one that is written whenever a batch is handed over. Before it begins, and
        whenever it is parked, `allow` says what it may do.
        """
        control = self.control
        control[[ring.FD, ring.WAKE_FD, ring.TELL_FD]] = fd, wake_fd, tell_fd
        control[ring.HALVES], control[ring.SERVES], control[ring.READS] = 2, 1, 1
        try:
            self._kernel(*self._nothing, self._decoder, self._walk, self._drive, self.rings, control, self._scratch)
        finally:
            control[ring.HALVES], control[ring.HALF], control[ring.SERVES] = 1, 0, 0

    def allow(
        self, patience_ns: int, floor_ns: int, batch_ns: int, *, tells_exposed: bool = False, tick_us: float = 0.0
    ) -> None:
        """Say what a serving kernel may do from here on; it is parked, or has not begun. The device may tell of its exposures.

        With the length of a tick, the kernel sleeps while no exposure can end a decision.
        """
        control, is_open = self.control, self.steps.takes
        control[ring.PATIENCE_NS], control[ring.FLOOR_NS] = patience_ns, floor_ns
        control[ring.OPEN] = is_open * (2 + tells_exposed)
        control[ring.BATCH_NS], control[ring.BATCH_MESSAGES] = batch_ns, BATCH_MESSAGES
        control[ring.TICK_PS] = round(tick_us * PS_PER_US)

    def stay_awake(self, now_ns: int) -> None:
        """Let a serving kernel be awake until the PONG comes of a probe that is about to leave; it has to be woken."""
        self.control[ring.PROBED_NS] = now_ns

    def receive_batch(self) -> bool:
        """Look at the batch that a serving kernel has handed over; False where there is none. `release` gives its half back."""
        if not self.control[ring.READY]:
            return False
        self._report(self.rings.handed)
        return True

    def release(self) -> bool:
        """Give the half of the last batch back; return whether the kernel waits for it, and has to be woken."""
        self.begin = self.end
        self.control[ring.READY] = 0
        return bool(self.control[ring.HUNGRY])

    def feed(self, chunks: Sequence[tuple[int, Bytes]]) -> int:
        """Take what was read elsewhere: one read or more, each with the time at which it came.

        Returns why it ended; `feed_on` goes on behind what ended it, until ALL_TAKEN.
        """
        times_ns, datas = zip(*chunks)
        if max(map(len, datas)) > CHUNK_BYTES:
            return self.feed([(at_ns, piece) for at_ns, data in chunks for piece in self.decoder.pieces(bytes(data))])
        reads = np.empty((len(datas), 2), np.int64)
        reads[:, 0], reads[:, 1] = tuple(map(len, datas)), times_ns
        self._fed = np.frombuffer(bytearray().join(datas), np.uint8), reads  # put together once, and writable
        self.control[ring.NEXT_READ : ring.READ_AT + 1] = 0
        self.control[ring.FD] = -1  # what is sent, the caller sends
        return self.feed_on()

    def feed_on(self) -> int:
        """Go on with what `feed` was given."""
        return self._call(self._fed, -1, NO_LIMITS)

    def hold(self, messages: Messages) -> None:
        """Process bodies of a recording in the calls of `run` that follow; STATUS and EXPOSED are passed, as by a serving kernel."""
        self._decoder, self._open = Decoder(*messages, self._decoder.tally), 3
        self.control[ring.PLACE : ring.ARRIVAL_NS + 1] = (0, len(messages.spans), 0)

    def stop(self) -> None:
        """End a call that is under way in another thread, and those that follow, at once."""
        self.control[ring.STOP] = 1

    # -- what came -----------------------------------------------------------------------------------------------------

    @property
    def arrival_ns(self) -> int:
        """When the bytes were read that were decoded last."""
        return int(self.control[ring.ARRIVAL_NS])

    @property
    def has_bodies(self) -> bool:
        """Whether decoded messages are left."""
        return bool(self.control[ring.PLACE] < self.control[ring.N_BODIES])

    @property
    def odd_type(self) -> int:
        """The type of the message that ended the call."""
        return int(self._decoder.buffer[self._decoder.bodies[int(self.control[ring.PLACE]), 0]])

    def take_odd(self) -> Frame:
        """Return the message that ended the call as a frame; the next call begins behind it."""
        decoder, place = self._decoder, int(self.control[ring.PLACE])
        first, stop = decoder.bodies[place].tolist()
        self.control[ring.PLACE] += 1
        self.end = self.end._replace(ended=ring.ALL_TAKEN)
        return unpack_body(decoder.buffer[first:stop].tobytes())

    @property
    def rows(self) -> npt.NDArray[np.void]:
        """The decisions of the call, DECISION_DTYPE (n,), in order."""
        return self.steps.rows(self.begin.rows, self.end.rows)

    @property
    def rows_by_block(self) -> I64:
        """How many decisions each of `blocks` gave, int64 (n,)."""
        return np.diff(self.blocks[:, ring.ROWS], prepend=self.begin.rows)

    @property
    def blocks(self) -> I64:
        """When each block came, was decoded, decided and kept, and what had come up to it: arrays.py's steps (n, N_STEP)."""
        return self.rings.steps[self.begin.steps : self.end.steps]

    @property
    def messages(self) -> I64:
        """Where the stream messages of the call stand in `kept`: arrays.py's spans (n, 4)."""
        return self.rings.messages[self.begin.messages : self.end.messages]

    @property
    def answers(self) -> I64:
        """Where the acknowledgements stand in `kept`."""
        return self.rings.answers[self.begin.answers : self.end.answers]

    @property
    def shows(self) -> I64:
        """Where the commands stand in `kept` that were sent."""
        return self.rings.shows[self.begin.shows : self.end.shows]

    @property
    def notes(self) -> I64:
        """The waits for bytes: arrays.py's notes (n, 4)."""
        return self.rings.notes[self.begin.notes : self.end.notes]

    @property
    def arrivals(self) -> I64:
        """When bytes were read, int64 (n,)."""
        return self.rings.arrivals[self.begin.arrivals : self.end.arrivals]

    @property
    def kept(self) -> U8:
        """The bytes that `messages`, `answers` and `shows` speak of."""
        return self.rings.kept

    def bytes_of(self, span: npt.NDArray[Any]) -> bytes:
        """Return what stands at one row of `messages`, `answers` or `shows`."""
        return self.kept[int(span[ring.BEGIN]) : int(span[ring.END])].tobytes()

    def heads(self, kind: MessageType, dtype: npt.DTypeLike) -> tuple[I64, npt.NDArray[np.void]]:
        """Return the spans of the messages of one kind, in order, and what each begins with: rows of `dtype`, BLOCK_DTYPE or MARK_DTYPE."""
        spans, size = self.messages[self.messages[:, ring.WHAT] == int(kind)], np.dtype(dtype).itemsize
        # what begins at each byte; `raw` is copied at once, its fields would be one by one
        raw: npt.NDArray[np.void] = np.ndarray(len(self.kept) - size + 1, f"V{size}", self.kept, strides=(1,))
        return spans, raw[spans[:, ring.BEGIN]].view(dtype)

    def passed(self) -> Iterator[tuple[int, Frame, Standing]]:
        """Yield each STATUS and EXPOSED that the kernel has passed: when it came, and where the stream stood then."""
        what = self.messages[:, ring.WHAT]
        for at in np.flatnonzero((what == int(MessageType.STATUS)) | (what == int(MessageType.EXPOSED))).tolist():
            span, standing = self.messages[at], self.rings.standings[self.begin.messages + at]
            yield int(span[ring.TIME]), unpack_body(self.bytes_of(span)), Standing._make(standing.tolist())

    def marks(self) -> npt.NDArray[np.void]:
        """Return the marks among `messages`, MARK_DTYPE (n,), in order."""
        return self.heads(MessageType.MARK, MARK_DTYPE)[1]
