"""The light watch: silent while nothing changes, finds a change in the stated time, and a run tells of its calibration."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from tree import ROOT

from pans.runtime.cli import main
from pans.runtime.instrument.light_level import LightWatch, make_baseline


def dim_clicks(efficiency: float, n: int, seed: int) -> np.ndarray:
    """Clicks of `n` decisions on objects of 20 kinds; a change of efficiency changes them by nearly as much."""
    rng = np.random.default_rng(seed)
    light = np.random.default_rng(0).uniform(0.02, 0.3, (20, 10)) * efficiency
    return rng.binomial(1, -np.expm1(-light)[rng.integers(0, 20, n)]).sum(axis=1)


def test_silent_while_nothing_changes() -> None:
    watch = LightWatch()
    assert watch.take(dim_clicks(1.0, 150_000, 1)) == []
    report = watch.report()
    assert report["clicks_per_decision"] == pytest.approx(1.5, rel=0.2)
    assert 500 < report["found_after_decisions"] < 20_000


@pytest.mark.parametrize(("efficiency", "side"), [(0.9, "fall"), (1.15, "rise")])
def test_a_change_is_found_in_time_and_again(efficiency: float, side: str) -> None:
    watch = LightWatch()
    for seed in range(2):  # the second time against a baseline of its own
        watch.take(dim_clicks(1.0, 50_000, seed))
        start, promised, known = watch.decisions, watch.report()["found_after_decisions"], len(watch.found)
        found = watch.take(dim_clicks(efficiency, 50_000, 10 + seed))[0]
        assert watch.found[known] is found
        assert found["side"] == side
        assert start < found["decision"] < start + 2 * promised
        assert found["ratio"] == pytest.approx(efficiency, rel=0.12)  # chosen when it looked worst
        watch.baseline = None


def test_one_by_one_is_all_at_once() -> None:
    clicks = np.concatenate([dim_clicks(1.0, 60_000, 1), dim_clicks(0.6, 20_000, 2)])
    whole, parts, rng = LightWatch(batch=100), LightWatch(batch=100), np.random.default_rng(3)
    whole.take(clicks)
    for part in np.split(clicks, np.sort(rng.integers(0, len(clicks), 3000))):
        parts.take(part)
    assert whole.found
    assert whole.report() == parts.report()


def test_threshold_is_siegmunds() -> None:
    base = make_baseline(1000.0, 100.0, 1e-9, 1e4)
    drift, b = base.slack / base.deviation, base.threshold / base.deviation + 1.166
    assert (math.exp(2 * drift * b) - 2 * drift * b - 1) / (2 * drift**2) / 2 == pytest.approx(1e4, rel=1e-6)
    rng, lengths = np.random.default_rng(3), []
    for _ in range(60):
        low = high = n = 0.0
        while max(low, high) < base.threshold:
            x, n = 100.0 * rng.standard_normal(), n + 1
            low, high = max(0.0, low - x - base.slack), max(0.0, high + x - base.slack)
        lengths.append(n)
    assert 0.55e4 < np.mean(lengths) < 1.8e4


def test_a_run_with_a_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration, device = tmp_path / "cal.json", "sim:oled-qcmos?scene={}&pace=fast&seed={}"
    words = ["calibrate", "--device", device.format("uniform", 5), "-o", str(calibration), "--seconds", "5", "--json"]
    assert main(words) == 0
    run = ["run", str(ROOT / "runtime" / "shipped" / "fashion10.pans"), "--decisions", "50", "--out", str(tmp_path)]
    run += ["--force", "--json", "--calibration", str(calibration), "--device"]
    capsys.readouterr()
    assert main([*run, device.format("fashion200", 5)]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["calibration"]["sha256"]
    assert summary["calibration_warnings"] == []
    assert summary["light"]["decisions"] == 50
    assert main([*run, device.format("fashion200", 6)]) == 2  # another serial number
    assert "SIM-00000005" in capsys.readouterr().err
    assert main([*run, device.format("fashion200", 5), "--calibration-max-age-h", "1e-9"]) == 0
    assert len(json.loads(capsys.readouterr().out)["calibration_warnings"]) == 1
