"""A hex trace of a link: every byte of both directions with its time, for looking at a conversation afterwards.

Owns the trace file; never changes a byte or a time. `TracedLink` is an ordinary Link around another one. One line per read or write:
seconds since the link was opened, `>` to the device or `<` from it, then the bytes in hex.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

from pans.runtime.errors import LinkError, UsageError
from pans.runtime.outputs import refuse_existing

from .base import Link


class TracedLink:
    """Passes everything on to `link` and writes it down; what is lost in the middle of a line is at most the last one."""

    def __init__(self, link: Link, path: Path, url: str = "", *, force: bool = False) -> None:
        self._link, self._url = link, url or link.name
        self.trouble = ""  # why the trace ended before the link did
        self._lock = threading.Lock()  # the reader's thread and the loop both write
        self._started_ns = link.now_ns()
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.now_ns = link.now_ns
        self.pause: Any = getattr(link, "pause", time.sleep)
        try:
            if force:
                path.unlink(missing_ok=True)
            self._file = open(path, "x", encoding="ascii", buffering=1)  # noqa: SIM115 - closed with the link
        except FileExistsError as error:
            raise refuse_existing(path) from error
        except OSError as error:
            raise UsageError(f"{path}: the trace cannot be written: {error.strerror or error}") from error
        self._note("#", f"{link.name} opened; > to the device, < from it; seconds since then")

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        try:
            data = self._link.read(timeout_s)
        except LinkError as error:
            self._note("#", error.message)
            raise
        if data:
            self._note("<", data.hex(" "))
        return data

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._note(">", data.hex(" "))
        self._link.write(data)

    def reopen(self) -> TracedLink:
        """Open the link again and go on with the same trace."""
        self._note("#", "opened again")
        reopen = getattr(self._link, "reopen", None)
        if reopen is not None:
            self._link = reopen()
        else:
            from .base import open_link

            self._link.close()
            self._link = open_link(self._url)
        return self

    def close(self) -> None:
        """Close the link, then the trace."""
        self._link.close()
        with self._lock:
            self._end()

    def _end(self) -> None:
        try:
            self._file.close()
        except OSError as error:  # what was still to be written
            self.trouble = error.strerror or str(error)

    def _note(self, mark: str, text: str) -> None:
        since_s = (self._link.now_ns() - self._started_ns) / 1e9
        with self._lock:
            if self._file.closed:
                return
            try:
                self._file.write(f"{since_s:.9f} {mark} {text}\n")
            except OSError as error:  # a run does not end because its trace cannot be written
                self.trouble = error.strerror or str(error)
                self._end()
