"""A simulated instrument in a thread of this process, for the places where an ordinary driver expects a device.

Owns the thread and its loopback port; never the instrument. Python's lock lets it disturb the host, so that latencies measured this
way are upper bounds. `ThreadedInstrument.connect` returns a socket to it.
"""

from __future__ import annotations

import socket
import threading
import time

from .serve import SimOptions, build_instrument
from .shell import TcpPort, serve

GOODBYE_S = 2.0


class ThreadedInstrument:
    """Switched on when made, until `close`; hosts may come and go, one at a time."""

    def __init__(self, options: SimOptions) -> None:
        self._device, clock = build_instrument(options, time.perf_counter_ns())
        self._port = TcpPort("127.0.0.1", 0)
        self._stopped = threading.Event()
        args = (self._device, clock, self._port, self._stopped.is_set)
        self._thread = threading.Thread(target=serve, args=args, name="pans-sim", daemon=True)
        self._thread.start()

    def connect(self) -> socket.socket:
        """Return a socket to the instrument."""
        connection = socket.create_connection(self._port.address, timeout=GOODBYE_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def close(self) -> None:
        """Switch off; idempotent."""
        self._stopped.set()
        self._thread.join(GOODBYE_S)
        self._port.close()
