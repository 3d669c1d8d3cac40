"""Receives the bytes of a run: the kernel reads and decides, and what it brought comes out as batches.

    for batch in receiver.receive(poll_s, due_ns): ...      # a batch is valid until the next one

The kernel takes what is ordinary; any other message is taken here, on the same state of the core. Nothing is recorded, shown or counted
here: that is done with each batch before the next one is made (accounts.py).

Where the link has a descriptor and the kernel gives each label, the kernel serves in a thread of its own (deciding.py) and hands over
batches; deciding then never waits for the accounting. Else it is called in turn with the accounting.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.base.errors import LinkError
from pans.base.machine import give_way
from pans.decide import DECISION_DTYPE, Action, Follower, Output, Standing
from pans.decide.kernel import NO_ENDS, QUIET_NS, Ends, Kernel, Limits, PhotonsOf, follow_up_of, offered
from pans.decide.kernel import arrays as ring
from pans.decide.plan import unknown_photons
from pans.decide.still import Core
from pans.live.timing.causes import INFERENCE, NS_PER_S
from pans.live.timing.lateness import Lateness
from pans.protocol.links import Link, count_delimiters, descriptor_of
from pans.protocol.session import ANSWER_TYPES, STREAM_TYPES, Refusal
from pans.protocol.wire import HEADER, Frame, Opcode, decode_ack, unpack_body

from .deciding import PARK_GIVE_UP_S, DecidingThread
from .drive import HostDriver
from .session import Session

Rows = npt.NDArray[np.void]

GATHERED_BYTES = 1 << 18  # of a virtual link, taken in one call: it makes thousands of blocks in the time of one call
EAGER_NS = 200_000  # as protocol/links/reader.py: an answer that was asked for is waited for awake
LEAST_NS = 100_000  # a wait that is due already would spin
# A call in turn returns at least so often, and a wait for a batch: signals, the watchdog's heartbeat, other threads' wishes.
CALL_NS, WAIT_NS = 30_000_000, 100_000_000


class Taken(NamedTuple):
    """A message that the core has taken, what came of it, and when it arrived, was decoded and decided, in ns."""

    frame: Frame
    output: Output
    times_ns: tuple[int, int, int]


class Pulse(NamedTuple):
    """A pulse that a decision asks for, when the bytes came that gave the decision, and when it was made, in ns; 0: no exposure gave it."""

    action: Action
    arrival_ns: int
    decided_ns: int


class Batch(NamedTuple):
    """What one call of the kernel brought, or one message that Python took; valid until the next batch.

    `kernel` is None where the kernel brought nothing: then there is `odd` alone. `rows` are its decisions, DECISION_DTYPE (n,), `ends` says
    when they ended, `photons_of` how bright their objects are. `outputs` is used once, behind the recording: the core sees there what the
    kernel has decided. `passed` are the STATUS and EXPOSED among the kernel's messages, `odd` is a message behind them; both have been
    taken by the core.
    """

    kernel: Kernel | None
    rows: Rows
    ends: Ends = NO_ENDS
    photons_of: PhotonsOf = unknown_photons
    outputs: Iterable[Output] = ()
    pulses: Sequence[Pulse] = ()
    passed: Sequence[Taken] = ()
    odd: Taken | None = None

    @property
    def has_block(self) -> bool:
        """Whether exposures came."""
        of_odd = self.odd is not None and self.odd.output.block_end_tick is not None
        return of_odd or (self.kernel is not None and self.kernel.end.steps > self.kernel.begin.steps)


Batches = Generator[Batch, None, None]
_NO_ROWS: Rows = np.zeros(0, DECISION_DTYPE)


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
    """The kernel's calls of one run, across reconnections: `attach` before each ARM, then `receive` again and again.

    With `prompt`, a call ends behind the first bytes that gave a decision, for a watcher that acts. `gather_ns` is for how long a kernel in
    a thread of its own gathers blocks before it hands them over.
    """

    def __init__(
        self, core: Follower, lateness: Lateness, driver: HostDriver | None, *, prompt: bool, gather_ns: int = 0
    ) -> None:
        self.driver = driver
        self.stops = False  # the device is being told to go dark: no state is named any more
        self._core, self._lateness, self._prompt, self._gather_ns = core, lateness, prompt, gather_ns
        self._follow_up = follow_up_of(core)
        self._thread: DecidingThread | None = None
        self._parked, self._parked_ns = False, 0  # whether the kernel waits for Python, and since when
        # whether the core takes a message without touching the rows of the batch before
        self._rows_stay = not core.moving
        self._kernel: Kernel | None = None
        self._session: Session | None = None
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

    def attach(self, session: Session) -> None:
        """Receive from `session` from here on; kernels are compiled or loaded."""
        if self._session is session:
            return
        self._session = session
        nonce = session.host.nonce
        drive = None if self.driver is None else self.driver.arrays(nonce)
        self._kernel = Kernel(self._core.steps(nonce), session.decoder, drive)
        self._kernel.warm_up()
        self._follow_up.warm_up(self._kernel)
        self._fd = None if why_fed(session.link) else descriptor_of(session.link)
        self._stamps_itself = has_host_clock(session.link)
        if self._may_serve(self._kernel) and self._thread is None:
            self._thread = DecidingThread()

    @property
    def session(self) -> Session:
        """The session that it is attached to."""
        assert self._session is not None
        return self._session

    def _may_serve(self, kernel: Kernel) -> bool:
        """Whether `kernel` may decide in a thread of its own: it needs nobody's help for an ordinary message, and nobody acts on each."""
        return self._fd is not None and kernel.steps.decides and not self._prompt

    def receive(self, poll_s: float, due_ns: int) -> Batches:
        """Wait for bytes, decide on them and answer, until `due_ns` at the latest; yield what came.

        Where Python reads, it waits `poll_s` at most. LinkError once all is yielded that came before the link broke.
        """
        session, kernel, came = self.session, self._kernel, False
        assert kernel is not None
        for batch in self._received(session, kernel, poll_s, due_ns):
            came |= bool(batch.odd or len(batch.rows) or batch.has_block or batch.passed)
            yield batch
        session.take_pongs()
        session.raise_broken()
        if not came:
            session.raise_failure()

    def _received(self, session: Session, kernel: Kernel, poll_s: float, due_ns: int) -> Batches:
        if self.serves or self._begins_to_serve(kernel):
            yield from self._receive_batch(kernel, due_ns)
        elif self._fd is not None and session.reader.lend():
            try:
                asked = session.send_due()
                self._load(kernel)
                ended = self._sent(kernel, kernel.run(self._fd, self._limits(due_ns, eager=asked)))
                yield self._brought(kernel)
            finally:
                session.reader.take_back()
            yield from self._continue(kernel, ended, kernel.run)
            if ended == ring.GONE:
                self._ask_why(kernel)
        elif chunks := self._gathered(poll_s, due_ns):
            yield from self._feed(kernel, chunks)

    def rest(self) -> Batches:
        """Yield what has arrived on a session that is given up; nothing is sent."""
        session, kernel = self.session, self._kernel
        assert kernel is not None
        self._gives_up = True
        try:
            yield from self.stop_serving()
            if chunks := session.reader.rest():
                yield from self._feed(kernel, chunks)
        finally:
            self._gives_up = False

    # -- a kernel in a thread of its own -------------------------------------------------------------------------------

    @property
    def serves(self) -> bool:
        """Whether the kernel decides in a thread of its own now."""
        return self._thread is not None and self._thread.serves

    def _begins_to_serve(self, kernel: Kernel) -> bool:
        """Let the kernel serve, where it may and nothing waits that was read before."""
        thread = self._thread
        if thread is None or self.stops or self._gives_up or not self._may_serve(kernel):
            return False
        assert self._fd is not None
        if not kernel.steps.takes or not self.session.reader.lend(long=True):
            return False
        self._allow(kernel)
        thread.start(kernel, self._fd)
        return True

    def _allow(self, kernel: Kernel) -> None:
        """Before the kernel begins to serve, or goes on: tell it how things stand."""
        self._load(kernel)
        lateness, tells = self._lateness, self.session.host.tells_exposed
        limits, tick_us = (lateness.longest_ns, lateness.evidence.floor_ns, self._gather_ns), self._core.plan.tick_us
        kernel.allow(*limits, tells_exposed=tells, tick_us=tick_us)

    def _receive_batch(self, kernel: Kernel, due_ns: int) -> Batches:
        """Wait until a batch is handed over, and yield it; answer what only Python can answer."""
        session, thread = self.session, self._thread
        assert thread is not None
        self._send(kernel, session.send_due)
        thread.wait(min(max(due_ns - session.link.now_ns(), LEAST_NS), WAIT_NS) / NS_PER_S)
        if kernel.control[ring.OVERDUE]:
            kernel.control[ring.OVERDUE] = 0
            session.host.probe(session.link.now_ns())
            self._send(kernel, session.flush)
        yield from self._handed_over(kernel)
        if not self._parked:
            return
        ended = kernel.end.ended
        if ended == ring.GONE:
            yield from self.stop_serving()
            self._ask_why(kernel)
            return
        if ended == ring.ODD:  # of a flow, or an answer
            yield from self._take_odd(kernel)
        elif ended == ring.BROKEN:
            self._sent(kernel, ended)
        self._go_on(kernel)

    def _send(self, kernel: Kernel, send: Callable[[], bool]) -> None:
        """Send by `send`. A clock probe wakes the kernel: the arrival of its PONG must not be the end of a sleep."""
        probes = self.session.host.has_probe
        if probes:
            kernel.stay_awake(self.session.link.now_ns())
        send()
        if probes and self._thread is not None:  # after the probe has left: waking takes as long as a good way there
            self._thread.wake()

    def _handed_over(self, kernel: Kernel) -> Batches:
        """Yield the batch that has been handed over, if there is one; then the kernel may write over it."""
        session, thread = self.session, self._thread
        assert thread is not None
        if not kernel.receive_batch():
            return
        self._parked, self._parked_ns = bool(kernel.reported[ring.PARKED]), session.link.now_ns()
        try:
            batch = self._brought(kernel)
            passed = [
                self._stepped(arrival_ns, frame, standing)
                for arrival_ns, frame, standing in kernel.passed()
                if session.digest(frame, arrival_ns)
            ]
            odd: Taken | None = None
            # An irregular message is taken before the accounting, so that the kernel waits for nothing else; an answer is not, since it
            # would be on record before those of this batch.
            if kernel.end.ended == ring.ODD and self._rows_stay and kernel.odd_type not in ANSWER_TYPES:
                odd = self._taken(kernel)
                self._go_on(kernel)
            yield batch._replace(passed=passed, odd=odd)
        finally:  # a file that cannot be written must not make messages count twice
            if kernel.release():
                thread.wake()

    def _go_on(self, kernel: Kernel) -> None:
        thread = self._thread
        assert thread is not None
        self._allow(kernel)
        self._parked = False
        thread.go_on()
        self._lateness.evidence.parked(self._parked_ns, self.session.link.now_ns())

    def _park(self, kernel: Kernel) -> Batches:
        """Let the kernel wait for Python, and yield all that it has brought."""
        thread = self._thread
        assert thread is not None
        thread.ask_to_park()
        give_up_s = time.monotonic() + PARK_GIVE_UP_S
        while not self._parked:
            thread.wait(PARK_GIVE_UP_S / 10)
            yield from self._handed_over(kernel)
            if time.monotonic() > give_up_s:
                raise LinkError("the thread that decides does not answer")

    def hold(self) -> Batches:
        """Decide on nothing until `resume`, so that the core may be changed; yield what came before."""
        if self._kernel is not None and self.serves:
            yield from self._park(self._kernel)

    def resume(self) -> Batches:
        """Go on after `hold`."""
        kernel = self._kernel
        if kernel is None or not self.serves:
            return
        if kernel.end.ended == ring.ODD:  # it was about to park for this one
            yield from self._take_odd(kernel)
        kernel.control[ring.PARK] = 0
        self._go_on(kernel)

    def stop_serving(self) -> Batches:
        """From here on the kernel is called in turn; yield what came before."""
        kernel = self._kernel
        if kernel is None or self._thread is None or not self._thread.serves:
            return
        try:
            yield from self._park(kernel)
        finally:
            self._thread.stop()
            self._parked = False
            self.session.reader.take_back()
        yield from self._continue(kernel, kernel.end.ended, kernel.run)

    # -- before a call -------------------------------------------------------------------------------------------------

    def _limits(self, due_ns: int, *, eager: bool) -> Limits:
        now_ns = self.session.link.now_ns()
        budget = 1 if self._prompt else max(self.session.granted(self._core.tracker.next_seq), 1)
        until_ns = min(now_ns + CALL_NS - QUIET_NS, max(due_ns, now_ns + LEAST_NS))
        patience_ns = self._lateness.patience_ns
        return Limits(until_ns, patience_ns, EAGER_NS if eager else 0, budget, self._lateness.evidence.floor_ns)

    def _load(self, kernel: Kernel) -> None:
        """Put what Python knows of the stream, the session and the driver where the kernel looks for it."""
        session, control, driver = self.session, kernel.control, self.driver
        next_id, oldest_id, oldest_ns, waiting = session.host.window
        control[ring.DRIVES : ring.WAITING + 1] = (self._drives, waiting)
        control[ring.NEXT_ID : ring.OLDEST_NS + 1] = (next_id, oldest_id, oldest_ns)
        control[ring.BLOCK_NS] = self._lateness.block_ns
        if driver is not None:
            control[ring.SENT_EXPOSURE : ring.SENT_STATE + 1] = driver.sent
        self._core.steps(session.host.nonce)

    @property
    def _drives(self) -> bool:
        """Whether the host names the states of walks, and still can."""
        return self.driver is not None and not self.stops and not self._gives_up and self.session.broken is None

    def _gathered(self, poll_s: float, due_ns: int) -> Sequence[tuple[int, bytes]]:
        """Return what Python has read; in virtual time many reads, where nobody acts on the first."""
        session, link, core = self.session, self.session.link, self._core
        chunks, self._asked = session.chunks(poll_s, asked=self._asked), False
        ahead = link.reads_ahead
        gathers = isinstance(core, Core) and core.takes and self.driver is None and (core.windows.parallel or ahead)
        if not (link.virtual and gathers and chunks) or self._prompt:
            return chunks
        left = session.granted(core.tracker.next_seq) - count_delimiters(chunks[0].data)
        more = session.reader.ahead(poll_s, left, GATHERED_BYTES, due_ns)
        evidence = self._lateness.evidence
        arrivals_ns = [chunks[-1].arrival_ns, *(arrival_ns for arrival_ns, _ in more)]
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

    def _feed(self, kernel: Kernel, chunks: Sequence[tuple[int, bytes]]) -> Batches:
        """Take what Python has read."""
        self._load(kernel)
        ended = self._sent(kernel, kernel.feed(chunks))
        yield self._brought(kernel)
        yield from self._continue(kernel, ended, kernel.feed_on)

    def _continue(self, kernel: Kernel, ended: int, again: Callable[[], int]) -> Batches:
        """Deal with what ended a call until nothing that was read is left; no more is read."""
        while ended in (ring.ODD, ring.FULL, ring.BROKEN):
            if ended == ring.ODD:
                yield from self._take_odd(kernel)
            self._load(kernel)
            ended = self._sent(kernel, again())
            yield self._brought(kernel)

    def _take_odd(self, kernel: Kernel) -> Batches:
        """Let Python take one message that is not ordinary."""
        if (taken := self._taken(kernel)) is not None:
            yield Batch(None, _NO_ROWS, odd=taken, pulses=_pulses_of(taken))

    def _taken(self, kernel: Kernel) -> Taken | None:
        """Let the core take one message that is not ordinary; None where it is the session's alone, or came before ARM."""
        session, arrival_ns, frame = self.session, kernel.arrival_ns, kernel.take_odd()
        if frame.type in STREAM_TYPES and frame.session == session.host.nonce:
            session.host.heard_ns = arrival_ns
            session.delivered += 1
        elif not session.sort(frame, arrival_ns):
            return None
        if not session.armed:
            return None
        session.taken += 1
        taken = self._stepped(arrival_ns, frame, None)
        if self._drives:  # name the next state before anything else is done with what has come
            assert self.driver is not None
            try:
                self.driver.turn(session, arrival_ns)
            except LinkError as error:
                session.note_broken(error)
        return taken

    def _stepped(self, arrival_ns: int, frame: Frame, standing: Standing | None) -> Taken:
        """Let the core take one message, as the stream stood then."""
        now_ns = self.session.link.now_ns
        decoded_ns = now_ns()
        output = self._core.step(frame, standing)
        decided_ns = now_ns()
        self._lateness.evidence.worked(INFERENCE, decoded_ns, decided_ns)
        return Taken(frame, output, (arrival_ns, decoded_ns, decided_ns))

    def _sent(self, kernel: Kernel, ended: int) -> int:
        """Send what is left of a command that the kernel could not send whole, all of it without a descriptor; return `ended`."""
        if ended == ring.BROKEN:
            last, unsent = kernel.rings.shows[kernel.end.shows - 1], kernel.end.unsent
            try:
                self.session.link.write(kernel.bytes_of(last)[-unsent:])
                last[ring.TIME], self._asked = self.session.link.now_ns(), True
                if kernel.control[ring.OLDEST_ID] == kernel.control[ring.NEXT_ID] - 1:
                    kernel.control[ring.OLDEST_NS] = last[ring.TIME]
            except LinkError as error:
                self.session.note_broken(error)
        return ended

    def _ask_why(self, kernel: Kernel) -> None:
        """The descriptor says that the other end is gone: the link says it in its words."""
        link, errno = self.session.link, kernel.end.errno
        try:
            self.session.reader.wait(0.0)
            raise LinkError(f"{link.name} went away: {os.strerror(errno) if errno else 'closed by the other end'}")
        except LinkError as error:
            self.session.note_broken(error)

    def _brought(self, kernel: Kernel) -> Batch:
        """Return what a call brought, or a batch of the thread: session, driver, marks and back end are brought to where the kernel is."""
        begin, end, session = kernel.begin, kernel.end, self.session
        if end.kept == begin.kept:
            return Batch(kernel, _NO_ROWS)
        messages = end.messages - begin.messages
        session.host.heard_ns = end.heard_ns or session.host.heard_ns
        session.delivered += messages
        session.taken += messages
        session.answers += end.answers - begin.answers
        self._settle_commands(kernel)
        if (
            not self._stamps_itself
        ):  # the kernel has another clock than the link; in virtual time none passes in between
            at_ns = kernel.blocks[:, ring.ARRIVAL, None] if session.link.virtual else session.link.now_ns()
            kernel.blocks[:, ring.DECODED : ring.RECORDED + 1] = at_ns
        give_way()  # between the parts, each of some 0.2 ms: nobody who is in a hurry waits for the whole
        if messages > end.steps - begin.steps:
            self._follow_up.marks(kernel)
        if end.steps == begin.steps:
            return Batch(kernel, _NO_ROWS)
        rows = kernel.rows  # a back end that is not the kernel's decides here
        outputs: Iterable[Output] = self._follow_up.outputs(kernel, rows)
        if not kernel.steps.decides:
            if self._core.moving:  # or here
                outputs = list(outputs)
            if not session.link.virtual:
                kernel.blocks[:, ring.DECIDED : ring.RECORDED + 1] = session.link.now_ns()
        blocks = kernel.blocks
        pulses = [
            Pulse(action, int(blocks[place, ring.ARRIVAL]), int(blocks[place, ring.DECIDED]))
            for action, place in self._follow_up.pulses(kernel)
        ]
        return Batch(kernel, rows, self._follow_up.ends(kernel), self._follow_up.photons_of(kernel), outputs, pulses)

    def _settle_commands(self, kernel: Kernel) -> None:
        """Bring the session and the driver to where the kernel has them, and give the session the answers that are left to it."""
        control, shows, answers, host = kernel.reported, kernel.shows, kernel.answers, self.session.host
        if control[ring.DRIVES]:
            first = int(control[ring.NEXT_ID]) - len(shows)
            open_since = max(int(control[ring.OLDEST_ID]), first)
            sent = [(n, kernel.bytes_of(shows[n - first])) for n in range(open_since, first + len(shows))]
            host.continue_from(int(control[ring.OLDEST_ID]), int(control[ring.OLDEST_NS]), sent, Opcode.SHOW)
            host.next_id = first + len(shows)
        for span in answers[answers[:, ring.WHAT] != ring.DONE] if len(answers) else ():
            body = kernel.bytes_of(span)
            if span[ring.WHAT] != ring.REFUSAL:
                self.session.digest(unpack_body(body), int(span[ring.TIME]))
                continue
            ack = decode_ack(body[HEADER.size :])
            host.refusals.append(Refusal(ack.refused_id, ack.status, ack.text, Opcode.SHOW))
        if self.driver is not None and control[ring.DRIVES]:
            exposure, state = control[ring.SENT_EXPOSURE : ring.SENT_STATE + 1].tolist()
            self.driver.account((exposure, state), shows[:, ring.TIME] - shows[:, ring.WHAT])


def _pulses_of(taken: Taken) -> list[Pulse]:
    """Return the pulses that a message asks for which Python took."""
    arrival_ns, _, decided_ns = taken.times_ns if taken.output.block_end_tick is not None else (0, 0, 0)
    return [Pulse(action, arrival_ns, decided_ns) for action in taken.output.actions]
