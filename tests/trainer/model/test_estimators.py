"""Gradient estimators against finite differences and exact ones, heads and their flips against plain passes, SSIM against an oracle."""

import itertools
import math

import naive_ssim
import numpy as np
import pytest
import torch
from trainings import assert_slope

from pans.instrument.click_law import ClickLaw, CountLaw, count_chances
from pans_trainer.model.detection import click_probability, word_probabilities
from pans_trainer.model.estimators import (
    CLICKS,
    ESTIMATORS,
    Readings,
    cross_entropy,
    exact,
    readings_of,
    similarity_loss,
    squared_error,
)
from pans_trainer.model.heads import MlpHead, new_head
from pans_trainer.model.ssim import ssim
from pans_trainer.options import PICTURE_HEADS, Options

READ_NOISE = ClickLaw(dark_per_exposure=1.8e-5, read_noise_e=0.2, threshold_e=0.84)
D_F, N, CLASSES = 4, 6, 3


class TableHead:
    """A score per word, without normalisation."""

    def __init__(self, scores):
        self.scores = scores

    def __call__(self, clicks, mean=None):
        index = (clicks @ (2.0 ** torch.arange(clicks.shape[-1], dtype=clicks.dtype))).long()
        return self.scores[index]

    def changed(self, clicks, mean, by):
        columns = []
        for i in range(clicks.shape[1]):
            other = clicks.clone()
            other[:, i] = 1 - other[:, i]
            columns.append(self(other))
        return torch.stack(columns, dim=1)


def problem(seed=0):
    rng = np.random.default_rng(seed)
    light = torch.from_numpy(rng.uniform(0.1, 2.5, (N, D_F)))
    head = TableHead(torch.from_numpy(2 * rng.normal(size=(1 << D_F, CLASSES))))
    return light, head, torch.from_numpy(rng.integers(0, CLASSES, N))


def gradient(name, light, head, labels, random, repeats=1):
    """Mean and standard error of the gradient in the light over `repeats` estimates."""
    found = []
    for _ in range(repeats):
        at = light.clone().requires_grad_()
        ESTIMATORS[name](click_probability(at, READ_NOISE), labels, head, cross_entropy, random, CLICKS).backward()
        found.append(at.grad)
    stacked = torch.stack(found)
    return stacked.mean(dim=0).numpy(), stacked.std(dim=0, correction=0).numpy() / np.sqrt(repeats)


def test_exact_loss_of_pictures_is_the_sum_over_words():
    light, head, _ = problem(2)
    pictures = torch.rand(N, CLASSES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    p = click_probability(light, READ_NOISE)
    errors = (head.scores.unsqueeze(0) - pictures.unsqueeze(1)).square().mean(dim=2)
    wanted = (word_probabilities(p) * errors).sum(dim=1).mean()
    assert float(exact(p, pictures, head, squared_error, None, CLICKS)) == pytest.approx(float(wanted))


def test_similarity_loss_weighs_ssim_of_what_is_shown_against_the_error_of_the_scores():
    random = torch.Generator().manual_seed(7)
    scores = torch.rand(3, 7 * 9, generator=random, dtype=torch.float64) * 1.6 - 0.3  # some beyond black and white
    wanted = torch.rand(3, 7 * 9, generator=random, dtype=torch.float64)
    found = similarity_loss(0.25, (7, 9))(scores, wanted)
    for i in range(3):
        shown = np.clip(scores[i].numpy(), 0, 1).reshape(7, 9)
        alike = np.mean(naive_ssim.ssim_map(shown.tolist(), wanted[i].reshape(7, 9).tolist()))
        error = np.square(scores[i].numpy() - wanted[i].numpy()).mean()
        assert float(found[i]) == pytest.approx(0.75 * error + 0.25 * (1 - alike), rel=1e-9)
    assert torch.equal(similarity_loss(0.0, (7, 9))(scores, wanted), squared_error(scores, wanted))
    every = similarity_loss(0.25, (7, 9))(scores.unsqueeze(0), wanted.unsqueeze(1))  # as `exact` asks for it
    assert every.shape == (3, 3)
    assert torch.allclose(every.diagonal(), found)


@pytest.mark.parametrize("name", ["local", "disarm", "loo"])
def test_unbiased_estimators_meet_the_exact_gradient(name):
    light, head, labels = problem(3)
    wanted, _ = gradient("exact", light, head, labels, None)
    found, error = gradient(name, light, head, labels, torch.Generator().manual_seed(1), repeats=3000)
    assert np.all(np.abs(found - wanted) < 5 * error + 1e-12)
    assert np.max(np.abs(wanted) / (error + 1e-12)) > 20  # the test could see a bias


def test_identity_passes_the_gradient_of_a_click_to_its_light_undamped():
    light, law = problem()[0], ClickLaw(dark_per_exposure=0.01)
    weights = torch.tensor([1.0, -2.0, 0.5, 3.0], dtype=torch.float64)

    def affine(clicks, _mean=None):  # a loss whose gradient in each click is its weight
        return clicks @ weights

    def found(name, at):
        at = at.clone().requires_grad_()
        p = click_probability(at, law)
        ESTIMATORS[name](p, None, affine, lambda scores, _: scores, torch.Generator().manual_seed(1), CLICKS).backward()
        return at.grad * len(at)

    assert torch.allclose(found("identity", light), weights.expand(N, D_F))
    damped = torch.exp(-(light + law.dark_per_exposure))
    assert torch.allclose(found("ste", light), weights * damped)
    bright = torch.full((1, D_F), 60.0, dtype=torch.float64)  # e**-60: no chance of staying dark to divide by
    assert torch.isfinite(found("identity", bright)).all()


def test_straight_through_is_biased_by_more_than_chance():
    light, head, labels = problem(3)
    head = MlpHead(D_F, 8, CLASSES, torch.Generator().manual_seed(0)).double()
    with torch.no_grad():
        head.hidden.weight.mul_(8)  # a loss far from affine in every click
        head.norm.running_mean.copy_(click_probability(light, READ_NOISE).mean(dim=0))
    fixed = FixedMean(head.eval(), head.norm.running_mean)
    wanted, _ = gradient("exact", light, fixed, labels, None)
    found, error = gradient("ste", light, fixed, labels, torch.Generator().manual_seed(1), repeats=2000)
    assert np.max(np.abs(found - wanted) / error) > 10


class FixedMean:
    """A head whose normalisation stays, so that estimators differ in nothing but the gradient."""

    def __init__(self, head, mean):
        self.head, self.mean = head, mean

    def __call__(self, clicks, mean=None):
        return self.head(clicks.to(self.head.hidden.weight.dtype), self.mean)

    def changed(self, clicks, mean, by):
        return self.head.changed(clicks, self.mean, by)


LAW = CountLaw(0.02, 0.3, (0.7, 1.5))
COUNTED, OBJECTS = 3, 5


def problem_readings(seed: int = 0):
    rng = np.random.default_rng(seed)
    light = torch.from_numpy(rng.uniform(0.1, 3.0, (OBJECTS, COUNTED)))
    head = MlpHead(COUNTED, 6, CLASSES, torch.Generator().manual_seed(seed)).double().eval()
    return light, head, torch.from_numpy(rng.integers(0, CLASSES, OBJECTS))


def test_chances_are_those_of_the_law() -> None:
    light = np.array([0.0, 1e-6, 0.3, 2.0, 9.0, 60.0, 400.0])
    for edges in ((0.7,), (0.7, 1.5), (0.6, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5)):
        law = CountLaw(0.02, 0.3, edges)
        found = Readings(law.outcomes).chances(torch.from_numpy(light), law).numpy()
        assert np.allclose(found.T, count_chances(law, light), rtol=0, atol=1e-12)


def test_samples_have_the_chances_and_the_mean() -> None:
    numbers, random = readings_of(3), torch.Generator().manual_seed(1)
    chances = torch.tensor([[[0.2, 0.5, 0.3], [0.9, 0.0, 0.1]]], dtype=torch.float64).expand(40_000, 2, 3)
    drawn = numbers.sample(chances, random).numpy()
    share = np.stack([(drawn == value).mean(axis=0) for value in (0.0, 0.5, 1.0)], axis=-1)
    assert np.abs(share - chances[0].numpy()).max() < 5 * math.sqrt(0.25 / 40_000)
    assert numbers.mean(chances)[0].tolist() == pytest.approx([0.55, 0.1])


def test_words_are_all_numbers_in_order_and_their_chances_products() -> None:
    numbers = readings_of(3)
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
    for word in itertools.product(range(3), repeat=COUNTED):
        with torch.no_grad():
            scores = head(torch.tensor([word], dtype=torch.float64) / 2, torch.from_numpy(mean))
            losses = cross_entropy(scores.expand(OBJECTS, CLASSES), labels).numpy()
        weight = np.prod([chances[number, :, i] for i, number in enumerate(word)], axis=0)
        total += float((weight * losses).sum())
    return total / OBJECTS


def test_the_exact_gradient_is_the_finite_difference() -> None:
    light, head, labels = problem_readings()
    at, numbers = light.clone().requires_grad_(), readings_of(3)
    loss = ESTIMATORS["exact"](numbers.chances(at, LAW), labels, head, cross_entropy, torch.Generator(), numbers)
    loss.backward()
    light.grad = at.grad
    assert float(loss.detach()) == pytest.approx(expected_loss(light, head, labels), abs=1e-9)
    assert_slope(light, lambda: expected_loss(light, head, labels), step=1e-5)


def test_the_local_gradient_is_unbiased() -> None:
    light, head, labels = problem_readings(1)
    numbers, random = readings_of(3), torch.Generator().manual_seed(4)
    chances, fixed = numbers.chances(light, LAW), FixedMean(head, torch.tensor([0.3, 0.5, 0.4], dtype=torch.float64))

    def one(name: str) -> np.ndarray:
        at = chances.clone().requires_grad_()
        ESTIMATORS[name](at, labels, fixed, cross_entropy, random, numbers).backward()
        return (at.grad - at.grad.mean(dim=-1, keepdim=True)).numpy()  # chances of an exposure sum to 1

    wanted = one("exact")
    drawn = np.stack([one("local") for _ in range(600)])
    error = drawn.std(axis=0) / math.sqrt(len(drawn))
    assert (np.abs(drawn.mean(axis=0) - wanted) < 5 * error + 1e-12).all()
    assert np.abs(wanted).max() > 20 * error.max()


def head_of(kind, d_f, seed=0):
    return new_head(Options(features=d_f, hidden=8, head=kind), 5, (9, 6), torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("d_f", [1, 2, 3, 4, 5, 7, 10, 16, 33, 64])
def test_the_convolutional_head_is_valid_for_every_number_of_patterns(d_f):
    head = head_of("conv", d_f)
    assert head(torch.zeros(3, d_f)).shape == (3, 5)
    out = head(torch.rand(8, d_f, generator=torch.Generator().manual_seed(1)))
    out.sum().backward()
    assert all(bool((parameter.grad != 0).any()) for parameter in head.convolutions.parameters())


@pytest.mark.parametrize("kind", ["mlp", "deep", "conv", "picture", "decoder"])
def test_flipped_is_a_pass_of_every_flipped_word(kind):
    head = head_of(kind, 4).double()
    assert head(torch.zeros(3, 4).double()).shape == (3, 54 if kind in PICTURE_HEADS else 5)
    clicks = torch.randint(0, 2, (6, 4), generator=torch.Generator().manual_seed(2)).double()
    mean = torch.tensor([0.2, 0.5, 0.7, 0.4], dtype=torch.float64)
    with torch.no_grad():
        found = head.changed(clicks, mean, 1 - 2 * clicks)
        for i in range(4):
            other = clicks.clone()
            other[:, i] = 1 - other[:, i]
            assert torch.allclose(found[:, i], head(other, mean), atol=1e-12)


def test_the_mean_is_that_of_the_slow_oracle_the_edge_included() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 9, 14))
    wanted = np.mean(naive_ssim.ssim_map(a.tolist(), b.tolist()))
    assert float(ssim(torch.from_numpy(a), torch.from_numpy(b))) == pytest.approx(wanted, abs=1e-12)


def test_the_gradient_is_that_of_the_pixels() -> None:
    a, b = torch.rand(2, 2, 5, 7, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    for both in (False, True):
        assert torch.autograd.gradcheck(ssim, (a.requires_grad_(), b.requires_grad_(both)))
    black = torch.zeros(1, 12, 12, requires_grad=True)
    ssim(black, torch.zeros(1, 12, 12)).sum().backward()
    assert not black.grad.any()  # at its best already
