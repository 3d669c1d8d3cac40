"""pyserial behind the Link protocol: device files, COM ports, pseudo-terminals, `socket://`, and URL handlers of other packages.

Devices are named by VID:PID:SERIAL, since ttyUSB0 may be another
one tomorrow. Opening raises LinkError that tells apart: not there, no permission, busy.
"""

from __future__ import annotations

import errno
import select
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from pans.runtime.errors import LinkError

READ_BYTES = 1 << 16
READ_POLL_S = 0.05
WRITE_TIMEOUT_S = 2.0
FTDI_SLOW_MS = 2  # above it an adapter keeps bytes longer than a decision may take


class SerialLink:
    """One open serial port; with a file descriptor the wait is select's, and one read returns all that is there."""

    simulated = False
    virtual = False

    def __init__(self, target: str, baud: int = 4_000_000) -> None:
        import serial

        self.name = f"serial:{target}"
        self._errors: tuple[type[BaseException], ...] = (
            *(serial.SerialException, OSError),
            *(TypeError, ValueError, AttributeError),  # what pyserial raises over a port that another thread closed
        )
        options: dict[str, Any] = {} if "://" in target else {"baudrate": baud, "exclusive": True}
        try:
            self._port = serial.serial_for_url(port_of(target), timeout=0, write_timeout=WRITE_TIMEOUT_S, **options)
        except (serial.SerialException, OSError, ValueError) as error:
            raise _not_opened(self.name, target, error) from error
        # pyserial's own in_waiting says 1 for socket:// whatever has arrived. Windows COM handles have no descriptor.
        self._selectable = hasattr(self._port, "fileno") and (sys.platform != "win32" or "://" in target)
        if not self._selectable:
            self._port.timeout = READ_POLL_S
        self._ask_for_low_latency()

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        try:
            if not self._selectable:
                self._port.timeout = timeout_s
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

    def fileno(self) -> int | None:
        """Return the descriptor, for a turn that reads and writes it itself; None of a port that has none."""
        try:
            return int(self._port.fileno()) if self._selectable else None
        except self._errors:
            return None

    def close(self) -> None:
        """See `Link.close`."""
        with suppress(*self._errors):
            self._port.close()

    def _ask_for_low_latency(self) -> None:
        """FTDI adapters keep bytes for 16 ms by default; a pty or a socket has no such switch and says so."""
        setter = getattr(self._port, "set_low_latency_mode", None)
        if setter is not None:
            with suppress(*self._errors, NotImplementedError):
                setter(True)


def _not_opened(name: str, target: str, error: BaseException) -> LinkError:
    number = getattr(error, "errno", None)
    text = str(error)
    if number in (errno.EACCES, errno.EPERM) or "Permission denied" in text:
        return LinkError(
            f"cannot open {name}: no permission",
            remedy="`pans doctor --udev` prints a rule to install, or: sudo usermod -aG dialout $USER, then log in again",
        )
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return LinkError(
            f"cannot open {name}: it is busy", remedy="close the other program; `pans devices` looks who it is"
        )
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return LinkError(
            f"cannot open {name}: it is not there", remedy="check cable and name; `pans devices` lists the ports"
        )
    return LinkError(
        f"cannot open {name}: {text}", remedy="check the name, the cable and that no other program holds it"
    )


def port_of(target: str) -> str:
    """Kernel VID:PID[:SERIAL] into the port that carries it; leave every other target as it is."""
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


def latency_timer_ms(device: str, sysfs: Path = Path("/sys")) -> int | None:
    """Return how long an FTDI adapter keeps bytes, in ms; None for any other port."""
    path = sysfs / "bus" / "usb-serial" / "devices" / Path(device).name / "latency_timer"
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
