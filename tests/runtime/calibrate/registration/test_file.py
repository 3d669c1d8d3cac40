"""The registration file: what it keeps and refuses, `info` and `verify` on it, and a run with it, whose replay is the same."""

import hashlib
import json
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Pans

from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import ConfigError, DamagedFileError, UsageError
from pans.bundle.sensor.bundle import load_bundle
from pans.calibrate.registration.correct import corrected
from pans.calibrate.registration.estimate import Estimate
from pans.calibrate.registration.file import check_usable, load_registration, registration_values, save_registration
from pans.calibrate.registration.parameters import DARK, vector_of
from pans.instrument.calibration_file import now_utc, sealed
from pans.instrument.optics import Imaging
from pans.instrument.profile import Profile, load_profile
from pans.record.reading import read_recording

PROFILE = load_profile("dmd-spad")
TABLE = Imaging(right_px=1.0, down_px=-0.5, rotation_deg=2.0, scale=1.01, psf_px=0.6, black=0.002, gain=0.9)


def values(table: Imaging = TABLE, bent: float = 0.1, profile: Profile = PROFILE, **changes: Any) -> dict[str, Any]:
    vector = vector_of(table, (bent, 0.0, 0.0, 0.0, 0.0), 0.004)
    found = Estimate(vector, np.eye(DARK + 1) * 1e-4, 0.0, 9.0, 9, 100, 200)
    return {
        "made_utc": now_utc().isoformat(timespec="seconds"),
        "profile": {"name": profile.name, "sha256": profile.sha256},
        "device": {},
        **registration_values(found, (28, 28)),
        **changes,
    }


def test_what_is_written_is_read_back(tmp_path: Path, pans: Pans) -> None:
    path = tmp_path / "table.json"
    sha256 = save_registration(path, values())
    found = load_registration(path)
    assert found.sha256 == sha256
    assert found.imaging().numbers() == pytest.approx(TABLE.numbers())
    flat = found.imaging().flat
    assert flat[0, 27] == pytest.approx(1.1)
    assert flat[:, 0] == pytest.approx(0.9)
    check_usable(found, PROFILE, (28, 28), now_utc())
    assert found.applied_to(PROFILE).projector.peak_photoelectrons_hz == pytest.approx(0.9 * 2000)
    with pytest.raises(UsageError, match="exists already"):
        save_registration(path, values())
    assert main(["verify", str(path)]) == 0
    assert main(["info", str(path), "--json"]) == 0
    told = json.loads(pans.said().out.splitlines()[-1])
    assert (told["kind"], told["parameters"]["right_px"]["value"]) == ("registration", 1.0)


def test_a_byte_that_changed_is_found(tmp_path: Path) -> None:
    path = tmp_path / "table.json"
    save_registration(path, values())
    path.write_text(path.read_text().replace('"value": 2.0', '"value": 2.5'))
    with pytest.raises(DamagedFileError, match="altered"):
        load_registration(path)
    assert main(["verify", str(path)]) != 0


@pytest.mark.parametrize(
    ("key", "row", "words"),
    [
        ("right_px", {"value": 5.0, "low": 4.0, "high": 6.0, "error": 0.1}, "right_px.value"),
        ("scale", {"value": 1.0, "low": 1.01, "high": 1.02, "error": 0.1}, "not within 1.01 to 1.02"),
        ("flat_x", {"value": -0.5, "low": -0.6, "high": 0.0, "error": 0.1}, None),
        ("black", {"value": 0.0, "low": 0.0, "error": 0.1}, "high is missing"),
        ("psf_px", [], "list"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, key: str, row: Any, words: str | None) -> None:
    changed = values()
    changed["parameters"][key] = row
    path = tmp_path / "table.json"
    path.write_bytes(sealed(changed, "registration"))
    if words is None:  # at its limit, and possible
        assert load_registration(path).values["parameters"][key] == row
        return
    with pytest.raises(DamagedFileError, match=words):
        load_registration(path)


def test_a_flat_field_without_light_is_refused(tmp_path: Path) -> None:
    changed = values()
    for key in ("flat_x", "flat_y", "flat_xy"):
        changed["parameters"][key] = {"value": -0.5, "low": -0.6, "high": 0.0, "error": 0.1}
    with pytest.raises(DamagedFileError, match="flat"):
        save_registration(tmp_path / "table.json", changed)


def test_a_run_refuses_what_is_of_another_table(tmp_path: Path) -> None:
    path = tmp_path / "table.json"
    save_registration(path, values())
    found, now = load_registration(path), now_utc()
    with pytest.raises(ConfigError, match=r"grid of 28 x 28 pixels, the bundle's patterns have 14 x 28"):
        check_usable(found, PROFILE, (14, 28), now)
    with pytest.raises(ConfigError, match=r"made for the profile dmd-spad .* this run uses ideal"):
        check_usable(found, load_profile("ideal"), (28, 28), now)
    with pytest.raises(ConfigError, match=r"25\.0 h old, allowed are 24 h"):
        check_usable(found, PROFILE, (28, 28), now + timedelta(hours=25))
    with pytest.raises(ConfigError, match=r"1\.0 h in the future"):
        check_usable(found, PROFILE, (28, 28), now - timedelta(hours=1))


URL = "sim:oled-qcmos?pace=fast&seed=3&optics=shift=1,1"


def registered(folder: Path, **changes: Any) -> Path:
    shifted = Imaging(right_px=1.0, down_px=1.0, psf_px=0.002)
    save_registration(folder / "table.json", values(shifted, 0.0, load_profile("oled-qcmos"), **changes))
    return folder / "table.json"


def test_a_run_shows_the_corrected_patterns_and_its_replay_is_the_same(tmp_path: Path, pans: Pans) -> None:
    table, out = registered(tmp_path), tmp_path / "out"
    words = ["run", "fashion10", "--device", URL, "--registration", str(table), "--out", str(out), "--no-realtime"]
    assert main([*words, "--decisions", "20", "--json"]) == 0
    captured = pans.said()
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
    assert json.loads(pans.said().out.splitlines()[-1])["identical"] is True


def test_a_run_refuses_a_registration_of_another_device(tmp_path: Path, pans: Pans) -> None:
    table = registered(tmp_path, device={"serial": "another"})
    call = ["run", "fashion10", "--device", URL, "--registration", str(table), "--decisions", "1", "--no-realtime"]
    assert "made on the device another" in pans.refuses(*call, "--out", tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.pansrec"))
