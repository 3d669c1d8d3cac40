"""`pans doctor --warm`: the commands that it runs end well, and one that fails or hangs is reported."""

from pathlib import Path

import pytest

from pans.app.doctor import warm
from pans.app.doctor.warm import COMMANDS, bundles, compiled_in, run_once, words_of
from pans.bundle.sensor.bundle import write_bundle


@pytest.mark.parametrize("name", ["objects in flow", "photon numbers", "two channels", "heads in eight bits"])
def test_what_is_run_ends_well(name: str, tmp_path: Path) -> None:
    for file, bundle in bundles():
        write_bundle(bundle, tmp_path / f"{file}.pans")
    assert run_once(name, COMMANDS[name], str(tmp_path))["told"] == ""


def test_a_failure_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = run_once("broken", ["run", "no-such-bundle", "--device", "sim:ideal"], str(tmp_path))
    assert (row["ok"], "no-such-bundle" in row["told"]) == (False, True)
    found = {"kernels": 1, "seconds": 1.0, "processes": 2, "folder": "f", "jobs": [row]}
    assert "FAILED: broken" in words_of(found)
    monkeypatch.setattr(warm, "PATIENCE_S", 0.01)
    assert "timed out" in run_once("slow", COMMANDS["walks"], str(tmp_path))["told"]


def test_what_is_compiled_is_counted_in_the_cache(tmp_path: Path) -> None:
    for suffix in ("nbc", "nbi"):
        (tmp_path / f"kernels.walk-1.py311.{suffix}").touch()
    assert len(compiled_in(tmp_path)) == 1
