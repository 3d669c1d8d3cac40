"""Coming back: what arrived in attempts that failed is counted too, and what arrives before ARM is no part of the run."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from links import Wrapped, served

from pans.base.errors import LinkError
from pans.bundle.backends.choose import make_decider
from pans.decide.still.core import Core
from pans.live.loop import Job, Observers, Recovery, run_live
from pans.live.options import RunOptions
from pans.live.reconnect import MOST_FRUITLESS
from pans.protocol.links.base import open_link
from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import AckStatus, FrameDecoder, MessageType, Opcode
from pans.protocol.wire.messages import CommandMessage, decode_command, encode_welcome
from pans.record.reading import read_recording
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.device.upload import Refused
from pans_sim.ports.virtual import START_NS, VirtualLink
from pans_sim.scene.still import load_scene
from pans_sim.testing import small_setup

FEW = 400


class Counted(Wrapped):
    """A link that counts the frames that are read, and breaks when there have been `most` of them."""

    def __init__(self, link: Any, frames: Counter[str], name: str, most: int) -> None:
        super().__init__(link)
        self._frames, self._attempt, self._most, self._decoder = frames, name, most, FrameDecoder()

    def read(self, timeout_s: float) -> bytes:
        if self._frames[self._attempt] >= self._most:
            raise LinkError("the cable was pulled")
        data = super().read(timeout_s)
        self._frames[self._attempt] += len(self._decoder.feed(data))
        return data


class Delayed(Wrapped):
    """A link on which each command of `opcode` takes `seconds`; what the device sends meanwhile is read then."""

    def __init__(self, link: Any, opcode: Opcode, seconds: float) -> None:
        super().__init__(link)
        self._opcode, self._seconds, self._early, self._decoder, self.sent = opcode, seconds, b"", FrameDecoder(), 0

    def write(self, data: bytes) -> None:
        commands = [frame for frame in self._decoder.feed(data) if frame.type == MessageType.COMMAND]
        if any(decode_command(frame.payload).opcode == self._opcode for frame in commands):
            self.sent += 1
            if self._opcode == Opcode.STOP:
                self._early = self.link.read(self._seconds)
                assert self._early
            else:
                self.link.pause(self._seconds)
        self.link.write(data)

    def read(self, timeout_s: float) -> bytes:
        early, self._early = self._early, b""
        return early or super().read(timeout_s)

    def reopen(self) -> Delayed:
        self.link.reopen()
        return self


def small_link(mode: str) -> VirtualLink:
    profile, _, _ = small_setup(mode)
    clock = DeviceClock(profile.clock.tick_hz)
    device = Instrument(profile, load_scene("uniform"), seed=1, power_on_tick=clock.tick_at(START_NS))
    return VirtualLink(device, clock, "sim:small")


def recorded_run(
    path: Path,
    link: Any,
    mode: str,
    url: str = "",
    cycles: int = FEW,
    way_back: Recovery | None = None,
    watch: Any = None,
) -> tuple[Any, Any, Any]:
    """A run over `link`, with the usual way back: its result, its recording and a replay."""
    profile, bundle, plan = small_setup(mode)
    backend = "table" if bundle.automaton is None else "automaton"
    core = Core(plan, make_decider(bundle, shots=1, backend=backend), 1, cycles)
    config = RunOptions(n_cycles=cycles, deadline_us=1e9, realtime=False)
    facts = {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": backend, "drive": plan.drive, "confidence": 0.0}
    with Recorder(path, {"config": facts}) as recorder:
        recovery, observers = way_back or Recovery.of(link, url, 60.0), Observers(watch=watch)
        result = run_live(link, Job(profile, bundle, plan, config), core, recorder, recovery, observers)
        recorder.close({})
    recording = read_recording(path)
    return result, recording, replay(recording, bundle)


@pytest.mark.parametrize("mode", ["sequential", "parallel"])  # of parallel frames many reads are taken at once
def test_the_frames_of_attempts_that_failed_are_counted(mode: str, tmp_path: Path) -> None:
    frames: Counter[str] = Counter()
    breaks = iter([("run", 200), ("first attempt", 3), ("second attempt", 7), ("rest", 1 << 30)])
    first = Counted(small_link(mode), frames, *next(breaks))
    way_back = Recovery(lambda lost: Counted(lost.link.reopen(), frames, *next(breaks)), 60.0, first.link.pause)  # type: ignore[attr-defined,arg-type,return-value]
    result, _, again = recorded_run(tmp_path / "run.pansrec", first, mode, cycles=500, way_back=way_back)
    assert (result.ended, result.reconnects, again.as_recorded) == ("completed", 1, True)
    assert min(frames["first attempt"], frames["second attempt"]) > 0
    assert result.decoder["frames"] == frames.total()


def test_what_comes_before_arm_is_no_part_of_the_run(tmp_path: Path) -> None:
    """The link breaks within the last object: the connection that is found again is told to stop, and never armed.

    STOP is late: the device has reported its status, as it does every second, before.
    """

    def broken(run: Any, output: Any) -> None:
        if output.block_end_tick is not None and not run.reconnects:
            raise LinkError("the cable was pulled")

    first, cycles = small_link("sequential"), small_setup()[2].cycles_per_object
    way_back = Recovery(lambda lost: Delayed(lost.reopen(), Opcode.STOP, 1.5), 60.0, first.pause)  # type: ignore[attr-defined,arg-type,return-value]
    result, _, again = recorded_run(
        tmp_path / "run.pansrec", first, "sequential", cycles=cycles, way_back=way_back, watch=broken
    )
    assert (result.ended, result.reconnects) == ("the link was lost within the last object", 1)
    assert (result.contradictions, again.as_recorded) == ({}, True)


@pytest.mark.parametrize("mode", ["sequential", "parallel", "host-driven"])
def test_an_arm_that_comes_too_late_is_sent_again_with_a_longer_lead(tmp_path: Path, mode: str) -> None:
    link = Delayed(small_link(mode), Opcode.ARM, 0.25)
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


@pytest.mark.parametrize("mode", ["parallel", "host-driven"])
def test_an_arm_is_sent_again_at_real_pace(tmp_path: Path, mode: str) -> None:
    profile, _, _ = small_setup(mode)
    clock = DeviceClock(profile.clock.tick_hz)
    device = Strict(profile, load_scene("uniform"), seed=1, power_on_tick=clock.tick_at(time.perf_counter_ns()))
    with served(device, clock) as port:
        result, recording, again = recorded_run(tmp_path / "run.pansrec", open_link(port.url), mode, port.url)
    assert (result.ended, again.as_recorded) == ("completed", True)
    late = [event["lead_ms"] for event in recording.events() if event["kind"] == "armed_too_late"]
    assert late[:2] == [200, 400]
    assert (result.contradictions, result.stream["lost_exposures"]) == ({}, 0)


def test_a_host_that_is_always_too_late_ends_with_the_refusal(tmp_path: Path) -> None:
    link = Delayed(small_link("sequential"), Opcode.ARM, 5.0)
    result, _, _ = recorded_run(tmp_path / "run.pansrec", link, "sequential")
    assert result.ended.startswith("the device refused") or "TOO_LATE" in result.ended
    assert (result.tally.decisions, result.reconnects, link.sent) == (0, 1, 7)  # the last one in a new session


class NewEpochs(Wrapped):
    """A link to a device that restarts again and again: after each `most` messages it says WELCOME with another epoch."""

    def __init__(self, link: Any, most: int) -> None:
        super().__init__(link)
        self._most, self._left, self.opened, self._decoder = most, most, 1, FrameDecoder()

    def read(self, timeout_s: float) -> bytes:
        data = super().read(timeout_s)
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
