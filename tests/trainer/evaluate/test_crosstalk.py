"""Crosstalk in evaluation, training and calibration: against clicks that the simulator draws, and single events."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from bundles import made_bundle
from single_events import crosstalk_on

from pans.firmware_sim.scene.detector import sample_clicks
from pans.firmware_sim.scene.detector_model import detector_model
from pans.runtime.core.calibration import CalibrationCore, calibration_exposure_us, counts_of, design_run, profile_level
from pans.runtime.detector.crosstalk import with_crosstalk
from pans.runtime.instrument.profile import Profile, load_profile
from pans.trainer.evaluate.accuracy import Light, evaluate_exactly, evaluate_sampled, light_of

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


def test_two_neighbours_of_five_percent() -> None:
    light = np.array([[1.0, 1.0, 1.0]]) * -math.log(0.7)
    assert with_crosstalk(-np.expm1(-light), (0.05,))[0, 1] == pytest.approx(0.3208, abs=1e-4)


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
        found = (
            -math.log1p(-share) + counts.log_other[lit][0]
        )  # the light that is left when its neighbours are taken away
        wanted = design.drives[channel] * level
        assert found == pytest.approx(wanted, abs=5 * math.sqrt(math.expm1(2.2) / n))


def test_training_clicks_as_often_as_the_evaluation() -> None:
    torch = pytest.importorskip("torch", reason="needs the train extra")
    from trainings import bars_task

    from pans.trainer.options import Options
    from pans.trainer.train.data import TrainingData
    from pans.trainer.train.loop import Run

    options = Options(features=5, epochs=2, batch=50, restarts=1)
    found = []
    for profile in (neighbours(), neighbours(crosstalk_probability=0.0, crosstalk_further=())):
        torch.manual_seed(0)
        run = Run(TrainingData(bars_task(200), profile, options), profile, options, restart=0)
        found.append(run.probabilities(0, 50).numpy())
    assert found[0] == pytest.approx(with_crosstalk(found[1], KERNEL), rel=1e-9)
    assert (found[0] > found[1]).all()
