"""Fixed patterns on a detector that counts: exact figures against a sum over Poisson numbers by hand, and drawn ones against exact."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from bundles import made_bundle

from pans.runtime.decide import make_decider
from pans.runtime.instrument.profile import load_profile
from pans.trainer.evaluate.accuracy import evaluate_exactly, evaluate_sampled, light_of, sampled_shares
from pans.trainer.evaluate.held_out import trials_needed
from pans.trainer.evaluate.readings import Numbers

PROFILE = load_profile("dmd-qcmos")
D_F, OUTCOMES, PIXELS = 2, 3, 16
PATTERNS = np.random.default_rng(4).integers(0, 2, (D_F, PIXELS))
BUNDLE = made_bundle(
    D_F, 2, outcomes=OUTCOMES, table=np.random.default_rng(2).normal(size=(9, 2)), image_shape=(4, 4), photons_per_level=0.2,
    pattern_levels=PATTERNS,
)  # fmt: skip
IMAGES = np.random.default_rng(5).integers(0, 256, (40, 4, 4)).astype(np.uint8)
LABELS = np.random.default_rng(6).integers(0, 2, 40)


def number_chances(mean: float) -> list[float]:
    """P(0), P(1), P(2 or more) of one reading by hand: Poisson weights times the Gaussian between edges 0.7 and 1.5."""
    noise = PROFILE.detector.read_noise_e

    def below(edge: float, k: int) -> float:
        return 0.5 * math.erfc((k - edge) / (noise * math.sqrt(2)))

    weight = [math.exp(-mean) * mean**k / math.factorial(k) for k in range(50)]
    upto = [sum(w * below(edge, k) for k, w in enumerate(weight)) for edge in (0.7, 1.5)]
    return [upto[0], upto[1] - upto[0], 1 - upto[1]]


def chances_by_hand() -> np.ndarray:
    """(objects, d_f, 3) from the images themselves."""
    exposure_s = 0.2 / PROFILE.projector.peak_photoelectrons_hz
    light = IMAGES.reshape(40, PIXELS) / 255 @ (PATTERNS.T * 0.2) + PROFILE.detector.dark_rate_hz * exposure_s
    return np.array([[number_chances(mean) for mean in row] for row in light])


def test_the_exact_accuracy_is_the_sum_over_all_numbers() -> None:
    chances, decider = chances_by_hand(), make_decider(BUNDLE)
    right = np.zeros(40)
    for word in product(range(3), repeat=D_F):
        label = decider.decide(np.array(word), 1).label
        right += np.prod([chances[:, i, number] for i, number in enumerate(word)], axis=0) * (label == LABELS)
    found = evaluate_exactly(BUNDLE, light_of(BUNDLE, PROFILE, IMAGES), LABELS)
    assert found.accuracy_mean == pytest.approx(right.mean(), abs=1e-9)
    assert found.clicks_mean == pytest.approx((chances @ [0, 1, 2]).sum(axis=1).mean(), abs=1e-9)
    assert found.photons_mean > found.clicks_mean > 0.5 * found.photons_mean > 0


def test_drawn_numbers_have_the_exact_chances() -> None:
    light = light_of(BUNDLE, PROFILE, IMAGES)
    exact = evaluate_exactly(BUNDLE, light, LABELS)
    drawn = evaluate_sampled(BUNDLE, light, LABELS, trials=500, seed=1)
    error = exact.accuracy_std / math.sqrt(500)
    assert abs(drawn.accuracy_mean - exact.accuracy_mean) < 4 * error
    assert drawn.clicks_mean == pytest.approx(exact.clicks_mean, abs=0.03)
    shares = sampled_shares(BUNDLE, light, trials=200, seed=2)
    assert shares.sum(axis=1).tolist() == pytest.approx([1.0] * 40)


def test_sums_of_shots_are_convolutions_and_their_head_answers_them() -> None:
    numbers = Numbers(chances_by_hand())
    found = numbers.sums(2)
    for total in range(5):
        pairs = [(a, total - a) for a in range(3) if 0 <= total - a < 3]
        wanted = sum(numbers.chances[:, :, a] * numbers.chances[:, :, b] for a, b in pairs)
        assert np.allclose(found[:, :, total], wanted)
    drawn = numbers.counts(2, np.random.default_rng(3))
    assert drawn.shape == (40, 2)
    assert set(np.unique(drawn)) <= set(range(5))
    assert numbers.counts(2, np.random.default_rng(3), slice(5, 9)).shape == (4, 2)


def test_a_detector_that_only_clicks_is_refused() -> None:
    with pytest.raises(ValueError, match="toy needs 3 outcomes per exposure, dmd-spad tells 2 apart"):
        light_of(BUNDLE, load_profile("dmd-spad"), IMAGES)
    assert trials_needed(BUNDLE) is None
    assert trials_needed(BUNDLE, shots=200) == 30
