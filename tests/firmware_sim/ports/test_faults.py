"""Faults by seed, the checkers' eyes, and whole runs under faults. Whole runs are short here; the long ones are
`pans trials fault-grid`."""

from __future__ import annotations

import itertools
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.firmware_sim.device import instrument as device_module
from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.device.gates import Gates
from pans.firmware_sim.ports import faulty as faulty_module
from pans.firmware_sim.ports.faults import NAMES, NO_FAULTS, USUAL, Faults, Recurring, check_possible, parse_faults
from pans.firmware_sim.ports.faulty import FaultCounters, FaultyDevice, Lane
from pans.firmware_sim.ports.serve import open_sim, parse_sim_url
from pans.firmware_sim.trials.fault_grid import MODES, NEVER_ARMED, case_faults, run_case
from pans.runtime.core import stream_kernels
from pans.runtime.core.follower import Follower
from pans.runtime.core.still import Core
from pans.runtime.core.window import DecisionWindows
from pans.runtime.decide.table import TableDecider
from pans.runtime.errors import ConfigError, LinkError, UsageError
from pans.runtime.live.reconnect import pauses_s
from pans.runtime.wire import messages as wire
from pans.runtime.wire import session as session_module
from pans.runtime.wire import tracker as ingest
from pans.runtime.wire.tracker import StreamTracker

MS = 1_000_000
FRAMES = [bytes([number]) * (10 + number) + b"\0" for number in range(1, 41)]


# -- what can be asked for ---------------------------------------------------------------------------------------------


def test_faults_are_named_with_or_without_a_strength() -> None:
    assert parse_faults("") == NO_FAULTS
    assert parse_faults("loss:0.5, flip") == Faults(loss=0.5, flip=0.01)
    assert parse_faults("stall:600ms/5s") == Faults(stall=Recurring(600 * MS, 5000 * MS))
    everything = parse_faults("all")
    assert all(getattr(everything, name) for name in NAMES)
    assert parse_faults("all,loss:0.25").loss == 0.25
    assert set(USUAL) == set(NAMES)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("lose", "there is no fault 'lose'"),
        ("loss:2", "a probability, allowed: 0 to 1, found '2'"),
        ("loss:nan", "a probability"),
        ("stall:600", "needs a length and how often"),
        ("stall:5s/600ms", "less than its period"),
        ("stall:5/6", "no time in us, ms or s"),
        ("clock_step:-2ms/1s", "cannot run backwards"),
    ],
)
def test_what_cannot_be_done_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_faults(text)
    assert complaint in str(caught.value)


def test_what_a_shell_cannot_do_is_refused_with_the_way_out() -> None:
    with pytest.raises(UsageError, match="pace=fast"):
        check_possible(parse_faults("pause"), pace="real")
    with pytest.raises(UsageError, match="tcp:"):
        check_possible(parse_faults("disconnect"), pace="real", listen="pty")
    with pytest.raises(UsageError, match="pause cannot be done"):
        parse_sim_url("sim:ideal?faults=pause")
    assert parse_sim_url("sim:ideal?faults=loss&pace=fast").faults == "loss"


def test_faults_come_from_a_file_too(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text('[faults]\nloss = 0.25\nstall = "600ms/5s"\n')
    assert parse_faults(str(path)) == Faults(loss=0.25, stall=Recurring(600 * MS, 5000 * MS))
    path.write_text("loss = 1\n")
    with pytest.raises(ConfigError, match="one table"):
        parse_faults(str(path))
    with pytest.raises(UsageError, match="cannot be read"):
        parse_faults(str(tmp_path / "none.toml"))


# -- what is done to the bytes -----------------------------------------------------------------------------------------


def through(faults: Faults, seed: int = 1, repeat: int = 50) -> tuple[list[bytes], FaultCounters]:
    counters = FaultCounters()
    lane = Lane(faults, random.Random(seed), 100_000, counters)
    out = b""
    for tick, frame in enumerate(FRAMES * repeat):
        lane.put(tick * 1000, frame)
        out += lane.take(tick * 1000 + 999)
    out += lane.take(1 << 60)
    return out.split(b"\0")[:-1], counters


def test_a_lane_without_faults_changes_nothing() -> None:
    frames, counters = through(NO_FAULTS)
    assert b"\0".join(frames) + b"\0" == b"".join(FRAMES * 50)
    assert counters == FaultCounters()


@pytest.mark.parametrize("name", ["loss", "flip", "duplicate", "truncate", "reorder", "drip"])
def test_each_fault_does_what_its_name_says_about_as_often_as_asked(name: str) -> None:
    faults = parse_faults(f"{name}:0.1")
    frames, counters = through(faults)
    sent = [frame[:-1] for frame in FRAMES * 50]
    done = {
        key: getattr(counters, key) for key in ("lost", "flipped", "duplicated", "truncated", "reordered", "dripped")
    }
    (happened,) = [count for count in done.values() if count]
    assert abs(happened - 200) < 5 * (200 * 0.9) ** 0.5  # 2000 frames at 10 %
    if name == "loss":
        assert len(frames) == len(sent) - happened
    elif name == "duplicate":
        assert len(frames) == len(sent) + happened
    elif name == "reorder":
        assert sorted(frames) == sorted(sent)
        assert frames != sent
    elif name == "drip":
        assert frames == sent
    else:
        assert frames != sent
    again, _ = through(faults)
    other, _ = through(faults, seed=2)
    assert again == frames
    assert name == "drip" or other != frames


def test_a_lane_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faulty_module, "MAX_LANE_BYTES", 100)
    counters = FaultCounters()
    lane = Lane(NO_FAULTS, random.Random(1), 10, counters)
    lane.blocked_until = 1 << 40
    for _ in range(20):
        lane.put(0, b"123456789\0")
    assert counters.overflowed == 10
    assert lane.take(1 << 50) == b"123456789\0" * 10


class Echo:
    """A device that answers every byte at once."""

    session = 1

    def __init__(self, epoch: int, tick: int) -> None:
        self.epoch, self.tick = epoch, tick

    def step(self, tick: int, data: bytes) -> bytes:
        assert tick >= self.tick
        self.tick = tick
        return data

    def next_event_tick(self) -> int | None:
        return None


def faulty(text: str) -> FaultyDevice:
    return FaultyDevice(Echo, DeviceClock(1_000_000, 0, 0), parse_faults(text), 3, 0)


def test_a_stall_ends_in_a_flood() -> None:
    device = faulty("stall:600ms/2s")
    begin = device.next_event_tick()
    assert begin is not None
    assert device.step(begin, b"") == b""
    sent = b"".join(device.step(begin + 1000 * n, b"ab\0") for n in range(600))
    assert sent == b""
    assert device.step(begin + 600_000, b"") == b"ab\0" * 600


def test_a_broken_link_loses_what_is_on_it_and_comes_back() -> None:
    device = faulty("disconnect:300ms/2s")
    begin = device.next_event_tick()
    assert begin is not None
    device.step(begin, b"")
    assert not device.connected
    assert device.step(begin + 299_999, b"lost\0") == b""
    assert device.step(begin + 300_000, b"") == b""
    assert device.connected
    assert device.step(begin + 300_001, b"back\0") == b"back\0"


def test_clock_steps_and_restarts_reach_the_device() -> None:
    device = faulty("clock_step:5ms/1s")
    begin = device.next_event_tick()
    assert begin is not None
    device.step(begin, b"")
    assert device.device.tick == begin + 5000  # type: ignore[attr-defined]
    device = faulty("reset:0ms/1s")
    begin = device.next_event_tick()
    assert begin is not None
    device.step(begin + 7, b"")
    assert (device.device.epoch, device.device.tick) == (2, faulty_module.RESET_TICK + 7)  # type: ignore[attr-defined]


def test_a_broken_virtual_link_can_be_opened_again() -> None:
    link: Any = open_sim("sim:ideal?scene=uniform&pace=fast&faults=disconnect:300ms/2s")
    with pytest.raises(LinkError, match="went away"):
        for _ in range(100):
            link.read(0.1)
    with pytest.raises(LinkError, match="is not there"):
        link.reopen()
    link.pause(0.5)
    assert link.reopen().read(0.01) == b""


def test_pauses_double_up_to_a_limit() -> None:
    schedule = pauses_s()
    assert [next(schedule) for _ in range(7)] == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]


# -- whole runs --------------------------------------------------------------------------------------------------------


OFTEN = {
    "stall": "stall:300ms/500ms",
    "disconnect": "disconnect:100ms/400ms",
    "pause": "pause:100ms/200ms",
    "clock_step": "clock_step:2ms/100ms",
    "reset": "reset:0ms/500ms",
    "late": "late:40ms/300ms",
}


@pytest.mark.parametrize(
    ("case", "seed"),
    [*((case, seed) for case in ("none", "all") for seed in range(4)), ("none", 4), ("all", 4), ("all", 5)],
)
def test_whole_runs_under_all_faults_or_none(case: str, seed: int) -> None:
    result = run_case(case, seed, 12_000 if seed < 4 else 5_000)
    assert result.mode == MODES[seed]
    assert result.violations == [], result.violations
    assert result.ended == "completed"
    assert result.checked["decisions"] > (1000 if seed < 4 else 400)
    assert result.checked["gates_executed"] > (10 if seed < 4 else 3)
    assert (result.checked["decisions_flagged"] > 0) == (case == "all")


@pytest.mark.parametrize("case", NAMES)
def test_whole_runs_under_each_fault(case: str) -> None:
    assert case_faults(case).startswith(case)
    result = run_case(case, NAMES.index(case) % len(MODES), 6_000, OFTEN.get(case))
    assert result.violations == [], result.violations
    assert any(count for name, count in result.faults.items() if name != "frames")
    assert (result.reconnects > 0) == (case in ("disconnect", "reset"))


def test_a_run_is_the_same_for_the_same_seed() -> None:
    first, second = run_case("all", 5, 3_000), run_case("all", 5, 3_000)
    assert (first.checked, first.faults) == (second.checked, second.faults)
    assert run_case("all", 7, 3_000).faults != first.faults


# -- the checkers must be able to fail: each of these breaks the host or the device on purpose --------------------------


def found(case: str, text: str, faults_text: str | None = None) -> bool:
    violations = run_case(case, 0, 6_000, OFTEN.get(case, faults_text)).violations
    return any(text in violation for violation in violations)


def test_a_gap_that_is_not_reported_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = StreamTracker._gap_before

    def silent(self: StreamTracker, exposure_index: int, drops: int, **end: bool) -> None:
        original(self, exposure_index, drops, **end)

    monkeypatch.setattr(StreamTracker, "_gap_before", silent)
    assert found("loss", "skipped in silence")


def test_a_gap_that_is_too_long_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = StreamTracker._gap_before

    def generous(self: StreamTracker, exposure_index: int, drops: int, **end: bool) -> Any:
        gap = original(self, exposure_index, drops, **end)
        return None if gap is None else gap._replace(exposures=gap.exposures + 1)

    monkeypatch.setattr(StreamTracker, "_gap_before", generous)
    assert found("loss", "the gap")


def test_a_repeated_block_that_is_taken_twice_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "HALF_SEQUENCE", 1 << 33)  # nothing ever counts as seen before
    monkeypatch.setattr(ingest, "MAX_GAP_EXPOSURES", 1 << 62)
    original = StreamTracker.accept

    def forgetful(self: StreamTracker, frame: wire.Frame) -> Any:
        self.next_seq = wire.decode_mark(frame.payload).seq if frame.type == wire.MessageType.MARK else self.next_seq
        if frame.type == wire.MessageType.CLICKS:
            block = wire.decode_clicks(frame.payload)
            self.next_seq, self.next_exposure = block.seq, min(self.next_exposure, block.exposure_index)
        return original(self, frame)

    decide = TableDecider.decide  # which would refuse two clicks of one shot by itself
    monkeypatch.setattr(TableDecider, "decide", lambda self, counts, shots: decide(self, np.minimum(counts, 1), shots))
    monkeypatch.setattr(StreamTracker, "accept", forgetful)
    assert found("duplicate", "repeated, changed, or skipped")


def test_a_decision_from_a_window_with_a_gap_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = DecisionWindows._settle

    def blind(self: DecisionWindows, relative_end: int) -> Any:
        return [window._replace(missing=0) for window in original(self, relative_end)]

    monkeypatch.setattr(DecisionWindows, "_settle", blind)
    assert found("loss", "was made from a window with a gap")


def test_a_window_that_is_skipped_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = DecisionWindows.skip_to
    monkeypatch.setattr(DecisionWindows, "skip_to", lambda self, index: original(self, index)[1:])
    assert found("loss", "due was")


def test_miscounted_clicks_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = stream_kernels.walk_messages

    def wrong(*arguments: Any) -> Any:
        ended = original(*arguments)
        arguments[2].rows["counts_crc"] ^= 1
        return ended

    monkeypatch.setattr(stream_kernels, "walk_messages", wrong)
    assert found("none", "other clicks than were emitted")


def test_changed_clicks_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = wire.decode_clicks

    def wrong(payload: bytes) -> wire.ClickBlock:
        block = original(payload)
        return block if block.exposure_index % 50 else block._replace(bits=block.bits ^ np.uint8(1))

    monkeypatch.setattr(wire, "decode_clicks", wrong)
    monkeypatch.setattr(Core, "step_messages", Follower.step_messages)  # message by message
    assert found("none", "repeated, changed")


def test_a_device_that_executes_repetitions_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = device_module.Instrument._command

    def eager(self: device_module.Instrument, command: wire.CommandMessage) -> None:
        if command.command_id == self._ack.last_id and command.opcode == wire.Opcode.GATE:
            self._ack = self._ack._replace(last_id=command.command_id - 1)
        original(self, command)

    monkeypatch.setattr(device_module.Instrument, "_command", eager)
    assert found("duplicate", "executed", "duplicate:0.3")


def test_a_device_that_executes_late_gates_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Gates.add
    monkeypatch.setattr(Gates, "add", lambda self, gate, now: original(self, gate, min(now, gate.tick - 1)))
    assert found("pause", "late")


def test_a_refusal_that_is_not_reported_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire.Ack, "refuses", lambda self, number: False)
    assert found("pause", "neither executed nor reported")


def test_memory_that_grows_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    hoard: list[bytearray] = []
    turns = itertools.count()
    original = session_module.HostSession.poll

    def hoarding(self: session_module.HostSession, now_ns: int) -> None:
        if next(turns) % 4 == 0:  # pieces so large that each takes new pages, however much was freed before
            hoard.append(bytearray(b"x" * (1 << 20)))
        original(self, now_ns)

    monkeypatch.setattr(session_module.HostSession, "poll", hoarding)
    assert found("none", "the process grew")


def test_a_device_that_goes_away_before_it_is_armed_ends_the_run() -> None:
    """Seed 6 takes the link away while the clock is measured: nothing has been asked for, and there is nothing to go on with."""
    result = run_case("disconnect", 6, 100, "disconnect:10ms/60ms")
    assert result.faults["disconnects"] == 1
    assert (result.ended, result.frames, result.violations) == (NEVER_ARMED, 0, [])
