"""Attempts to come back that fail: what arrived in them is counted too."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.ports.virtual import START_NS, VirtualLink
from pans.firmware_sim.scene.still import load_scene
from pans.firmware_sim.testing import small_setup
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import LinkError
from pans.runtime.live import Recovery, RunConfig, run_live
from pans.runtime.wire.messages import FrameDecoder

CYCLES = 3000


class Counted:
    """An ordinary link that counts the frames that are read, and breaks when there have been `most` of them."""

    def __init__(self, link: Any, frames: Counter[str], name: str, most: int) -> None:
        self.link, self._frames, self._name, self._most = link, frames, name, most
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.now_ns, self.close, self.write = link.now_ns, link.close, link.write
        self._decoder = FrameDecoder()

    def read(self, timeout_s: float) -> bytes:
        if self._frames[self._name] >= self._most:
            raise LinkError("the cable was pulled")
        data = self.link.read(timeout_s)
        self._frames[self._name] += len(self._decoder.feed(data))
        return bytes(data)


@pytest.mark.parametrize("mode", ["sequential", "parallel"])  # of parallel frames many reads are taken at once
def test_the_frames_of_attempts_that_failed_are_counted(mode: str) -> None:
    profile, bundle, plan = small_setup(mode)
    clock = DeviceClock(profile.clock.tick_hz)
    device = Instrument(profile, load_scene("uniform"), seed=1, power_on_tick=clock.tick_at(START_NS))
    frames: Counter[str] = Counter()
    breaks = iter([("run", 500), ("first attempt", 3), ("second attempt", 7), ("rest", 1 << 30)])
    first = Counted(VirtualLink(device, clock, "sim:turn"), frames, *next(breaks))
    recovery = Recovery(
        lambda lost: Counted(lost.link.reopen(), frames, *next(breaks)),  # type: ignore[attr-defined]
        60.0,
        first.link.pause,
    )
    core = Core(plan, make_decider(bundle, backend="table"), 1, CYCLES)
    config = RunConfig(n_cycles=CYCLES, deadline_us=1e9, realtime=False)
    result = run_live(first, profile, bundle, plan, core, config, None, recovery)
    assert (result.ended, result.reconnects) == ("completed", 1)
    assert min(frames["first attempt"], frames["second attempt"]) > 0
    assert result.decoder["frames"] == frames.total()
