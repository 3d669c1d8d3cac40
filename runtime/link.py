"""Device URLs -> an open link: bytes in, bytes out, and the clock they are stamped with.

Owns the schemes and the thread that reads; never looks into the bytes. `open_link` returns a `Link` (link_serial.py, link_usb.py, or a
driver by entry point, see docs/LINKS.md); `LinkReader` returns stamped chunks from any link, through a thread of its own where
the link blocks.
"""

from __future__ import annotations

import threading
from collections import deque
from importlib.metadata import entry_points
from typing import Any, NamedTuple, Protocol

from .errors import UsageError
from .link_serial import SerialLink
from .link_usb import UsbLink

READ_POLL_S = 0.05
MAX_QUEUED_BYTES = 1 << 24


class Link(Protocol):
    """An open connection to an instrument; a lab's own driver implements these and an opener (`pans.devices`).

    A link may also have `reopen() -> Link` (come back after an outage) and `pause(seconds)`; without them its URL is opened again.
    """

    name: str
    simulated: bool
    virtual: bool  # True: time passes only inside `read`, in one thread (the in-process simulator)

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, b"" after `timeout_s` without data; LinkError when the link is gone."""

    def write(self, data: bytes) -> None:
        """Send all of `data`; LinkError when the link is gone."""

    def now_ns(self) -> int:
        """Return this link's host clock in nanoseconds (monotonic; its zero means nothing)."""

    def close(self) -> None:
        """Release the port; idempotent."""


def open_link(url: str) -> Link:
    """Open the device that `url` names: `serial:...`, `usb:...`, or a scheme of the entry points `pans.devices` (`sim:` is one).

    Raises UsageError for a URL that cannot be meant and LinkError for a device that cannot be reached.
    """
    scheme, colon, rest = url.partition(":")
    if not colon or not rest:
        raise UsageError(
            f"{url!r} is no device URL", remedy="write scheme:target, for example sim:ideal or serial:/dev/ttyACM0"
        )
    if scheme == "serial":
        return SerialLink(rest.removeprefix("//"))
    if scheme == "usb":
        return UsbLink(rest)
    points = {point.name: point for point in entry_points(group="pans.devices")}
    if scheme not in points:
        known = ", ".join(sorted({"serial", "usb", *points}))
        raise UsageError(f"unknown device scheme {scheme!r} in {url!r}", remedy=f"known: {known}")
    link: Link = points[scheme].load()(url)
    return link


class Chunk(NamedTuple):
    """Bytes as they came from the link, with the host time at which they were there."""

    arrival_ns: int
    data: bytes


class LinkReader:
    """Stamped chunks from a link; a thread reads and only reads, unless the link's time is virtual.

    The queue is bounded by MAX_QUEUED_BYTES: above it the thread stops reading, so that the transport and then the receive
    window hold the device back. The thread's death is kept and raised by the next `wait`.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._chunks: deque[Chunk] = deque()
        self._queued_bytes = 0
        self._ready = threading.Condition()
        self._death: BaseException | None = None
        self._stopping = False
        self._thread: threading.Thread | None = None
        if not link.virtual:
            self._thread = threading.Thread(target=self._pump, name="pans-link-reader", daemon=True)
            self._thread.start()

    @property
    def thread_id(self) -> int | None:
        """Native id of the reading thread, for the scheduler; None without one."""
        return None if self._thread is None else self._thread.native_id

    def wait(self, timeout_s: float) -> list[Chunk]:
        """Return the chunks that are there, waiting at most `timeout_s` for the first; LinkError when the reader has died."""
        if self._thread is None:
            data = self._link.read(timeout_s)
            return [Chunk(self._link.now_ns(), data)] if data else []
        with self._ready:
            if not self._chunks and self._death is None:
                self._ready.wait(timeout_s)
            chunks = list(self._chunks)
            self._chunks.clear()
            self._queued_bytes = 0
            self._ready.notify_all()
        if not chunks and self._death is not None:
            raise self._death
        return chunks

    def stop(self) -> None:
        """Stop the thread; the link stays as it is."""
        self._stopping = True
        if self._thread is not None and self._thread is not threading.current_thread():
            with self._ready:
                self._ready.notify_all()
            self._thread.join(timeout=2.0)

    def close(self) -> None:
        """Stop the thread and close the link."""
        self.stop()
        self._link.close()

    def _pump(self) -> None:
        try:
            while not self._stopping:
                data = self._link.read(READ_POLL_S)
                if data:
                    self._put(Chunk(self._link.now_ns(), data))
        except BaseException as error:  # whatever ends the reader must end the run loudly, not leave it waiting
            with self._ready:
                self._death = error
                self._ready.notify_all()

    def _put(self, chunk: Chunk) -> None:
        with self._ready:
            while self._queued_bytes > MAX_QUEUED_BYTES and not self._stopping:
                self._ready.wait(READ_POLL_S)
            self._chunks.append(chunk)
            self._queued_bytes += len(chunk.data)
            self._ready.notify_all()


def link_facts(link: Link) -> dict[str, Any]:
    """Return what a recording should say about the link."""
    return {"name": link.name, "simulated": link.simulated, "virtual_time": link.virtual}
