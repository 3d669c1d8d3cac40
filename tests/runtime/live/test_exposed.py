"""When exposures happened, as the device tells: kept, judged, recorded and replayed; a device that does not tell is not judged."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import fault_grid
import numpy as np
import pytest
from commands import fixed_run, json_of, page_of, words_of

from pans.decide.follower import Place, exposure_timing
from pans.decide.still.core import Core
from pans.live.loop import Job, RunResult, run_live
from pans.live.options import RunOptions
from pans.live.timing.ledger import TimingLedger
from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import Frame, MessageType, unpack_body
from pans.protocol.wire.messages import Exposed, encode_exposed
from pans.protocol.wire.schema import EXPOSED_SCHEMA
from pans.record.reading import read_recording
from pans.record.reading.sent_plan import sent_to_device
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans.report.pages.run import advice_on
from pans.report.summary.summary import exposure_fault, find_faults
from pans.report.summary.words import exposure_words
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.virtual import START_NS, VirtualLink

FRAMES = 900
MOST = 40  # ticks
NOT_TOLD = ("within", "worst_start_us", "worst_length_us", "worst_start_exposure", "worst_length_exposure")


class Board(Instrument):
    """Its exposures are off by chance; `off` holds (start, length) of each that it has told of."""

    schema: int | None = EXPOSED_SCHEMA
    copies = 1  # of each EXPOSED
    beyond = 0  # what is added to their numbers
    every_ticks = 0  # between STATUS and STATUS, above 0

    def __init__(self, *what: Any, **words: Any) -> None:
        self.off: list[tuple[int, int]] = []
        self.dice = random.Random(words["seed"])
        super().__init__(*what, **words)

    def _send_status(self) -> None:
        super()._send_status()
        if self.every_ticks and self._status_tick is not None:
            self._status_tick = self._tick + self.every_ticks

    def _send_exposed(self, ended: int) -> None:
        first = len(self.off)
        self.off += [(self.dice.randint(-MOST, MOST), self.dice.randint(-MOST, MOST)) for _ in range(first, ended)]
        if ended > first:
            starts, lengths = zip(*self.off[first:])
            longest = [max(map(abs, one)) for one in (starts, lengths)]
            at = [[abs(error) for error in one].index(most) for one, most in zip((starts, lengths), longest)]
            numbers = first + at[0] + self.beyond, first + at[1] + self.beyond
            told = Exposed(ended - first, starts[at[0]], lengths[at[1]], *numbers)
            self._out += [encode_exposed(told, self.session)] * self.copies

    def _facts(self) -> dict[str, Any]:
        facts = {key: value for key, value in super()._facts().items() if key != "exposed_schema"}
        return facts if self.schema is None else facts | {"exposed_schema": self.schema}


def ran(path: Path, mode: str = "sequential", **board: Any) -> tuple[RunResult, Board, dict[str, Any], Any]:
    """One run of FRAMES messages against a board; also what its replay says, and the case."""
    one = fault_grid.Case.of(mode, FRAMES)
    clock = DeviceClock(one.profile.clock.tick_hz)
    device = Board(one.profile, one.scene, seed=7, power_on_tick=clock.tick_at(START_NS))
    for name, value in board.items():
        setattr(device, name, value)
    config = RunOptions(n_cycles=one.n_cycles, deadline_us=1e9, realtime=False)
    header = {"config": one.recorded(), "profile": {"toml": one.profile.text}}
    with Recorder(path / "run.pansrec", header) as recorder:
        link = VirtualLink(device, clock, "sim:board")
        result = run_live(link, Job(one.profile, one.bundle, one.plan, config), one.core, recorder)
        result.decisions_sha256 = recorder.close({})
    again = replay(read_recording(path / "run.pansrec"), one.bundle)
    assert again.as_recorded
    assert again.contradictions == result.contradictions
    return result, device, again.exposure_timing, one


@pytest.mark.parametrize("mode", ["sequential", "parallel", "device-driven", "host-driven"])
def test_the_farthest_exposures_of_a_run_are_named(tmp_path: Path, mode: str) -> None:
    result, board, again, one = ran(tmp_path, mode, copies=2)  # an equal one is a repetition
    timing, tick_us = result.exposure_timing, one.plan.tick_us
    assert timing["exposures"] == len(board.off) == result.stream["exposures"] > 500
    for what, errors in zip(("start", "length"), zip(*board.off)):
        number = max(range(len(errors)), key=lambda k: abs(errors[k]))
        assert timing[f"worst_{what}_us"] == pytest.approx(errors[number] * tick_us)
        assert timing[f"worst_{what}_exposure"] == number
    assert again == timing
    assert timing["tolerance_us"] == pytest.approx(max(one.plan.exposure_us / 100, tick_us + 0.001))
    assert timing["within"] is (tick_us * MOST <= timing["tolerance_us"])
    assert bool(find_faults(result, 0)) is not timing["within"]


@pytest.mark.parametrize("schema", [None, EXPOSED_SCHEMA ^ 1])
def test_a_device_that_does_not_announce_it_is_not_judged(tmp_path: Path, schema: int | None) -> None:
    (tmp_path / "told").mkdir()
    result, board, again, _ = ran(tmp_path, schema=schema)
    told, *_ = ran(tmp_path / "told")
    assert board.off
    assert result.exposure_timing == again
    assert (again["announced"], again["exposures"]) == (False, 0)
    assert {again[key] for key in NOT_TOLD} == {None}
    assert exposure_words(again) == "not told by the device"
    assert find_faults(result, 0) == []
    assert result.decisions_sha256 == told.decisions_sha256


def talkative(path: Path) -> tuple[Any, list[Frame]]:
    """A core that has begun the stream of a run with a STATUS every 20 ms, and the run's messages."""
    ran(path, every_ticks=20_000)
    recording = read_recording(path / "run.pansrec")
    (arm,) = sent_to_device(recording).arms.values()

    def core() -> Core:
        begun = fault_grid.Case.of("sequential", FRAMES).core
        begun.begin(arm.start_tick, arm.n_cycles)
        return begun

    return core, [unpack_body(body) for _, body in recording.messages()]


@pytest.mark.parametrize(
    ("is_old", "silent", "judged"), [(False, False, False), (False, True, True), (True, True, False)]
)
def test_a_part_of_a_recording_goes_on_with_what_was_told_before_it(
    tmp_path: Path, *, is_old: bool, silent: bool, judged: bool
) -> None:
    """One that was made before parts knew is not judged; `silent`: EXPOSED ends with the first part."""
    core, frames = talkative(tmp_path)
    one, later, place, half = core(), core(), None, 0
    while place is None or half < len(frames) // 2:
        one.step(frames[half])
        half += 1
        place = one.part()
    assert place.told[0] > 500
    assert place.told[1] > MOST // 2
    facts = json.loads(json.dumps(place.facts()))
    later.resume(Place.of({name: value for name, value in facts.items() if name != "told" or not is_old}))
    for frame in frames[half:]:
        if not silent or frame.type != MessageType.EXPOSED:
            later.step(frame)
    assert (later.completed, later.contradictions) == (True, {})
    assert (later.untold > 0) is judged


def test_the_tail_of_a_stream_that_broke_off_need_not_be_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    core, frames = talkative(tmp_path)
    monkeypatch.setattr("pans.decide.follower.TAIL_US", 40_000.0)
    last = max(at for at, frame in enumerate(frames) if frame.type == MessageType.EXPOSED)
    whole = [frame for frame in frames[:last] if frame.type != MessageType.STATUS]
    for kept, is_told in ((frames[:last], True), (whole, True), ([f for f in whole if f.type in STREAM_TYPES], False)):
        broken = core()
        for frame in kept:
            broken.step(frame)
        broken.end()
        assert (broken.untold == 0) is is_told


def test_what_lies_beyond_the_plan_is_not_believed(tmp_path: Path) -> None:
    result, _, again, _ = ran(tmp_path, beyond=1 << 40)
    assert result.contradictions["exposed"] > 0
    assert result.exposure_timing["exposures"] == again["exposures"] == 0
    (contradict, none) = find_faults(result, 0)
    assert "exposed" in contradict
    assert "told of none" in none  # although it has announced it


@pytest.mark.parametrize(("late", "said"), [(3, ""), (6, "; half of all decisions took more than 2,")])
def test_a_deadline_below_the_usual_latency_is_said_to_be_one(tmp_path: Path, late: int, said: str) -> None:
    result, *_ = ran(tmp_path)
    timing = TimingLedger(1_000_000)
    marks_ns = np.array([[0, 100, 200, took_ns, took_ns] for took_ns in (500_000, 2_000_000)])
    timing.judge(marks_ns, np.zeros(2, np.int64), np.array([10 - late, late]))
    fault = find_faults(replace(result, timing=timing), 0)[0]
    assert fault.startswith(f"{late} decisions later than 1 ms (cause: ")
    assert fault.partition(")")[2].startswith(said) if said else fault.endswith(")")
    assert ("--deadline-us" in advice_on(fault)) is bool(said)


def test_both_errors_are_judged_in_both_directions_and_up_to_the_tolerance() -> None:
    for start, length, within in ((5, -5, True), (-6, 0, False), (0, 6, False), (6, -6, False)):
        timing = exposure_timing(Exposed(9, start, length, 3, 4), 0.5, 2.5, announced=True)
        assert timing["within"] is within
        fault = exposure_fault(timing)
        assert ("start of exposure 3" in fault) is (abs(start) == 6)
        assert ("length of exposure 4" in fault) is (abs(length) == 6)
        assert within or "allowed 2.5 us" in fault


def test_a_run_whose_exposures_are_late_and_short_fails_wherever_it_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, state = list(fixed_run(20)), tmp_path / "state.json"
    fine = json_of(capsys, *words, "--out", tmp_path / "fine")
    assert (fine["verdict"], fine["exposure_timing"]["within"], fine["exposure_timing"]["worst_start_us"]) == (
        "PASS",
        True,
        0,
    )
    words[words.index("--device") + 1] += "&exposure_late_us=60&exposure_short_us=100"
    off = json_of(capsys, *words, "--out", tmp_path / "off", "--state", state, code=4)
    timing = off["exposure_timing"]
    assert (timing["worst_start_us"], timing["worst_length_us"], timing["tolerance_us"]) == (60.0, -100.0, 30.0)
    assert (off["verdict"], off["contradictions"], off["slot_jitter_us"]) == ("FAIL", {}, 60.0)
    assert off["photons_mean"] == pytest.approx(fine["photons_mean"] * 2900 / 3000)  # of 3 ms
    (fault,) = off["faults"]
    told = json.loads(state.read_text())
    assert (told["exposure_start_us"], told["exposure_length_us"]) == (60.0, -100.0)
    assert json_of(capsys, "replay", off["recording"])["exposure_timing"] == timing
    page = words_of(page_of(Path(off["recording"]), tmp_path))
    assert fault in page
    assert exposure_words(timing) in page
    assert exposure_words(timing) in Path(off["report"]).read_text()
    wider = tmp_path / "wider.toml"
    text = json_of(capsys, "profile show oled-qcmos")["toml"]
    wider.write_text(text.replace("[timing]", "[timing]\nexposure_tolerance_us = 100.0"))
    words[words.index("--device") + 1] = words[words.index("--device") + 1].replace("oled-qcmos", str(wider))
    assert json_of(capsys, *words, "--out", tmp_path / "wide")["verdict"] == "PASS"
