"""How a signal ends a run, and the recorder of a run for days.

A signal becomes a word that the loop reads at the end of an iteration, so that nothing is cut in its middle; while the loop does not look
(setting up, waiting for a lost device, the second time) the signal interrupts as Ctrl-C does.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = "interrupted"
ASKED_TO_STOP = "stopped by SIGTERM"
DISK_NEARLY_FULL = "the disk is nearly full"
RECORDING_DELETED = "the recording was deleted during the run"
REFUSED = "the device refused: "  # and what it said
LOADERS = frozenset(("numba", "llvmlite", "importlib", "_frozen_importlib"))  # top-level modules
AGAIN_S = 0.02


class Stop:
    """`word` is why to stop, "" while nobody has asked; `polled` is True while somebody looks at it again and again."""

    def __init__(self, *, continuous: bool = False) -> None:
        self.word = ""
        self.polled = False
        self.raised = False  # KeyboardInterrupt, wherever the main thread was
        self._continuous = continuous
        self._waits = False  # a signal that came while libraries were loaded comes again
        self._again: threading.Timer | None = None

    def request(self, why: str) -> None:
        """Ask for an end at the end of a turn, from another thread; a signal that came before is the reason."""
        self.word = self.word or why

    def ask(self, signum: int, frame: FrameType | None) -> None:
        """Take a signal; a run without an end of its own ends well when SIGTERM asks for it."""
        second = bool(self.word) and not self._waits
        self._waits = False
        self.word = ASKED_TO_STOP if self._continuous and signum == signal.SIGTERM else INTERRUPTED
        if (second or not self.polled) and _is_loading(frame):
            self._waits = True
            self._again = threading.Timer(AGAIN_S, os.kill, (os.getpid(), signum))
            self._again.daemon = True
            self._again.start()
        elif second or not self.polled:
            self.raised = True
            raise KeyboardInterrupt(self.word)

    def obey(self) -> None:
        """Raise KeyboardInterrupt where a signal has asked for an end; it does not come again then."""
        if self.word:
            if self._again is not None:
                self._again.cancel()
            raise KeyboardInterrupt(self.word)


def _is_loading(frame: FrameType | None) -> bool:
    """Whether one of ours is waiting for a library that is imported or compiled: interrupted there, it may crash the process."""
    while frame is not None:
        module = str(frame.f_globals.get("__name__", ""))
        if module.startswith("pans."):
            return False
        if module.partition(".")[0] in LOADERS:
            return True
        frame = frame.f_back
    return False


def _outlives_its_terminal(number: int) -> bool:
    """Whether this is the end of the terminal, and nohup has been asked that it ends nothing."""
    return number == getattr(signal, "SIGHUP", None) and signal.getsignal(number) is signal.SIG_IGN


@contextmanager
def stop_signals(*, continuous: bool, stop: Stop | None = None) -> Iterator[Stop]:
    """Turn SIGTERM, SIGINT and SIGHUP into a `Stop`, and put the handlers back afterwards; in the main thread only, else none comes."""
    stop = stop or Stop(continuous=continuous)
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, stop.ask) for number in numbers if not _outlives_its_terminal(number)}
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
