"""The first sign of life: a line within half a second, and one more while kernels are compiled.

Nothing is printed where a command answers at once and where all kernels are in the cache.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .printing import say, state

FIRST_AFTER_S = 0.35
LOOK_EVERY_S = 0.05
LOOK_FOR_S = 60.0  # a command that has not loaded numba by then does not wait for it
COMPILING = "compiling kernels: once per machine, about 15 s"
_listening: list[Any] = []  # numba keeps listeners for good: one per process


@contextmanager
def first_sign(text: str) -> Iterator[None]:
    """Print `text` unless something else is printed soon; say so when kernels are compiled within the block."""
    ended = threading.Event()
    threading.Thread(target=_look, args=(text, ended), name="pans-first-sign", daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _look(text: str, ended: threading.Event) -> None:
    said, looked_s = False, 0.0
    while not (said and _listening) and looked_s < LOOK_FOR_S and not ended.wait(LOOK_EVERY_S):
        looked_s += LOOK_EVERY_S
        if not said and (state.said or looked_s >= FIRST_AFTER_S):
            if not state.said:
                say(text)
            said = True
        if not _listening and "numba.core.dispatcher" in sys.modules:
            _listen()


def _listen() -> None:
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        """Reports the first compilation only; kernels in the cache make no event."""

        def __init__(self) -> None:
            self.said = False

        def on_start(self, event: Any) -> None:
            if not self.said:
                self.said = True
                say(COMPILING)

        def on_end(self, event: Any) -> None:
            pass

    try:
        _listening.append(Listener())
        event.register("numba:compile", _listening[-1])
    except (AttributeError, ImportError):  # another numba: it compiles without being announced
        pass
