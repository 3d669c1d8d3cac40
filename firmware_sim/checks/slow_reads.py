"""A virtual link whose reads bring what came within a while, as drivers do that hand over their bytes now and then.

Owns how long each read waits once something has come, drawn by seed: nothing of the wait is the link's own, and no byte is changed. USB
hands over frames of a millisecond, a serial adapter's latency timer waits up to 16 ms.
"""

from __future__ import annotations

import random

from pans.firmware_sim.device.clock import DeviceClock, SteppedDevice
from pans.firmware_sim.ports.virtual import VirtualLink

WAITS_NS = (0, 300_000, 3_000_000, 16_000_000)


class SlowReads(VirtualLink):
    """`waits_ns` of one read in `slow` of them, else it ends with the first bytes."""

    def __init__(self, device: SteppedDevice, clock: DeviceClock, name: str, seed: int, slow: float) -> None:
        super().__init__(device, clock, name)
        self._dice, self._slow = random.Random(seed), slow

    def read(self, timeout_s: float) -> bytes:
        """See VirtualLink."""
        data = super().read(timeout_s)
        wait_ns = self._dice.choice(WAITS_NS) if data and self._dice.random() < self._slow else 0
        if not wait_ns:
            return data
        self._step(self._now_ns + wait_ns, b"")
        later, self._arrived = self._arrived, b""
        return data + later
