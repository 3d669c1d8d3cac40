"""Receives the bytes of a run: the kernel reads and decides, then what it brought is accounted for.

`Receiver.receive` returns the outputs of what came: decisions in rows, events, the tick at which the last exposure ended. The kernel takes
what is ordinary; any other message is given to `LiveRun.take_frame`, which continues the same state.

Where the link has a descriptor and the kernel gives each label, the kernel serves in a thread of its own (deciding.py) and hands over
batches; deciding then never waits for the accounting. Else it is called in turn with the accounting.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pans.base.errors import LinkError
from pans.base.machine import give_way
from pans.decide import Follower, Output, RowDecisions
from pans.decide.kernel import QUIET_NS, Kernel, Limits, offered, unpack_blocks
from pans.decide.kernel import arrays as ring
from pans.decide.still import Core, CoreState
from pans.live.timing.causes import INFERENCE, NS_PER_S
from pans.protocol.clock import STEP_MARGIN_NS
from pans.protocol.links import Link, count_delimiters, descriptor_of
from pans.protocol.session import STREAM_TYPES, Refusal
from pans.protocol.wire import BLOCK_DTYPE, HEADER, MessageType, Opcode, decode_ack, unpack_body
from pans.record.reading import Kind

from .connection import Connection
from .deciding import PARK_GIVE_UP_S, DecidingThread

if TYPE_CHECKING:
    from .run import LiveRun, Taken

I64 = npt.NDArray[np.int64]

GATHERED_BYTES = 1 << 18
EAGER_NS = 200_000  # as protocol/links/reader.py: an answer that was asked for is waited for awake
LEAST_NS = 100_000
CALL_NS = (
    30_000_000  # a call in turn returns at least so often: signals, the watchdog's heartbeat, other threads' wishes
)
WAIT_NS = 100_000_000  # so does a wait for a batch


def why_fed(link: Link) -> str:
    """Return why the kernel cannot read `link` by itself, so that it is given the bytes; "" where it can."""
    if link.virtual:
        return "virtual time: what was read at once is taken at once"
    if descriptor_of(link) is None:
        return "Python reads the link, which has no descriptor"
    return offered() or ("" if has_host_clock(link) else "the link stamps with a clock of its own")


def has_host_clock(link: Link) -> bool:
    """Whether `link` has the clock that the kernel reads."""
    before_ns, there_ns = time.perf_counter_ns(), link.now_ns()
    return not link.virtual and before_ns <= there_ns <= time.perf_counter_ns() and not offered()


class Receiver:
    """The kernel's calls of `run`, across reconnections: `prepare` before each ARM, then `receive` again and again.

    With `prompt`, a call ends behind the first bytes that gave a decision, for a watcher that acts. `gather_ns` is for how long a kernel in
    a thread of its own gathers blocks before it hands them over.
    """

    def __init__(self, run: LiveRun, core: Follower, *, prompt: bool, gather_ns: int = 0) -> None:
        self._run, self._core, self._prompt, self._gather_ns = run, core, prompt, gather_ns
        self._thread: DecidingThread | None = None
        self._parked, self._parked_ns = False, 0  # whether the kernel waits for Python, and since when
        # whether the core takes a message without touching the rows of the batch before
        self._rows_stay = not core.moving
        self._kernel: Kernel | None = None
        self._attached: Connection | None = None
        self._fd: int | None = None
        self._stamps_itself = True  # whether the kernel's times are the link's
        self._asked = False  # what Python sent of a call is about to be answered
        self._gives_up = False  # nothing is sent any more

    @property
    def thread_id(self) -> int | None:
        """Native id of the thread that decides; None where that is the one that calls."""
        return None if self._thread is None else self._thread.thread_id

    def next_id(self) -> int:
        """Let a call that is under way end, from any thread; return the id that follows those of the commands that it has sent."""
        if self._kernel is None:
            return 0
        self._kernel.stop()
        if self._thread is not None:
            self._thread.wake()
        return int(self._kernel.control[ring.NEXT_ID])

    def close(self) -> None:
        """End the thread that decides."""
        if self._thread is not None:
            self._thread.close()

    def prepare(self) -> None:
        """Attach the kernel to the run's present connection, once; kernels are compiled or loaded."""
        run = self._run
        if self._attached is run.connection:
            return
        self._attached = run.connection
        nonce, bulk = run.connection.session.nonce, run.connection.decoder
        assert bulk is not None
        drive = None if run.driver is None else run.driver.arrays(nonce)
        self._kernel = Kernel(self._core.steps(nonce), bulk, drive)
        self._kernel.warm_up()
        self._warm_up(self._kernel)
        link = run.connection.link
        self._fd = None if why_fed(link) else descriptor_of(link)
        self._stamps_itself = has_host_clock(link)
        if self._may_serve(self._kernel) and self._thread is None:
            self._thread = DecidingThread()

    def _may_serve(self, kernel: Kernel) -> bool:
        """Whether `kernel` may decide in a thread of its own: it needs nobody's help for an ordinary message, and nobody acts on each."""
        return self._fd is not None and kernel.steps.decides and not self._prompt

    def _warm_up(self, kernel: Kernel) -> None:
        """Compile or load what settles a call."""

    def receive(self, poll_s: float) -> list[Output]:
        """Wait for bytes, decide on them and answer until something is due; return what came of it."""
        run, outputs = self._run, list[Output]()
        connection, kernel = run.connection, self._kernel
        assert kernel is not None
        if self.serves or self._begins_to_serve(kernel):
            self._receive_batch(kernel, outputs)
        elif self._fd is not None and connection.reader.lend():
            try:
                asked = connection.send_due()
                self._load(kernel)
                ended = self._sent(kernel, kernel.run(self._fd, self._limits(eager=asked)))
                self._settle(kernel, outputs)
            finally:
                connection.reader.take_back()
            self._continue(kernel, ended, outputs, kernel.run)
            if ended == ring.GONE:
                self._ask_why(kernel)
        elif chunks := self._gathered(poll_s):
            self._feed(kernel, chunks, outputs)
        connection.take_pongs()
        run.raise_broken()
        if not outputs:
            connection.raise_failure()
        return outputs

    def last(self, poll_s: float) -> None:
        """Receive while the device stops: no state is named any more."""
        if self._attached is self._run.connection:
            self.receive(poll_s)
        else:  # a new one, broken off before it was armed
            self._run.connection.pump(poll_s)

    def rest(self) -> None:
        """Take what has arrived on a connection that is given up; nothing is sent."""
        run, kernel = self._run, self._kernel
        if kernel is None or self._attached is not run.connection or run.connection is not run.armed:
            run.connection.rest()
            return
        self._gives_up = True
        self.stop_serving([])
        if chunks := run.connection.reader.rest():
            self._feed(kernel, chunks, [])
        self._gives_up = False

    # -- a kernel in a thread of its own -------------------------------------------------------------------------------

    @property
    def serves(self) -> bool:
        """Whether the kernel decides in a thread of its own now."""
        return self._thread is not None and self._thread.serves

    def _begins_to_serve(self, kernel: Kernel) -> bool:
        """Let the kernel serve, where it may and nothing waits that was read before."""
        run, thread = self._run, self._thread
        if thread is None or run.stops or self._gives_up or not self._may_serve(kernel):
            return False
        assert self._fd is not None
        if not kernel.steps.takes or not run.connection.reader.lend(long=True):
            return False
        self._allow(kernel)
        thread.start(kernel, self._fd)
        return True

    def _allow(self, kernel: Kernel) -> None:
        """Before the kernel begins to serve, or goes on: tell it how things stand."""
        self._load(kernel)
        lateness = self._run.lateness
        tells = self._run.connection.session.tells_exposed
        kernel.allow(lateness.longest_ns, lateness.evidence.floor_ns, self._gather_ns, tells_exposed=tells)

    def _receive_batch(self, kernel: Kernel, outputs: list[Output]) -> None:
        """Wait until a batch is handed over, and account for it; answer what only Python can answer."""
        run, thread = self._run, self._thread
        assert thread is not None
        run.connection.send_due()
        now_ns = run.now_ns()
        thread.wait(min(max(run.due_ns - now_ns, LEAST_NS), WAIT_NS) / NS_PER_S)
        if kernel.control[ring.OVERDUE]:
            kernel.control[ring.OVERDUE] = 0
            run.connection.session.probe(run.now_ns())
            run.connection.flush()
        self._take_batch(kernel, outputs)
        if not self._parked:
            return
        ended = kernel.end.ended
        if ended == ring.GONE:
            self.stop_serving(outputs)
            self._ask_why(kernel)
            return
        if ended == ring.ODD:  # of a flow
            self._take_odd(kernel, outputs)
        elif ended == ring.BROKEN:
            self._sent(kernel, ended)
        self._go_on(kernel)

    def _take_batch(self, kernel: Kernel, outputs: list[Output]) -> None:
        """Account for the batch that has been handed over, if there is one."""
        thread = self._thread
        assert thread is not None
        if not kernel.receive_batch():
            return
        self._parked, self._parked_ns = bool(kernel.reported[ring.PARKED]), self._run.now_ns()
        try:
            taken = self._settle(kernel, outputs)
            give_way()
            self._run.report(outputs)  # before the kernel writes over the rows
            if taken is not None:
                self._run.book_frame(taken, outputs)
        finally:  # a file that cannot be written must not make messages count twice
            if kernel.release():
                thread.wake()

    def _go_on(self, kernel: Kernel) -> None:
        thread, run = self._thread, self._run
        assert thread is not None
        self._allow(kernel)
        self._parked = False
        thread.go_on()
        run.lateness.evidence.parked(self._parked_ns, run.now_ns())

    def _park(self, kernel: Kernel, outputs: list[Output]) -> None:
        """Let the kernel wait for Python, with all accounted for that it has brought."""
        thread = self._thread
        assert thread is not None
        thread.ask_to_park()
        give_up_s = time.monotonic() + PARK_GIVE_UP_S
        while not self._parked:
            thread.wait(PARK_GIVE_UP_S / 10)
            self._take_batch(kernel, outputs)
            if time.monotonic() > give_up_s:
                raise LinkError("the thread that decides does not answer")

    @contextmanager
    def held(self, outputs: list[Output]) -> Iterator[None]:
        """While the block runs, the core may be changed: nothing is decided, and all is accounted for that came before."""
        kernel = self._kernel
        if kernel is None or not self.serves:
            yield
            return
        self._park(kernel, outputs)
        yield
        if kernel.end.ended == ring.ODD:  # of a flow: it was about to park for this one
            self._take_odd(kernel, outputs)
        kernel.control[ring.PARK] = 0
        self._go_on(kernel)

    def stop_serving(self, outputs: list[Output]) -> None:
        """From here on the kernel is called in turn; all is accounted for that came before."""
        kernel, run = self._kernel, self._run
        if kernel is None or self._thread is None or not self._thread.serves:
            return
        try:
            self._park(kernel, outputs)
        finally:
            self._thread.stop()
            self._parked = False
            run.connection.reader.take_back()
        self._continue(kernel, kernel.end.ended, outputs, kernel.run)

    # -- before a call -------------------------------------------------------------------------------------------------

    def _limits(self, *, eager: bool) -> Limits:
        run = self._run
        now_ns = run.now_ns()
        budget = 1 if self._prompt else max(run.messages_granted, 1)
        due_ns = min(now_ns + CALL_NS - QUIET_NS, max(run.due_ns, now_ns + LEAST_NS))
        patience_ns = run.lateness.patience_ns
        return Limits(due_ns, patience_ns, EAGER_NS if eager else 0, budget, run.lateness.evidence.floor_ns)

    def _load(self, kernel: Kernel) -> None:
        """Put what Python knows of the stream, the session and the driver where the kernel looks for it."""
        run, control, driver = self._run, kernel.control, self._run.driver
        next_id, oldest_id, oldest_ns, waiting = run.connection.session.window
        drives = driver is not None and not run.stops and not run.is_broken and not self._gives_up
        control[ring.DRIVES : ring.WAITING + 1] = (drives, waiting)
        control[ring.NEXT_ID : ring.OLDEST_NS + 1] = (next_id, oldest_id, oldest_ns)
        control[ring.BLOCK_NS] = run.lateness.block_ns
        if driver is not None:
            control[ring.SENT_EXPOSURE : ring.SENT_STATE + 1] = driver.sent
        self._core.steps(run.connection.session.nonce)

    def _gathered(self, poll_s: float) -> Sequence[tuple[int, bytes]]:
        """Return what Python has read; in virtual time many reads, where nobody acts on the first."""
        run = self._run
        connection, link = run.connection, run.connection.link
        chunks, self._asked = connection.chunks(poll_s, asked=self._asked), False
        core, ahead = self._core, link.reads_ahead
        gathers = isinstance(core, Core) and core.takes and run.driver is None and (core.windows.parallel or ahead)
        if not (link.virtual and gathers and chunks) or self._prompt:
            return chunks
        left = run.messages_granted - count_delimiters(chunks[0].data)
        more = connection.reader.ahead(poll_s, left, GATHERED_BYTES, run.due_ns)
        evidence, arrivals_ns = run.lateness.evidence, [chunks[-1].arrival_ns, *(arrival_ns for arrival_ns, _ in more)]
        evidence.arrived(*arrivals_ns[1:])
        if link.now_ns() > arrivals_ns[-1]:
            arrivals_ns.append(link.now_ns())  # the read that brought nothing
        began_ns, poll_ns = arrivals_ns[0], int(poll_s * NS_PER_S)
        for begin_ns, end_ns in pairwise(arrivals_ns):
            if end_ns - begin_ns > poll_ns:  # one wait each; those that end in time are one
                if begin_ns > began_ns:
                    evidence.waited(began_ns, begin_ns, begin_ns)
                evidence.waited(begin_ns, begin_ns + poll_ns, end_ns)
                began_ns = end_ns
        if arrivals_ns[-1] > began_ns:
            evidence.waited(began_ns, arrivals_ns[-1], arrivals_ns[-1])
        return [*chunks, *more]

    # -- after a call --------------------------------------------------------------------------------------------------

    def _feed(self, kernel: Kernel, chunks: Sequence[tuple[int, bytes]], outputs: list[Output]) -> None:
        """Take what Python has read."""
        self._load(kernel)
        ended = self._sent(kernel, kernel.feed(chunks))
        self._settle(kernel, outputs)
        self._continue(kernel, ended, outputs, kernel.feed_on)

    def _continue(self, kernel: Kernel, ended: int, outputs: list[Output], again: Callable[[], int]) -> None:
        """Deal with what ended a call until nothing that was read is left; no more is read."""
        while ended in (ring.ODD, ring.FULL, ring.BROKEN):
            if ended == ring.ODD:
                self._take_odd(kernel, outputs)
            self._load(kernel)
            self._run.report(outputs)  # before the rings are filled anew
            ended = self._sent(kernel, again())
            self._settle(kernel, outputs)

    def _take_odd(self, kernel: Kernel, outputs: list[Output]) -> None:
        """Let Python take one message that is not ordinary."""
        if (taken := self._taken(kernel)) is not None:
            self._run.book_frame(taken, outputs)

    def _taken(self, kernel: Kernel) -> Taken | None:
        """Let the core take one message that is not ordinary; None where it is the session's alone."""
        run, arrival_ns = self._run, kernel.arrival_ns
        connection, frame = run.connection, kernel.take_odd()
        if frame.type in STREAM_TYPES and frame.session == connection.session.nonce:
            connection.session.heard_ns = arrival_ns
            connection.delivered += 1
        elif not connection.sort(frame, arrival_ns):
            return None
        return run.take_frame(arrival_ns, frame)

    def _sent(self, kernel: Kernel, ended: int) -> int:
        """Send what is left of a command that the kernel could not send whole, all of it without a descriptor; return `ended`."""
        if ended == ring.BROKEN:
            last, unsent = kernel.rings.shows[kernel.end.shows - 1], kernel.end.unsent
            try:
                self._run.connection.link.write(kernel.bytes_of(last)[-unsent:])
                last[ring.TIME], self._asked = self._run.now_ns(), True
                if kernel.control[ring.OLDEST_ID] == kernel.control[ring.NEXT_ID] - 1:
                    kernel.control[ring.OLDEST_NS] = last[ring.TIME]
            except LinkError as error:
                self._run.note_broken(error)
        return ended

    def _ask_why(self, kernel: Kernel) -> None:
        """The descriptor says that the other end is gone: the link says it in its words."""
        link, errno = self._run.connection.link, kernel.end.errno
        try:
            self._run.connection.reader.wait(0.0)
            raise LinkError(f"{link.name} went away: {os.strerror(errno) if errno else 'closed by the other end'}")
        except LinkError as error:
            self._run.note_broken(error)

    def _note(self, kernel: Kernel) -> None:
        """Give what a call has waited for, and long decisions, to the evidence of what makes work late, in the order of time."""
        evidence, blocks = self._run.lateness.evidence, kernel.blocks
        worked = blocks[blocks[:, ring.DECIDED] - blocks[:, ring.DECODED] >= evidence.floor_ns]
        spans = [(ended, began, -1) for began, ended in worked[:, ring.DECODED : ring.DECIDED + 1].tolist()]
        spans += [(ended, began, asked) for began, asked, ended, _ in kernel.notes.tolist()]
        for ended, began, asked in sorted(spans) if len(worked) else spans:
            if asked < 0:
                evidence.worked(INFERENCE, began, ended)
            else:
                evidence.waited(began, asked, ended)
        evidence.arrived(*kernel.arrivals.tolist())

    def _settle(self, kernel: Kernel, outputs: list[Output]) -> Taken | None:
        """Account for what a call, or a batch, brought: session, driver, marks, recording, decisions.

        A kernel that is parked for an irregular message gets it taken and goes on before the decisions are accounted for; return what
        came of that message.
        """
        run, begin, end = self._run, kernel.begin, kernel.end
        taken: Taken | None = None
        if end.kept > begin.kept:
            connection = run.connection
            connection.session.heard_ns = end.heard_ns or connection.session.heard_ns
            connection.delivered += end.messages - begin.messages
            connection.answers += end.answers - begin.answers
            run.taken_here += end.messages - begin.messages
            self._settle_commands(kernel)
            self._stamp(kernel)
            give_way()  # between the parts, each of some 0.2 ms: nobody who is in a hurry waits for the whole
            if end.messages - begin.messages > end.steps - begin.steps:
                self._settle_marks(kernel)
            self._record(kernel)
            for arrival_ns, frame, standing in kernel.passed() if self.serves else ():
                if connection.digest(frame, arrival_ns):
                    run.book_frame(run.stepped(arrival_ns, frame, standing), outputs)
        if self.serves and end.ended == ring.ODD and self._rows_stay:
            taken = self._taken(kernel)
            self._go_on(kernel)
        if end.kept > begin.kept:
            give_way()
            if end.steps > begin.steps:
                self._settle_blocks(kernel, outputs)
        if not run.connection.link.virtual and (end.notes > begin.notes or end.arrivals > begin.arrivals):
            self._note(kernel)
        return taken

    def _stamp(self, kernel: Kernel) -> None:
        """Set the times of the blocks where the kernel has another clock than the link; in virtual time none passes in between."""
        if not self._stamps_itself:
            blocks, link = kernel.blocks, self._run.connection.link
            blocks[:, ring.DECODED : ring.RECORDED + 1] = (
                blocks[:, ring.ARRIVAL, None] if link.virtual else link.now_ns()
            )

    def _record(self, kernel: Kernel) -> None:
        """Record what a call took and sent."""
        recorder = self._run.recorder
        if recorder is not None:
            recorder.add_stamped(Kind.MESSAGES, kernel.kept, kernel.messages)
            recorder.add_stamped(Kind.ANSWERS, kernel.kept, kernel.answers)
            recorder.add_stamped(Kind.COMMANDS, kernel.kept, kernel.shows)

    def _settle_marks(self, kernel: Kernel) -> None:
        """Let the core know of the marks of a call."""
        self._core.remember_rows(kernel.marks())

    def _settle_commands(self, kernel: Kernel) -> None:
        """Bring the session and the driver to where the kernel has them, and give the session the answers that are left to it."""
        run, control, shows, answers = self._run, kernel.reported, kernel.shows, kernel.answers
        session = run.connection.session
        if control[ring.DRIVES]:
            first = int(control[ring.NEXT_ID]) - len(shows)
            open_since = max(int(control[ring.OLDEST_ID]), first)
            sent = [(n, kernel.bytes_of(shows[n - first])) for n in range(open_since, first + len(shows))]
            session.continue_from(int(control[ring.OLDEST_ID]), int(control[ring.OLDEST_NS]), sent, Opcode.SHOW)
            session.next_id = first + len(shows)
        for span in answers[answers[:, ring.WHAT] != ring.DONE] if len(answers) else ():
            body = kernel.bytes_of(span)
            if span[ring.WHAT] != ring.REFUSAL:
                run.connection.digest(unpack_body(body), int(span[ring.TIME]))
                continue
            ack = decode_ack(body[HEADER.size :])
            session.refusals.append(Refusal(ack.refused_id, ack.status, ack.text, Opcode.SHOW))
        if run.driver is not None and control[ring.DRIVES]:
            exposure, state = control[ring.SENT_EXPOSURE : ring.SENT_STATE + 1].tolist()
            run.driver.account((exposure, state), shows[:, ring.TIME] - shows[:, ring.WHAT])

    def _settle_blocks(self, kernel: Kernel, outputs: list[Output]) -> None:
        """Account for the blocks of a call and their decisions."""
        raise NotImplementedError

    def _ends_of(self, kernel: Kernel) -> tuple[I64, I64]:
        """Return when each block ended on the host's clock and how uncertain that is; what lies in the future is noted."""
        run, blocks = self._run, kernel.blocks
        ends_ns, unsure_ns = run.connection.known_clock().to_host_ns_many(blocks[:, ring.END_TICK])
        for at in np.flatnonzero(ends_ns - unsure_ns - STEP_MARGIN_NS > blocks[:, ring.ARRIVAL]).tolist():
            run.check_tick(int(blocks[at, ring.END_TICK]), int(blocks[at, ring.ARRIVAL]))
        return ends_ns, unsure_ns


class StillReceiver(Receiver):
    """The receiver of a run with objects that stand still."""

    def __init__(self, run: LiveRun, core: Core, *, prompt: bool, gather_ns: int = 0) -> None:
        super().__init__(run, core, prompt=prompt, gather_ns=gather_ns)
        self._still = core
        self._stamps, self._bits = np.ones(0, np.uint16), np.ones(0, np.uint8)
        if core.guard is not None and not core.windows.parallel:
            exposures = ring.KEPT_BYTES // 2  # two bytes each
            self._stamps, self._bits = np.ones(exposures, np.uint16), np.ones(exposures, np.uint8)

    def _warm_up(self, kernel: Kernel) -> None:
        unpack_blocks(kernel.kept, kernel.messages, self._stamps, self._bits)
        if self._run.recorder is not None:
            self._run.recorder.add_stamped(Kind.MESSAGES, kernel.kept, kernel.messages)

    def _settle_blocks(self, kernel: Kernel, outputs: list[Output]) -> None:
        run, blocks, steps = self._run, kernel.blocks, kernel.steps
        assert isinstance(steps, CoreState)
        rows = kernel.rows  # a back end that is not the kernel's decides here
        if not steps.decides and not run.connection.link.virtual:
            blocks[:, ring.DECIDED : ring.RECORDED + 1] = run.now_ns()
        events = self._watch(kernel)
        for event in events:
            run.journal.take(event)
        give_way()
        if self._still.guard is not None and not self._still.windows.parallel:
            self._still.watch_objects(rows)
            give_way()
        ends_ns, unsure_ns = self._ends_of(kernel)
        give_way()
        if len(rows):
            run.tally.add_rows(rows, steps.photons_of)
            give_way()
            if run.recorder is not None:
                run.recorder.add_decisions(rows)
            counts = kernel.rows_by_block
            some = counts > 0
            stamps = blocks[some, : ring.RECORDED + 1]
            run.account_times(int(rows["index"][0]), counts[some], ends_ns[some], unsure_ns[some], stamps)
        run.block_came(int(blocks[-1, ring.ARRIVAL]))
        outputs.append(Output(RowDecisions(rows), events, int(blocks[-1, ring.END_TICK])))

    def _watch(self, kernel: Kernel) -> list[Any]:
        """Let the guard of the dark counts see the exposures of a call."""
        core = self._still
        if core.guard is None:
            return []
        if core.windows.parallel:
            spans, heads = kernel.heads(MessageType.FRAMES, BLOCK_DTYPE)
            return core.watch_frames(_words_of(kernel.kept, spans, heads), heads)
        n = int(unpack_blocks(kernel.kept, kernel.messages, self._stamps, self._bits))
        return core.watch_blocks(self._stamps[:n], self._bits[:n], kernel.end.following - n)


def _words_of(kept: npt.NDArray[np.uint8], spans: I64, heads: npt.NDArray[np.void]) -> npt.NDArray[np.uint8]:
    """Return the words of all FRAMES of a call behind one another, uint8 (frames, bytes), as wide as the narrowest."""
    data, width = kept.data, int(heads["width"].min())
    bodies = [data[begin:end] for begin, end in (spans[:, : ring.END + 1] + [BLOCK_DTYPE.itemsize, 0]).tolist()]
    if width == heads["width"].max():
        return np.frombuffer(b"".join(bodies), np.uint8).reshape(-1, width)
    wide = zip(bodies, heads["width"].tolist())
    return np.concatenate([np.frombuffer(body, np.uint8).reshape(-1, n)[:, :width] for body, n in wide])
