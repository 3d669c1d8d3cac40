"""The end of a run that does not end itself: stuck in a back end or in a call of the file system when a signal asks for its end.

A thread of its own receives the signal even where the main thread cannot (`signal.set_wakeup_fd`): the device is told to stop, what is
buffered is written as far as that does not block, the state file and stderr say where the loop was, and the process exits. A run that ends
in its own time is left alone. Native code that keeps the interpreter's lock stops this thread too: then the lease turns the light off, and
only SIGKILL ends the process.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING, Self

from pans.base.errors import EXIT_INTERRUPTED, EXIT_TIMING
from pans.live.stop import ASKED_TO_STOP, INTERRUPTED

if TYPE_CHECKING:
    from pans.live.status import Status
    from pans.record.recorder import Recorder

# A loop that turns reads the signal within 20 ms and takes at most 1 s until the device has said that it is dark.
LIGHT_OFF_AFTER_S = 1.5
END_AFTER_S = 3.5  # with the steps below the process is gone 5 s after the signal
CLOSING_END_AFTER_S = 30.0  # once the light is off and only files are closed: a slow disk may take long to sync
STEP_S = 0.4  # for each step of the end that might block
SIGNALS = frozenset(int(getattr(signal, name)) for name in ("SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name))


class Watchdog:
    """Ends this process when it was asked to end and does not; to be entered in the main thread, inside `stop_signals`."""

    def __init__(self, *, continuous: bool) -> None:
        self.run: Status | None = None
        self.recorder: Recorder | None = None  # to be flushed
        self.note: Callable[[str], object] = str  # is called with why the process ends
        self.closes = False  # from here on the light is off and files are closed
        self._continuous = continuous
        self._done = threading.Event()
        self._main = threading.get_ident()

    def __enter__(self) -> Self:
        self._receiver, self._sender = socket.socketpair()
        self._sender.setblocking(False)
        self._before = -1
        if threading.current_thread() is threading.main_thread():
            self._before = signal.set_wakeup_fd(self._sender.fileno(), warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._listen, name="pans-watchdog", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        if threading.current_thread() is threading.main_thread():
            signal.set_wakeup_fd(self._before)
        self._sender.close()  # the thread reads the end
        self._thread.join()
        self._receiver.close()

    def _listen(self) -> None:
        while data := self._receiver.recv(64):
            if asked := SIGNALS & set(data):
                self._wait_for_end(min(asked), time.monotonic())
                return

    def _wait_for_end(self, signum: int, asked_s: float) -> None:
        """Wait for the run to end, and end it when it does not."""
        if self._is_done_by(asked_s + LIGHT_OFF_AFTER_S):
            return
        if self.run is not None and not self.run.receiver.stops:
            session, receiver = self.run.session, self.run.receiver
            # in the loop's place
            _within(STEP_S, lambda: session.link.write(session.host.stop_frames(receiver.next_id())))
        if self._is_done_by(asked_s + END_AFTER_S):
            return
        while self.closes or (
            self.run is not None and self.run.stopped
        ):  # a busy machine is slow to close links and files
            if self._done.wait(0.1):
                return
            if time.monotonic() >= asked_s + CLOSING_END_AFTER_S:
                break
        self._end_process(signum)

    def _is_done_by(self, at_s: float) -> bool:
        return self._done.wait(max(0.0, at_s - time.monotonic()))

    def _end_process(self, signum: int) -> None:
        asked = ASKED_TO_STOP if self._continuous and signum == signal.SIGTERM else INTERRUPTED
        stack = _stack_of(self._main)
        code = stack[0].f_code
        place = f"{code.co_qualname}, line {stack[0].f_lineno} of {os.path.basename(code.co_filename)}"
        why = f"{asked}: the run did not end by itself; it was in {place}"
        # The main thread is not in the recorder, and is not expected back: what is buffered can be written from here.
        modules = [str(frame.f_globals.get("__name__", "")) for frame in stack]
        if self.recorder is not None and not any(name.startswith("pans.record") for name in modules):
            _within(STEP_S, self.recorder.flush)
        _within(STEP_S, lambda: self.note(why))
        shown = "\x1b[?25h" if sys.stderr.isatty() else ""  # a live view had hidden the cursor
        _within(STEP_S, lambda: os.write(2, f"{shown}pans: {why}\n".encode(errors="replace")))
        os._exit(EXIT_TIMING if asked == ASKED_TO_STOP else EXIT_INTERRUPTED)


def _within(seconds: float, call: Callable[[], object]) -> None:
    """Make `call` in a thread and wait that long for it: one that blocks is left behind."""

    def work() -> None:
        with suppress(Exception):  # nothing may keep the process from its end
            call()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(seconds)


def _stack_of(thread_id: int) -> list[FrameType]:
    """Return the frames of a thread that lives, the innermost first."""
    stack = [sys._current_frames()[thread_id]]
    while (frame := stack[-1].f_back) is not None:
        stack.append(frame)
    return stack
