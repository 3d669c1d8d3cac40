"""The instrument at real pace: a port (pseudo-terminal or TCP) and the loop that steps the device on time.

`serve` returns when `stopped()` says so. What the client does not take is held up to MAX_BACKLOG_BYTES, then whole device outputs are
dropped, as a full transmit buffer would.
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Protocol

from pans.base.errors import LinkError, UsageError
from pans.base.machine import busy_core, off_the_deciding_core, scheduled
from pans_sim.device.clock import SteppedDevice

READ_BYTES = 1 << 16
MAX_BACKLOG_BYTES = 1 << 20
FIFO_PRIORITY = 20  # above the host's loop: light does not wait for a computer
LONGEST_WAIT_S = 0.25  # how late a stop request may be noticed
DRAW_S = 100e-6  # with nothing due for so long, what comes is made ahead


class Clock(Protocol):
    """From this computer's clock to the instrument's ticks and back."""

    def tick_at(self, host_ns: int) -> int: ...

    def host_ns_at(self, tick: int) -> int: ...


class Port(Protocol):
    """One end of a connection that the simulator offers; reads and writes never block."""

    url: str

    def read(self) -> bytes: ...

    def write(self, data: bytes) -> int: ...

    def wait(self, timeout_s: float, wants_to_write: bool) -> bool:
        """Wait for something to read, or with `wants_to_write` for room to write; whether there is something to read."""

    def close(self) -> None: ...

    def hang_up(self) -> None:
        """Break the connection to whoever is there."""


def open_port(listen: str) -> Port:
    """Open `pty`, `tcp:PORT` (loopback) or `tcp:HOST:PORT`; port 0 lets the system choose."""
    if listen == "pty":
        return PtyPort()
    kind, _, rest = listen.partition(":")
    host, _, number = rest.rpartition(":")
    if kind != "tcp" or not number.isdecimal() or int(number) > 65535:
        raise UsageError(
            f"cannot listen on {listen!r}", remedy="write pty, or tcp:127.0.0.1:PORT (PORT 0: any free one)"
        )
    return TcpPort(host or "127.0.0.1", int(number))


class PtyPort:
    """A raw pseudo-terminal. It keeps its own end open, so that a client may leave and come back."""

    def __init__(self) -> None:
        if not hasattr(os, "openpty"):
            raise UsageError("this system has no pseudo-terminals", remedy="use --listen tcp:127.0.0.1:0")
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # before the first byte: an echo would answer the host with its own bytes
        os.set_blocking(self._master, False)
        self.url = f"serial://{os.ttyname(self._slave)}"

    def read(self) -> bytes:
        try:
            return os.read(self._master, READ_BYTES)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def wait(self, timeout_s: float, wants_to_write: bool) -> bool:
        return bool(select.select([self._master], [self._master] if wants_to_write else [], [], timeout_s)[0])

    def hang_up(self) -> None:
        raise UsageError("a pseudo-terminal cannot break and come back under its name")

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


class TcpPort:
    """One client at a time; further ones wait in the queue until it has left. Without a client, output is lost."""

    def __init__(self, host: str, number: int) -> None:
        try:
            self._listener = socket.create_server((host, number), backlog=1)
        except OSError as error:
            raise LinkError(f"cannot listen on {host}:{number}: {error}", remedy="choose another port, or 0") from error
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self.url = "serial:socket://{}:{}".format(*self.address)

    def read(self) -> bytes:
        if self._client is None:
            self._accept()
        if self._client is None:
            return b""
        try:
            data = self._client.recv(READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.hang_up()
        return data

    def write(self, data: bytes) -> int:
        if self._client is None:
            return len(data)
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self.hang_up()
            return len(data)

    def wait(self, timeout_s: float, wants_to_write: bool) -> bool:
        source = self._client or self._listener
        return bool(select.select([source], [source] if wants_to_write and self._client else [], [], timeout_s)[0])

    def close(self) -> None:
        self.hang_up()
        self._listener.close()

    def _accept(self) -> None:
        try:
            self._client, _ = self._listener.accept()
        except BlockingIOError:
            return
        self._client.setblocking(False)
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def hang_up(self) -> None:
        """See `Port.hang_up`."""
        if self._client is not None:
            self._client.close()
            self._client = None


def serve(
    device: SteppedDevice,
    clock: Clock,
    port: Port,
    stopped: Callable[[], bool],
    core: int | None = None,
    realtime: bool = False,
    simulates: bool = False,
) -> None:
    """Step `device` in real time and carry its bytes over `port` until `stopped()`; on `core`, kept awake, if one is given.

    With `realtime` the thread asks for SCHED_FIFO. A simulator computes its clicks: so it may take most of a core from all others, and
    stays off the one where a run decides (`simulates`), unless it is given a core.
    """
    apart = off_the_deciding_core() if simulates and core is None else nullcontext()
    with scheduled("SCHED_FIFO", FIFO_PRIORITY) if realtime else nullcontext(), apart, busy_core(core):
        _serve(device, clock, port, stopped)


def _serve(device: SteppedDevice, clock: Clock, port: Port, stopped: Callable[[], bool]) -> None:
    backlog = bytearray()
    session = device.session
    readable = True
    while not stopped():
        data = port.read() if readable else b""
        if not getattr(device, "connected", True):
            port.hang_up()
            backlog.clear()
        sent = device.step(clock.tick_at(time.perf_counter_ns()), data)
        if device.session != session:
            # A new host must not wait for what the last one never read; the delimiter ends a frame cut in its middle.
            session = device.session
            backlog[:] = b"\0"
        if backlog or len(sent) > MAX_BACKLOG_BYTES:
            if len(backlog) + len(sent) <= MAX_BACKLOG_BYTES:
                backlog += sent
            del backlog[: port.write(bytes(backlog))]
        elif sent:
            backlog += sent[port.write(sent) :]
        due = device.next_event_tick()
        wait_s = LONGEST_WAIT_S
        if due is not None:
            wait_s = min(wait_s, max(0.0, (clock.host_ns_at(due) - time.perf_counter_ns()) * 1e-9))
        if wait_s > DRAW_S and device.draw_ahead():
            wait_s = 0.0
        readable = port.wait(wait_s, bool(backlog))
