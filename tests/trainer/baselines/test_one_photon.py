"""The minimum-error measurement against Helstrom's closed form, trine states, and outcomes counted one by one."""

import itertools

import numpy as np
import pytest

from pans.trainer.baselines.one_photon import class_chances, class_moments, fields_of, minimum_error, several


@pytest.mark.parametrize("prior", [0.5, 0.2])
def test_two_classes_reach_helstroms_bound(prior):
    """1/2 + 1/2 times the trace norm of the difference of both moments (Helstrom 1976)."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(2, 5, 3))
    moments = np.stack([root @ root.T for root in roots])
    moments *= (np.array([prior, 1 - prior]) / np.trace(moments, axis1=1, axis2=2))[:, None, None]
    wanted = 0.5 + 0.5 * np.abs(np.linalg.eigvalsh(moments[0] - moments[1])).sum()
    found = minimum_error(moments, 2000)
    assert found.right == pytest.approx(wanted, abs=1e-5)
    assert found.right - 1e-12 <= found.bound <= wanted + 1e-3


def test_three_fields_120_degrees_apart_are_told_two_times_in_three():
    angles = np.deg2rad([0, 120, 240])
    fields = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    found = minimum_error(class_moments(fields, np.arange(3), 3))
    assert found.right == pytest.approx(2 / 3, abs=1e-9)
    assert found.bound == pytest.approx(2 / 3, abs=1e-9)
    assert found.operators.sum(axis=0) == pytest.approx(np.eye(2))
    assert class_chances(found, fields).diagonal() == pytest.approx(np.full(3, 2 / 3))


def test_any_other_measurement_stays_below_the_bound():
    rng = np.random.default_rng(1)
    moments = class_moments(rng.normal(size=(60, 6)) / 6**0.5, np.arange(60) % 4, 4)
    bound = minimum_error(moments, 20).bound  # early: not yet the best, but already a bound
    for _ in range(200):
        turned, _ = np.linalg.qr(rng.normal(size=(6, 6)))
        of_class = rng.integers(0, 4, 6)
        right = sum(turned[:, k] @ moments[of_class[k]] @ turned[:, k] for k in range(6))
        assert right <= bound


def test_several_photons_are_counted_as_their_outcomes_one_by_one():
    rng = np.random.default_rng(2)
    chances, fitted = rng.dirichlet(np.ones(3), 5), rng.dirichlet(np.ones(3), 40)
    labels, fitted_labels = np.array([0, 1, 2, 0, 1]), np.arange(40) % 3
    words: dict[tuple[int, ...], list[tuple[int, ...]]] = {}
    for outcome in itertools.product(range(3), repeat=4):
        words.setdefault(tuple(sorted(outcome)), []).append(outcome)
    right = np.zeros(5)
    for outcomes in words.values():
        chance = [sum(np.prod([row[k] for k in outcome]) for outcome in outcomes) for row in fitted]
        best = np.argmax([sum(c for c, label in zip(chance, fitted_labels) if label == wanted) for wanted in range(3)])
        for i in range(5):
            if labels[i] == best:
                right[i] += sum(np.prod([chances[i, k] for k in outcome]) for outcome in outcomes)
    assert several(chances, labels, fitted, fitted_labels, 4) == pytest.approx(right)
    with pytest.raises(ValueError, match="allowed: 1 to 8"):
        several(chances, labels, fitted, fitted_labels, 9)


def test_fields_have_unit_power():
    images = np.random.default_rng(3).integers(1, 256, (30, 4, 4)).astype(np.uint8)
    fields = fields_of(images, 0.5)
    assert (fields**2).sum(axis=1) == pytest.approx(np.ones(30))
    assert fields[0] ** 2 == pytest.approx(images[0].ravel() / images[0].sum(dtype=np.int64))
    with pytest.raises(ValueError, match="black"):
        fields_of(np.zeros((1, 4, 4), np.uint8), 1.0)
