"""Above, level, below: the rule, the errors that enter it, and the counts."""

import math

import numpy as np
import pytest

from pans.trainer.verdicts import Claim, against, claim, sampling_error, training_spread, verdict


def test_a_difference_counts_beyond_two_combined_errors():
    assert against(80.0, 70.0, 3.0, 4.0) == {"ahead": 10.0, "error": 5.0, "verdict": "level"}  # exactly two
    assert against(80.1, 70.0, 3.0, 4.0)["verdict"] == "above"
    assert against(70.0, 80.1, 3.0, 4.0)["verdict"] == "below"
    assert against(70.0, 70.0)["verdict"] == "level"
    assert verdict(0.01, 0.0) == "above"  # both sides known exactly


def test_the_sampling_error_is_that_of_drawn_images():
    right = np.random.default_rng(0).random((20_000, 200)) < 0.7431
    assert sampling_error(74.31, 200) == pytest.approx(100 * right.mean(axis=1).std(), rel=0.02)
    assert sampling_error(100.0, 200) == 0.0


def test_the_spread_of_trainings_needs_two():
    assert training_spread([76.57]) == 0.0
    assert training_spread([76.0, 74.0]) == pytest.approx(math.sqrt(2))


def test_counts_leave_out_what_was_not_compared():
    found = claim("ours", "the paper", [{"verdict": "above"}, None, {"verdict": "level"}])
    assert found == Claim("ours", "the paper", ("above", "level"))
    assert found.counts() == (1, 1, 0)
    assert found.line() == "ours against the paper: 1 above, 1 level, 0 below, of 2."
