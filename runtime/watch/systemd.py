"""Messages to systemd: READY when the run is prepared, WATCHDOG while the loop turns, STOPPING at the end.

Owns the datagrams of sd_notify(3) and when they are sent; does nothing where NOTIFY_SOCKET is not set. The thread sends, but only what the
loop's heartbeat says: a loop that is stuck is not spoken for, and systemd's WatchdogSec= ends the service.
"""

from __future__ import annotations

import os
import socket
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from .heartbeat import is_stalled

if TYPE_CHECKING:
    from pans.runtime.live import LiveRun

EVERY_S = 1.0  # without WATCHDOG_USEC
SENDS_PER_TIMEOUT = 3


class Notifier:
    """Speaks to the service manager of this process, if it has one."""

    def __init__(self, address: str, every_s: float) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._every_s = every_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    @classmethod
    def of_environment(cls) -> Notifier | None:
        """Return the one that NOTIFY_SOCKET and WATCHDOG_USEC ask for, None without."""
        address, microseconds = os.environ.get("NOTIFY_SOCKET", ""), os.environ.get("WATCHDOG_USEC", "")
        if not address or not hasattr(socket, "AF_UNIX"):
            return None
        known = microseconds.isdecimal() and 0 < int(microseconds) < 1 << 62
        return cls(address, int(microseconds) / 1e6 / SENDS_PER_TIMEOUT if known else EVERY_S)

    def begin(self, run: LiveRun) -> None:
        """Say that the service is ready, and from here on that the loop of `run` turns."""
        self._send("READY=1")
        self._thread = threading.Thread(target=self._keep, args=(run,), name="pans-systemd", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Say that the service stops."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
        self._send("STOPPING=1")
        self._socket.close()

    def _keep(self, run: LiveRun) -> None:
        while True:
            if run.ended or not is_stalled(run):
                self._send("WATCHDOG=1")
            if self._ending.wait(self._every_s):
                return

    def _send(self, message: str) -> None:
        with suppress(OSError):  # nobody listens: a run does not end because of that
            self._socket.sendto(message.encode(), self._address)
