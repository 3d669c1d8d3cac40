"""Being asked to stop: a signal becomes a word that the loop reads at the end of its turn, so that nothing is cut in its middle.

Owns the handlers while a command runs; the loop decides when to look. While nobody looks (setting up, waiting for a lost device, the second
time) the signal interrupts as Ctrl-C does.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = "interrupted"
ASKED_TO_STOP = "stopped by SIGTERM"


class Stop:
    """`word` is why to stop, "" while nobody has asked; `polled` is True while somebody looks at it again and again."""

    def __init__(self, *, continuous: bool = False) -> None:
        self.word = ""
        self.polled = False
        self._continuous = continuous

    def ask(self, signum: int, frame: FrameType | None) -> None:
        """Take a signal; a run without an end of its own ends well when SIGTERM asks for it."""
        second = bool(self.word)
        self.word = ASKED_TO_STOP if self._continuous and signum == signal.SIGTERM else INTERRUPTED
        if second or not self.polled:
            raise KeyboardInterrupt(self.word)


@contextmanager
def stop_signals(*, continuous: bool) -> Iterator[Stop]:
    """Turn SIGTERM, SIGINT and SIGHUP into a `Stop`, and put the handlers back afterwards; in the main thread only, else none comes."""
    stop = Stop(continuous=continuous)
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    names = [name for name in ("SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name)]
    before = {getattr(signal, name): signal.signal(getattr(signal, name), stop.ask) for name in names}
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
