"""Changed files with right checksums: verify answers, and what it accepts can be used; `pans fuzz --files` makes a hundred thousand."""

from __future__ import annotations

import json
import secrets
from pathlib import Path

import pytest

from pans.firmware_sim.resealed import fuzz_files
from pans.runtime.cli import main
from pans.runtime.instrument import calibration


def test_a_short_run_finds_nothing_and_comes_far(tmp_path: Path) -> None:
    counts, failure = fuzz_files(secrets.randbits(32), 500, tmp_path)
    assert failure == ""
    assert set(counts.made) == {"bundle", "recording", "calibration", "profile", "scene", "flow"}
    assert 50 < sum(counts.accepted.values()) < 400


def test_a_missing_check_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_check_channel", lambda row, what: None)
    _, failure = fuzz_files(1, 400, tmp_path)
    assert "kept as" in failure


def test_the_command_reports_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fuzz", "--files", "20", "--parts", "2", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["files"], told["failed_seed"]) == (20, None)
