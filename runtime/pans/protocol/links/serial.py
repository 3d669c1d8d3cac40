"""pyserial behind the Link protocol: device files, COM ports, pseudo-terminals, `socket://`, and URL handlers of other packages.

Devices are named by VID:PID:SERIAL, since ttyUSB0 may be another one tomorrow. Opening raises LinkError that tells apart: not there,
no permission, busy.
"""

from __future__ import annotations

import errno
import select
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from pans.base.errors import LinkError, UsageError

from .link import Link

READ_BYTES = 1 << 16
READ_POLL_S = 0.05
WRITE_TIMEOUT_S = 2.0
TCP_ESTABLISHED = "01"  # in Linux's /proc/net/tcp
FTDI_SLOW_MS = 2  # above it an adapter keeps bytes longer than a decision may take


class SerialLink(Link):
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
            raise not_opened(self.name, error) from error
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

    def is_shared(self) -> bool:
        """Whether another connection of this machine leads to the same socket; False where the system does not tell."""
        if (handle := self.fileno()) is None:
            return False
        try:
            ours = socket.socket(fileno=handle)  # only to ask: the descriptor stays pyserial's
            try:
                host, port = ours.getpeername()
            finally:
                ours.detach()
            there = f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"
            rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()]
        except (OSError, ValueError):  # no socket, one of IPv6, no Linux
            return False
        return sum(row[2:4] == [there, TCP_ESTABLISHED] for row in rows) > 1

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


_REASONS = (  # numbers of the system, what they say, and the remedy
    (
        (errno.EACCES, errno.EPERM),
        "no permission",
        "`pans doctor --udev` prints a rule to install; for a serial port also: sudo usermod -aG dialout $USER, then log in again",
    ),
    ((errno.EBUSY, errno.EAGAIN), "it is busy", "close the other program; `pans devices` looks who it is"),
    (
        (errno.ENOENT, errno.ENODEV, errno.ENXIO),
        "it is not there",
        "check cable and name; `pans devices` lists what is connected",
    ),
)


def not_opened(name: str, error: BaseException) -> LinkError:
    """Return why the device `name` could not be opened, from the system's error."""
    text = str(error)  # pyserial has put some into words
    in_words = errno.EACCES if "Permission denied" in text else errno.EBUSY if "exclusively lock" in text else None
    number = in_words or getattr(error, "errno", None)
    for numbers, words, remedy in _REASONS:
        if number in numbers:
            return LinkError(f"cannot open {name}: {words}", remedy=remedy)
    return LinkError(
        f"cannot open {name}: {text}", remedy="check the name, the cable and that no other program holds it"
    )


def usb_target(target: str) -> tuple[int, int, str]:
    """Read VID:PID[:SERIAL] (hex); UsageError for anything else."""
    fields = target.split(":", 2)
    try:
        vid, pid = int(fields[0], 16), int(fields[1], 16)
    except (ValueError, IndexError):
        raise UsageError(
            f"usb:{target} is no USB device", remedy="write usb:VID:PID or usb:VID:PID:SERIAL in hex"
        ) from None
    return vid, pid, fields[2] if len(fields) == 3 else ""


def port_of(target: str) -> str:
    """Return the port that carries VID:PID[:SERIAL]; every other target as it is."""
    try:
        vid, pid, serial_number = usb_target(target)
    except UsageError:
        return target
    from serial.tools import list_ports

    ports = [port for port in list_ports.comports() if (port.vid, port.pid) == (vid, pid)]
    ports = [port for port in ports if serial_number in ("", port.serial_number)]
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
