"""The light watch: silent while nothing changes, finds a change in the stated time, and a run tells of its calibration."""

import math
from pathlib import Path

import numpy as np
import pytest
from commands import Pans
from tree import ROOT

from pans.app.main import main
from pans.decide.dark import light_level
from pans.decide.dark.light_level import STATED_ERRORS, STATED_FALSE_ALARM, STATED_FEW, LightWatch, make_baseline


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


@pytest.mark.parametrize(("efficiency", "side"), [(0.8, "fall"), (1.0, ""), (1.03, ""), (1.2, "rise"), (0.0, "fall")])
def test_a_beginning_unlike_what_is_stated_is_found_once(efficiency: float, side: str) -> None:
    clicks = dim_clicks(efficiency, 20_000, 5)
    watch = LightWatch(stated=dim_clicks(1.0, 1_000_000, 6).mean())
    watch.take(clicks)
    assert [(one["side"], one["since"]) for one in watch.found] == ([(side, 0)] if side else [])
    if side:
        at = watch.found[0]["decision"]
        assert at in (32 * 50, 64 * 50, 128 * 50)
        assert watch.found[0]["ratio"] == pytest.approx(clicks[:at].mean() / watch.stated)
        assert "bundle" in watch.found[0]["words"]


def student_tail(errors: float, freedom: int) -> float:
    """Chance that Student's t is beyond `errors` on either side: twice the integral of its density, in the angle atan(t / sqrt(f))."""
    angle = np.linspace(math.atan(errors / math.sqrt(freedom)), math.pi / 2, 20_001)
    powers = np.cos(angle) ** (freedom - 1)
    norm = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(math.pi)
    return 2 * norm * float(((powers[1:] + powers[:-1]) / 2 * np.diff(angle)).sum())


def test_false_alarms_at_the_beginning_are_as_rare_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    assert student_tail(2.093, 19) == pytest.approx(0.05, rel=1e-3)
    tails = {
        n: student_tail(STATED_ERRORS + STATED_FEW / n, n - 1)
        for n in [*range(20, 200), *(1 << k for k in range(8, 15))]
    }
    together = [tails[n] + sum(tails[1 << k] for k in range(5, 15) if 1 << k < n) for n in tails]
    assert max(together) < STATED_FALSE_ALARM
    # the worst mean that is still as stated, and a threshold that is passed often enough to be counted
    monkeypatch.setattr(light_level, "STATED_ERRORS", 2.0)
    monkeypatch.setattr(light_level, "STATED_FEW", 0.0)
    rng, passed, runs = np.random.default_rng(4), 0, 1500
    for _ in range(runs):
        watch = LightWatch(batch=1, stated=1000 / (1 + light_level.CHANGE))
        watch.take(np.rint(rng.normal(1000.0, 55.0, 70)))
        passed += bool(watch.found)
    # one side of each test: after 32 batches, and at the end, after about 54; both together lie between the first and the sum
    one, both = student_tail(2.0, 31) / 2, (student_tail(2.0, 31) + student_tail(2.0, 53)) / 2
    assert one * 0.8 < passed / runs < both * 1.2


def test_a_run_with_a_calibration(tmp_path: Path, pans: Pans) -> None:
    calibration, device = tmp_path / "cal.json", "sim:oled-qcmos?scene={}&pace=fast&seed={}"
    words = ["calibrate", "--device", device.format("uniform", 5), "-o", str(calibration), "--seconds", "5", "--json"]
    assert main(words) == 0
    run = ["run", str(ROOT / "runtime/pans/shipped" / "fashion10.pans"), "--decisions", "50", "--out", str(tmp_path)]
    run += ["--force", "--json", "--calibration", str(calibration), "--device"]
    pans.said()
    summary = pans(*run, device.format("fashion200", 5))
    assert summary["calibration"]["sha256"]
    assert summary["calibration_warnings"] == []
    assert summary["light"]["decisions"] == 50
    assert main([*run, device.format("fashion200", 6)]) == 2  # another serial number
    assert "SIM-00000005" in pans.said().err
    assert (
        len(pans(*run, device.format("fashion200", 5), "--calibration-max-age-h", "1e-9")["calibration_warnings"]) == 1
    )


def test_a_run_beside_its_place_says_so(tmp_path: Path, pans: Pans) -> None:
    device = "sim:dmd-spad?scene=fashion200&pace=fast&seed=3&optics=shift={0},{0}"
    for shift, found in ((0, 0), (1, 1)):
        words = ["run", "fashion-adaptive", "--device", device.format(shift), "--decisions", "1650", "--no-realtime"]
        summary = pans(*words, "--out", tmp_path / str(shift), code=found)
        light = summary["light"]
        assert light["clicks_stated"] == pytest.approx(5.46, abs=0.01)
        assert len(light["found"]) == found
        # what the bundle states is contradicted: a fault without a calibration, too
        assert summary["faults"] == [one["words"] for one in light["found"]]
    assert 1.1 < light["found"][0]["ratio"] < 1.35
