"""Fixed patterns on a detector that counts: exact figures against a sum over Poisson numbers by hand, and drawn ones against exact."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from bundles import made_bundle
from single_events import crosstalk_on

from pans.bundle.backends import make_decider
from pans.calibrate.measurement import CalibrationCore, calibration_exposure_us, counts_of, design_run, profile_level
from pans.instrument.profile import Profile, load_profile
from pans_sim.scene.detector import sample_clicks
from pans_sim.scene.detector_model import detector_model
from pans_trainer.evaluate.accuracy import Light, decision_shares, evaluate_exactly, evaluate_sampled, light_of
from pans_trainer.evaluate.readings import Numbers

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
    shares = decision_shares(BUNDLE, light, trials=200, seed=2)
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


KERNEL = (0.05, 0.03)


def neighbours(**facts: object) -> Profile:
    profile = load_profile("wdm-snspd")
    stated = {"crosstalk_probability": KERNEL[0], "crosstalk_further": KERNEL[1:]} | facts
    return replace(profile, detector=replace(profile.detector, **stated))


def test_exact_and_sampled_figures_click_as_the_simulator_does() -> None:
    rng, n = np.random.default_rng(0), 40_000
    together = [1.0 if word & 3 == 3 or word & 12 == 12 else -1.0 for word in range(16)]  # two neighbours clicked
    bundle = made_bundle(
        name="row", classes=("a", "b"), image_shape=(4, 5), levels=256, pattern_levels=rng.integers(0, 256, (4, 20)),
        photons_per_level=2e-4, table=np.stack([np.zeros(16), together], axis=1),
    )  # fmt: skip
    images, labels = rng.integers(0, 256, (5, 4, 5), dtype=np.uint8), np.ones(5, np.int64)
    strong = neighbours(crosstalk_probability=0.2, crosstalk_further=(0.1,))
    light = light_of(bundle, strong, images)
    plain = light_of(bundle, neighbours(crosstalk_probability=0.0, crosstalk_further=()), images)
    assert (light.probability > plain.probability + 0.005).all()
    model = detector_model(strong, 5.0)
    own = np.repeat(plain.probability, n, axis=0)
    drawn = sample_clicks(model, own, 3, 0, np.zeros(4, np.uint8)).reshape(5, n, 4)
    assert np.abs(drawn.mean(axis=1) - light.probability).max() < 5 * 0.5 / math.sqrt(n)
    right = np.argmax(bundle.table, axis=1)[(drawn << np.arange(4)).sum(axis=2)] == labels[:, None]
    exact, sampled = evaluate_exactly(bundle, light, labels), evaluate_sampled(bundle, light, labels, trials=n)
    allowed = 5 * 0.5 / math.sqrt(5 * n)
    assert abs(exact.accuracy_mean - right.mean()) < allowed
    assert abs(sampled.accuracy_mean - right.mean()) < 2 * allowed
    independent = Light(light.photoelectrons, light.probability, light.law, light.illumination)
    for other in (plain, independent):  # neither no crosstalk nor its mean alone gives this accuracy
        assert abs(evaluate_exactly(bundle, other, labels).accuracy_mean - right.mean()) > 1.5 * allowed


def test_a_calibration_takes_the_clicks_of_all_neighbours_back() -> None:
    profile = neighbours(crosstalk_probability=0.2, crosstalk_further=(0.1,), channels=6)
    level = profile_level(profile, calibration_exposure_us(profile))
    design = design_run(profile, (0.3, 1.6), level, 0.01, 1)
    core = CalibrationCore(design.plan, design.n_cycles)
    n, rng = 400_000, np.random.default_rng(2)
    for pattern, mean in ((0, design.drives * level), (-1, np.full(6, 1e-3))):
        clicks = crosstalk_on((rng.random((n, 6)) < -np.expm1(-mean)).astype(np.uint8), [0.2, 0.1], pattern + 2)
        core.sums[:, pattern, 0, 0], core.sums[:, pattern, 0, 1] = n, clicks.sum(axis=0)
    for channel, counts in enumerate(counts_of(core, design, profile)):
        lit = counts.drive > 0
        share = counts.clicks[lit][0] / counts.exposures[lit][0]
        found = -math.log1p(-share) + counts.log_other[lit][0]  # what is left when its neighbours are taken away
        wanted = design.drives[channel] * level
        assert found == pytest.approx(wanted, abs=5 * math.sqrt(math.expm1(2.2) / n))
