"""The instrument in process, in virtual time: a link whose clock moves only while the host waits.

A run is the same bit for bit on every machine, and an hour takes seconds. `VirtualLink` is an ordinary Link (pans.protocol.links) that can
break and be opened again.
"""

from __future__ import annotations

from contextlib import suppress

from pans.base.errors import LinkError
from pans.protocol.links import Link, count_delimiters
from pans_sim.device.clock import DeviceClock, SteppedDevice

from .faulty import FaultyDevice

START_NS = 1_000_000_000
NS_PER_S = 1_000_000_000


class VirtualLink(Link):
    """A link to a stepped device; `read` advances time to the next emission or the time-out, whichever is first."""

    simulated = True
    virtual = True
    reads_ahead = True

    def __init__(self, device: SteppedDevice, clock: DeviceClock, name: str) -> None:
        self.name = name
        self.device = device
        self.clock = clock
        self._faulty = device if isinstance(device, FaultyDevice) else None
        self._now_ns = START_NS
        self._arrived = b""
        self._closed = False
        self._broken = False

    def read(self, timeout_s: float) -> bytes:
        """Return what the device has sent, advancing time to its next emission, but by at most `timeout_s`."""
        self._check_open()
        deadline_ns = self._now_ns + max(0, round(timeout_s * NS_PER_S))
        if self._faulty is not None:
            self._stand_still(self._faulty)
        while not self._arrived and self._now_ns < deadline_ns:
            self._step(deadline_ns, b"", to_event=True)
            self._check_open()
        data, self._arrived = self._arrived, b""
        return data

    def read_ahead(self, timeout_s: float, frames: int, size: int, until_ns: int) -> list[tuple[int, bytes]]:
        """`read` again and again until `frames` delimiters or `size` bytes have come, or time has passed `until_ns`.

        Returns each read that brought something, with its time; one that fails ends it, and the next `read` fails again.
        """
        reads: list[tuple[int, bytes]] = []
        with suppress(LinkError):
            while frames > 0 and size > 0 and self._now_ns < until_ns and (data := self.read(timeout_s)):
                reads.append((self._now_ns, data))
                frames -= count_delimiters(data)
                size -= len(data)
        return reads

    def write(self, data: bytes) -> None:
        """Hand `data` to the device at the present virtual time."""
        self._check_open()
        self._step(self._now_ns, bytes(data))

    def now_ns(self) -> int:
        """Virtual host time in nanoseconds."""
        return self._now_ns

    def pause(self, seconds: float) -> None:
        """Let virtual time pass while the host does not read: what the device sends meanwhile is lost with the closed port."""
        until_ns = self._now_ns + round(seconds * NS_PER_S)
        while self._now_ns < until_ns:
            self._step(until_ns, b"", to_event=True)
            self._arrived = b""

    def reopen(self) -> VirtualLink:
        """Open the link to the same device again; LinkError while it is broken."""
        if self._faulty is not None and not self._faulty.connected:
            raise LinkError(f"{self.name} is not there")
        self._closed = self._broken = False
        self._arrived = b""
        return self

    def close(self) -> None:
        """End the link; idempotent."""
        self._closed = True

    def _step(self, now_ns: int, data: bytes, *, to_event: bool = False) -> None:
        """Let time pass up to `now_ns`, or with `to_event` only up to what the device does next."""
        if to_event and (due := self.device.next_event_tick()) is not None:
            now_ns = min(now_ns, self.clock.host_ns_at(due))
        self._now_ns = max(now_ns, self._now_ns)
        self._arrived += self.device.step(self.clock.tick_at(self._now_ns), data)
        if self._faulty is not None and not self._faulty.connected:
            self._broken = True

    def _stand_still(self, faulty: FaultyDevice) -> None:
        until = faulty.pause_until(self.clock.tick_at(self._now_ns))
        if until is not None:
            self._step(self.clock.host_ns_at(until), b"")
            self._check_open()

    def _check_open(self) -> None:
        if self._closed:
            raise LinkError(f"{self.name} is closed")
        if self._broken:
            raise LinkError(f"{self.name} went away")
