"""Hadamard pairs and trained masks: the matrix, the patterns, noise and its gradient, and cases whose best accuracy is known."""

import itertools
import math

import numpy as np
import pytest
import torch

from pans_trainer.baselines.common import Light, measure, run_trials
from pans_trainer.baselines.end_to_end import masks_measured, masks_that_stop, noisy, principal_masks, train_masks
from pans_trainer.baselines.networks import aware_net, hadamard_12, pairs
from pans_trainer.options import BaselineOptions
from pans_trainer.tasks.registry import Objects, Task


def test_the_matrix_is_hadamard_and_begins_with_the_constant() -> None:
    matrix = hadamard_12()
    np.testing.assert_array_equal(matrix @ matrix.T, 12 * np.eye(12))
    assert (matrix[0] == 1).all()
    changes = [int(sum(a != b for a, b in itertools.pairwise(row))) for row in matrix.tolist()]
    assert changes == sorted(changes)


@pytest.mark.parametrize("shape", [(12, 12), (28, 28), (24, 36)])
def test_pairs_are_binary_inverse_to_each_other_and_coarsest_first(shape: tuple[int, int]) -> None:
    n = 20
    shown = pairs(n, shape)
    assert shown.shape == (2 * n, math.prod(shape))
    assert set(np.unique(shown)) == {0.0, 1.0}
    np.testing.assert_array_equal(shown[:n] + shown[n:], 1)
    assert (shown[0] == 1).all()
    edges = [sum(int((np.diff(p.reshape(shape), axis=k) != 0).sum()) for k in (0, 1)) for p in shown[:n]]
    assert edges[1] < edges[-1]


@pytest.mark.parametrize("differences", [True, False])
def test_the_network_reaches_what_the_counts_of_two_pairs_allow(differences: bool) -> None:
    """Upper or lower half bright: of the first pairs one tells, the others see the same of both. The best decision is by its difference."""
    upper = np.zeros((2, 12, 12), np.uint8)
    upper[0, :6], upper[1, 6:] = 255, 255
    shown = pairs(12, (12, 12))
    half = shown @ (upper.reshape(2, -1) / 255).T  # (24, 2): light of each pattern
    n = 1500
    objects = Objects(upper.repeat(n, axis=0), np.repeat([0, 1], n))
    task = Task("halves", ("upper", "lower"), objects, objects, "0" * 64, "made here")
    measurement = measure(task, shown)
    photons = 20.0
    rates = photons * half / half.sum(axis=0).mean()
    method = "differences" if differences else "counts"
    decide = aware_net(method, measurement, photons, "counting", seed=0, epochs=8)
    found = run_trials(measurement, photons, "counting", decide, trials=4, seed=1).right.mean()
    # the Bayes decision on draws of all counts: sum of n log(rate_0 / rate_1), a floor for dark patterns
    rng, draws = np.random.default_rng(3), 20_000
    counts = rng.poisson(rates[:, 0], (draws, 24))
    score = counts @ np.log((rates[:, 0] + 1e-9) / (rates[:, 1] + 1e-9)) - (rates[:, 0] - rates[:, 1]).sum()
    best = float((score > 0).mean() + 0.5 * (score == 0).mean())
    error = 5 * math.sqrt(best * (1 - best) * (1 / draws + 1 / (8 * n))) + 5e-4
    assert found < best + error
    assert found > best - 0.03 - error


def pixels_task(n: int = 2000) -> Task:
    """Two objects on two pixels, one bright in each."""
    images = np.array([[[204, 51]], [[51, 204]]], np.uint8).repeat(n, axis=0)
    objects = Objects(images, np.repeat([0, 1], n))
    return Task("pixels", ("a", "b"), objects, objects, "0" * 64, "made here")


@pytest.mark.parametrize("detector", ["counting", "binary"])
def test_noise_is_that_of_the_detector_and_its_mean_gradient_is_that_of_the_mean(detector: str) -> None:
    torch.manual_seed(0)
    n = 200_000
    expected = torch.full((n,), 0.7, requires_grad=True)
    readouts = noisy(expected, detector)
    values = readouts.detach()
    assert torch.equal(values, values.round())
    mean = 0.7 if detector == "counting" else 1 - math.exp(-0.7)
    variance = 0.7 if detector == "counting" else mean * (1 - mean)
    assert float(values.mean()) == pytest.approx(mean, abs=5 * math.sqrt(variance / n))
    readouts.sum().backward()
    slope = 1.0 if detector == "counting" else math.exp(-0.7)
    assert float(expected.grad.mean()) == pytest.approx(slope, abs=5 * 0.5 * math.sqrt(1 / 0.7 / n))


def test_principal_masks_are_parts_of_the_axes_of_the_images() -> None:
    rng = np.random.default_rng(0)
    along = np.array([3.0, -4.0, 0.0]) / 5
    images = (128 + 60 * rng.normal(size=(4000, 1)) * along + rng.normal(size=(4000, 3))).clip(0, 255).astype(np.uint8)
    masks = principal_masks(images, 2)
    assert sorted(np.round(masks, 1).tolist()) == [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    with pytest.raises(ValueError, match="features is 7, allowed: at most"):
        principal_masks(images, 7)


def best_of_two_pixels() -> float:
    """The best accuracy of 3 photons without stopping: one mask per pixel, 2.4 and 0.6 photons on average."""
    log_p = [[n * math.log(rate) - rate - math.lgamma(n + 1) for n in range(60)] for rate in (2.4, 0.6)]
    p, q = (np.exp(row) for row in log_p)
    return float(np.tril(np.outer(p, q), -1).sum() + 0.5 * (p * q).sum())


def test_masks_hold_the_photon_budget_and_reach_what_counts_allow() -> None:
    """Best is one mask per pixel: right if the bright pixel (2.4) counts more than the dim one (0.6), half right on a tie."""
    task = pixels_task()
    model = train_masks(task, BaselineOptions("fsi", "deep", features=2, epochs=6), Light("photons", 3.0))
    measurement, decide = masks_measured(model, task, "source")
    with torch.no_grad():
        masks = model.masks().numpy()
    assert (masks @ np.array([0.5, 0.5])).sum() == pytest.approx(3.0, rel=1e-4)  # the mean object is 0.5 everywhere
    best = best_of_two_pixels()
    found = run_trials(measurement, 3.0, "counting", decide, trials=10, seed=1).right
    error = 5 * math.sqrt(best * (1 - best) / found.size)
    assert found.mean() > best - 0.02 - error


def test_masks_that_stop_spend_their_level_are_calibrated_and_above_those_that_do_not() -> None:
    """The two pixels are two halves here, a little noisy, so that there are components enough for six masks."""
    rng = np.random.default_rng(4)
    labels = rng.integers(0, 2, 4000)
    images = np.where((np.arange(4) // 2 == labels[:, None])[:, None], 204, 51) + rng.integers(-25, 26, (4000, 2, 4))
    parts = [Objects(images[rows].astype(np.uint8), labels[rows]) for rows in (slice(0, 2500), slice(2500, None))]
    task = Task("halves", ("a", "b"), *parts, "0" * 64, "made here")
    options = BaselineOptions("fsi", "stopping", features=6, epochs=16, trials=2)
    for level in (Light("photons", 3.0), Light("illumination", 6.0)):  # the mean object is 0.5 everywhere
        ((asked, facts, trials),) = masks_that_stop(task, options, [level])
        found = trials.measured()
        assert asked == level
        assert found.illumination == pytest.approx(2 * found.photons_mean, rel=0.05)
        assert 2.4 < found.photons_mean < 3.1  # six masks cannot come nearer
        assert facts["confidence"] == pytest.approx(found.accuracy_mean, abs=0.03)
        assert found.accuracy_mean > best_of_two_pixels() + 3 * found.accuracy_se_objects
