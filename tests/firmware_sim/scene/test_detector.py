"""The detector: against its slow oracle, its law, and the quality of its random numbers (5 sigma, fixed seeds)."""

from __future__ import annotations

from dataclasses import replace

import naive_detector as naive
import numpy as np
import pytest

from pans.instrument.click_law import ClickLaw
from pans.instrument.detector.dead_time import DeadTime
from pans.instrument.profile import load_profile
from pans_sim.scene.detector import sample_clicks, uniform_numbers
from pans_sim.scene.detector_model import DetectorModel, detector_model

N = 200_000
QUIET = ClickLaw()


def no_clicks(channels: int) -> np.ndarray:
    return np.zeros(channels, np.uint8)


# -- random numbers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("exposures", "channels"), [(1, 1), (2, 3), (4, 3)])  # few numbers, and many
def test_numbers_equal_the_oracle(exposures: int, channels: int) -> None:
    for seed, first, stream in [(0, 0, 0), (7, 2**40, 1), (2**64 - 1, 2**64 - 2, 2)]:
        found = uniform_numbers(seed, first, exposures, channels, stream)
        expected = [[naive.number(seed, first + t, c, stream) for c in range(channels)] for t in range(exposures)]
        assert found.tolist() == expected


def test_numbers_are_uniform() -> None:
    numbers = uniform_numbers(3, 0, N, 1).ravel()
    assert numbers.min() >= 0
    assert numbers.max() < 1
    assert abs(numbers.mean() - 0.5) < 5 / np.sqrt(12 * N)
    assert abs(numbers.var() - 1 / 12) < 5 * np.sqrt(1 / 180 / N)
    counts = np.bincount((numbers * 1000).astype(int), minlength=1000)
    chi2 = ((counts - N / 1000) ** 2 / (N / 1000)).sum()
    assert abs(chi2 - 999) < 5 * np.sqrt(2 * 999)


@pytest.mark.parametrize("lag", [1, 2, 3, 10, 64])
def test_numbers_of_neighbouring_exposures_are_uncorrelated(lag: int) -> None:
    numbers = uniform_numbers(11, 12345, N, 1).ravel() - 0.5
    assert abs((numbers[lag:] * numbers[:-lag]).mean() * 12) < 5 / np.sqrt(N - lag)


def test_channels_streams_and_seeds_are_uncorrelated() -> None:
    base = uniform_numbers(1, 0, N // 4, 4)
    others = [uniform_numbers(2, 0, N // 4, 4), uniform_numbers(1, 0, N // 4, 4, 1), uniform_numbers(1, 1, N // 4, 4)]
    others.append(np.roll(base, 1, axis=1))
    for other in others:
        assert abs(((base - 0.5) * (other - 0.5)).mean() * 12) < 5 / np.sqrt(base.size)


# -- the law -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("p_ap", "p_ct", "channels"),
    [(0, 0, 3), (0.3, 0, 1), (0.3, 0, 4), (0, 0.2, 5), (0.3, 0.2, 5), (1, 0, 2), (0, 1, 3)],
)
def test_clicks_equal_the_oracle(p_ap: float, p_ct: float, channels: int) -> None:
    model = DetectorModel(QUIET, afterpulse_probability=p_ap, crosstalk_probability=p_ct)
    probability = np.random.default_rng(1).random((300, channels)) * 0.5
    for previous in (no_clicks(channels), np.ones(channels, np.uint8)):
        found = sample_clicks(model, probability, 21, 1000, previous)
        expected = naive.clicks(p_ap, p_ct, probability.tolist(), 21, 1000, previous.tolist())
        assert found.dtype == np.uint8
        assert found.tolist() == expected


# -- the profile's effects ---------------------------------------------------------------------------------------------


def test_only_declared_effects_are_modelled() -> None:
    assert detector_model(load_profile("ideal"), 1000.0) == DetectorModel(ClickLaw())
    spad = detector_model(load_profile("dmd-spad"), 50.0)
    assert spad.afterpulse_probability == 0.005
    assert spad.law.dead_time == DeadTime()  # 24 ns of 50 us
    fast = detector_model(load_profile("wdm-snspd"), 1.0)
    assert fast.law.dead_time.dead == pytest.approx(6.7e-3)
    assert fast.crosstalk_probability == 0.001


def test_crosstalk_needs_neighbours() -> None:
    profile = load_profile("ideal")
    profile = replace(profile, detector=replace(profile.detector, crosstalk_probability=0.1))
    assert detector_model(profile, 1000.0).crosstalk_probability == 0
