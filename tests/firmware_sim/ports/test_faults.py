"""Faults by seed, whole runs under faults, and the judge of these runs."""

from __future__ import annotations

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from fault_grid import MODES, NEVER_ARMED, OFTEN, run_case
from run_books import DeviceLog, ObservedLink

from pans.base.errors import ConfigError, LinkError, UsageError
from pans.live.reconnect import pauses_s
from pans.record.recorder import Recorder
from pans_sim.device.clock import DeviceClock
from pans_sim.device.gates import Gates
from pans_sim.ports import faulty as faulty_module
from pans_sim.ports.faults import NAMES, NO_FAULTS, USUAL, Faults, Recurring, check_possible, parse_faults
from pans_sim.ports.faulty import FaultCounters, FaultyDevice, Lane
from pans_sim.ports.serve import open_sim, parse_sim_url

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
    with pytest.raises(ConfigError, match="cannot be read"):
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


# -- whole runs: every pair of a fault and a mode is in tests/slow/test_fault_grid.py -----------------------------------


@pytest.mark.parametrize("seed", range(len(MODES)))
def test_whole_runs_under_all_faults(seed: int) -> None:
    result = run_case("all", seed, 2_000)
    assert (result.violations, result.ended) == ([], "completed")
    assert result.checked["decisions"] > 100
    assert result.checked["decisions_flagged"] > 0
    assert result.checked["gates_executed"] > 0


@pytest.mark.parametrize("case", ["disconnect", "reset", "late"])
def test_whole_runs_under_slow_faults(case: str) -> None:
    result = run_case(case, NAMES.index(case), 4_000, OFTEN[case])
    assert result.violations == []
    assert any(count for name, count in result.faults.items() if name != "frames")
    assert (result.reconnects > 0) == (case in ("disconnect", "reset"))


def test_a_device_that_goes_away_before_it_is_armed_ends_the_run() -> None:
    result = run_case("disconnect", 6, 100, "disconnect:10ms/60ms")
    assert result.faults["disconnects"] == 1
    assert (result.ended, result.frames, result.violations) == (NEVER_ARMED, 0, [])


# -- the judge must be able to fail: the books are changed, or the device does wrong on purpose --------------------------


def other_clicks(log: DeviceLog, wire: ObservedLink) -> None:
    for blocks in log.blocks.values():
        blocks[:] = [one._replace(readings=one.readings ^ 1) for one in blocks]


def other_length(log: DeviceLog, wire: ObservedLink) -> None:
    next(iter(log.blocks.values())).pop()


def second_execution(log: DeviceLog, wire: ObservedLink) -> None:
    log.commands.append(log.commands[-1])
    log.pulses.append(log.pulses[-1])


def no_pulse(log: DeviceLog, wire: ObservedLink) -> None:
    del log.pulses[-1]


def other_message(log: DeviceLog, wire: ObservedLink) -> None:
    next(iter(wire.heard.values())).add(b"one more")
    wire.answers.add(b"one more")


@pytest.mark.parametrize(
    ("change", "texts"),
    [
        (other_clicks, ["other clicks than were emitted"]),
        (other_length, ["STATUS claims"]),
        (second_execution, ["executed after", "executed twice"]),
        (no_pulse, ["neither executed nor reported"]),
        (other_message, ["messages arrived", "answers arrived"]),
    ],
)
def test_books_that_disagree_are_found(change: Any, texts: list[str]) -> None:
    violations = run_case("none", 0, 1_500, None, change).violations
    assert all(any(text in violation for violation in violations) for text in texts), violations


@pytest.mark.parametrize(("name", "text"), [("gap", "no gap"), ("gate_refused", "neither executed nor reported")])
def test_an_event_that_is_not_reported_is_found(name: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Recorder.add_event

    def silent(self: Recorder, event: Mapping[str, Any]) -> None:
        if event["kind"] != name:
            original(self, event)

    monkeypatch.setattr(Recorder, "add_event", silent)
    violations = run_case("all", 0, 3_000).violations
    assert any(text in violation for violation in violations), violations


def test_a_device_that_executes_late_gates_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Gates.add
    monkeypatch.setattr(Gates, "add", lambda self, gate, now: original(self, gate, min(now, gate.tick - 1)))
    assert any("late" in violation for violation in run_case("pause", 0, 6_000, OFTEN["pause"]).violations)
