"""Mutual information, Bayes errors and Fisher ratios against closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from pans.trainer.evaluate.information import (
    fisher,
    mutual_information_bits,
    posterior_information,
    word_information,
    word_joint,
)


def h2(p: float) -> float:
    """Entropy of a coin."""
    return -p * math.log2(p) - (1 - p) * math.log2(1 - p)


def naive_joint(probability: np.ndarray, labels: np.ndarray, n_classes: int) -> dict[tuple[int, ...], list[float]]:
    joint = {}
    for word in itertools.product((0, 1), repeat=probability.shape[1]):
        of_class = [0.0] * n_classes
        for p, label in zip(probability.tolist(), labels.tolist()):
            of_class[label] += math.prod(q if click else 1 - q for q, click in zip(p, word)) / len(labels)
        joint[word] = of_class
    return joint


def test_a_binary_symmetric_channel() -> None:
    joint = word_joint(np.array([[0.9], [0.1]]), np.array([0, 1]), 2)
    assert mutual_information_bits(joint) == pytest.approx(1 - h2(0.1), abs=1e-14)


@pytest.mark.parametrize("photons", [1e-6, 0.3, 2.0, 40.0])
def test_a_dark_and_a_bright_object_are_a_z_channel(photons: float) -> None:
    light, labels = np.array([[0.0], [photons]]), np.array([0, 1])
    found = word_information(light, labels, light, labels, 2)
    q = math.exp(-photons)  # the bright one is missed
    click = (1 - q) / 2
    assert found.bits == pytest.approx(h2(click) - h2(q) / 2, rel=1e-6, abs=1e-15)
    assert found.bayes_accuracy == pytest.approx(1 - q / 2, abs=1e-14)
    assert found.heldout_bayes_accuracy == pytest.approx(found.bayes_accuracy, abs=1e-14)
    assert found.heldout_bits == pytest.approx(found.bits, abs=1e-6)
    assert (found.photons, found.clicks) == pytest.approx((photons / 2, (1 - q) / 2))
    assert found.label_bits == pytest.approx(1.0)


def test_the_joint_is_that_of_plain_loops_and_of_the_tables_order() -> None:
    rng = np.random.default_rng(0)
    probability, labels = rng.random((7, 4)), rng.integers(0, 3, 7)
    joint = word_joint(probability, labels, 3)
    for word, of_class in naive_joint(probability, labels, 3).items():
        row = sum(click << i for i, click in enumerate(word))
        assert joint[row].tolist() == pytest.approx(of_class, abs=1e-15)
    assert joint.sum() == pytest.approx(1, abs=1e-14)


def test_held_out_objects_are_judged_by_the_table_of_the_training_objects() -> None:
    train, labels = np.array([[0.1], [2.0]]), np.array([0, 1])
    swapped = word_information(train, labels, train, 1 - labels, 2)
    fair = word_information(train, labels, train, labels, 2)
    assert swapped.heldout_bayes_accuracy == pytest.approx(1 - fair.heldout_bayes_accuracy, abs=1e-12)
    assert swapped.heldout_bits < 0 < fair.heldout_bits <= fair.bits + 1e-9


# ---- frames: one pixel, two objects, exact sums ----


def poisson_two(low: float, high: float) -> tuple[float, np.ndarray]:
    """I(label; count) in bits, and log P(count, label) for counts 0 ... 199."""
    counts = np.arange(200)
    log_factorial = np.array([math.lgamma(n + 1) for n in counts])
    log_joint = np.stack([counts * math.log(rate) - rate - log_factorial for rate in (low, high)], axis=1) - math.log(2)
    return mutual_information_bits(np.exp(log_joint)), log_joint


def test_sampled_bounds_meet_the_exact_information_when_the_posterior_is_right() -> None:
    exact, table = poisson_two(2.0, 5.0)
    rng = np.random.default_rng(3)
    labels = np.arange(40_000) % 2
    counts = rng.poisson(np.where(labels == 1, 5.0, 2.0))
    found = posterior_information(table[counts], labels)
    assert found.label_bits == pytest.approx(1)
    assert 0.1 < exact < 0.9
    assert abs(found.lower_bits - exact) < 5 * found.lower_bits_se
    assert abs(found.believed_bits - exact) < 5 * found.lower_bits_se
    assert found.temperature == pytest.approx(1, abs=0.25)


def test_an_overconfident_posterior_believes_too_much_and_is_cooled() -> None:
    exact, table = poisson_two(2.0, 5.0)
    rng = np.random.default_rng(4)
    labels = np.arange(40_000) % 2
    counts = rng.poisson(np.where(labels == 1, 5.0, 2.0))
    found = posterior_information(8 * table[counts], labels)
    assert found.believed_bits > exact + 50 * found.lower_bits_se
    assert abs(found.lower_bits - exact) < 5 * found.lower_bits_se
    assert found.temperature == pytest.approx(8, rel=0.25)


# ---- Fisher ----


def test_fisher_of_two_classes_in_one_dimension() -> None:
    mean, variance = np.array([[1.0], [1.0], [4.0], [4.0]]), np.full((4, 1), 0.5)
    found = fisher(mean, variance, np.array([0, 0, 1, 1]))
    assert found.trace == pytest.approx(1.5**2 / 0.5)
    assert found.discriminant == pytest.approx(found.trace)


def test_fisher_of_counts_is_that_of_sampled_frames() -> None:
    rng = np.random.default_rng(5)
    light, labels = rng.gamma(2.0, 1.0, (60, 5)), np.arange(60) % 3
    light[labels == 1] += 1.0
    exact = fisher(light, light, labels)
    copies = 4000
    counts = rng.poisson(np.tile(light, (copies, 1))).astype(float)
    sampled = fisher(counts, np.full(counts.shape, 1e-12), np.tile(labels, copies))
    assert sampled.trace == pytest.approx(exact.trace, rel=0.02)
    assert sampled.discriminant == pytest.approx(exact.discriminant, rel=0.02)
