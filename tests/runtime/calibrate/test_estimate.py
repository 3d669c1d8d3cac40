"""The estimate against 40 digits and against fine grids; the file, its checks, and the command through the ordinary session."""

import argparse
import json
import math
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from pans.app.commands.calibrate import CALIBRATE
from pans.base.errors import ConfigError, DamagedFileError, UsageError
from pans.base.numbers.intervals import CHI2_95
from pans.calibrate.estimate import CountModel, Counts, fit_light, fit_spread, log_likelihood
from pans.instrument.calibration_file import find_warnings, load_calibration, now_utc, save_calibration
from pans.instrument.click_law import ClickLaw, click_law, click_probability
from pans.instrument.detector.dead_time import DeadTime
from pans.instrument.profile import load_profile
from pans.report.files.facts import file_facts
from pans.report.files.verify import verify_file

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")

PLAIN, NOISY = CountModel(ClickLaw()), CountModel(ClickLaw(0.0, 0.2, 0.84))


def counts_of(drive: list[float], clicks: list[int], exposures: list[int]) -> Counts:
    n = len(drive)
    return Counts(
        np.array(drive), np.array(clicks, np.int64), np.array(exposures, np.int64), np.zeros(n), np.arange(n) - 1
    )


@pytest.mark.parametrize("dark", [0.0, 1e-9, 0.9])
@pytest.mark.parametrize("level", [0.0, 1e-9, 0.9])
def test_likelihood_in_40_digits(level: float, dark: float) -> None:
    mpmath.mp.dps = 40
    n = 1 << 33  # counters past 2**32
    p = 1 - mpmath.exp(-mpmath.mpf(2.0) * mpmath.mpf(level) - mpmath.mpf(dark))
    clicks = round(n * float(p))
    exact = (clicks * mpmath.log(p) if clicks else 0) + (n - clicks) * mpmath.log(1 - p)
    found = log_likelihood(counts_of([2.0], [clicks], [n]), PLAIN, level, dark)
    assert found == pytest.approx(float(exact), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("mean", [1e-9, 1e-3, 0.9, 4.0, 40.0])
def test_noisy_law_is_that_of_clicks(mean: float) -> None:
    at = np.array([mean])
    if mean < 20:
        assert NOISY.log_miss(at) == pytest.approx(np.log1p(-click_probability(NOISY.law, at)), rel=1e-8)
    step = max(1e-6 * mean, 1e-7)
    slope = (NOISY.log_miss(at + 2 * step) - NOISY.log_miss(at)) / (2 * step)
    assert NOISY.log_miss_slope(at + step) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("model", [PLAIN, NOISY, CountModel(ClickLaw(dead_time=DeadTime(0.3)))])
def test_maximum_and_interval_against_a_grid(model: CountModel) -> None:
    counts = counts_of([0.0, 50.0, 80.0, 110.0], [9, 130, 160, 178], [3000, 200, 200, 200])
    fit = fit_light(counts, model)
    levels = np.linspace(0.7, 1.3, 241) * fit.level.value
    darks = np.linspace(0.2, 3.0, 141) * max(fit.dark.value, 1e-6)
    heights = np.array([[log_likelihood(counts, model, level, dark) for dark in darks] for level in levels])
    assert heights.max() <= fit.log_likelihood + 1e-7
    inside = levels[2 * (fit.log_likelihood - heights.max(axis=1)) <= CHI2_95]
    step = levels[1] - levels[0]
    assert fit.level.low == pytest.approx(inside[0], abs=1.01 * step)
    assert fit.level.high == pytest.approx(inside[-1], abs=1.01 * step)


def test_one_drive_without_dark_counts_has_a_closed_form() -> None:
    fit = fit_light(counts_of([0.0, 100.0], [0, 700], [10**9, 1000]), PLAIN)
    assert fit.level.value == pytest.approx(-math.log(0.3) / 100, rel=1e-6)
    assert fit.dark.low == 0.0
    assert fit.dark.high == pytest.approx(0.5 * CHI2_95 / 10**9, rel=0.01)


def test_no_clicks_and_all_clicks_are_bounded_on_one_side() -> None:
    silent = fit_light(counts_of([0.0, 100.0], [0, 0], [500, 500]), PLAIN)
    assert silent.level.value == silent.level.low == 0.0
    assert silent.level.high == pytest.approx(0.5 * CHI2_95 / (500 * 100), rel=0.02)
    full = fit_light(counts_of([0.0, 100.0], [0, 500], [500, 500]), PLAIN)
    assert full.level.value == full.level.high == math.inf
    mpmath.mp.dps = 30
    low = -mpmath.log(1 - mpmath.exp(-mpmath.mpf(CHI2_95) / 1000)) / 100
    assert full.level.low == pytest.approx(float(low), rel=1e-3)
    with pytest.raises(ValueError, match="no exposure with light"):
        fit_light(counts_of([0.0], [3], [100]), PLAIN)


@pytest.mark.parametrize("spread", [0.0, 0.15])
def test_spread_of_patterns(spread: float) -> None:
    rng = np.random.default_rng(5)
    p_values, estimates = [], []
    for _ in range(60):
        drive = np.repeat([1.0, 1.6, 2.2], 20)
        light = drive * np.exp(spread * rng.standard_normal(60))
        clicks = rng.binomial(300, -np.expm1(-light))
        found = fit_spread(
            Counts(drive, clicks, np.full(60, 300, np.int64), np.zeros(60), np.arange(60)), PLAIN, 1.0, 0.0
        )
        p_values.append(found.p_value)
        estimates.append(found.relative.value)
        assert found.relative.low <= found.relative.value <= found.relative.high
    if spread:
        assert np.mean(np.array(p_values) < 0.01) > 0.9
        assert np.mean(estimates) == pytest.approx(spread, rel=0.1)
    else:
        assert 0.0 < np.mean(np.array(p_values) < 0.1) < 0.3


@pytest.mark.slow
def test_intervals_cover() -> None:
    """Calibrations of about 20 clicks of light in 3000 exposures, and a tenth as many dark ones in 3000 more."""
    drive, n, covered = np.array([0.5, 1.0, 1.5, 0.0]), np.array([1000, 1000, 1000, 3000], np.int64), []
    for trial in range(150):
        rng = np.random.default_rng([3_000_009 + trial, 7])
        level, dark = 20 / 3000 * math.exp(rng.uniform(-0.3, 0.3)), 2 / 3000 * math.exp(rng.uniform(-0.5, 0.5))
        clicks = rng.binomial(n, -np.expm1(-(drive * level + dark)))
        found = fit_light(Counts(drive, clicks, n, np.zeros(4), np.arange(4)), PLAIN).level
        covered.append(found.low <= level <= found.high)
    assert 0.89 <= np.mean(covered) <= 0.99


def calibrated(tmp_path: Path, profile: str, seconds: float = 2.0, scene: str = "uniform") -> tuple[int, Path]:
    parser = argparse.ArgumentParser()
    CALIBRATE.configure(parser)
    out = tmp_path / "cal.json"
    args = parser.parse_args(
        ["--device", f"sim:{profile}?scene={scene}&pace=fast&seed=7", "-o", str(out), "--seconds", str(seconds)]
    )
    args.json = True
    return CALIBRATE.run(args), out


def test_command_and_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, path = calibrated(tmp_path, "dmd-spad")
    payload = json.loads(capsys.readouterr().out)
    assert code == 0
    profile = load_profile("dmd-spad")
    low, high = payload["photons_per_level_ci"]
    assert low <= 2000.0 * 40e-6 <= high
    assert payload["photons_per_level"] == pytest.approx(0.08, rel=0.03)
    assert payload["dark_ci"][0] <= float(click_probability(click_law(profile, 40.0), 0.0)) <= payload["dark_ci"][1]
    calibration = load_calibration(path)
    calibration.check_made_for(profile, "SIM-00000007")
    with pytest.raises(ConfigError, match="made on the device SIM-00000007"):
        calibration.check_made_for(profile, "OTHER")
    with pytest.raises(ConfigError, match="made for the profile dmd-spad"):
        calibration.check_made_for(load_profile("ideal"), None)
    assert find_warnings(calibration, now_utc()) == []
    assert "25.0 h old" in find_warnings(calibration, calibration.made + timedelta(hours=25))[0]
    later = calibration.made + timedelta(milliseconds=1)  # within the second of its stamp
    assert "measure again" in find_warnings(calibration, later, max_age_h=1e-9)[0]
    assert "no calibration" in find_warnings(None, now_utc())[0]
    assert calibration.applied_to(profile) is profile  # within the interval
    brighter = replace(profile, projector=replace(profile.projector, peak_photoelectrons_hz=3000.0))
    assert calibration.applied_to(brighter).projector.peak_photoelectrons_hz == pytest.approx(2000.0, rel=0.03)
    expected, floor, top = calibration.dark_probability(profile, 400.0, 3)
    assert floor[0] < expected[0] == expected[2] < top[0]
    assert -math.log1p(-expected[0]) == pytest.approx(-10 * math.log1p(-payload["dark_per_exposure"]), rel=1e-6)
    assert file_facts(path)["kind"] == "calibration"
    assert verify_file(path).ok
    path.write_bytes(path.read_bytes().replace(b'"seed": 1', b'"seed": 2'))
    assert verify_file(path).damaged


def test_a_dark_field_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"clicked|light"):
        calibrated(tmp_path, "ideal", scene="dark")


def test_impossible_files_are_refused(tmp_path: Path) -> None:
    _, path = calibrated(tmp_path, "ideal", 0.5)
    values = {
        key: value for key, value in load_calibration(path).values.items() if key not in ("sha256", "format", "version")
    }
    for key, bad in (("photons_per_level", -1.0), ("exposure_us", 0.0), ("channels", []), ("made_utc", "yesterday")):
        with pytest.raises(DamagedFileError):
            save_calibration(tmp_path / "bad.json", {**values, key: bad})
    assert not (tmp_path / "bad.json").exists()
    (tmp_path / "empty.json").write_text("{}")
    with pytest.raises(DamagedFileError, match="format"):
        load_calibration(tmp_path / "empty.json")
