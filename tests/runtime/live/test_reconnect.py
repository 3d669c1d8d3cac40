"""Coming back: what arrived in attempts that failed is counted too, and what arrives before ARM is no part of the run."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
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
from pans.runtime.live import Observers, Recovery, RunConfig, run_live
from pans.runtime.record import Recorder, read_recording, replay
from pans.runtime.wire.messages import FrameDecoder, MessageType, Opcode, decode_command

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


class LateStop:
    """An ordinary link on which STOP is late: the device has reported its status before."""

    def __init__(self, link: Any) -> None:
        self.link, self._early = link, b""
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.now_ns, self.close, self.pause = link.now_ns, link.close, link.pause
        self._decoder = FrameDecoder()

    def write(self, data: bytes) -> None:
        commands = [frame for frame in self._decoder.feed(data) if frame.type == MessageType.COMMAND]
        if any(decode_command(frame.payload).opcode == Opcode.STOP for frame in commands):
            self._early = self.link.read(1.5)  # STATUS comes every second
            assert self._early
        self.link.write(data)

    def read(self, timeout_s: float) -> bytes:
        early, self._early = self._early, b""
        return bytes(early or self.link.read(timeout_s))


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


@pytest.mark.parametrize("turn", ["python", "auto"])
def test_what_comes_before_arm_is_no_part_of_the_run(tmp_path: Path, turn: str) -> None:
    """The link breaks within the last object: the connection that is found again is told to stop, and never armed."""
    profile, bundle, plan = small_setup()
    clock = DeviceClock(profile.clock.tick_hz)
    device = Instrument(profile, load_scene("uniform"), seed=1, power_on_tick=clock.tick_at(START_NS))
    first = VirtualLink(device, clock, "sim:stop")
    core = Core(plan, make_decider(bundle, backend="table"), 1, plan.cycles_per_object)
    config = RunConfig(n_cycles=plan.cycles_per_object, deadline_us=1e9, realtime=False, turn=turn)

    def broken(run: Any, output: Any) -> None:
        if output.block_end_tick is not None and not run.reconnects:
            raise LinkError("the cable was pulled")

    facts = {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table", "drive": plan.drive, "confidence": 0.0}
    path = tmp_path / "run.pansrec"
    with Recorder(path, {"config": facts}) as recorder:
        recovery = Recovery(lambda lost: LateStop(lost.reopen()), 60.0, first.pause)  # type: ignore[attr-defined]
        observers = Observers(watch=broken)
        result = run_live(first, profile, bundle, plan, core, config, recorder, recovery, observers)
        recorder.close({})
    assert (result.ended, result.reconnects) == ("the link was lost within the last object", 1)
    assert result.contradictions == {}
    recording = read_recording(path)
    assert replay(recording, bundle).as_recorded
