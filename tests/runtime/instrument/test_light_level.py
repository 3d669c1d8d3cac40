"""The light watch: silent while nothing changes, finds what it says, and runs tell it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from tree import ROOT

from pans.firmware_sim.trials.light_level import Decisions
from pans.runtime.cli import main
from pans.runtime.instrument.light_level import BATCH, LightWatch, make_baseline


def feed(watch: LightWatch, clicks: np.ndarray) -> list[str]:
    return [words for one in clicks.tolist() if (words := watch.take(one))]


def test_silent_while_nothing_changes() -> None:
    watch, source = LightWatch(), Decisions(1)
    assert feed(watch, source.clicks(np.ones(150_000))) == []
    report = watch.report()
    assert report["clicks_per_decision"] == pytest.approx(1.5, rel=0.2)
    assert 500 < report["found_after_decisions"] < 20_000


@pytest.mark.parametrize(("efficiency", "side"), [(0.9, "fall"), (1.15, "rise")])
def test_a_change_is_found_in_time(efficiency: float, side: str) -> None:
    watch, source = LightWatch(), Decisions(2)
    while watch.baseline is None:
        feed(watch, source.clicks(np.ones(1000)))
    start, promised = watch.decisions, watch.report()["found_after_decisions"]
    words = feed(watch, source.clicks(np.full(30_000, efficiency)))
    assert words
    found = watch.found[0]
    assert found["side"] == side
    assert found["decision"] - start < 2 * promised
    assert found["ratio"] == pytest.approx(
        1 + (efficiency - 1) * source.sensitivity(), rel=0.12
    )  # chosen when it looked worst


def test_threshold_is_siegmunds() -> None:
    base = make_baseline(1000.0, 100.0, 1e-9, 1e4)
    drift = base.slack / base.deviation
    b = base.threshold / base.deviation + 1.166
    arl = (math.exp(2 * drift * b) - 2 * drift * b - 1) / (2 * drift**2) / 2
    assert arl == pytest.approx(1e4, rel=1e-6)
    rng = np.random.default_rng(3)
    lengths = []
    for _ in range(60):
        low = high = 0.0
        n = 0
        for x in 1000.0 + 100.0 * rng.standard_normal(60_000):
            n += 1
            low, high = max(0.0, low + 1000.0 - x - base.slack), max(0.0, high + x - 1000.0 - base.slack)
            if max(low, high) >= base.threshold:
                break
        lengths.append(n)
    assert 0.55e4 < np.mean(lengths) < 1.8e4


def test_no_clicks_at_all_have_no_baseline() -> None:
    watch = LightWatch()
    assert feed(watch, np.zeros(50 * BATCH, np.int64)) == []
    assert watch.baseline is None


def test_a_run_with_a_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration, device = tmp_path / "cal.json", "sim:oled-qcmos?scene={}&pace=fast&seed=5"
    words = ["calibrate", "--device", device.format("uniform"), "-o", str(calibration), "--seconds", "5", "--json"]
    assert main(words) == 0
    bundle = ROOT / "runtime" / "shipped" / "fashion10.pans"
    run = [
        "run",
        str(bundle),
        "--decisions",
        "50",
        "--out",
        str(tmp_path),
        "--force",
        "--json",
        "--calibration",
        str(calibration),
    ]
    capsys.readouterr()
    assert main([*run, "--device", device.format("fashion200")]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["calibration"]["sha256"]
    assert summary["calibration_warnings"] == []
    assert summary["light"]["decisions"] == 50
    assert (
        main([*run, "--device", device.format("fashion200").replace("seed=5", "seed=6")]) == 2
    )  # another serial number
    assert "made on the device SIM-00000005" in capsys.readouterr().err
    stale = [*run, "--device", device.format("fashion200"), "--calibration-max-age-h", "1e-9"]
    assert main(stale) == 0
    captured = capsys.readouterr()
    assert "calibrate again" in captured.err
    assert len(json.loads(captured.out)["calibration_warnings"]) == 1


def test_many_decisions_at_once_are_those_one_by_one() -> None:
    rng = np.random.default_rng(3)
    clicks = np.concatenate([rng.poisson(5.0, 60_000), rng.poisson(3.0, 40_000)])
    one, many, numbered = LightWatch(batch=100), LightWatch(batch=100), LightWatch(batch=100)
    table = np.array([(n, 2) for n in range(int(clicks.max()) + 1)], [("clicks", np.uint32), ("flags", np.uint32)])
    for number in clicks.tolist():
        one.take(number)
    at = 0
    while at < len(clicks):
        n = min(int(rng.integers(0, 700)), len(clicks) - at)
        rows = np.zeros(2 * n, [("clicks", np.uint32), ("flags", np.uint32)])
        rows["clicks"][:n], rows[n:] = clicks[at : at + n], (9, 6)  # the second half is left out
        many.take_many(rows, 4)
        numbered.take_many(table, 0, clicks[at : at + n].astype(np.uint32))
        at += n
    assert one.found
    assert (one.found, one.report()) == (many.found, many.report()) == (numbered.found, numbered.report())
