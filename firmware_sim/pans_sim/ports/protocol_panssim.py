"""A pyserial URL handler: `panssim://PROFILE?scene=...` is a serial port with a simulated instrument at its end.

pyserial finds this module by its name (`protocol_SCHEME`) once `register` has been called; reading and writing are pyserial's own.
"""

from __future__ import annotations

from typing import Any

import serial
from serial.urlhandler import protocol_socket

from pans.base.errors import PansError
from pans.protocol.links import Link, open_link

from .serve import SimOptions, ThreadedInstrument, parse_sim_url

PACKAGE = __package__


class Serial(protocol_socket.Serial):  # type: ignore[misc]
    """pyserial's socket port, connected to an instrument that lives as long as the port is open."""

    _instrument: ThreadedInstrument | None = None
    _socket: Any
    is_open: bool

    def open(self) -> None:
        """Switch an instrument on and connect to it; SerialException like any port that cannot be opened."""
        if self.is_open:
            raise serial.SerialException("Port is already open.")
        self.logger = None
        try:
            self._instrument = ThreadedInstrument(self.from_url(self.portstr))
        except PansError as error:
            raise serial.SerialException(f"Could not open port {self.portstr}: {error.message}") from error
        self._socket = self._instrument.connect()
        self._socket.setblocking(False)
        self.is_open = True

    def from_url(self, url: str) -> SimOptions:
        """Read `panssim://PROFILE?...`, whose keys are those of `sim:`."""
        return parse_sim_url("sim:" + url.partition("://")[2])

    def close(self) -> None:
        """Disconnect and switch off; idempotent."""
        if self.is_open:
            self.is_open = False
            self._socket.close()
            self._socket = None
        if self._instrument is not None:
            self._instrument.close()
            self._instrument = None


def register() -> None:
    """Let `serial.serial_for_url` know the scheme."""
    if PACKAGE not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(PACKAGE)


def open_simserial(url: str) -> Link:
    """Open `simserial:PROFILE?...` (entry point of `pans.devices`): the simulator through real pyserial, in this process."""
    register()
    link = open_link("serial:panssim://" + url.partition(":")[2])
    link.simulated = True
    link.name = url
    return link
