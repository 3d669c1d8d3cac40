"""Photon pairs and the matched filter against what optics and statistics say of simple scenes."""

import numpy as np
import pytest

from pans.trainer.baselines.common import Measurement, run_trials
from pans.trainer.baselines.statistics import LAGS, matched, matched_decision, pair_excess, pairs_decision


def frames_of(intensity, photons, seed=1):
    rng = np.random.default_rng(seed)
    return rng.poisson(photons * intensity / intensity.mean(axis=(1, 2), keepdims=True) / intensity[0].size).astype(
        np.float32
    )


def test_independent_photons_in_an_even_light_have_no_excess_of_pairs():
    pairs = pair_excess(frames_of(np.ones((400, 24, 20)), 200.0))
    assert pairs.mean(axis=0) == pytest.approx(np.ones(len(LAGS)), abs=6 * (pairs.std(axis=0) / 20).max())


def test_a_developed_speckle_doubles_the_pairs_within_a_grain():
    """Exponential intensities: the mean square is twice the squared mean (Goodman), and pixels apart know nothing of each other."""
    speckle = np.random.default_rng(0).exponential(size=(800, 32, 32))
    pairs = pair_excess(frames_of(speckle, 300.0))
    assert pairs[:, 0].mean() == pytest.approx(2.0, abs=0.05)
    assert pairs[:, 1:].mean() == pytest.approx(1.0, abs=0.02)


def test_frames_of_less_than_two_photons_say_nothing():
    frames = np.zeros((2, 16, 16), np.float32)
    frames[1, 3, 4] = 1
    assert pair_excess(frames) == pytest.approx(np.ones((2, len(LAGS))))


def test_the_filter_answers_in_units_of_shot_noise():
    rng = np.random.default_rng(2)
    dim, bright = (matched(rng.poisson(mean, (60, 32, 32)).astype(np.float32), 2.0, 8.0) for mean in (2.0, 800.0))
    assert dim.mean() == pytest.approx(bright.mean(), rel=0.1)
    frame = np.full((1, 32, 32), 100.0, np.float32)
    frame[0, 16, 16] += 400.0
    lone = matched(frame, 2.0, 8.0)[0]
    # 400 photons in one pixel, through Gaussians of unit sum, over the root of the background: 400 (1/(8 pi) - 1/(128 pi)) / 10
    assert lone == pytest.approx(40 * (1 / (2 * np.pi * 4) - 1 / (2 * np.pi * 64)), rel=0.05)


def scenes(side=40, n=400, contrast=0.8):
    """Half of the frames hold a spot; the other half do not."""
    rng = np.random.default_rng(3)
    labels = np.arange(n) % 2
    y, x = np.mgrid[:side, :side]
    at = rng.uniform(12, side - 12, (n, 2, 1, 1))
    spot = np.exp(-((y - at[:, 0]) ** 2 + (x - at[:, 1]) ** 2) / (2 * 2.5**2))
    light = (1 + contrast * labels[:, None, None] * spot).reshape(n, -1).astype(np.float32)
    half = n // 2
    ones = np.ones(side * side, np.float32)
    return Measurement(light[:half], labels[:half], light[half:], labels[half:], 2, ones, 1.0, "source", (side, side))


def test_an_event_is_found_with_light_enough_and_not_without():
    measurement = scenes()

    def share(photons):
        decide = matched_decision(measurement, photons, seed=0)
        return run_trials(measurement, photons, "counting", decide, trials=1, seed=0).right.mean()

    assert share(1e6) > 0.98
    assert share(100.0) == pytest.approx(0.5, abs=0.12)


def test_pairs_need_two_classes_of_frames():
    whole = scenes(n=40)
    with pytest.raises(ValueError, match="2 classes"):
        pairs_decision(Measurement(*(getattr(whole, name) for name in whole.__slots__[:8]), None), 100.0, seed=0)
