"""A recording that was cut off, at any byte: what is recorded is decided again bit for bit, and the rest can be decided too."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from commands import json_of

from pans.firmware_sim.ports.serve import open_sim
from pans.firmware_sim.testing import small_setup
from pans.runtime.bundle.model import bundle_bytes
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.live import Recovery, RunOptions, run_live
from pans.runtime.record import Recorder, Recording, read_recording
from pans.runtime.record.format import Kind
from pans.runtime.record.replaying import replay

CYCLES = 2400
ALL_FAULTS = "loss:0.01,duplicate:0.01,flip:0.01,stall:300ms/700ms"


def record(path: Path, faults: str = "", seed: int = 1) -> Path:
    """Record a run in virtual time, ended by `close`."""
    profile, bundle, plan = small_setup()
    url = f"sim:ideal?scene=uniform&pace=fast&seed={seed}&faults={faults}"
    link = open_sim(url)
    header = {"config": {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table"}}
    header["profile"] = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}
    core = Core(plan, make_decider(bundle, backend="table"), 1, CYCLES)
    config = RunOptions(n_cycles=CYCLES, deadline_us=1e9, realtime=False)
    with Recorder(path, header, bundle=bundle_bytes(bundle)) as recorder:
        result = run_live(link, profile, bundle, plan, core, config, recorder, Recovery.of(link, url, 10.0))
        recorder.close({"decisions": result.tally.decisions})
    return path


@pytest.fixture
def small_buffers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffers that are full now and then, each in its own time."""
    monkeypatch.setattr("pans.runtime.record.recorder.BUFFER_ROWS", 23)
    monkeypatch.setattr("pans.runtime.record.recorder._MESSAGE_BUFFER_BYTES", 3001)
    monkeypatch.setattr("pans.runtime.live.run.FLUSH_EVERY_NS", 50_000_000)


def cut_at(whole: bytes, size: int, path: Path) -> Recording:
    path.write_bytes(whole[:size])
    return read_recording(path)


@pytest.mark.usefixtures("small_buffers")
@pytest.mark.parametrize("faults", ["", ALL_FAULTS])
def test_what_is_recorded_of_a_cut_run_is_decided_again(tmp_path: Path, faults: str) -> None:
    seed = random.SystemRandom().randrange(1 << 32)
    rng = random.Random(seed)
    path = record(tmp_path / "run.pansrec", faults, seed)
    whole, recording = path.read_bytes(), read_recording(path)
    complete = replay(recording, recording.bundle())
    assert complete.as_recorded
    assert complete.more == 0
    ends = [block.end for block in recording.iter_blocks()]
    assert recording.kinds[Kind.DECISIONS] > 10
    found = []
    for size in sorted({*rng.sample(ends[1:-1], 12), *(rng.randrange(ends[1], len(whole)) for _ in range(6))}):
        part = cut_at(whole, size, tmp_path / "cut.pansrec")
        again = replay(part, part.bundle())
        assert again.as_recorded, f"seed {seed}, {size} of {len(whole)} bytes: {part.n_decisions} recorded, {again}"
        assert again.decisions >= part.n_decisions == again.recorded
        assert again.decisions <= complete.decisions
        found.append(again.more)
    assert max(found) > 0


@pytest.mark.usefixtures("small_buffers")
def test_the_words_about_a_cut_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(tmp_path / "run.pansrec")
    whole, recording = path.read_bytes(), read_recording(path)
    decisions = [block for block in recording.iter_blocks(Kind.DECISIONS)]
    messages = [block for block in recording.iter_blocks(Kind.MESSAGES) if block.end > decisions[3].end]
    part = cut_at(whole, messages[0].end, path)
    found = json_of(capsys, "replay", path)
    more = found["decisions"] - part.n_decisions
    assert found["identical"]
    assert not found["complete"]
    assert (found["decisions_recorded"], found["decisions_more"]) == (part.n_decisions, more)
    assert more > 0
    assert json_of(capsys, "replay", path, code=0)["sha256"] != found["recorded_sha256"]


def test_a_run_that_was_cut_before_it_armed_has_nothing_to_decide(tmp_path: Path) -> None:
    whole = record(tmp_path / "run.pansrec").read_bytes()
    recording = read_recording(tmp_path / "run.pansrec")
    end = next(recording.iter_blocks(Kind.BUNDLE)).end
    part = cut_at(whole, end, tmp_path / "cut.pansrec")
    assert replay(part, part.bundle())[:3] == (0, part.decisions_sha256, None)
