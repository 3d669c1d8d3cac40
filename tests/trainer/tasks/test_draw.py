"""Drawing primitives against direct formulas and the statistics that they promise."""

import numpy as np
import pytest

from pans.trainer.tasks import draw


def rng():
    return np.random.default_rng(7)


def test_spots_are_gaussians_where_they_were_put():
    y, x = np.array([[3.25, -6.0], [0.0, 40.0]]), np.array([[-2.5, 9.0], [0.0, 0.0]])
    sigma, weight = np.array([[1.5, 2.0], [1.0, 1.0]]), np.array([[1.0, 0.5], [2.0, 1.0]])
    found = draw.spots(20, 30, y, x, sigma, weight)
    rows, columns = np.arange(20) - 9.5, np.arange(30) - 14.5
    for i in range(2):
        wanted = np.zeros((20, 30))
        for k in range(2):
            away = (rows[:, None] - y[i, k]) ** 2 + (columns[None, :] - x[i, k]) ** 2
            wanted += weight[i, k] * np.exp(-away / (2 * sigma[i, k] ** 2))
        assert np.abs(found[i] - wanted).max() < 1e-4


def test_speckle_is_circular_gaussian_of_mean_one():
    field = draw.speckle(rng(), 200, 32, 32, 3.0).astype(np.complex128)
    intensity = np.abs(field) ** 2
    grains = 200 * 32 * 32 * np.pi * (0.61 / 3) ** 2  # independent modes
    assert abs(intensity.mean() - 1) < 5 / np.sqrt(grains)
    assert intensity.std() == pytest.approx(1, abs=0.05)  # contrast of fully developed speckle
    assert abs((field**2).mean()) < 0.02  # no preferred phase
    correlation = (field[:, :, 3:] * field[:, :, :-3].conj()).mean().real
    assert abs(correlation) < 0.05  # the first zero of the Airy amplitude is one grain away


@pytest.mark.parametrize(
    "make", [lambda r: draw.smooth_noise(r, 400, 24, 24, 2.0), lambda r: draw.cloud_noise(r, 400, 24, 24, 1.0)]
)
def test_noise_has_unit_variance(make):
    noise = make(rng())
    assert noise.dtype == np.float32
    assert abs(noise.mean()) < 0.05
    assert noise.var() == pytest.approx(1, abs=0.05)
    assert (noise[:, 1:] * noise[:, :-1]).mean() > 0.5  # neighbours are alike


def test_blur_keeps_the_mean_and_widens():
    point = np.zeros((1, 33, 33), np.float32)
    point[0, 16, 16] = 1
    seen = draw.blur(point, 2.0)[0]
    assert seen.sum() == pytest.approx(1, abs=1e-5)
    variance = (seen.sum(axis=0) * (np.arange(33) - 16.0) ** 2).sum()
    assert variance == pytest.approx(4.0, rel=1e-3)


def test_waviness_is_a_sum_of_harmonics():
    theta = np.linspace(0, 2 * np.pi, 48, endpoint=False).reshape(1, 6, 8)
    wave = draw.waviness(rng(), np.sin(theta), np.cos(theta), range(2, 4), 0.5).ravel()
    spectrum = np.abs(np.fft.rfft(wave)) / 48
    assert spectrum[2] > 1e-3
    assert spectrum[3] > 1e-3
    assert np.delete(spectrum, [2, 3]).max() < 1e-6


def test_places_turn_with_the_object():
    v, u = draw.places(5, 5, np.array([1.0]), np.array([-1.0]), np.array([np.pi / 2]))
    assert (v[0, 3, 1], u[0, 3, 1]) == pytest.approx((0, 0), abs=1e-6)
    assert (v[0, 4, 1], u[0, 4, 1]) == pytest.approx((0, 1), abs=1e-6)  # one pixel down lies on the turned u axis


def test_some_of_keeps_a_first_part():
    kept = draw.some_of(rng(), 500, 1, 4)
    assert (np.diff(kept, axis=1) <= 0).all()
    assert set(kept.sum(axis=1)) == {1, 2, 3, 4}


def test_grey_saturates_and_rounds():
    assert draw.to_grey(np.array([[[-1.0, 0.5019, 2.0]]])).tolist() == [[[0, 128, 255]]]
