"""Mutual information, Bayes errors and Fisher ratios against closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from pans.runtime.instrument.click_law import ClickLaw
from pans.trainer.evaluate import information
from pans.trainer.evaluate.information import (
    entropy_bits,
    fisher,
    fisher_of_frames,
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


def test_readouts_that_do_not_depend_on_the_label_say_nothing() -> None:
    probability = np.tile([0.2, 0.7, 0.5], (30, 1))
    joint = word_joint(probability, np.arange(30) % 3, 3)
    assert mutual_information_bits(joint) == pytest.approx(0, abs=1e-14)


def test_two_shots_know_as_much_as_two_equal_patterns() -> None:
    rng = np.random.default_rng(1)
    probability, labels = rng.random((9, 3)), rng.integers(0, 2, 9)
    counts = mutual_information_bits(word_joint(probability, labels, 2, shots=2))
    twice = mutual_information_bits(word_joint(np.repeat(probability, 2, axis=1), labels, 2))
    assert counts == pytest.approx(twice, abs=1e-13)  # the count is a sufficient statistic


def test_dark_counts_and_less_light_lose_information() -> None:
    rng = np.random.default_rng(2)
    light, labels = rng.gamma(1.0, 1.0, (40, 4)), np.arange(40) % 2
    light[labels == 1] *= 3

    def bits(law: ClickLaw) -> float:
        return word_information(light, labels, light, labels, 2, law=law).bits

    assert bits(ClickLaw()) > bits(ClickLaw(0.1)) > bits(ClickLaw(1.0)) > 0


def test_held_out_objects_are_judged_by_the_table_of_the_training_objects() -> None:
    train, labels = np.array([[0.1], [2.0]]), np.array([0, 1])
    swapped = word_information(train, labels, train, 1 - labels, 2)
    fair = word_information(train, labels, train, labels, 2)
    assert swapped.heldout_bayes_accuracy == pytest.approx(1 - fair.heldout_bayes_accuracy, abs=1e-12)
    assert swapped.heldout_bits < 0 < fair.heldout_bits <= fair.bits + 1e-9


def test_a_word_that_no_training_object_shows_costs_finite_bits() -> None:
    train, test, labels = np.array([[0.0], [50.0]]), np.array([[50.0], [0.0]]), np.array([0, 1])
    assert -60 < word_information(train, labels, test, labels, 2).heldout_bits < 0


def test_more_than_sixteen_patterns_are_refused() -> None:
    with pytest.raises(ValueError, match="131072 outcomes, allowed: 65536"):
        word_joint(np.full((2, 17), 0.5), np.array([0, 1]), 2)


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


def test_a_posterior_that_rules_classes_out_stays_finite() -> None:
    log_joint = np.array([[0.0, -np.inf], [-np.inf, 0.0], [0.0, -1e5], [-np.inf, -3.0]])
    right = posterior_information(log_joint, np.array([0, 1, 0, 1]))
    assert right.lower_bits == pytest.approx(right.label_bits, abs=1e-6)
    assert math.isfinite(posterior_information(log_joint, np.array([1, 0, 1, 0])).lower_bits)


def test_entropy() -> None:
    assert entropy_bits(np.array([0.25, 0.25, 0.5, 0.0])) == pytest.approx(1.5)


# ---- Fisher ----


def test_fisher_of_two_classes_in_one_dimension() -> None:
    mean, variance = np.array([[1.0], [1.0], [4.0], [4.0]]), np.full((4, 1), 0.5)
    found = fisher(mean, variance, np.array([0, 0, 1, 1]))
    assert found.trace == pytest.approx(1.5**2 / 0.5)
    assert found.discriminant == pytest.approx(found.trace)


def test_the_discriminant_adds_over_independent_readouts_and_ignores_silent_ones() -> None:
    labels = np.array([0, 1])
    mean = np.array([[1.0, 2.0, 0.0], [3.0, 8.0, 0.0]])
    variance = np.array([[2.0, 9.0, 0.0], [2.0, 9.0, 0.0]])
    signal = np.array([1.0, 9.0]) / np.array([2.0, 9.0])  # between over within, each alone
    # two classes: the squared distance of the means in units of the noise, and independent readouts add up
    assert fisher(mean, variance, labels).discriminant == pytest.approx(signal.sum())
    assert fisher(mean, variance, labels).trace == pytest.approx(10 / 11)


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


def test_fisher_of_frames_at_every_photon_level() -> None:
    rng = np.random.default_rng(6)
    light, labels = rng.gamma(1.0, 1.0, (50, 6)), np.arange(50) % 2
    light[:, 2] = 0
    levels = [1.0, 30.0, 1e5]
    for level, found in zip(levels, fisher_of_frames(light, labels, levels)):
        shown = light * level / (light.sum() / len(light))
        wanted = fisher(shown, shown, labels)
        assert (found.trace, found.discriminant) == pytest.approx((wanted.trace, wanted.discriminant), rel=1e-9)
    ratios = [found.trace for found in fisher_of_frames(light, labels, [1.0, 1e2, 1e4, 1e8])]
    assert ratios == sorted(ratios)
    assert ratios[0] < 0.2 * ratios[-1]


def test_large_frames_have_a_trace_ratio_only(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(7)
    light, labels = rng.gamma(1.0, 1.0, (20, 4)), np.arange(20) % 2
    small = fisher(light, light, labels)
    monkeypatch.setattr(information, "DISCRIMINANT_MAX", 3)
    large = fisher(light, light, labels)
    assert (large.trace, large.discriminant) == (small.trace, None)


def test_fisher_refuses_what_does_not_belong_together() -> None:
    with pytest.raises(ValueError, match="variances"):
        fisher(np.zeros((2, 3)), np.zeros((3, 3)), np.array([0, 1]))
