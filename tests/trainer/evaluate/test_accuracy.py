"""Evaluation: exact against a loop over all words, sampled against exact, and what the options do."""

import itertools
import math
import subprocess
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest
from bundles import made_bundle

from pans.bundle.backends import make_decider
from pans.bundle.sensor.bundle import write_bundle
from pans.instrument.profile import load_profile
from pans_trainer.evaluate import evaluate
from pans_trainer.evaluate.accuracy import among_classes, evaluate_exactly, evaluate_sampled, light_of
from pans_trainer.evaluate.held_out import held_out_of
from pans_trainer.options import Conditions

RNG = np.random.default_rng(0)
PROFILE = load_profile("oled-qcmos")
LABELS = RNG.integers(0, 3, 60)
IMAGES = RNG.integers(0, 256, (60, 4, 5), dtype=np.uint8)


def head_bundle():
    torch = pytest.importorskip("torch", reason="needs the train extra")
    from pans_trainer.export.onnx_heads import head_onnx
    from pans_trainer.model.heads import MlpHead

    graph, _ = head_onnx(MlpHead(3, 8, 3, torch.Generator().manual_seed(0)), np.full(3, 0.4))
    facts = {"name": "small", "task": "own", "classes": ("a", "b", "c"), "image_shape": (4, 5), "levels": 124}
    levels = RNG.integers(0, 124, (3, 20))
    return made_bundle(**facts, pattern_levels=levels, photons_per_level=1e-3, head_onnx=graph)


@pytest.mark.parametrize("shots", [1, 2])
def test_exact_accuracy_is_the_sum_over_all_counts(shots):
    model = head_bundle()
    light, decider = light_of(model, PROFILE, IMAGES), make_decider(model, shots=shots)
    right, bits = 0.0, 0.0
    for counts in itertools.product(range(shots + 1), repeat=3):
        ways = [math.comb(shots, k) * p**k * (1 - p) ** (shots - k) for k, p in zip(counts, light.probability.T)]
        said = np.exp(decider.scores_batch(np.array([counts]), shots)[0].astype(np.float64))
        share = np.array([(label == LABELS).mean() for label in range(3)])
        bits += float((math.prod(ways) * np.log2(said / said.sum() / share)[LABELS]).sum())
        right += float((math.prod(ways) * (decider.decide(np.array(counts), shots).label == LABELS)).sum())
    found = evaluate_exactly(model, light, LABELS, shots=shots)
    assert found.accuracy_mean == pytest.approx(right / 60, rel=1e-10)
    assert found.bits == pytest.approx(bits / 60, rel=1e-6)
    assert found.bits_per_photon == pytest.approx(bits / (shots * light.photoelectrons.sum()), rel=1e-6)
    assert found.clicks_mean == pytest.approx(shots * light.probability.sum(axis=1).mean())
    assert found.photons_mean == pytest.approx(shots * light.photoelectrons.sum(axis=1).mean())
    assert (found.illumination, found.trials) == (pytest.approx(shots * model.illumination()), 0)


@pytest.mark.parametrize("shots", [1, 3])
def test_sampled_agrees_with_exact(shots):
    model = head_bundle()
    light = light_of(model, PROFILE, IMAGES)
    exact = evaluate_exactly(model, light, LABELS, shots=shots)
    sampled = evaluate_sampled(model, light, LABELS, shots=shots, trials=400, seed=1)
    assert abs(sampled.accuracy_mean - exact.accuracy_mean) < 5 * exact.accuracy_std / math.sqrt(400)
    click_sigma = math.sqrt(shots * (light.probability * (1 - light.probability)).sum() / 60 / (60 * 400))
    assert abs(sampled.clicks_mean - exact.clicks_mean) < 5 * click_sigma
    assert sampled.bits == pytest.approx(exact.bits, abs=5 * 1.5 / math.sqrt(60 * 400))  # one's bits vary by about one
    assert sampled.photons_mean == exact.photons_mean
    assert sampled.accuracy_std == pytest.approx(exact.accuracy_std, rel=5 / math.sqrt(2 * 400))


def test_light_is_pattern_times_transmission_and_follows_its_options():
    shape = {"image_shape": (4, 5), "levels": 124, "pattern_levels": RNG.integers(0, 124, (4, 20))}
    model, floor = (
        made_bundle(4, 3, photons_per_level=1e-3, table=RNG.normal(size=(16, 3)), **shape),
        PROFILE.min_transmission,
    )
    shown = floor + (1 - floor) * IMAGES.reshape(60, -1) / 255
    assert light_of(model, PROFILE, IMAGES).photoelectrons == pytest.approx(shown @ model.patterns().T, rel=1e-10)
    plain, double = light_of(model, PROFILE, IMAGES), light_of(model, PROFILE, IMAGES, eta=2.0)
    assert double.photoelectrons == pytest.approx(2 * plain.photoelectrons)
    assert double.illumination == pytest.approx(2 * plain.illumination)
    nothing = light_of(model, PROFILE, IMAGES, eta=0.0, dark=0.5)
    assert nothing.photoelectrons.max() == 0
    assert nothing.law.dark_per_exposure == 0.5
    assert np.all(nothing.probability == nothing.probability[0, 0])
    assert nothing.probability[0, 0] > 0.2


@pytest.fixture
def own_task(tmp_path):
    path = tmp_path / "own.npz"
    np.savez(path, images=IMAGES, labels=LABELS, classes=np.array(["a", "b", "c"]))
    return str(path)


def test_a_bundle_is_judged_by_one_call(own_task, tmp_path):
    model = head_bundle()
    write_bundle(model, tmp_path / "small.pans")
    exact = evaluate_exactly(model, light_of(model, PROFILE, IMAGES), LABELS)
    for given in (model, tmp_path / "small.pans"):  # never trained on this file: all its objects are held out
        found = evaluate(given, task=own_task)
        assert found.by_class.recall == pytest.approx(exact.by_class.recall, rel=1e-12)
        found, wanted = (asdict(replace(one, by_class=0)) for one in (found, exact))  # which is compared above
        assert found == pytest.approx(wanted, rel=1e-12)
    assert evaluate(model, task=own_task, exact=False).trials == 30
    doubled = Conditions(profile="ideal", eta=2.0, dark=0.1, seed=3)
    held_out = held_out_of(model, own_task, 7, None, doubled).objects
    assert len(held_out) == 7
    light = light_of(model, load_profile("ideal"), held_out.images, eta=2.0, dark=0.1)
    wanted = evaluate_sampled(model, light, held_out.labels, shots=2, trials=5, seed=3)
    assert evaluate(model, task=own_task, shots=2, trials=5, objects=7, conditions=doubled) == wanted


def test_evaluation_loads_no_torch():
    code = (
        "import sys, pans_trainer.commands, pans_trainer.evaluate, pans_trainer.tasks\n"
        "assert 'torch' not in sys.modules and 'onnx' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_recall_and_the_gain_over_the_largest_class_are_those_of_a_loop():
    """By hand: 6 objects of three classes, the chances of a right decision each, and a decision for only part of the last one."""
    right, labels = np.array([1.0, 0.5, 0.5, 0.0, 1.0, 0.25]), np.array([0, 0, 0, 0, 1, 1])
    found = among_classes(right, labels, ("a", "b", "none"))
    assert found.majority_class == "a"
    assert found.majority_share == pytest.approx(4 / 6)
    assert found.recall == {"a": 0.5, "b": 0.625, "none": None}
    assert found.balanced_accuracy == pytest.approx(0.5625)
    gains = [0.0, -0.5, -0.5, -1.0, 1.0, 0.25]  # right, less 1 where the object is of class a
    assert found.above_majority == pytest.approx(sum(gains) / 6)
    assert found.above_majority_se == pytest.approx(np.std(gains, ddof=1) / math.sqrt(6))
    assert not found.better_than_majority
    half = among_classes(right, labels, ("a", "b", "none"), np.array([1.0, 1, 1, 1, 1, 0.5]))
    assert half.recall["b"] == pytest.approx(1.25 / 1.5)
    assert among_classes(np.zeros(6), labels, ("a", "b", "none"), np.zeros(6)) is None


@pytest.mark.parametrize(("right_of_b", "better"), [(0, False), (8, True)])
def test_a_sensor_is_better_than_the_largest_class_by_two_standard_errors_only(right_of_b, better):
    labels = np.repeat([0, 1], [90, 10])
    right = np.ones(100)
    right[90 : 100 - right_of_b] = 0
    assert among_classes(right, labels, ("a", "b")).better_than_majority == better
