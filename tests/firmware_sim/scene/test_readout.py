"""What the simulator does with traps, neighbours, jitter, jumping pixels and a drifting threshold, against single events."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from readout_events import jittered, telegraph
from single_events import crosstalk_on, rounds_of

from pans.decide.dark.cusum import ChannelWatch, WatchSettings
from pans.instrument.click_law import ClickLaw
from pans.instrument.detector import Afterpulses
from pans.instrument.profile import Profile, load_profile
from pans_sim.scene.changes import Changes, Telegraph
from pans_sim.scene.detector import sample_clicks
from pans_sim.scene.detector_model import DetectorModel, detector_model, first_click_probability
from pans_sim.scene.drawing import moved_parts
from pans_sim.scene.moving import Change
from pans_sim.scene.scene_file import reading_changes, scene_on_table

SIGMAS = 4.5
SEQUENCE = (1.5, 0.1, 0.02, 0.8, 3.0, 0.05, 0.3, 0.0)  # mean photoelectrons of exposures one after the other


@pytest.mark.parametrize("law", [Afterpulses(0.1, 2.0, 0.2), Afterpulses(0.2, 1.0, 0.5, True)])
def test_the_simulator_clicks_as_trapped_carriers_do(law: Afterpulses) -> None:
    n, rounds = len(SEQUENCE), 12
    model = DetectorModel(
        ClickLaw(), law.probability, trap_time=law.time, pause=law.pause, on_in_pause=law.free_running
    )
    chance = np.tile(-np.expm1(-np.array(SEQUENCE)), 8000)[:, None]
    found = sample_clicks(model, chance, 11, 0, np.zeros(1, np.uint8))[:, 0].reshape(-1, n)
    facts = {"pause": law.pause, "free_running": law.free_running, "afterpulse": law.probability, "tau": law.time}
    single = rounds_of(list(SEQUENCE * rounds), 2000, 4, **facts).reshape(2000, rounds, n)
    expected = single[:, rounds // 2 :].mean(axis=(0, 1))  # the traps have settled
    errors = np.sqrt(np.maximum(expected * (1 - expected), 1e-4) * (1 / len(found) + 1 / 12_000))
    assert np.all(np.abs(found.mean(axis=0) - expected) < SIGMAS * errors)


def test_how_exposures_are_cut_into_batches_changes_no_click() -> None:
    model = DetectorModel(
        ClickLaw(), 0.3, trap_time=3.0, pause=0.1, crosstalk_probability=0.1, crosstalk_further=(0.05,)
    )
    chance, none = np.full((40, 5), 0.2), np.zeros(5, np.uint8)
    whole = sample_clicks(model, chance, 2, 100, none)
    memory = np.zeros(5)
    parts = [sample_clicks(model, chance[a:b], 2, 100 + a, none, memory) for a, b in ((0, 1), (1, 17), (17, 40))]
    assert np.array_equal(whole, np.concatenate(parts))


def test_crosstalk_reaches_as_far_as_is_stated() -> None:
    kernel, n, channels = [0.05, 0.02, 0.01], 60_000, 9
    model = DetectorModel(ClickLaw(), crosstalk_probability=kernel[0], crosstalk_further=tuple(kernel[1:]))
    chance = np.zeros((n, channels))
    chance[:, 4] = 0.5
    found = sample_clicks(model, chance, 3, 0, np.zeros(channels, np.uint8))
    wanted = crosstalk_on((np.random.default_rng(1).random((n, channels)) < chance).astype(np.uint8), kernel, 2)
    for channel in range(channels):
        here, there = float(found[:, channel].mean()), float(wanted[:, channel].mean())
        assert abs(here - there) < SIGMAS * math.sqrt(2 * max(there, 1e-4) / n)
    assert not found[:, 0].any()  # farther than the kernel
    assert found[:, 1].mean() > 0.003
    assert not found[:, [1, 2, 3, 5, 6, 7]][found[:, 4] == 0].any()  # no click fires without the one that causes it


@pytest.mark.parametrize(("sigma", "pause"), [(0.1, 0.0), (0.3, 0.2), (1.0, 0.0), (0.4, 1.0)])
def test_jitter_moves_events_to_the_exposures_about(sigma: float, pause: float) -> None:
    light, runs = np.array([0.0] * 6 + [2.0, 0.5] + [0.0] * 6), 60_000
    found = jittered(light, sigma, pause, runs, 4)
    parts = moved_parts(sigma, pause)
    wanted = np.convolve(light, parts, "same") if len(parts) <= len(light) else np.convolve(light, parts)[4:18]
    assert np.all(np.abs(found - wanted) < SIGMAS * np.sqrt(np.maximum(wanted, 1e-3) / runs))
    assert wanted[6] < 1.95  # of 2.0: something moved


def qcmos(**facts: float) -> Profile:
    profile = load_profile("oled-qcmos")
    return replace(profile, detector=replace(profile.detector, **facts))


def test_a_pixel_jumps_as_often_and_as_long_as_is_stated() -> None:
    times = np.arange(60_000) * 0.05
    ours = [Telegraph(Change("telegraph", seed, 2.0, 0, 0.3)).raised(times).astype(float) for seed in range(8)]
    theirs = [telegraph(times, 2.0, seed).astype(float) for seed in range(8)]
    for lag in (1, 20, 60):
        same = [[float((row[lag:] == row[:-lag]).mean()) for row in rows] for rows in (ours, theirs)]
        error = math.hypot(*(np.std(row, ddof=1) / math.sqrt(8) for row in same))
        assert abs(np.mean(same[0]) - np.mean(same[1])) < SIGMAS * error
    pieces = Telegraph(Change("telegraph", 0, 2.0, 0, 0.3))
    joined = np.concatenate([pieces.raised(times[a:b]) for a, b in ((0, 10), (10, 30_000), (30_000, 60_000))])
    assert np.array_equal(joined, ours[0] > 0)


def test_only_the_stated_share_of_pixels_jumps_and_the_law_is_that_of_the_shifted_reading() -> None:
    profile = replace(
        qcmos(telegraph_share=0.25, telegraph_offset_e=0.3, telegraph_time_s=5.0, channels=8), mode="parallel"
    )
    changes = Changes(reading_changes(profile, 5), 8)
    model, times = detector_model(profile, 1000.0), np.arange(0.0, 600.0)
    found = changes.probability(model, np.full((600, 8), 0.2), times, 1e-3)
    rng = np.random.default_rng(0)
    reading = rng.poisson(0.2 + model.law.dark_per_exposure, 400_000)
    reading = reading + model.law.read_noise_e * rng.standard_normal(len(reading))
    levels = [float((reading + shift >= model.law.threshold_e).mean()) for shift in (0.0, 0.3)]
    jumping = [channel for channel in range(8) if np.ptp(found[:, channel]) > 0]
    assert len(jumping) == 2
    for channel in jumping:
        assert sorted(set(np.round(found[:, channel], 9))) == pytest.approx(levels, abs=SIGMAS * 0.5 / math.sqrt(4e5))
    steady = first_click_probability(model, np.array([0.2]))
    assert found[:, [c for c in range(8) if c not in jumping]] == pytest.approx(float(steady[0]), rel=1e-12)


def test_a_threshold_that_drifts_does_so_by_the_hour() -> None:
    profile = qcmos(threshold_drift_e_per_hour=-0.2)
    scene = scene_on_table("dark", "", "", profile)
    model = detector_model(profile, 1000.0)
    found = Changes(scene.changes, 1).probability(model, np.zeros((2, 1)), np.array([0.0, 3600.0]), 1e-3)[:, 0]
    later = replace(model, law=replace(model.law, threshold_e=model.law.threshold_e - 0.2))
    assert found[0] == pytest.approx(float(first_click_probability(model, np.zeros(1))[0]))
    assert found[1] == pytest.approx(float(first_click_probability(later, np.zeros(1))[0]))
    assert found[1] > 1.5 * found[0]


def alarms(seconds: int, **facts: float) -> int:
    """How often the watch on dark counts gives an alarm, at 100 dark exposures per second and the rate of the start."""
    changes, model = Changes(reading_changes(qcmos(**facts), 1), 1), detector_model(qcmos(), 1000.0)
    watch = ChannelWatch(1, first_click_probability(model, np.zeros(1)), WatchSettings(arl_exposures=1e8))
    times = np.arange(seconds, dtype=np.float64)
    chances = changes.probability(model, np.zeros((seconds, 1)), times, 1e-3)[:, 0]
    clicks = np.random.default_rng(1).binomial(100, chances)
    return sum(len(watch.update(100, np.array([one]))) for one in clicks.tolist())


def test_the_watch_on_dark_counts_sees_readings_that_rise_and_none_that_sink() -> None:
    jumps = {"telegraph_share": 1.0, "telegraph_time_s": 60.0}
    assert alarms(300, telegraph_offset_e=0.3, **jumps)
    assert alarms(900, threshold_drift_e_per_hour=-1.0)
    assert not alarms(900, threshold_drift_e_per_hour=1.0)
    assert not alarms(900)
