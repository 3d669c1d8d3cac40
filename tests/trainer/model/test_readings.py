"""Photon numbers in training: chances against the law in numpy, samples against chances, gradients against finite differences."""

# ruff: noqa: E402  (what follows needs torch)
import itertools
import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.errors import PlanError, UsageError
from pans.runtime.instrument.click_law import CountLaw, count_chances
from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.estimators import Numbers, cross_entropy, readings_of
from pans.trainer.model.heads import MlpHead
from pans.trainer.options import Options, check_options

LAW = CountLaw(0.02, 0.3, (0.7, 1.5))
D_F, N, CLASSES = 3, 5, 3


def problem(seed: int = 0):
    rng = np.random.default_rng(seed)
    light = torch.from_numpy(rng.uniform(0.1, 3.0, (N, D_F)))
    head = MlpHead(D_F, 6, CLASSES, torch.Generator().manual_seed(seed)).double().eval()
    return light, head, torch.from_numpy(rng.integers(0, CLASSES, N))


def test_chances_are_those_of_the_law() -> None:
    light = np.array([0.0, 1e-6, 0.3, 2.0, 9.0, 60.0, 400.0])
    for edges in ((0.7,), (0.7, 1.5), (0.6, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5)):
        law = CountLaw(0.02, 0.3, edges)
        found = Numbers(law.outcomes).chances(torch.from_numpy(light), law).numpy()
        assert np.allclose(found.T, count_chances(law, light), rtol=0, atol=1e-12)


def test_samples_have_the_chances_and_the_mean() -> None:
    numbers, random = Numbers(3), torch.Generator().manual_seed(1)
    chances = torch.tensor([[[0.2, 0.5, 0.3], [0.9, 0.0, 0.1]]], dtype=torch.float64).expand(40_000, 2, 3)
    drawn = numbers.sample(chances, random).numpy()
    share = np.stack([(drawn == value).mean(axis=0) for value in (0.0, 0.5, 1.0)], axis=-1)
    assert np.abs(share - chances[0].numpy()).max() < 5 * math.sqrt(0.25 / 40_000)
    assert numbers.mean(chances)[0].tolist() == pytest.approx([0.55, 0.1])


def test_words_are_all_numbers_in_order_and_their_chances_products() -> None:
    numbers = Numbers(3)
    chances = torch.rand((4, 2, 3), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    words, found = numbers.words(2), numbers.word_chances(chances)
    for place, (high, low) in enumerate(itertools.product(range(3), repeat=2)):
        assert words[place].tolist() == [low / 2, high / 2]
        assert torch.allclose(found[:, place], chances[:, 0, low] * chances[:, 1, high])


def expected_loss(light, head, labels) -> float:
    """By hand: every word of every object."""
    chances = count_chances(LAW, light.numpy())
    mean = ((chances[1] + 2 * chances[2]) / 2).mean(axis=0)
    total = 0.0
    for word in itertools.product(range(3), repeat=D_F):
        with torch.no_grad():
            scores = head(torch.tensor([word], dtype=torch.float64) / 2, torch.from_numpy(mean))
            losses = cross_entropy(scores.expand(N, CLASSES), labels).numpy()
        weight = np.prod([chances[number, :, i] for i, number in enumerate(word)], axis=0)
        total += float((weight * losses).sum())
    return total / N


def gradient(name: str, light, head, labels, random) -> tuple[float, np.ndarray]:
    at, numbers = light.clone().requires_grad_(), Numbers(3)
    loss = numbers.estimator(name)(numbers.chances(at, LAW), labels, head, cross_entropy, random)
    loss.backward()
    return float(loss.detach()), at.grad.numpy()


def test_the_exact_gradient_is_the_finite_difference() -> None:
    light, head, labels = problem()
    loss, found = gradient("exact", light, head, labels, torch.Generator())
    assert loss == pytest.approx(expected_loss(light, head, labels), abs=1e-9)
    for i, j in ((0, 0), (2, 1), (4, 2)):
        moved = [light.clone(), light.clone()]
        moved[0][i, j] += 1e-5
        moved[1][i, j] -= 1e-5
        wanted = (expected_loss(moved[0], head, labels) - expected_loss(moved[1], head, labels)) / 2e-5
        assert found[i, j] == pytest.approx(wanted, abs=2e-6)


def test_the_local_gradient_is_unbiased() -> None:
    light, head, labels = problem(1)
    numbers, random = Numbers(3), torch.Generator().manual_seed(4)
    chances = numbers.chances(light, LAW).clone()
    fixed = torch.tensor(
        [0.3, 0.5, 0.4], dtype=torch.float64
    )  # of the normalisation: both estimates go through the chances alone

    class Fixed:
        def __call__(self, clicks, mean=None):
            return head(clicks, fixed)

        def changed(self, clicks, mean, by):
            return head.changed(clicks, fixed, by)

    def one(name: str) -> np.ndarray:
        at = chances.clone().requires_grad_()
        numbers.estimator(name)(at, labels, Fixed(), cross_entropy, random).backward()
        return (at.grad - at.grad.mean(dim=-1, keepdim=True)).numpy()  # chances of an exposure sum to 1

    wanted = one("exact")
    drawn = np.stack([one("local") for _ in range(600)])
    error = drawn.std(axis=0) / math.sqrt(len(drawn))
    assert (np.abs(drawn.mean(axis=0) - wanted) < 5 * error + 1e-12).all()
    assert np.abs(wanted).max() > 20 * error.max()


def test_a_changed_number_is_a_pass_of_its_own() -> None:
    _, head, _ = problem(2)
    clicks, by = torch.rand((N, D_F), dtype=torch.float64), torch.rand((N, D_F), dtype=torch.float64)
    mean = torch.full((D_F,), 0.4, dtype=torch.float64)
    found = head.changed(clicks, mean, by)
    for i in range(D_F):
        other = clicks.clone()
        other[:, i] += by[:, i]
        assert torch.allclose(found[:, i], head(other, mean))


def test_what_cannot_be_counted_is_refused_before_training() -> None:
    counting, clicking = load_profile("dmd-qcmos"), load_profile("dmd-spad")
    check_options(Options(7, photons=5.0, outcomes=3), counting)
    for changes, profile, error, words in (
        ({}, clicking, PlanError, "dmd-spad tells 2 apart"),
        ({"outcomes": 17}, counting, UsageError, "--outcomes is 17, allowed: 2 to 16"),
        ({"features": 8}, counting, UsageError, r"3\*\*8 click words, allowed: at most 7 patterns"),
        ({"estimator": "disarm"}, counting, UsageError, "knows clicks alone"),
        ({"clicks": 14.0}, counting, UsageError, "below 14, 2 photons per pattern"),
        ({"bleach": "40"}, counting, UsageError, "not for a passive encoder, pictures or --bleach"),
    ):
        with pytest.raises(error, match=words):
            check_options(Options(**{"features": 7, "outcomes": 3, **changes}), profile)
    assert [readings_of(outcomes).outcomes for outcomes in (2, 5)] == [2, 5]
