"""Coming back: what arrived in attempts that failed is counted too, and what arrives before ARM is no part of the run."""

from __future__ import annotations

import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.device.upload import Refused
from pans.firmware_sim.ports.shell import open_port, serve
from pans.firmware_sim.ports.virtual import START_NS, VirtualLink
from pans.firmware_sim.scene.still import load_scene
from pans.firmware_sim.testing import small_setup
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import LinkError
from pans.runtime.link.base import open_link
from pans.runtime.live import Observers, Recovery, RunOptions, run_live
from pans.runtime.live.reconnect import MOST_FRUITLESS
from pans.runtime.record import Recorder, read_recording
from pans.runtime.record.replaying import replay
from pans.runtime.wire.messages import (
    AckStatus,
    CommandMessage,
    FrameDecoder,
    MessageType,
    Opcode,
    decode_command,
    encode_welcome,
)
from pans.runtime.wire.session import STREAM_TYPES

CYCLES = 3000
FEW = 400


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
    config = RunOptions(n_cycles=CYCLES, deadline_us=1e9, realtime=False)
    result = run_live(first, profile, bundle, plan, core, config, None, recovery)
    assert (result.ended, result.reconnects) == ("completed", 1)
    assert min(frames["first attempt"], frames["second attempt"]) > 0
    assert result.decoder["frames"] == frames.total()


def test_what_comes_before_arm_is_no_part_of_the_run(tmp_path: Path) -> None:
    """The link breaks within the last object: the connection that is found again is told to stop, and never armed."""
    profile, bundle, plan = small_setup()
    clock = DeviceClock(profile.clock.tick_hz)
    device = Instrument(profile, load_scene("uniform"), seed=1, power_on_tick=clock.tick_at(START_NS))
    first = VirtualLink(device, clock, "sim:stop")
    core = Core(plan, make_decider(bundle, backend="table"), 1, plan.cycles_per_object)
    config = RunOptions(n_cycles=plan.cycles_per_object, deadline_us=1e9, realtime=False)

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


class SlowArm:
    """An ordinary link on which each ARM takes `seconds` to arrive."""

    def __init__(self, link: Any, seconds: float) -> None:
        self.link, self._seconds, self.sent = link, seconds, 0
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.now_ns, self.close, self.read, self.pause = link.now_ns, link.close, link.read, link.pause
        self._decoder = FrameDecoder()

    def write(self, data: bytes) -> None:
        commands = [frame for frame in self._decoder.feed(data) if frame.type == MessageType.COMMAND]
        if any(decode_command(frame.payload).opcode == Opcode.ARM for frame in commands):
            self.sent += 1
            self.link.pause(self._seconds)
        self.link.write(data)

    def reopen(self) -> SlowArm:
        self.link.reopen()
        return self


def recorded_run(path: Path, link: Any, mode: str, url: str = "") -> tuple[Any, Any, Any]:
    """A run of FEW cycles over `link`, with the usual way back: its result, its recording and a replay."""
    profile, bundle, plan = small_setup(mode)
    backend = "table" if bundle.automaton is None else "automaton"
    core = Core(plan, make_decider(bundle, shots=1, backend=backend), 1, FEW)
    config = RunOptions(n_cycles=FEW, deadline_us=1e9, realtime=False)
    facts = {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": backend, "drive": plan.drive, "confidence": 0.0}
    with Recorder(path, {"config": facts}) as recorder:
        result = run_live(link, profile, bundle, plan, core, config, recorder, Recovery.of(link, url, 60.0))
        recorder.close({})
    recording = read_recording(path)
    return result, recording, replay(recording, bundle)


def small_link(mode: str) -> VirtualLink:
    profile, _, _ = small_setup(mode)
    clock = DeviceClock(profile.clock.tick_hz)
    scene = load_scene("uniform")
    return VirtualLink(Instrument(profile, scene, seed=1, power_on_tick=clock.tick_at(START_NS)), clock, "sim:small")


@pytest.mark.parametrize("mode", ["sequential", "parallel", "host-driven"])
def test_an_arm_that_comes_too_late_is_sent_again_with_a_longer_lead(tmp_path: Path, mode: str) -> None:
    link = SlowArm(small_link(mode), 0.25)
    result, recording, again = recorded_run(tmp_path / "run.pansrec", link, mode)
    assert (result.ended, result.reconnects, link.sent) == ("completed", 0, 3)
    assert (result.contradictions, result.stream["lost_exposures"], result.tally.abstained) == ({}, 0, 0)
    events = list(recording.events())
    assert [event["lead_ms"] for event in events if event["kind"] == "armed_too_late"] == [200, 400]
    assert sum(event["kind"] == "session" for event in events) == 1
    assert (again.as_recorded, again.decisions) == (True, result.tally.decisions)


class Strict(Instrument):
    """An instrument that takes no ARM but the third."""

    arms = 0

    def _execute(self, command: CommandMessage) -> None:
        if command.opcode == Opcode.ARM:
            self.arms += 1
            if self.arms < 3:
                raise Refused(AckStatus.TOO_LATE, f"the start has passed, attempt {self.arms}")
        super()._execute(command)


@pytest.mark.parametrize("mode", ["sequential", "parallel", "device-driven", "host-driven"])
def test_an_arm_is_sent_again_at_real_pace(tmp_path: Path, mode: str) -> None:
    profile, _, _ = small_setup(mode)
    clock = DeviceClock(profile.clock.tick_hz)
    device = Strict(profile, load_scene("uniform"), seed=1, power_on_tick=clock.tick_at(time.perf_counter_ns()))
    port, stopped = open_port("tcp:127.0.0.1:0"), threading.Event()
    thread = threading.Thread(target=serve, args=(device, clock, port, stopped.is_set), daemon=True)
    thread.start()
    result, recording, again = recorded_run(tmp_path / "run.pansrec", open_link(port.url), mode, port.url)
    stopped.set()
    thread.join(10)
    assert (result.ended, again.as_recorded) == ("completed", True)
    late = [event["lead_ms"] for event in recording.events() if event["kind"] == "armed_too_late"]
    assert late[:2] == [200, 400]
    assert (result.contradictions, result.stream["lost_exposures"]) == ({}, 0)


def test_a_host_that_is_always_too_late_ends_with_the_refusal(tmp_path: Path) -> None:
    link = SlowArm(small_link("sequential"), 5.0)
    result, _, _ = recorded_run(tmp_path / "run.pansrec", link, "sequential")
    assert result.ended.startswith("the device refused") or "TOO_LATE" in result.ended
    assert (result.tally.decisions, result.reconnects, link.sent) == (0, 1, 7)  # the last one in a new session


class NewEpochs:
    """An ordinary link to a device that restarts again and again: after each `most` messages it says WELCOME with another epoch."""

    def __init__(self, link: Any, most: int) -> None:
        self.link, self._most, self._left, self.opened = link, most, most, 1
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.now_ns, self.close, self.write, self.pause = link.now_ns, link.close, link.write, link.pause
        self._decoder = FrameDecoder()

    def read(self, timeout_s: float) -> bytes:
        data = bytes(self.link.read(timeout_s))
        frames = self._decoder.feed(data)
        self._left -= sum(frame.type in STREAM_TYPES for frame in frames)
        if self._left > 0:
            return data
        self._left = 1 << 30
        return data + encode_welcome({"epoch": 1000 + self.opened}, frames[-1].session)

    def reopen(self) -> NewEpochs:
        self.link.reopen()
        self._left, self.opened, self._decoder = self._most, self.opened + 1, FrameDecoder()
        return self


def test_a_device_that_always_restarts_is_given_up(tmp_path: Path) -> None:
    link = NewEpochs(small_link("sequential"), 2)  # a mark and a block, of an object that takes many
    result, recording, again = recorded_run(tmp_path / "run.pansrec", link, "sequential")
    assert (result.link_lost, result.reconnects, link.opened) == (True, MOST_FRUITLESS, MOST_FRUITLESS + 1)
    assert f"lost {MOST_FRUITLESS + 1} times in a row without one whole decision" in result.ended
    assert "restarted" in result.ended
    assert (recording.complete, again.as_recorded) == (True, True)
    assert result.stream["exposures"] > 0


def test_a_device_that_restarts_between_decisions_is_not_given_up(tmp_path: Path) -> None:
    link = NewEpochs(small_link("sequential"), 60)
    result, _, again = recorded_run(tmp_path / "run.pansrec", link, "sequential")
    assert not result.link_lost
    assert result.reconnects > 2 * MOST_FRUITLESS
    assert again.as_recorded
