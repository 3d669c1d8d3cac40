"""A call of the compiled turn that goes on in a thread of its own, while another thread takes what it publishes.

Owns the thread, the hand-over of banks to whoever takes them, and who may write to the descriptor; what comes of a bank is the caller's.
The thread needs the interpreter only where a call begins and ends. Where the caller has real-time priority the thread goes one step above
it: whoever takes what came must not keep the next block waiting.
"""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from pans.runtime.timing.page_faults import ThreadCounts

from . import rings as ring
from .engine import Turn
from .shared import HOLD, LEAVE, READY, TAKEN, ask

STOP_S = 1.0  # for a call to see that it is to end
HOLD_S, HOLD_POLL_S = 0.05, 20e-6  # the kernel holds the descriptor for one command
DEAD_S = 1.0  # without a sign of life; one comes every 10 ms


class LastingCall:
    """The thread, from construction to `close`; one call at a time, `begin`, `wait` and `banks` again and again, `end`."""

    def __init__(self, *, wakes: bool = False) -> None:
        """With `wakes`, `wait` returns as soon as a bank has been published that is urgent (rings.URGENT)."""
        self.under_way = False
        self._wake: tuple[int, int] | None = _pipe() if wakes else None  # where a byte comes, and is written
        self.page_faults: dict[str, int] = {}  # of the thread during calls
        self._turn: Turn | None = None
        self._call: Callable[[], int] | None = None
        self._outcome: int | BaseException = 0
        self._beat, self._beat_s = -1, 0.0
        self._go, self._done, self._there = threading.Lock(), threading.Lock(), threading.Lock()
        for lock in (self._go, self._done, self._there):
            lock.acquire()
        self._thread = threading.Thread(target=self._work, name="pans-turn", daemon=True)
        self._thread.start()
        self._there.acquire()

    @property
    def thread_id(self) -> int | None:
        """Native id of the thread."""
        return self._thread.native_id

    def begin(self, turn: Turn, fd: int, floor_ns: int) -> None:
        """Begin a call that reads `fd`; `turn` is the thread's until `wait` or `end` says that it has ended."""
        self._turn, self._call = turn, turn.lasting(fd, floor_ns)
        turn.control[ring.WAKE_FD] = -1 if self._wake is None else self._wake[1]
        self._beat, self._beat_s, self.under_way = -1, time.monotonic(), True
        self._go.release()

    def wait(self, seconds: float) -> int | None:
        """Wait until the call has ended, at most so long; return why it did, None where it goes on."""
        if self._wake is None:
            return self._ended(seconds)
        if select.select([self._wake[0]], [], [], seconds)[0]:
            os.read(self._wake[0], 4096)
        return self._ended(0.0)

    def _ended(self, seconds: float) -> int | None:
        if not self._done.acquire(timeout=seconds):
            return None
        self.under_way = False
        if isinstance(self._outcome, BaseException):
            raise self._outcome
        return self._outcome

    def banks(self) -> Iterator[None]:
        """Let the turn show each bank that has been published, one after the other; it is taken when the next one is asked for."""
        turn = self._turn
        assert turn is not None
        for _ in range(self.published):
            turn.show_bank()
            try:
                yield
            finally:
                ask(turn.control, TAKEN)

    @property
    def published(self) -> int:
        """How many banks wait to be taken, that under way among them."""
        assert self._turn is not None
        return int(ask(self._turn.control, READY)) - int(self._turn.control[ring.TAIL])

    @property
    def is_behind(self) -> bool:
        """Whether more than one bank waits to be taken."""
        return self.published > 1

    def end(self) -> int | None:
        """Stop the call; return why it ended, None where it does not stop."""
        assert self._turn is not None
        self._turn.stop()
        return self._ended(STOP_S)

    @property
    def lives(self) -> bool:
        """Whether the call has given a sign of life in the last DEAD_S, or none is under way."""
        if not self.under_way or self._turn is None:
            return True
        beat, now_s = int(self._turn.control[ring.BEAT]), time.monotonic()
        if beat != self._beat:
            self._beat, self._beat_s = beat, now_s
        return now_s - self._beat_s < DEAD_S

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Keep the kernel from writing: a frame is never put into the middle of another one."""
        turn = self._turn
        assert turn is not None
        until_s, held = time.monotonic() + HOLD_S, False
        while not (held := bool(ask(turn.control, HOLD))) and time.monotonic() < until_s:
            time.sleep(HOLD_POLL_S)
        try:
            yield
        finally:
            if held:
                ask(turn.control, LEAVE)

    def close(self) -> None:
        """End the thread, unless its call does not stop: it then is left behind."""
        if self.under_way and self.end() is None:
            return
        self._call = None
        if self._thread.is_alive():
            self._go.release()
            self._thread.join()
        if self._wake is not None:
            for fd in self._wake:
                os.close(fd)
            self._wake = None

    def _work(self) -> None:
        _go_above()
        self._there.release()
        while self._go.acquire() and self._call is not None:
            counts = ThreadCounts()
            try:
                self._outcome = self._call()
            except BaseException as error:  # whoever waits must learn of it
                self._outcome = error
            for name, count in counts.since().items():
                self.page_faults[name] = self.page_faults.get(name, 0) + count
            self._done.release()
            if self._wake is not None:
                with suppress(BlockingIOError):  # it is awake anyhow
                    os.write(self._wake[1], b"\0")


def _pipe() -> tuple[int, int]:
    """Return the ends of a pipe that never lets a writer wait."""
    ends = os.pipe()
    for end in ends:
        os.set_blocking(end, False)
    return ends


def _go_above() -> None:
    """Give this thread, which has its creator's priority, one step more where that is a real-time one."""
    if hasattr(os, "sched_setscheduler") and os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        with suppress(OSError):
            more = os.sched_param(os.sched_getparam(0).sched_priority + 1)
            os.sched_setscheduler(0, os.sched_getscheduler(0), more)
