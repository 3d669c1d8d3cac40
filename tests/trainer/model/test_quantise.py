"""From real patterns to levels: what rounding may change is bounded, and the bound is reached."""

import numpy as np
import pytest

from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.quantise import exposure_us_of, quantise, top_limits

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("levels", [2, 16, 124, 65536])
@pytest.mark.parametrize("top", [None, 1.5])
def test_no_object_changes_by_more_than_the_bound(levels, top):
    patterns = RNG.exponential(0.3, (4, 50))
    found = quantise(patterns, levels, top)
    change = found.patterns() - patterns
    for transmission in [RNG.uniform(size=(200, 50)), np.ones((1, 50)), np.zeros((1, 50))]:
        assert np.all(np.abs(transmission @ change.T) <= found.error_bound * (1 + 1e-12) + 1e-15)
    # reached by the object that lets through only the light added, or only the light taken away
    worst = np.maximum((change * (change > 0)).sum(axis=1), -(change * (change < 0)).sum(axis=1))
    assert found.error_bound == pytest.approx(worst, rel=1e-12)


def test_the_brightest_pixel_is_the_top_level():
    found = quantise(RNG.uniform(0, 2, (3, 30)), 124)
    assert found.levels.max() == 123
    assert found.levels.dtype == np.uint16


def test_without_clipping_no_pixel_moves_by_more_than_half_a_level():
    patterns = RNG.uniform(0, 2, (3, 30))
    found = quantise(patterns, 124)
    assert np.abs(found.patterns() - patterns).max() <= found.photons_per_level / 2 * (1 + 1e-12)


def test_brighter_pixels_are_clipped_to_the_top():
    found = quantise(np.array([[0.2, 3.0]]), 11, 1.0)
    assert found.levels.tolist() == [[2, 10]]
    assert found.error_bound == pytest.approx([2.0])


@pytest.mark.parametrize(
    "patterns",
    [np.zeros((2, 3)), np.array([[-1.0, 1.0]]), np.array([[np.nan, 1.0]]), np.ones(3)],
    ids=["dark", "negative", "nan", "one-dimensional"],
)
def test_impossible_patterns_are_refused(patterns):
    with pytest.raises(UsageError):
        quantise(patterns, 124)


def test_limits_of_the_top_level_are_those_of_the_exposure():
    profile = load_profile("oled-qcmos")
    low, high = top_limits(profile)
    assert exposure_us_of(profile, low) == pytest.approx(profile.exposure.min_us)
    assert exposure_us_of(profile, high) == pytest.approx(profile.exposure.max_us)


def test_exposures_full_of_dark_counts_are_not_used():
    profile = load_profile("dmd-spad")  # 100 dark counts per second, exposures up to 10 ms
    low, high = top_limits(profile)
    assert exposure_us_of(profile, high) * 1e-6 * profile.detector.dark_rate_hz == pytest.approx(0.05)
    assert exposure_us_of(profile, low) == pytest.approx(profile.exposure.min_us)
