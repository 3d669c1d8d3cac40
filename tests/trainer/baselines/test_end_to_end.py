"""Trained masks with counts: the noise and its gradient, principal masks, the photon budget, and a case whose best accuracy is known."""

# ruff: noqa: E402  (what follows needs torch)

import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

import math

import numpy as np

from pans.trainer.baselines.common import run_trials
from pans.trainer.baselines.end_to_end import masks_measured, noisy, principal_masks, train_masks
from pans.trainer.options import BaselineOptions
from pans.trainer.tasks.registry import Objects, Task


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


def test_masks_hold_the_photon_budget_and_reach_what_counts_allow() -> None:
    """Best is one mask per pixel: right if the bright pixel (2.4) counts more than the dim one (0.6), half right on a tie."""
    task = pixels_task()
    model = train_masks(task, BaselineOptions("fsi", "deep", features=2, epochs=6), 3.0)
    measurement, decide = masks_measured(model, task, "source")
    with torch.no_grad():
        masks = model.masks().numpy()
    assert (masks @ np.array([0.5, 0.5])).sum() == pytest.approx(3.0, rel=1e-4)  # the mean object is 0.5 everywhere
    log_p = [[n * math.log(rate) - rate - math.lgamma(n + 1) for n in range(60)] for rate in (2.4, 0.6)]
    p, q = (np.exp(row) for row in log_p)
    best = float(np.tril(np.outer(p, q), -1).sum() + 0.5 * (p * q).sum())
    found = run_trials(measurement, 3.0, "counting", decide, trials=10, seed=1).right
    error = 5 * math.sqrt(best * (1 - best) / found.size)
    assert found.mean() > best - 0.02 - error
