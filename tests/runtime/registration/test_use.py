"""A run with a registration: what it shows and records, that a replay is the same, and what it refuses."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.runtime import SHIPPED
from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import main
from pans.runtime.imaging import Imaging
from pans.runtime.instrument.calibration import now_utc
from pans.runtime.instrument.profile import load_profile
from pans.runtime.record import read_recording
from pans.runtime.registration.correct import corrected
from pans.runtime.registration.estimate import Estimate
from pans.runtime.registration.file import load_registration, registration_values, save_registration
from pans.runtime.registration.parameters import DARK, vector_of

PROFILE = load_profile("oled-qcmos")
URL = "sim:oled-qcmos?pace=fast&seed=3&optics=shift=1,1"
TABLE = Imaging(right_px=1.0, down_px=1.0, psf_px=0.002)


def registered(path: Path, **changes: Any) -> Path:
    found = Estimate(vector_of(TABLE), np.eye(DARK + 1) * 1e-6, 0.0, 9.0, 9, 100, 200)
    facts = {
        "made_utc": now_utc().isoformat(timespec="seconds"),
        "profile": {"name": PROFILE.name, "sha256": PROFILE.sha256},
        "device": {},
    }
    save_registration(path, {**facts, **registration_values(found, (28, 28)), **changes})
    return path


def test_a_run_shows_the_corrected_patterns_and_its_replay_is_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, out = registered(tmp_path / "table.json"), tmp_path / "out"
    words = ["run", "fashion10", "--device", URL, "--registration", str(table), "--out", str(out), "--no-realtime"]
    assert main([*words, "--decisions", "20", "--json"]) == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out.splitlines()[-1])
    assert "patterns corrected for the table" in captured.err
    recording = read_recording(out / "run.pansrec")
    kept = recording.header["config"]["registration"]
    shown, _ = corrected(load_bundle(SHIPPED / "fashion10.pans")[0], load_registration(table).imaging())
    assert kept["sha256"] == summary["registration"]["sha256"] == hashlib.sha256(table.read_bytes()).hexdigest()
    assert kept["levels_sha256"] == hashlib.sha256(shown.pattern_levels.astype("<u2").tobytes()).hexdigest()
    assert summary["illumination"] == pytest.approx(shown.illumination())
    assert summary["registration"]["error_after"] < 0.2 * summary["registration"]["error_before"]
    assert main(["replay", str(out / "run.pansrec"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["identical"] is True


def test_a_run_refuses_a_registration_of_another_device(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = registered(tmp_path / "table.json", device={"serial": "another"})
    call = ["run", "fashion10", "--device", URL, "--registration", str(table), "--decisions", "1", "--no-realtime"]
    assert main([*call, "--out", str(tmp_path / "out")]) == 2
    assert "made on the device another" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*.pansrec"))
