"""pyusb behind the Link protocol: one bulk endpoint in each direction of the first interface that has both.

Opening raises LinkError that tells apart: no libusb, not there, several, no permission, busy.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

from pans.base.console import install
from pans.base.errors import LinkError

from .link import Link
from .serial import not_opened, usb_target

READ_BYTES = 1 << 16
WRITE_TIMEOUT_MS = 2000


class UsbLink(Link):
    """An open USB device; `backend` is a usb.backend.IBackend (None: pyusb's choice, libusb)."""

    simulated = False
    virtual = False

    def __init__(self, target: str, backend: Any = None) -> None:
        import usb.core
        import usb.util

        self.name = f"usb:{target}"
        self._util = usb.util
        self._timeout, self._error = usb.core.USBTimeoutError, usb.core.USBError
        self._closed = False
        try:
            self._device = self._find(usb.core, target, backend)
            self._claim(usb.util)
        except usb.core.NoBackendError as error:
            raise LinkError(
                f"cannot open {self.name}: no libusb", remedy=f"{install('usb')}, or install libusb-1.0"
            ) from error
        except usb.core.USBError as error:
            raise not_opened(self.name, error) from error

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        if self._closed:
            raise LinkError(f"{self.name} is closed")
        try:
            # array.array('B'): its buffer is copied once, here
            return bytes(self._in.read(READ_BYTES, timeout=max(1, round(timeout_s * 1000))))
        except self._timeout:
            return b""
        except self._error as error:
            raise LinkError(f"{self.name} went away while reading: {error}") from error

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        if self._closed:
            raise LinkError(f"{self.name} is closed")
        try:
            left = memoryview(data)
            while left:
                left = left[self._out.write(left.tobytes(), timeout=WRITE_TIMEOUT_MS) :]
        except self._error as error:
            raise LinkError(f"{self.name} went away while writing: {error}") from error

    def now_ns(self) -> int:
        """See `Link.now_ns`."""
        return time.perf_counter_ns()

    def close(self) -> None:
        """See `Link.close`."""
        if not self._closed:
            self._closed = True
            with suppress(self._error):
                self._util.release_interface(self._device, self._interface)
            self._util.dispose_resources(self._device)

    def _find(self, core: Any, target: str, backend: Any) -> Any:
        vid, pid, serial = usb_target(target)
        found = list(core.find(find_all=True, idVendor=vid, idProduct=pid, backend=backend))
        if serial:
            found = [device for device in found if device.serial_number == serial]
        if not found:
            raise LinkError(
                f"{self.name} is not there", remedy="check the cable; `pans devices` lists what is connected"
            )
        if len(found) > 1:
            raise LinkError(
                f"{self.name} matches {len(found)} devices", remedy="add the serial number: usb:VID:PID:SERIAL"
            )
        return found[0]

    def _claim(self, util: Any) -> None:
        device = self._device
        try:
            configuration = device.get_active_configuration()
        except self._error:
            device.set_configuration()
            configuration = device.get_active_configuration()
        for interface in configuration:
            ends: dict[int, Any] = {}
            for endpoint in interface:
                if util.endpoint_type(endpoint.bmAttributes) == util.ENDPOINT_TYPE_BULK:
                    ends.setdefault(util.endpoint_direction(endpoint.bEndpointAddress), endpoint)
            if util.ENDPOINT_IN in ends and util.ENDPOINT_OUT in ends:
                self._interface = interface.bInterfaceNumber
                with suppress(NotImplementedError, self._error):
                    if device.is_kernel_driver_active(self._interface):
                        device.detach_kernel_driver(self._interface)
                util.claim_interface(device, self._interface)
                self._in, self._out = ends[util.ENDPOINT_IN], ends[util.ENDPOINT_OUT]
                self._discard_old()
                return
        raise LinkError(f"{self.name} has no interface with a bulk endpoint in each direction")

    def _discard_old(self) -> None:
        """What the last program left in the device's buffer belongs to nobody; the session nonce would drop it anyway."""
        with suppress(self._error):
            for _ in range(64):
                self._in.read(READ_BYTES, timeout=1)
