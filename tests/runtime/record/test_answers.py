"""WELCOME, ACK and PONG on record: handshakes and refusals can be audited, and recordings from before them are read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from commands import json_of

from pans.firmware_sim.ports.serve import open_sim
from pans.firmware_sim.testing import small_setup
from pans.runtime.bundle.model import bundle_bytes
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import DeviceError
from pans.runtime.live import LiveRun, Observers, RunOptions, run_live
from pans.runtime.record import Recorder, read_recording
from pans.runtime.record.format import Kind
from pans.runtime.record.replaying import replay
from pans.runtime.wire.messages import MessageType, Opcode, unpack_body

CYCLES = 40


def record(path: Path, prepared: Any = None) -> Path:
    profile, bundle, plan = small_setup()
    header = {"config": {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table"}}
    header["profile"] = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}
    core = Core(plan, make_decider(bundle, backend="table"), 1, CYCLES)
    config = RunOptions(n_cycles=CYCLES, deadline_us=1e9, realtime=False)
    with Recorder(path, header, bundle=bundle_bytes(bundle)) as recorder:
        link = open_sim("sim:ideal?scene=uniform&pace=fast&seed=1")
        run_live(link, profile, bundle, plan, core, config, recorder, observers=Observers(prepared=prepared))
        recorder.close({})
    return path


def test_what_the_device_answered_is_on_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(tmp_path / "run.pansrec")
    recording = read_recording(path)
    kinds = [unpack_body(body).type for _, body in recording.answers()]
    assert kinds[0] == MessageType.WELCOME
    assert {MessageType.ACK, MessageType.PONG} <= set(kinds)
    assert MessageType.STATUS not in kinds
    facts = json_of(capsys, "info", path)
    (session,) = facts["handshakes"]
    assert session["device"]["simulated"] is True
    assert (session["welcomes"], session["refused"], session["malformed"]) == (1, [], 0)
    assert session["acks"] + session["pongs"] + 1 == facts["answers"] == len(kinds)
    assert json_of(capsys, "verify", path, code=0)["ok"]
    assert replay(recording, recording.bundle()).as_recorded


def test_a_refusal_that_ends_the_set_up_is_on_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(run: LiveRun) -> None:
        run.connection.session.submit(Opcode.LOAD_PLAN, b"nothing that is a plan")
        run.connection.settle()

    path = tmp_path / "run.pansrec"
    with pytest.raises(DeviceError, match="refused command"):
        record(path, refused)
    (session,) = json_of(capsys, "info", path)["handshakes"]
    (told,) = session["refused"]
    assert (told["command"], told["status"] > 0) == ("LOAD_PLAN", True)
    recording = read_recording(path)
    assert replay(recording, recording.bundle())[:2] == (0, recording.decisions_sha256)


def test_an_answer_that_is_none_is_a_violation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for body, words in ((b"short", "answer 0"), (bytes([MessageType.STATUS]) + bytes(20), "allowed: WELCOME")):
        path = tmp_path / f"{len(body)}.pansrec"
        with Recorder(path, {}) as recorder:
            recorder.add_answer(1, body)
            recorder.close({})
        assert read_recording(path).kinds[Kind.ANSWERS] == 1
        found = json_of(capsys, "verify", path, code=1)["violations"]
        assert words in " ".join(one["message"] for one in found)
