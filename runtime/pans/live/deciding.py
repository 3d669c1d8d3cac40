"""The thread in which the kernel receives and decides: it never waits for Python, and Python's accounting never delays a decision.

`DecidingThread.start` lets a kernel serve a descriptor; `wait` returns when it has handed over a batch (decide/kernel/receive.py says how).
The thread lives as long as the run, across reconnections: it keeps its priority and its core.
"""

from __future__ import annotations

import os
import queue
import select
import threading
from contextlib import suppress
from dataclasses import dataclass

from pans.base.errors import LinkError
from pans.decide.kernel import Kernel
from pans.decide.kernel import arrays as ring

PARK_GIVE_UP_S = 2.0  # a kernel waits 20 ms at most for a port that takes no more, and looks at the pipe then


@dataclass(slots=True)
class _Job:
    kernel: Kernel
    fd: int


class DecidingThread:
    """One thread for the kernels of a run, of which one serves at a time."""

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._idle = threading.Event()
        self._idle.set()
        self._kernel: Kernel | None = None
        self._wake_out, self._wake = os.pipe()  # read by the kernel, written here
        self._told, self._tell_out = os.pipe()
        for fd in self._pipes:
            os.set_blocking(fd, False)
        self._thread = threading.Thread(target=self._work, name="pans-deciding", daemon=True)
        self._thread.start()

    @property
    def _pipes(self) -> tuple[int, ...]:
        return self._wake_out, self._wake, self._told, self._tell_out

    @property
    def thread_id(self) -> int:
        """Native id of the thread, for the scheduler."""
        return self._thread.native_id or 0

    @property
    def serves(self) -> bool:
        """Whether a kernel has been started, and not been stopped."""
        return self._kernel is not None

    def start(self, kernel: Kernel, fd: int) -> None:
        """Let `kernel` serve `fd`; what it may do has been said by `Kernel.allow`."""
        kernel.control[[ring.PARK, ring.PARKED, ring.READY, ring.HUNGRY, ring.HANDED_NS]] = 0
        kernel.control[ring.OVERDUE_BLOCK_NS], kernel.control[ring.OVERDUE] = -1, 0
        self._kernel = kernel
        self._idle.clear()
        self._jobs.put(_Job(kernel, fd))

    def wait(self, timeout_s: float) -> None:
        """Wait until something has been handed over, at most `timeout_s`."""
        ready, _, _ = select.select([self._told], [], [], timeout_s)
        if ready:
            with suppress(BlockingIOError):
                os.read(self._told, 4096)
        elif self._idle.is_set() and self._kernel is not None and not self._kernel.control[ring.STOP]:
            raise RuntimeError("the thread that decides has ended")

    def wake(self) -> None:
        """Let the kernel look at what Python has changed."""
        with suppress(BlockingIOError):  # it is being woken
            os.write(self._wake, b"1")

    def ask_to_park(self) -> None:
        """Let the kernel hand over and park as soon as it can: a batch says that it has."""
        if self._kernel is not None:
            self._kernel.control[ring.PARK] = 1
            self.wake()

    def go_on(self) -> None:
        """Let the parked kernel go on."""
        if self._kernel is not None:
            self._kernel.control[ring.PARKED] = 0
            self.wake()

    def stop(self) -> None:
        """End the serving of the kernel; it is parked, and its batches are accounted for, or nobody will."""
        if self._kernel is None:
            return
        kernel, self._kernel = self._kernel, None
        kernel.control[ring.STOP] = 1
        self.wake()
        if not self._idle.wait(PARK_GIVE_UP_S):
            raise LinkError("the thread that decides does not end")
        kernel.control[[ring.STOP, ring.PARK, ring.PARKED, ring.READY, ring.HUNGRY]] = 0

    def close(self) -> None:
        """End the thread; idempotent."""
        if not self._thread.is_alive():
            return
        self.stop()
        self._jobs.put(None)
        self._thread.join(PARK_GIVE_UP_S)
        for fd in self._pipes:
            os.close(fd)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job.kernel.serve(job.fd, self._wake_out, self._tell_out)
            finally:
                self._idle.set()
