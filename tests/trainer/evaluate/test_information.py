"""Mutual information, Bayes errors and Fisher ratios against closed forms."""

import itertools
import math

import numpy as np
import pytest

from pans_trainer.evaluate import information


def h2(p: float) -> float:
    """Entropy of a coin."""
    return -p * math.log2(p) - (1 - p) * math.log2(1 - p)


def test_a_binary_symmetric_channel() -> None:
    joint = information.word_joint(np.array([[0.9], [0.1]]), np.array([0, 1]), 2)
    assert information.mutual_information_bits(joint) == pytest.approx(1 - h2(0.1), abs=1e-14)


@pytest.mark.parametrize("photons", [1e-6, 0.3, 2.0, 40.0])
def test_a_dark_and_a_bright_object_are_a_z_channel(photons: float) -> None:
    light, labels = np.array([[0.0], [photons]]), np.array([0, 1])
    found = information.word_information(light, labels, light, labels, 2)
    q = math.exp(-photons)  # the bright one is missed
    click = (1 - q) / 2
    assert found.bits == pytest.approx(h2(click) - h2(q) / 2, abs=1e-6)
    assert (found.accuracy, found.clicks) == pytest.approx((1 - q / 2, (1 - q) / 2), abs=1e-14)


def test_the_joint_is_that_of_plain_loops_and_of_the_tables_order() -> None:
    rng = np.random.default_rng(0)
    probability, labels = rng.random((7, 4)), rng.integers(0, 3, 7)
    joint, wanted = information.word_joint(probability, labels, 3), np.zeros((16, 3))
    for (p, label), word in itertools.product(zip(probability, labels), range(16)):
        wanted[word, label] += math.prod(q if word >> i & 1 else 1 - q for i, q in enumerate(p)) / 7
    np.testing.assert_allclose(joint, wanted, atol=1e-15)


def test_held_out_objects_are_judged_by_the_table_of_the_training_objects() -> None:
    train, labels = np.array([[0.1], [2.0]]), np.array([0, 1])
    swapped = information.word_information(train, labels, train, 1 - labels, 2)
    fair = information.word_information(train, labels, train, labels, 2)
    assert swapped.accuracy == pytest.approx(1 - fair.accuracy, abs=1e-12)
    assert swapped.bits < 0 < fair.bits


def test_bits_of_light_and_their_errors_are_those_of_objects_drawn_again() -> None:
    rng = np.random.default_rng(8)
    labels, photons = rng.integers(0, 3, 400), rng.gamma(2.0, 4.0, 400)
    surprise = rng.exponential(0.4, 400) + 0.05 * photons
    found = information.conveyed(surprise, labels, photons, 30.0)
    drawn = [rng.integers(0, 400, 400) for _ in range(3000)]
    again = [information.conveyed(surprise[some], labels[some], photons[some], 30.0) for some in drawn]
    for name in ("bits", "bits_per_photon", "bits_per_illumination"):
        assert found[f"{name}_se"] == pytest.approx(np.std([one[name] for one in again]), rel=0.06)
    assert found["bits_per_illumination"] == pytest.approx(found["bits"] / 30)
    # (classes - 1) / (2 n ln 2) below the entropy of three equal classes
    fair = [information.conveyed(np.zeros(60), rng.integers(0, 3, 60), np.ones(60), 1.0)["bits"] for _ in range(4000)]
    assert math.log2(3) - np.mean(fair) == pytest.approx(2 / (2 * 60 * math.log(2)), rel=0.1)
    assert "bits_per_photon" not in information.conveyed(np.zeros(4), np.arange(4) % 2, np.zeros(4), 0.0)


def poisson_two(low: float, high: float) -> tuple[float, np.ndarray]:
    """I(label; count) in bits, and log P(count, label) for counts 0 ... 199."""
    counts = np.arange(200)
    log_factorial = np.array([math.lgamma(n + 1) for n in counts])
    log_joint = np.stack([counts * math.log(rate) - rate - log_factorial for rate in (low, high)], axis=1) - math.log(2)
    return information.mutual_information_bits(np.exp(log_joint)), log_joint


@pytest.mark.parametrize("confidence", [1, 8])
def test_sampled_bounds_meet_the_exact_information_and_an_overconfident_posterior_is_cooled(confidence: int) -> None:
    exact, table = poisson_two(2.0, 5.0)
    labels = np.arange(40_000) % 2
    counts = np.random.default_rng(2 + confidence).poisson(np.where(labels == 1, 5.0, 2.0))
    found = information.posterior_information(confidence * table[counts], labels)
    assert found.label_bits == pytest.approx(1)
    assert 0.1 < exact < 0.9
    assert abs(found.lower_bits - exact) < 5 * found.lower_bits_se
    if confidence == 1:
        assert abs(found.believed_bits - exact) < 5 * found.lower_bits_se
    else:  # it believes too much
        assert found.believed_bits > exact + 50 * found.lower_bits_se
    assert found.temperature == pytest.approx(confidence, rel=0.25)


def test_fisher_of_two_classes_in_one_dimension() -> None:
    mean, variance = np.array([[1.0], [1.0], [4.0], [4.0]]), np.full((4, 1), 0.5)
    found = information.fisher(mean, variance, np.array([0, 0, 1, 1]))
    assert found.trace == pytest.approx(1.5**2 / 0.5)
    assert found.discriminant == pytest.approx(found.trace)


def test_fisher_of_counts_is_that_of_sampled_frames() -> None:
    rng = np.random.default_rng(5)
    light, labels = rng.gamma(2.0, 1.0, (60, 5)), np.arange(60) % 3
    light[labels == 1] += 1.0
    exact = information.fisher(light, light, labels)
    copies = 4000
    counts = rng.poisson(np.tile(light, (copies, 1))).astype(float)
    sampled = information.fisher(counts, np.full(counts.shape, 1e-12), np.tile(labels, copies))
    assert sampled.trace == pytest.approx(exact.trace, rel=0.02)
    assert sampled.discriminant == pytest.approx(exact.discriminant, rel=0.02)
