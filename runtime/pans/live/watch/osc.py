"""Decisions out to Bonsai and its kind while a run goes on: one OSC message each, many in a datagram.

In come the outputs of the loop, out go datagrams (OSC 1.0 over UDP and IPv4). The socket never waits: its send buffer is the queue, and
what does not fit is dropped and counted. The loop sends by itself; a thread would compete with it for the interpreter.
"""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from pans.base.console import say, warn
from pans.base.errors import UsageError
from pans.bundle.backends import NO_LABEL
from pans.decide import rows_of

from .metrics import parse_address

if TYPE_CHECKING:
    from pans.decide import Output
    from pans.live.status import Status

# An element of a bundle: its size, address, types and arguments, big-endian; strings end with a zero and fill words of four bytes.
OSC_DTYPE = np.dtype(
    [
        ("size", ">u4"),
        ("address", "S16"),
        ("types", "S12"),
        ("number", ">i8"),
        ("tick", ">i8"),  # end of the last exposure, device ticks
        ("label", ">i4"),  # -1: abstained
        ("probability", ">f4"),  # softmax of the winner
        ("clicks", ">i4"),
        ("flags", ">i4"),  # DecisionFlag
        ("late", ">i4"),  # 1: after the deadline
    ]
)
ADDRESS, TYPES = b"/pans/decision", b",hhifiii"
AT_ONCE = b"#bundle\0" + (1).to_bytes(8, "big")  # the time tag that means: now
PER_DATAGRAM = (1472 - len(AT_ONCE)) // OSC_DTYPE.itemsize  # what Ethernet carries in one piece


class OscSender:
    """Sends decisions to `address` (PORT or HOST:PORT) until `close`; UsageError if there is no such host."""

    def __init__(self, address: str) -> None:
        host, port = parse_address(address, "--osc")
        try:
            self._to = socket.gethostbyname(host), port
        except (OSError, UnicodeError) as error:
            raise UsageError(f"--osc {address}: no such host: {error}", remedy="write HOST:PORT, or PORT") from error
        self._socket, self._address = socket.socket(type=socket.SOCK_DGRAM), address
        self._socket.setblocking(False)
        self.sent = self.dropped = 0  # decisions

    def watch(self, run: Status, output: Output) -> None:
        """Send the decisions of `output`."""
        rows = rows_of(output.decisions)
        if not len(rows):
            return
        messages = np.empty(len(rows), OSC_DTYPE)
        messages["size"], messages["address"], messages["types"] = OSC_DTYPE.itemsize - 4, ADDRESS, TYPES
        for name, column in (("number", "index"), ("tick", "tick"), ("probability", "probability")):
            messages[name] = rows[column]
        messages["clicks"], messages["flags"] = rows["clicks"], rows["flags"]
        messages["label"] = np.where(rows["label"] == NO_LABEL, -1, rows["label"].astype(np.int32))
        messages["late"] = np.isin(rows["index"], run.accounts.late) if run.accounts.late else 0
        for first in range(0, len(rows), PER_DATAGRAM):
            some = messages[first : first + PER_DATAGRAM]
            with suppress(OSError):  # the buffer is full, or the network is gone: a run does not end because of that
                self._socket.sendto(AT_ONCE + some.tobytes(), self._to)
                self.sent += len(some)
                continue
            self.dropped += len(some)

    def close(self) -> None:
        """Say what was sent, and what was dropped."""
        self._socket.close()
        say(f"pans: {self.sent} decisions sent to {self._address} as OSC")
        if self.dropped:
            warn(f"{self.dropped} decisions could not be sent to {self._address}: the network did not take them")
