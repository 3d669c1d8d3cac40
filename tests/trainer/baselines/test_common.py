"""The alternatives to PANS: equal photons, exact posteriors against loops and closed forms, networks that learn, the command."""

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import naive_baselines
import numpy as np
import pytest
import torch
from commands import Pans
from trainings import kept_task

from pans.app.main import main
from pans.base.errors import EXIT_INTERRUPTED, EXIT_USAGE, UsageError
from pans_trainer.baselines import bayes as baseline_bayes
from pans_trainer.baselines import common as baselines
from pans_trainer.baselines import rows as baseline_rows
from pans_trainer.baselines.bayes import bayes, log_joint
from pans_trainer.baselines.common import Light, Trials, detect, measure, run_trials, silent
from pans_trainer.baselines.end_to_end import patterns_measured, train_conventionally
from pans_trainer.baselines.networks import aware_net, clean_cnn, patterns, walsh
from pans_trainer.evaluate.accuracy import Measured
from pans_trainer.options import BaselineOptions
from pans_trainer.tasks.registry import Objects, Task

SIDE = 8


def bars(n: int, seed: int) -> Objects:
    """Vertical and horizontal bars and spots on a faint, uneven ground."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, n)
    images = rng.integers(0, 40, (n, SIDE, SIDE))
    for image, label in zip(images, labels):
        at, bright = rng.integers(1, SIDE - 1), rng.integers(150, 216)
        if label == 0:
            image[:, at] += bright
        elif label == 1:
            image[at, :] += bright
        else:
            image[at - 1 : at + 2, at - 1 : at + 2] += bright
    return Objects(images.astype(np.uint8), labels.astype(np.int64))


@pytest.fixture(scope="module")
def task() -> Task:
    return Task("bars", ("|", "-", "o"), bars(1500, 1), bars(240, 2), "0" * 64, "made here")


def two_pixels(*grays: tuple[int, int]) -> Task:
    """One object per class, to train on and to test on."""
    images = np.array(grays, np.uint8)[:, None, :]
    objects = Objects(images, np.arange(len(grays)))
    return Task("pixels", tuple(map(str, range(len(grays)))), objects, objects, "0" * 64, "made here")


def test_a_decision_that_claims_too_much_conveys_what_its_readouts_know() -> None:
    """One pixel, dark or of 1.2 photons: a Z channel; the log posterior is eight times too sure where there is no photon."""
    images = np.repeat(np.array([0, 255], np.uint8), 20_000)[:, None, None]
    objects = Objects(images, np.repeat(np.arange(2), 20_000))
    measurement = measure(Task("pixel", ("dark", "bright"), objects, objects, "0" * 64, "made here"), None)
    silent = math.exp(-1.2)
    posterior = np.array([[1, silent], [1e-9, 1]])

    def decide(readouts: np.ndarray) -> np.ndarray:
        return 8 * np.log(posterior[(readouts[:, 0] > 0).astype(int)])

    found = run_trials(measurement, 0.6, "binary", decide, trials=1, seed=3).measured()
    p = (1 - silent) / 2
    known = sum(-q * math.log2(q) for q in (p, 1 - p)) - sum(-q * math.log2(q) for q in (silent, 1 - silent)) / 2
    assert found.bits is not None
    assert found.bits_se is not None
    assert abs(found.bits - known) < 5 * found.bits_se < 0.05
    assert found.bits_per_photon == pytest.approx(found.bits / 0.6)
    assert found.bits_per_illumination == pytest.approx(found.bits / 1.2)


@pytest.mark.parametrize("brightness", baselines.BRIGHTNESS)
@pytest.mark.parametrize("features", [None, 6])
def test_one_source_gives_bright_objects_more_photons_and_one_that_follows_them_all_the_same(
    task: Task, features: int | None, brightness: str
) -> None:
    weights = None if features is None else patterns("binary", features, task.image_shape, 0)
    measurement = measure(task, weights, brightness)
    light = measurement.photoelectrons(measurement.test, 17.0).sum(axis=1)
    shown = np.ones((1, SIDE * SIDE)) if weights is None else weights
    bright = (task.test.images.reshape(len(task.test), -1) / 255) @ shown.sum(axis=0)
    by = bright.mean() if brightness == "source" else bright
    np.testing.assert_allclose(light, 17 * bright / by, rtol=1e-5)
    # the sum of the patterns: what a transmission of 1 everywhere would give
    assert measurement.illumination(17.0) == pytest.approx(float(np.mean(17 * shown.sum() / by)), rel=1e-5)


def test_detectors_have_the_mean_and_variance_of_their_law() -> None:
    light, n = np.full(200_000, 0.7, np.float32), 200_000
    counts = detect(light, "counting", np.random.default_rng(0), dark=0.3)
    clicks = detect(light, "binary", np.random.default_rng(0), dark=0.3)
    assert counts.mean() == pytest.approx(1.0, abs=5 / math.sqrt(n))
    assert counts.var() == pytest.approx(1.0, abs=5 * math.sqrt(3 / n))  # fourth central moment of Poisson(1) is 4
    p = 1 - math.exp(-1.0)
    assert set(np.unique(clicks)) == {0.0, 1.0}
    assert clicks.mean() == pytest.approx(p, abs=5 * math.sqrt(p * (1 - p) / n))


@pytest.mark.parametrize("detector", baselines.DETECTORS)
@pytest.mark.parametrize("brightness", baselines.BRIGHTNESS)
@pytest.mark.parametrize(("floor", "dark"), [(1e-3, 0.0), (0.02, 0.1), (0.0, 0.05)])
def test_the_posterior_is_that_of_plain_loops(
    task: Task, detector: str, brightness: str, floor: float, dark: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baselines, "_BLOCK", 7)
    monkeypatch.setattr(baseline_bayes, "_CHUNK", 4)
    few = Task("bars", task.classes, bars(40, 3), bars(9, 4), "0" * 64, "made here")
    measurement = measure(few, None, brightness)
    light = measurement.photoelectrons(measurement.test, 6.0)
    readouts = detect(light, detector, np.random.default_rng(5), dark)
    found = log_joint(measurement, readouts, 6.0, detector, floor=floor, dark=dark)
    posterior = np.exp(found - np.logaddexp.reduce(found, axis=1, keepdims=True))
    shown = few.train.images.reshape(40, -1) / 255 + floor
    total = few.test.images.sum() / 255 / 9 if brightness == "source" else shown.sum(axis=1, keepdims=True)
    lights = (6.0 * shown / total + dark).tolist()
    for row, readout in zip(posterior, readouts.tolist()):
        wanted = naive_baselines.posterior(readout, lights, few.train.labels.tolist(), 3, detector)
        np.testing.assert_allclose(row, wanted, atol=2e-5)


def test_bayes_reaches_the_closed_form_of_two_objects() -> None:
    pair = two_pixels((204, 51), (51, 204))
    many = Objects(pair.test.images.repeat(2000, axis=0), pair.test.labels.repeat(2000))
    measurement = measure(Task("pixels", pair.classes, pair.train, many, "0" * 64, "made here"), None)
    decide, _ = bayes(measurement, 3.0, "counting", seed=0, floor=1e-9)
    trials = run_trials(measurement, 3.0, "counting", decide, trials=10, seed=1)
    # right if the bright pixel (2.4) counts more than the dim one (0.6); half right, for one of two objects, on a tie
    log_p = [[n * math.log(rate) - rate - math.lgamma(n + 1) for n in range(60)] for rate in (2.4, 0.6)]
    p, q = (np.exp(row) for row in log_p)
    exact = float(np.tril(np.outer(p, q), -1).sum() + 0.5 * (p * q).sum())
    assert abs(trials.right.mean() - exact) < 5 * math.sqrt(exact * (1 - exact) / trials.right.size)


def test_spreads_over_trials_and_over_objects_are_kept_apart() -> None:
    right = np.zeros((4, 300), bool)
    right[:, :150] = True  # the same objects every time: no spread over trials, much over objects
    error = pytest.approx(math.sqrt(0.25 / 299))
    measured = Trials(right, np.full(300, 2.0), np.full(300, 3.0), 7.0).measured()
    assert measured == Measured(0.5, 0.0, error, 2.0, 3.0, 7.0, objects=300, trials=4, shots=1)
    whole = Trials(right.T.repeat(2, axis=1), np.full(8, 2.0), np.full(8, 3.0), 7.0).measured()
    spread = pytest.approx(math.sqrt(0.25 * 300 / 299))
    assert whole == Measured(0.5, spread, 0.0, 2.0, 3.0, 7.0, objects=8, trials=300, shots=1)
    first = Trials(right, np.arange(300.0), np.arange(300.0), 7.0).measured(200)
    assert (first.objects, first.accuracy_mean, first.clicks_mean) == (200, 0.75, 99.5)


def test_hadamard_patterns_are_two_dimensional_walsh_functions() -> None:
    functions = walsh(8)
    assert (np.diff(functions, axis=1) != 0).sum(axis=1).tolist() == list(range(8))
    every = patterns("hadamard", 64, (8, 8), 0)
    signs = 2 * every - 1
    assert np.array_equal(signs @ signs.T, 64 * np.eye(64))
    assert set(np.unique(every)) == {0.0, 1.0}
    assert every[0].all()
    assert patterns("hadamard", 10, (28, 28), 0).shape == (10, 784)
    with pytest.raises(ValueError, match="allowed on 8 x 8 pixels: 64"):
        patterns("hadamard", 65, (8, 8), 0)


def test_networks_that_know_the_noise_beat_those_that_do_not(task: Task) -> None:
    before = torch.random.get_rng_state()
    measurement = measure(task, None)
    clean = clean_cnn(measurement, seed=0, epochs=4)
    aware = aware_net("cnn", measurement, 10.0, "counting", seed=0, epochs=4)
    exact, _ = bayes(measurement, 10.0, "counting", seed=0, floor=1e-3)
    poor, good, best = (
        run_trials(measurement, 10.0, "counting", decide, trials=4, seed=0).measured()
        for decide in (clean, aware, exact)
    )
    least = poor.accuracy_mean + 5 * poor.accuracy_se_objects
    assert min(good.accuracy_mean, best.accuracy_mean) > least
    assert run_trials(measurement, 1e6, "counting", clean, trials=1, seed=0).right.mean() > 0.9
    assert torch.equal(before, torch.random.get_rng_state()), "the global generator belongs to the caller"


@pytest.mark.parametrize("bits", [4, None])
def test_conventional_end_to_end_works_in_bright_light_only(task: Task, bits: int | None) -> None:
    model = train_conventionally(task, 6, seed=0, bits=bits, epochs=40)
    measurement, at = patterns_measured(model, task, "source")
    assert (measurement.full > 0).all()
    accuracy = {}
    for photons in (3.0, 1e6):
        done = run_trials(measurement, photons, "counting", at(photons, "counting"), trials=3, seed=0)
        accuracy[photons] = done.measured().accuracy_mean
    assert accuracy[1e6] > 0.85
    assert accuracy[3.0] < accuracy[1e6] - 0.2
    binary = run_trials(measurement, 3.0, "binary", at(3.0, "binary"), trials=3, seed=0).measured()
    assert binary.clicks_mean <= 6


KEYS = {"accuracy_mean", "accuracy_std", "clicks_mean", "photons_mean", "illumination", "objects", "trials"}


@pytest.fixture(scope="module")
def task_file(task: Task, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return kept_task(tmp_path_factory.mktemp("task") / "bars.npz", task)


def called(pans: Pans, *words: object) -> tuple[int, dict[str, Any]]:
    code = main(["baseline", *map(str, words), "--json"])
    answer = pans.said().out
    return code, json.loads(answer) if answer else {}


@pytest.mark.parametrize(
    "words",
    [
        ("direct",),
        ("direct", "--detector", "binary", "--brightness", "object", "--dark", 0.01),
        ("direct", "--method", "cnn", "--epochs", 1),
        ("direct", "--method", "clean-cnn", "--epochs", 1),
        ("compressive", "--features", 8, "--epochs", 1),
        ("compressive", "--features", 8, "--epochs", 1, "--method", "clean-mlp", "--detector", "binary"),
        ("compressive", "--features", 8, "--method", "bayes", "--patterns", "hadamard"),
        ("e2e", "--features", 4, "--epochs", 1),
        ("e2e", "--features", 4, "--epochs", 1, "--method", "plain", "--detector", "binary"),
        ("fsi", "--features", 4, "--epochs", 1),
        ("fsi", "--features", 4, "--epochs", 1, "--method", "pca", "--detector", "binary"),
        ("hadamard", "--features", 6, "--epochs", 1),
        ("hadamard", "--features", 6, "--epochs", 1, "--method", "counts", "--brightness", "object"),
    ],
)
def test_every_way_answers_with_the_keys_of_evaluate(words: tuple[object, ...], task_file: Path, pans: Pans) -> None:
    code, answer = called(pans, *words, "--task", task_file, "--photons", 4, 40, "--illumination", 9, "--trials", 2)
    assert code == 0
    rows = answer["rows"]
    assert all(set(row) >= KEYS for row in (answer, *rows, answer["first_200"]))
    assert [row["photons_asked"] for row in rows] == [4.0, 40.0, None]
    assert [row["photons_mean"] for row in rows[:2]] == pytest.approx([4.0, 40.0], rel=1e-5)
    assert (rows[2]["illumination_asked"], rows[2]["illumination"]) == (9.0, pytest.approx(9.0, rel=1e-5))
    assert rows[0]["illumination"] < rows[1]["illumination"]
    assert rows[0]["clicks_mean"] < rows[1]["clicks_mean"]
    assert (rows[0]["objects"], rows[0]["first_200"]["objects"], rows[0]["trials"]) == (240, 200, 2)
    # what is known of three classes, measured: below 0 where a decision claims too much
    assert all(row["bits"] <= math.log2(3) for row in rows)
    assert answer.get("quantiser_bits") == (4 if words[0] == "e2e" and "plain" not in words else None)
    assert answer["simulated"] is True


@pytest.mark.parametrize(
    "words",
    [
        ("direct", "--information", "--detector", "binary"),
        ("direct", "--method", "mlp"),
        ("e2e", "--method", "bayes"),
        ("direct", "--photons", 0),
        ("direct", "--photons", "nan"),
        ("direct", "--trials", 0),
        ("direct", "--floor", 0),
        ("compressive", "--features", 0),
        ("e2e", "--bits", 17),
        ("direct", "--dark", -1),
    ],
)
def test_what_cannot_be_meant_is_refused(words: tuple[object, ...], task_file: Path, pans: Pans) -> None:
    try:
        code: object = main(["baseline", *map(str, words), "--task", str(task_file)])
    except SystemExit as refused:  # by the parser: no number
        code = refused.code
    assert code == EXIT_USAGE
    assert re.search("allowed|is not a", pans.said().err)


def test_an_interrupt_keeps_the_levels_that_are_done(
    task_file: Path, pans: Pans, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run_trials

    def interrupted(measurement: object, photons: float, *rest: object, **named: object) -> Trials:
        if photons > 10:
            raise KeyboardInterrupt
        return whole(measurement, photons, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(baseline_rows, "run_trials", interrupted)
    code, answer = called(pans, "direct", "--task", task_file, "--photons", 4, 40)
    assert code == EXIT_INTERRUPTED
    assert answer["interrupted"] is True
    assert [row["photons_asked"] for row in answer["rows"]] == [4.0]


def test_frames_of_a_field_are_intensities_and_take_no_patterns():
    images = np.array([[[10, 20], [30, 40]], [[0, 5], [200, 255]]], np.uint8)
    objects = Objects(images, np.array([0, 1]))
    task = Task("field", ("a", "b"), objects, objects, "0" * 64, "", light="field")
    measurement = measure(task, None)
    light = measurement.photoelectrons(measurement.test, 100.0)
    intensity = (images.astype(np.float64) / 255).reshape(2, 4) ** 2
    np.testing.assert_allclose(light, intensity * (100 * 2 / intensity.sum()), rtol=1e-5)
    lifted = measurement.photoelectrons(measurement.test, 100.0, floor=0.5)
    assert lifted.sum() == pytest.approx(300)  # 200 of the objects, and half of their mean light on every pixel
    with pytest.raises(ValueError, match="light that reaches us"):
        measure(task, np.ones((2, 4)))


def test_nothing_is_sent_to_a_scene_whose_light_is_its_own(task: Task) -> None:
    scene = dataclasses.replace(task, light="field")
    options = BaselineOptions("direct", "bayes", trials=1)
    (row,) = baseline_rows.baseline_rows(scene, options, [Light("photons", 20.0)], silent)
    assert (row["photons_mean"], row["illumination"]) == (pytest.approx(20.0, rel=1e-5), 0.0)
    assert row["bits_per_illumination"] is None
    assert baseline_rows.at_equal_light(scene, 20.0, 0.0, silent).keys() == {"direct_imaging"}
    with pytest.raises(UsageError, match="--illumination 9: the light of bars is its own, nothing is sent"):
        list(baseline_rows.baseline_rows(scene, options, [Light("illumination", 9.0)], silent))
