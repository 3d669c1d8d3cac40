"""The top level of the patterns: as bright as the exposures of a profile allow."""

import pytest

from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.exposure import exposure_us_of, top_limits


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
