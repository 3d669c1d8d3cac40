"""Detection in torch: the click law, the damped straight-through gradient, exact enumeration."""

# ruff: noqa: E402  (what follows needs torch)
import mpmath
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.instrument.click_law import ClickLaw
from pans.runtime.instrument.click_law import click_probability as reference_probability
from pans.trainer.model.detection import ThermalLaw, click_probability, click_words, sample_clicks, word_probabilities

PLAIN = ClickLaw()
READ_NOISE = ClickLaw(dark_per_exposure=1.8e-5, read_noise_e=0.2, threshold_e=0.84)
WIDE = ClickLaw(dark_per_exposure=0.01, read_noise_e=1.5, threshold_e=3.5)


@pytest.mark.parametrize("law", [PLAIN, READ_NOISE, WIDE], ids=["plain", "read noise", "wide"])
def test_probability_is_the_law_of_the_runtime(law):
    light = np.concatenate([[0.0, 1e-30, 1e-7], np.geomspace(1e-3, 60, 50), [1e4]])
    found = click_probability(torch.from_numpy(light), law).numpy()
    assert found == pytest.approx(reference_probability(law, light), rel=1e-8, abs=1e-12)


def test_plain_probability_of_faint_light_keeps_its_digits():
    assert float(click_probability(torch.tensor([1e-30], dtype=torch.float64), PLAIN)) == 1e-30


@pytest.mark.parametrize("slope", [1.0, 0.5])
def test_damped_straight_through_gradient_is_the_papers(slope):
    light = torch.tensor([[0.0, 0.1, 0.7, 3.0, 9.0]], dtype=torch.float64, requires_grad=True)
    weights = torch.tensor([1.0, -2.0, 3.0, 0.5, 7.0], dtype=torch.float64)
    clicks = sample_clicks(click_probability(light, PLAIN, slope), torch.Generator().manual_seed(1))
    (clicks * weights).sum().backward()
    wanted = weights * slope * torch.exp(-slope * light.detach()[0])
    assert light.grad[0].numpy() == pytest.approx(wanted.numpy(), rel=1e-12)


def test_gradient_through_read_noise_is_the_slope_of_the_law():
    light = torch.linspace(0.01, 6, 40, dtype=torch.float64, requires_grad=True)
    click_probability(light, READ_NOISE).sum().backward()
    at, step = light.detach().numpy(), 1e-5
    slope = (reference_probability(READ_NOISE, at + step) - reference_probability(READ_NOISE, at - step)) / (2 * step)
    assert light.grad.numpy() == pytest.approx(slope, rel=1e-6, abs=1e-9)


def test_sampled_clicks_have_the_right_rate_and_are_independent():
    p = torch.tensor([0.0, 1e-3, 0.3, 0.5, 1.0], dtype=torch.float64).expand(200_000, 5)
    clicks = sample_clicks(p, torch.Generator().manual_seed(2)).numpy()
    assert set(np.unique(clicks)) == {0.0, 1.0}
    sigma = np.sqrt(p[0].numpy() * (1 - p[0].numpy()) / len(clicks))
    assert np.all(np.abs(clicks.mean(axis=0) - p[0].numpy()) <= 5 * sigma)
    assert abs(np.corrcoef(clicks[:, 2], clicks[:, 3])[0, 1]) < 5 / np.sqrt(len(clicks))
    assert abs(np.corrcoef(clicks[:-1, 3], clicks[1:, 3])[0, 1]) < 5 / np.sqrt(len(clicks))


def test_sampling_repeats_with_the_seed():
    p = torch.full((100, 4), 0.4)
    first, again = (sample_clicks(p, torch.Generator().manual_seed(3)) for _ in range(2))
    other = sample_clicks(p, torch.Generator().manual_seed(4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_words_are_products_in_the_order_of_the_table():
    p = np.random.default_rng(0).uniform(size=(3, 4))
    found = word_probabilities(torch.from_numpy(p)).numpy()
    words = click_words(4).numpy()
    for row in range(3):
        for word in range(16):
            bits = [(word >> i) & 1 for i in range(4)]
            assert words[word].tolist() == bits
            chances = [p[row, i] if bit else 1 - p[row, i] for i, bit in enumerate(bits)]
            assert found[row, word] == pytest.approx(np.prod(chances), rel=1e-12)
    assert found.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize("modes", [1.0, 2.0, 7.5])
def test_thermal_law_is_the_sum_over_its_photon_numbers(modes):
    light = torch.tensor([0.0, 1e-9, 0.3, 4.0], dtype=torch.float64)
    found = click_probability(light, ThermalLaw(modes, dark_per_exposure=0.02)).numpy()
    for value, p in zip(light.tolist(), found):
        none = float(mpmath.power(1 + mpmath.mpf(value) / modes, -modes) * mpmath.exp(-0.02))
        assert p == pytest.approx(1 - none, rel=1e-9)


def test_thermal_light_of_many_modes_is_poisson_and_of_one_clicks_less():
    light = torch.linspace(0.01, 5, 20, dtype=torch.float64)
    poisson = click_probability(light, PLAIN)
    assert torch.allclose(click_probability(light, ThermalLaw(1e9)), poisson, atol=1e-7)
    assert bool((click_probability(light, ThermalLaw(1.0)) < poisson).all())


def test_a_law_of_ones_own_is_differentiated():
    light = torch.tensor([0.5, 2.0], dtype=torch.float32, requires_grad=True)
    p = click_probability(light, lambda mu: mu / (1 + mu))
    p.sum().backward()
    assert p.dtype == torch.float32
    assert light.grad.numpy() == pytest.approx(1 / (1 + light.detach().numpy()) ** 2, rel=1e-6)
