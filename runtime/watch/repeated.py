"""A call that is repeated in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Repeated:
    """Makes `call` every `every_s` seconds, the first time after as long, until `close`."""

    def __init__(self, name: str, every_s: float, call: Callable[[], object]) -> None:
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._keep, args=(every_s, call), name=name, daemon=True)
        self._thread.start()

    def _keep(self, every_s: float, call: Callable[[], object]) -> None:
        while not self._ending.wait(every_s):
            call()

    def close(self, patience_s: float | None = None) -> None:
        """Call no more, and wait for a call under way, at most `patience_s`."""
        self._ending.set()
        self._thread.join(patience_s)
