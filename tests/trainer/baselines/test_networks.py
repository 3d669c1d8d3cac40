"""Hadamard pairs: the matrix, the patterns, what their differences measure, and a case whose best accuracy is known."""

# ruff: noqa: E402  (what follows needs torch)

import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

import itertools
import math

import numpy as np

from pans.trainer.baselines.common import measure, run_trials
from pans.trainer.baselines.networks import aware_net, hadamard_12, pairs
from pans.trainer.tasks.registry import Objects, Task


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
