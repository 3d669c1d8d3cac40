"""Detection in torch: the click law, the damped straight-through gradient, exact enumeration."""

from itertools import product

import numpy as np
import pytest
import torch
from trainings import random_machine

from pans.instrument.click_law import ClickLaw
from pans.instrument.click_law import click_probability as reference_probability
from pans.instrument.detector import Afterpulses
from pans_trainer.evaluate.readings import Chain
from pans_trainer.model import detection
from pans_trainer.train.automaton.machine import Sight, forward

PLAIN = ClickLaw()
READ_NOISE = ClickLaw(dark_per_exposure=1.8e-5, read_noise_e=0.2, threshold_e=0.84)
WIDE = ClickLaw(dark_per_exposure=0.01, read_noise_e=1.5, threshold_e=3.5)


@pytest.mark.parametrize("law", [PLAIN, READ_NOISE, WIDE], ids=["plain", "read noise", "wide"])
def test_probability_is_the_law_of_the_runtime(law):
    light = np.concatenate([[0.0, 1e-30, 1e-7], np.geomspace(1e-3, 60, 50), [1e4]])
    found = detection.click_probability(torch.from_numpy(light), law).numpy()
    assert found == pytest.approx(reference_probability(law, light), rel=1e-8, abs=1e-12)


@pytest.mark.parametrize("slope", [1.0, 0.5])
def test_damped_straight_through_gradient_is_the_papers(slope):
    light = torch.tensor([[0.0, 0.1, 0.7, 3.0, 9.0]], dtype=torch.float64, requires_grad=True)
    weights = torch.tensor([1.0, -2.0, 3.0, 0.5, 7.0], dtype=torch.float64)
    clicks = detection.sample_clicks(detection.click_probability(light, PLAIN, slope), torch.Generator().manual_seed(1))
    (clicks * weights).sum().backward()
    wanted = weights * slope * torch.exp(-slope * light.detach()[0])
    assert light.grad[0].numpy() == pytest.approx(wanted.numpy(), rel=1e-12)


def test_gradient_through_read_noise_is_the_slope_of_the_law():
    light = torch.linspace(0.01, 6, 40, dtype=torch.float64, requires_grad=True)
    detection.click_probability(light, READ_NOISE).sum().backward()
    at, step = light.detach().numpy(), 1e-5
    slope = (reference_probability(READ_NOISE, at + step) - reference_probability(READ_NOISE, at - step)) / (2 * step)
    assert light.grad.numpy() == pytest.approx(slope, rel=1e-6, abs=1e-9)


def test_sampled_clicks_have_the_right_rate_and_are_independent():
    p = torch.tensor([0.0, 1e-3, 0.3, 0.5, 1.0], dtype=torch.float64).expand(200_000, 5)
    clicks = detection.sample_clicks(p, torch.Generator().manual_seed(2)).numpy()
    assert set(np.unique(clicks)) == {0.0, 1.0}
    sigma = np.sqrt(p[0].numpy() * (1 - p[0].numpy()) / len(clicks))
    assert np.all(np.abs(clicks.mean(axis=0) - p[0].numpy()) <= 5 * sigma)
    assert abs(np.corrcoef(clicks[:, 2], clicks[:, 3])[0, 1]) < 5 / np.sqrt(len(clicks))
    assert abs(np.corrcoef(clicks[:-1, 3], clicks[1:, 3])[0, 1]) < 5 / np.sqrt(len(clicks))


def test_words_are_products_in_the_order_of_the_table():
    p = np.random.default_rng(0).uniform(size=(3, 4))
    found = detection.word_probabilities(torch.from_numpy(p)).numpy()
    words = detection.click_words(4).numpy()
    for word in range(16):
        bits = [(word >> i) & 1 for i in range(4)]
        assert words[word].tolist() == bits
        assert found[:, word] == pytest.approx(np.where(bits, p, 1 - p).prod(axis=1), rel=1e-12)


LAW = Afterpulses(0.15, 2.0, 0.1)


def chances_of_words(first: list[float], law: Afterpulses, begins: np.ndarray) -> dict[tuple[int, ...], float]:
    """The chance of every word, one at a time: the memory follows from its clicks."""
    found = {}
    for word in product((0, 1), repeat=len(first)):
        chance, memory = 1.0, begins
        for p, clicked in zip(first, word):
            click = float(law.chance(p, memory))
            chance *= click if clicked else 1 - click
            memory = law.after(-np.log1p(-p), memory, clicked)
        found[word] = chance
    return found


@pytest.mark.parametrize("law", [LAW, Afterpulses(0.2), Afterpulses(0.05, 1.0, 0.3, True)])
def test_words_and_their_draws_are_those_of_the_chain(law: Afterpulses) -> None:
    first = np.random.default_rng(0).random((3, 5)) * 0.8
    chain = Chain.of(first, law)
    assert chain.begins[0] > 0
    words = chain.word_chances(slice(None))
    for i, row in enumerate(first.tolist()):
        for word, chance in chances_of_words(row, law, chain.begins).items():
            assert words[i, sum(bit << k for k, bit in enumerate(word))] == pytest.approx(chance, rel=1e-9)
    bits = (np.arange(32)[:, None] >> np.arange(5)) & 1
    assert chain.mean_chances() == pytest.approx(words @ bits, abs=2e-3)
    many = Chain.of(np.repeat(first, 20_000, axis=0), law)
    drawn = many.counts(1, np.random.default_rng(1), slice(None)).reshape(3, 20_000, 5).mean(axis=1)
    assert drawn == pytest.approx(words @ bits, abs=4.5 * 0.5 / np.sqrt(20_000))
    assert (words @ bits > first).all()


def test_training_has_the_mean_chances_of_the_evaluation_and_their_gradient() -> None:
    first = np.random.default_rng(2).random((4, 6)) * 0.7 + 0.05
    for law, error in ((LAW, 4e-3), (Afterpulses(0.05, 2.0, 0.1), 5e-4)):
        found = detection.with_mean_memory(torch.tensor(first), law).numpy()
        assert found == pytest.approx(Chain.of(first, law).mean_chances(), abs=error)
    few = torch.tensor(first[:1], requires_grad=True)
    detection.with_mean_memory(few, LAW)[0, 5].backward()
    assert (few.grad[0, :5] > 0).all()  # more light before means more clicks behind
    step = 1e-6
    for i in (1, 4):  # the memory of the begin stands still in the gradient, and is the same to first order
        up, down = few.detach().clone(), few.detach().clone()
        up[0, i] += step
        down[0, i] -= step
        slope = float(detection.with_mean_memory(up, LAW)[0, 5] - detection.with_mean_memory(down, LAW)[0, 5]) / (
            2 * step
        )
        assert float(few.grad[0, i]) == pytest.approx(slope, rel=0.1)
    assert detection.with_mean_memory(few, None) is few


def test_a_machine_in_training_clicks_as_its_expectation() -> None:
    machine, grey = random_machine(1), torch.tensor([[0, 10, 255, 30, 7]], dtype=torch.float64)
    sight = Sight(ClickLaw(0.05), 1 / 255, 0.0, torch.float64, afterpulses=LAW)
    passed, plain = forward(machine, sight, grey), forward(machine, sight.exact(), grey)
    assert torch.cat(passed.leaves).sum().item() == pytest.approx(1.0, abs=1e-12)
    first, second = passed.steps[0], passed.steps[1]
    assert torch.equal(first.chances[0], plain.steps[0].chances[0])  # nothing before the first exposure
    silent = float(first.chances[0][0, 0])
    after_click = float(LAW.sight(LAW.after(-np.log(silent), np.zeros(2), 1)))
    ways = machine.levels[0].successors[:, 0].tolist()
    if ways[0] != ways[1]:
        for clicked, node in enumerate(ways):
            if node < len(second.chances[0]):
                wanted = float(plain.steps[1].chances[0][node, 0]) * np.exp(-after_click * clicked)
                assert float(second.chances[0][node, 0]) == pytest.approx(wanted, rel=1e-9)
    assert float(passed.clicks()) > 1.01 * float(plain.clicks())
