"""Device URLs -> an open link: bytes in, bytes out, and the clock they are stamped with.

Owns ports and the thread that reads them; never looks into the bytes. `open_link` returns a `Link`; `LinkReader` returns
stamped chunks from any link, through a thread of its own where the link blocks.
"""

from __future__ import annotations

import select
import sys
import threading
import time
from collections import deque
from importlib.metadata import entry_points
from typing import Any, NamedTuple, Protocol

from .errors import LinkError, UsageError

READ_BYTES = 1 << 16
READ_POLL_S = 0.05
MAX_QUEUED_BYTES = 1 << 24


class Link(Protocol):
    """An open connection to an instrument; a lab's own driver implements these five and an opener (`pans.devices`)."""

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


class SerialLink:
    """pyserial behind the Link protocol: a device file, a COM port, a pty or `socket://`."""

    simulated = False
    virtual = False

    def __init__(self, target: str, baud: int = 4_000_000) -> None:
        import serial

        self.name = f"serial:{target}"
        self._errors: tuple[type[BaseException], ...] = (serial.SerialException, OSError, TypeError)
        # With a file descriptor the wait is select's: then one read returns all that is there, where pyserial's own
        # in_waiting says 1 for socket:// whatever has arrived. Windows COM handles have no descriptor.
        self._selectable = target.startswith("socket://") or sys.platform != "win32"
        try:
            self._port = serial.serial_for_url(
                target,
                **({} if "://" in target else {"baudrate": baud, "exclusive": True}),
                timeout=0 if self._selectable else READ_POLL_S,
                write_timeout=2.0,
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise LinkError(
                f"cannot open {self.name}: {error}",
                remedy="check the name, the cable and that no other program holds it",
            ) from error

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        try:
            if not self._selectable:
                return bytes(self._port.read(self._port.in_waiting or 1))
            ready, _, _ = select.select([self._port.fileno()], [], [], timeout_s)
            if not ready:
                return b""
            data = bytes(self._port.read(READ_BYTES))
        except self._errors as error:
            raise LinkError(f"{self.name} went away while reading: {error}") from error
        if not data:
            raise LinkError(f"{self.name} was closed by the other end")
        return data

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        try:
            self._port.write(data)
        except self._errors as error:
            raise LinkError(f"{self.name} went away while writing: {error}") from error

    def now_ns(self) -> int:
        """See `Link.now_ns`."""
        return time.perf_counter_ns()

    def close(self) -> None:
        """See `Link.close`."""
        self._port.close()


def open_link(url: str) -> Link:
    """Open the device that `url` names: `serial:...`, or any scheme of the entry points `pans.devices` (`sim:` among them).

    Raises UsageError for a URL that cannot be meant and LinkError for a device that cannot be reached.
    """
    scheme, colon, rest = url.partition(":")
    if not colon or not rest:
        raise UsageError(
            f"{url!r} is no device URL", remedy="write scheme:target, for example sim:ideal or serial:/dev/ttyACM0"
        )
    if scheme == "serial":
        target = rest.removeprefix("//") if not rest.startswith("socket://") else rest
        return SerialLink(_port_of(target))
    points = {point.name: point for point in entry_points(group="pans.devices")}
    if scheme not in points:
        known = ", ".join(sorted({"serial", *points}))
        raise UsageError(f"unknown device scheme {scheme!r} in {url!r}", remedy=f"known: {known}")
    link: Link = points[scheme].load()(url)
    return link


def _port_of(target: str) -> str:
    """Turn VID:PID[:SERIAL] into the port that carries it; leave every other target as it is."""
    fields = target.split(":")
    if "://" in target or "/" in target or not 2 <= len(fields) <= 3:
        return target
    try:
        vid, pid = (int(field, 16) for field in fields[:2])
    except ValueError:
        return target
    from serial.tools import list_ports

    ports = [port for port in list_ports.comports() if (port.vid, port.pid) == (vid, pid)]
    ports = [port for port in ports if len(fields) == 2 or port.serial_number == fields[2]]
    if len(ports) != 1:
        found = ", ".join(f"{port.device} (serial number {port.serial_number})" for port in ports) or "none"
        raise LinkError(
            f"serial:{target} matches {len(ports)} ports: {found}", remedy="add the serial number: VID:PID:SERIAL"
        )
    return str(ports[0].device)


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
