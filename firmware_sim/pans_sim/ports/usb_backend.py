"""A pyusb backend with one simulated instrument on its bus, so that pyusb's own find, claim, read and write run without hardware.

Errors are those of libusb: USBTimeoutError (-7, 110), USBError 16 (busy), 19 (gone).
"""

from __future__ import annotations

import errno
import select
import socket
from array import array
from types import SimpleNamespace
from typing import Any, Protocol

import usb.backend
import usb.core

from pans.base.errors import UsageError
from pans.protocol.links import Link, UsbLink

from .serve import GOODBYE_S, ThreadedInstrument, parse_sim_url

VENDOR_ID, PRODUCT_ID = 0x1209, 0x0001  # the pair that pid.codes sets aside for tests
SERIAL_NUMBER = "SIM-USB"
IN, OUT = 0x81, 0x01
STRINGS = ("", "pans", "simulated instrument", SERIAL_NUMBER)
GET_DESCRIPTOR, STRING_TYPE = 6, 3
GONE = (errno.ENODEV, "No such device (it may have been disconnected)")


class Behind(Protocol):
    """What stands behind the bus: `connect` returns a socket to it."""

    def connect(self) -> socket.socket: ...

    def close(self) -> None: ...


class Listening:
    """An instrument that listens elsewhere, in a process of its own: HOST:PORT."""

    def __init__(self, target: str) -> None:
        host, _, port = target.rpartition(":")
        if not host or not port.isdecimal():
            raise UsageError(f"socket://{target} is no address", remedy="write simusb:socket://127.0.0.1:PORT")
        self._address = (host, int(port))

    def connect(self) -> socket.socket:
        """See `Behind`."""
        connection = socket.create_connection(self._address, timeout=GOODBYE_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def close(self) -> None:
        """Leave it to the process that it lives in."""


class SimBackend(usb.backend.IBackend):  # type: ignore[misc]
    """The bus: `plugged` False takes the device off it, as a pulled cable does."""

    def __init__(self, instrument: Behind) -> None:
        self.plugged = True
        self._instrument = instrument
        self._socket: socket.socket | None = None

    def close(self) -> None:
        """Switch the instrument off."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._instrument.close()

    # -- descriptors ---------------------------------------------------------------------------------------------------

    def enumerate_devices(self) -> Any:
        return iter(["pans"] if self.plugged else [])

    def get_parent(self, dev: Any) -> None:
        return None

    def get_device_descriptor(self, dev: Any) -> Any:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0xFF, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=VENDOR_ID, idProduct=PRODUCT_ID, bcdDevice=0x0100, iManufacturer=1, iProduct=2,
            iSerialNumber=3, bNumConfigurations=1, address=1, bus=1, port_number=1, port_numbers=(1,), speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        if intf or alt or config:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2, bInterfaceClass=0xFF,
            bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: Any, ep: int, intf: int, alt: int, config: int) -> Any:
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(IN, OUT)[ep], bmAttributes=2, wMaxPacketSize=512, bInterval=0,
            bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    # -- opening -------------------------------------------------------------------------------------------------------

    def open_device(self, dev: Any) -> Any:
        self._check_plugged()
        return dev

    def close_device(self, dev_handle: Any) -> None:
        pass

    def set_configuration(self, dev_handle: Any, config_value: int) -> None:
        self._check_plugged()

    def get_configuration(self, dev_handle: Any) -> int:
        self._check_plugged()
        return 1

    def set_interface_altsetting(self, dev_handle: Any, intf: int, altsetting: int) -> None:
        pass

    def claim_interface(self, dev_handle: Any, intf: int) -> None:
        self._check_plugged()
        if self._socket is not None:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        self._socket = self._instrument.connect()

    def release_interface(self, dev_handle: Any, intf: int) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def is_kernel_driver_active(self, dev_handle: Any, intf: int) -> bool:
        return False

    # -- transfers -----------------------------------------------------------------------------------------------------

    def ctrl_transfer(
        self, dev_handle: Any, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data: Any, timeout: int
    ) -> int:
        self._check_plugged()
        kind, index = divmod(wValue, 256)
        if (bRequest, kind) != (GET_DESCRIPTOR, STRING_TYPE) or index >= len(STRINGS):
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        body = b"\x09\x04" if index == 0 else STRINGS[index].encode("utf-16-le")
        answer = bytes([len(body) + 2, STRING_TYPE]) + body
        count = min(len(answer), len(data))
        data[:count] = array("B", answer[:count])
        return count

    def bulk_write(self, dev_handle: Any, ep: int, intf: int, data: Any, timeout: int) -> int:
        connection = self._connection()
        connection.settimeout(timeout / 1000)
        try:
            return connection.send(data)
        except TimeoutError:
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT) from None
        except OSError as error:
            raise usb.core.USBError(GONE[1], -4, GONE[0]) from error

    def bulk_read(self, dev_handle: Any, ep: int, intf: int, buff: Any, timeout: int) -> int:
        connection = self._connection()
        try:
            ready, _, _ = select.select([connection], [], [], timeout / 1000)
            count = connection.recv_into(buff) if ready else -1
        except (OSError, ValueError) as error:
            raise usb.core.USBError(GONE[1], -4, GONE[0]) from error
        if count < 0:
            self._check_plugged()
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        if count == 0:
            raise usb.core.USBError(GONE[1], -4, GONE[0])
        return count

    def _connection(self) -> socket.socket:
        self._check_plugged()
        if self._socket is None:
            raise usb.core.USBError("Entity not found", -5, errno.ENOENT)
        return self._socket

    def _check_plugged(self) -> None:
        if not self.plugged:
            raise usb.core.USBError(GONE[1], -4, GONE[0])


class SimUsbLink(UsbLink):
    """The ordinary USB link on a simulated bus; `reopen` finds the same instrument again."""

    simulated = True

    def __init__(self, url: str) -> None:
        target = url.partition(":")[2]
        address = target.removeprefix("socket://")
        self.backend = SimBackend(
            Listening(address) if address != target else ThreadedInstrument(parse_sim_url(f"sim:{target}"))
        )
        try:
            self._open()
        except BaseException:
            self.backend.close()
            raise
        self.name = url

    def reopen(self) -> SimUsbLink:
        """Claim the interface again, as after a pulled cable."""
        name = self.name
        UsbLink.close(self)
        self._open()
        self.name = name
        return self

    def close(self) -> None:
        """Release the interface and switch the instrument off."""
        super().close()
        self.backend.close()

    def _open(self) -> None:
        super().__init__(f"{VENDOR_ID:04x}:{PRODUCT_ID:04x}:{SERIAL_NUMBER}", self.backend)


def open_simusb(url: str) -> Link:
    """Open `simusb:PROFILE?...` (entry point of `pans.devices`): the simulator through real pyusb, in this process.

    `simusb:socket://HOST:PORT` reaches one that listens there (`pans simulate --listen tcp:...`).
    """
    return SimUsbLink(url)
