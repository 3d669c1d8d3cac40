"""`pans calibrate` on instruments whose messages contradict each other, and on several detectors, one of them hot or silent."""

from pathlib import Path

import numpy as np
import pytest
from commands import Pans
from mutated_sessions import Evidence, MutatedLink, Mutation
from tree import ROOT

from pans.app.main import main
from pans.app.run import one_run
from pans.base.errors import EXIT_ALERT, EXIT_TIMING, DamagedFileError
from pans.instrument.calibration_file import find_warnings, load_calibration, now_utc, save_calibration
from pans.instrument.profile import load_profile
from pans.live import gates
from pans.protocol import links

URL = "sim:ideal?scene=uniform&pace=fast&seed=1"


def test_contradictions_are_a_fault_and_stand_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans
) -> None:
    opened = links.open_link
    for module in (one_run, gates):  # imported before: else they would keep the false one for good
        assert module.open_link is opened
    lie = Mutation("CLICKS", "object_index", by=17, most=3)
    monkeypatch.setattr(links, "open_link", lambda url: MutatedLink(opened(url), (lie,), Evidence(1 << 40, 2, 10**6)))
    out = tmp_path / "c.json"
    found = pans("calibrate", "--device", URL, "--seconds", "0.5", "-o", out, code=EXIT_TIMING)
    assert found["contradictions"] == {"object": 6}  # in each of the two stages
    (doubt,) = find_warnings(load_calibration(out), now_utc())
    assert "contradicted each other" in doubt


FOUR = "sim:dmd-four-snspd?scene=uniform&pace=fast&seed=3"


def calibrated(out: Path, url: str, pans: Pans, code: int = 0) -> str:
    """What the command prints of `url`."""
    assert main(["calibrate", "--device", url, "--seconds", "1", "-o", str(out)]) == code
    return pans.said().out


def test_detectors_that_are_read_at_once_are_measured_together(tmp_path: Path, pans: Pans) -> None:
    profile, out = load_profile("dmd-four-snspd"), tmp_path / "four.json"
    said = calibrated(out, f"{FOUR}&changes=hot:at_s=0:channel=2:rate_hz=2000", pans)
    calibration = load_calibration(out)
    low, high = calibration.values["photons_per_level_ci"]
    truth = profile.projector.peak_photoelectrons_hz * calibration.values["exposure_us"] * 1e-6
    assert low <= truth <= high
    expected, lowest, highest = calibration.dark_probability(profile, calibration.values["exposure_us"], 4)
    rates_hz = np.array([130.0, 130.0, 2130.0, 130.0])  # of the profile, and what is hot
    dark = -np.expm1(-rates_hz * calibration.values["exposure_us"] * 1e-6)
    assert np.all((0.8 * lowest <= dark) & (dark <= 1.2 * highest))
    assert expected[2] > 10 * expected[[0, 1, 3]].max()
    assert [line.split()[:2] for line in said.splitlines() if "channel" in line] == [
        ["channel", str(n)] for n in range(4)
    ]
    assert find_warnings(calibration, now_utc()) == []


@pytest.mark.parametrize("url", [FOUR, "sim:wdm-snspd?scene=uniform&pace=fast&seed=3"], ids=["at once", "parallel"])
def test_a_silent_detector_is_named_and_leaves_the_photon_level_alone(url: str, tmp_path: Path, pans: Pans) -> None:
    out = tmp_path / "dead.json"
    said = calibrated(out, f"{url}&changes=dead:at_s=0:channel=1", pans, EXIT_ALERT)
    assert "no click in light: channel 1" in said
    calibration = load_calibration(out)
    assert calibration.values["silent_channels"] == [1]
    assert calibration.values["efficiency"]["relative_to_profile"] == pytest.approx(1.0, abs=0.03)
    assert calibration.values["channels"][1]["dark_clicks"] == 0
    (doubt,) = find_warnings(calibration, now_utc())
    assert "no click of channel 1 in light" in doubt
    values = {key: value for key, value in calibration.values.items() if key not in ("sha256", "format", "version")}
    for wrong in (1, [99], ["1"], [True]):
        with pytest.raises(DamagedFileError, match="silent_channels"):
            save_calibration(tmp_path / "wrong.json", {**values, "silent_channels": wrong})


def test_where_the_device_follows_no_automaton_the_first_detector_is_measured(tmp_path: Path, pans: Pans) -> None:
    shipped = ROOT / "hw_profiles" / "dmd-four-snspd.toml"
    text = shipped.read_text(encoding="utf-8").replace("automaton_states = 16_383", "automaton_states = 14")
    (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    out = tmp_path / "one.json"
    calibrated(out, f"sim:{tmp_path / 'own.toml'}?scene=uniform&pace=fast&seed=3", pans)
    assert len(load_calibration(out).values["channels"]) == 1
