"""Active illumination: squared weights inside the limits of the projector, whole levels, gradients through the rounding."""

# ruff: noqa: E402  (what follows needs torch)
import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.bundle.optics import Analyser, amplification
from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.encoders import ActiveIllumination, CoherentField, IncoherentIntensity, new_encoder
from pans.trainer.options import Options


def encoder(limits=(0.1, 2.0), seed=0):
    return ActiveIllumination(3, 20, limits, torch.Generator().manual_seed(seed))


def test_photoelectrons_are_squared_weights_times_transmission():
    light = encoder(limits=(0.1, 100.0))
    transmission = torch.rand(5, 20, generator=torch.Generator().manual_seed(1))
    wanted = transmission.numpy() @ (light.weight.detach().numpy() ** 2).T
    assert light(transmission).detach().numpy() == pytest.approx(wanted, rel=1e-6)


def test_gradient_of_the_illumination_is_twice_the_weight():
    light = encoder(limits=(0.1, 100.0))
    light.patterns().sum().backward()
    assert torch.allclose(light.weight.grad, 2 * light.weight.detach())


def test_initial_weights_are_kaiming_uniform():
    wide = ActiveIllumination(10, 784, (0.1, 2.0), torch.Generator().manual_seed(2))
    bound = math.sqrt(6 / ((1 + 1.2**2) * 784))
    weights = wide.weight.detach().numpy()
    assert np.abs(weights).max() <= bound
    assert weights.std() == pytest.approx(bound / math.sqrt(3), rel=0.03)
    assert abs(weights.mean()) < 5 * bound / math.sqrt(3 * weights.size)


def test_no_pixel_is_brighter_than_the_projector():
    light = encoder()
    with torch.no_grad():
        light.weight[0, 0] = 5.0
    assert float(light.patterns().detach().max()) == 2.0


def test_a_pixel_at_the_limit_can_become_darker_again():
    light = encoder()
    with torch.no_grad():
        light.weight[0, 0] = -5.0
    light.dim_to_top()
    assert float(light.weight.detach()[0, 0]) == pytest.approx(-math.sqrt(2.0))
    light.patterns().sum().backward()
    assert float(light.weight.grad[0, 0]) != 0


def test_patterns_are_whole_levels_once_quantised():
    light = encoder()
    with torch.no_grad():
        light.weight.mul_(8)
    before = light.patterns().detach()
    light.start_quantising(16)
    top = float(light.top().detach())
    assert top == pytest.approx(float(before.max()))
    levels = light.patterns().detach() / (top / 15)
    assert torch.allclose(levels, levels.round(), atol=1e-5)
    assert float((light.patterns().detach() - before).abs().max()) <= 0.5 * top / 15 * (1 + 1e-5)


def test_the_gradient_passes_the_rounding_and_reaches_the_top_level():
    light = encoder()
    with torch.no_grad():
        light.weight.mul_(8)
    light.start_quantising(4)
    light.patterns().sum().backward()
    inside = light.weight.detach() ** 2 < float(light.top().detach())
    assert torch.allclose(light.weight.grad[inside], 2 * light.weight.detach()[inside])
    assert float(light.log_top.grad) != 0


def test_the_top_level_stays_within_its_limits():
    light = encoder()
    light.start_quantising(4)
    assert 0.1 <= float(light.top().detach()) <= 2.0
    with torch.no_grad():
        light.log_top.fill_(10.0)
    assert float(light.top().detach()) == pytest.approx(2.0)


def rng_field(n=5, pixels=9, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy((rng.normal(size=(n, pixels)) + 1j * rng.normal(size=(n, pixels))).astype(np.complex64))


@pytest.mark.parametrize("complex_field", [False, True])
def test_coherent_light_is_the_squared_modulus_of_the_transformed_field(complex_field):
    encoder = CoherentField(4, 9, torch.Generator().manual_seed(0), complex_field=complex_field)
    field = rng_field()
    found = encoder(field).detach().numpy()
    matrix = encoder.matrix().detach().numpy()
    assert np.iscomplexobj(matrix) == complex_field
    for i in range(5):
        for j in range(4):
            assert found[i, j] == pytest.approx(abs(np.sum(matrix[j] * field[i].numpy())) ** 2, rel=1e-5)
    real = field.real
    assert encoder(real).detach().numpy() == pytest.approx(encoder(real.to(torch.complex64)).detach().numpy(), rel=1e-5)


@pytest.mark.parametrize("complex_field", [False, True])
def test_conserving_coherent_encoder_creates_no_light(complex_field):
    random = torch.Generator().manual_seed(0)
    encoder = CoherentField(6, 9, random, light=50.0, complex_field=complex_field, conserving=True)
    assert float(torch.linalg.svdvals(encoder.matrix())[0].detach()) == pytest.approx(1.0, rel=1e-5)
    field = rng_field(50)
    assert bool((encoder(field).sum(dim=1) <= field.abs().square().sum(dim=1) * (1 + 1e-5)).all())
    free = CoherentField(6, 9, torch.Generator().manual_seed(0), light=50.0, complex_field=complex_field)
    assert bool((free(field).sum(dim=1) > field.abs().square().sum(dim=1)).any())
    dim = CoherentField(6, 9, torch.Generator().manual_seed(0), light=1e-4, conserving=True)
    assert torch.equal(dim.matrix(), dim.weight[0])  # below the limit nothing is changed


def test_conserving_incoherent_encoder_creates_no_light():
    encoder = IncoherentIntensity(6, 9, torch.Generator().manual_seed(0), light=50.0, conserving=True)
    columns = encoder.matrix().sum(dim=0).detach().numpy()
    assert columns.max() <= 1 + 1e-6
    assert (encoder.matrix() >= 0).all()
    intensity = torch.rand(20, 9, generator=torch.Generator().manual_seed(1))
    assert encoder(intensity).detach().numpy() == pytest.approx((intensity @ encoder.matrix().T).detach().numpy())
    assert bool((encoder(intensity).sum(dim=1) <= intensity.sum(dim=1) * (1 + 1e-6)).all())


def test_new_encoder_is_what_the_options_ask_for():
    profile = load_profile("ideal")
    random = torch.Generator().manual_seed(0)
    for name, kind in (
        ("active", ActiveIllumination),
        ("coherent", CoherentField),
        ("incoherent", IncoherentIntensity),
    ):
        assert type(new_encoder(9, profile, Options(features=2, encoder=name), random)) is kind


def test_a_top_level_above_the_brightest_pixel_comes_down():
    light = encoder(limits=(0.01, 100.0))
    light.start_quantising(64)
    brightest = float((light.weight.detach() ** 2).max())
    with torch.no_grad():
        light.log_top += 0.5
    light.lower_top()
    assert light.brightest() == pytest.approx(brightest, rel=1e-6)
    assert float(light.patterns().max().detach()) == pytest.approx(brightest, rel=1e-6)
    with torch.no_grad():
        light.log_top -= 0.5  # brighter pixels than the top level are clipped: nothing to lower
    light.lower_top()
    assert light.brightest() == pytest.approx(brightest * np.exp(-0.5), rel=1e-6)


@pytest.mark.parametrize("kind", ["coherent", "complex", "incoherent"])
def test_no_light_in_gives_more_than_the_amplification(kind):
    """Against power iteration, and by the light that many inputs give out."""
    rng = np.random.default_rng(4)
    matrix = rng.normal(size=(5, 8)).astype(np.float32)
    if kind == "complex":
        matrix = (matrix + 1j * rng.normal(size=(5, 8))).astype(np.complex64)
    if kind == "incoherent":
        matrix = np.abs(matrix)
        out, best = matrix @ rng.random((8, 500)) @ np.eye(500), matrix @ np.eye(8)[:, matrix.sum(axis=0).argmax()]
        light_in, light_out = np.ones(1), np.array([best.sum()])
        assert (out.sum(axis=0) <= amplification("incoherent", matrix) * 8).all()
    else:
        x = rng.normal(size=8).astype(matrix.dtype)
        for _ in range(2000):
            x = matrix.conj().T @ (matrix @ x)
            x /= np.linalg.norm(x)
        light_in, light_out = np.array([np.vdot(x, x).real]), np.array([np.vdot(matrix @ x, matrix @ x).real])
    found = amplification("incoherent" if kind == "incoherent" else "coherent", matrix)
    assert light_out[0] / light_in[0] == pytest.approx(found, rel=1e-5)


def test_what_must_reach_the_optics_grows_with_the_light_that_they_make():
    images = np.full((3, 2, 2), 255, np.uint8)
    seen = Analyser("coherent", 3 * np.eye(4, dtype=np.float32)[:2], "field", "none", 0.5, 100.0)
    assert seen.reaching(images) == pytest.approx(9 * 0.5 * 4)  # amplitude 3, half a photoelectron in each of 4 pixels
