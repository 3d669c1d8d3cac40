"""Links for tests: an instrument in a thread behind a real port, and a link around another one."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pans.protocol.links import Link
from pans_sim.ports.shell import open_port, serve


@contextmanager
def served(device: Any, clock: Any, listen: str = "tcp:127.0.0.1:0") -> Iterator[Any]:
    """Run `device` in a thread; yield its port."""
    port, stopped = open_port(listen), threading.Event()
    thread = threading.Thread(target=serve, args=(device, clock, port, stopped.is_set), daemon=True)
    thread.start()
    try:
        yield port
    finally:
        stopped.set()
        thread.join(10)
        port.close()


class Wrapped(Link):
    """A link around `link`, to be overridden; reads come one by one, since `read_ahead` is not passed on."""

    def __init__(self, link: Any) -> None:
        self.link = link
        for name in ("name", "simulated", "virtual", "now_ns", "close", "pause"):
            setattr(self, name, getattr(link, name))

    def read(self, timeout_s: float) -> bytes:
        return bytes(self.link.read(timeout_s))

    def write(self, data: bytes) -> None:
        self.link.write(data)


class Stepped(Wrapped):
    """A link in virtual time whose time passes when a test says so; what is written is kept with its time, reads are counted."""

    def __init__(self, link: Any) -> None:
        super().__init__(link)
        self.written: list[tuple[int, bytes]] = []
        self.read_ns: list[int] = []
        self._arrived = b""

    def read(self, timeout_s: float) -> bytes:
        self.read_ns.append(self.now_ns())
        data, self._arrived = self._arrived, b""
        return data or super().read(timeout_s)

    def write(self, data: bytes) -> None:
        self.written.append((self.now_ns(), data))
        super().write(data)

    def let_pass(self, seconds: float) -> None:
        """Let time pass; what arrives meanwhile is read later."""
        until_ns = self.now_ns() + round(seconds * 1e9)
        while (left_ns := until_ns - self.now_ns()) > 0:
            self._arrived += self.link.read(left_ns / 1e9)
