"""Encoders: active patterns within the projector's limits, coherent fields and their basis, light through optics and bleaching."""

import numpy as np
import pytest
import torch
from trainings import random_machine

from pans.bundle.sensor.analyser import amplification
from pans.instrument.click_law import ClickLaw
from pans.instrument.optics import Bleaching, Imaging, bleached, met
from pans.instrument.profile import load_profile
from pans_trainer.model import encoders
from pans_trainer.model.exposure import exposure_us_of, top_limits
from pans_trainer.model.field_basis import discriminant_basis, in_pixels
from pans_trainer.model.imaging import bleached_patterns, through
from pans_trainer.options import Options
from pans_trainer.train.automaton.machine import Aim, Sight, backward, forward


def encoder(limits=(0.1, 2.0), seed=0):
    return encoders.ActiveIllumination(3, 20, limits, torch.Generator().manual_seed(seed))


def test_photoelectrons_are_squared_weights_times_transmission():
    light = encoder(limits=(0.1, 100.0))
    transmission = torch.rand(5, 20, generator=torch.Generator().manual_seed(1))
    wanted = transmission.numpy() @ (light.weight.detach().numpy() ** 2).T
    assert light(transmission).detach().numpy() == pytest.approx(wanted, rel=1e-6)


def test_patterns_are_whole_levels_once_quantised_and_pass_the_gradient():
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
    light.start_quantising(4)  # the gradient passes the rounding and reaches the top level
    light.patterns().sum().backward()
    inside = light.weight.detach() ** 2 < float(light.top().detach())
    assert torch.allclose(light.weight.grad[inside], 2 * light.weight.detach()[inside])
    assert float(light.log_top.grad) != 0


def rng_field(n=5, pixels=9, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy((rng.normal(size=(n, pixels)) + 1j * rng.normal(size=(n, pixels))).astype(np.complex64))


@pytest.mark.parametrize("complex_field", [False, True])
def test_coherent_light_is_the_squared_modulus_of_the_transformed_field(complex_field):
    options = Options(features=4, encoder="coherent", complex_field=complex_field)
    encoder = encoders.new_encoder(9, load_profile("ideal"), options, torch.Generator().manual_seed(0))
    field = rng_field()
    found = encoder(field).detach().numpy()
    matrix = encoder.matrix().detach().numpy()
    assert np.iscomplexobj(matrix) == complex_field
    assert found == pytest.approx(np.abs(field.numpy() @ matrix.T) ** 2, rel=1e-5)
    real = field.real
    assert encoder(real).detach().numpy() == pytest.approx(encoder(real.to(torch.complex64)).detach().numpy(), rel=1e-5)


@pytest.mark.parametrize("complex_field", [False, True])
def test_conserving_coherent_encoder_creates_no_light(complex_field):
    random = torch.Generator().manual_seed(0)
    encoder = encoders.CoherentField(6, 9, random, light=50.0, complex_field=complex_field, conserving=True)
    assert float(torch.linalg.svdvals(encoder.matrix())[0].detach()) == pytest.approx(1.0, rel=1e-5)
    field = rng_field(50)
    assert bool((encoder(field).sum(dim=1) <= field.abs().square().sum(dim=1) * (1 + 1e-5)).all())
    free = encoders.CoherentField(6, 9, torch.Generator().manual_seed(0), light=50.0, complex_field=complex_field)
    assert bool((free(field).sum(dim=1) > field.abs().square().sum(dim=1)).any())
    dim = encoders.CoherentField(6, 9, torch.Generator().manual_seed(0), light=1e-4, conserving=True)
    assert torch.equal(dim.matrix(), dim.weight[0])  # below the limit nothing is changed


def test_conserving_incoherent_encoder_creates_no_light():
    options = Options(features=6, encoder="incoherent", light=50.0, conserving=True)
    encoder = encoders.new_encoder(9, load_profile("ideal"), options, torch.Generator().manual_seed(0))
    columns = encoder.matrix().sum(dim=0).detach().numpy()
    assert columns.max() <= 1 + 1e-6
    assert (encoder.matrix() >= 0).all()
    intensity = torch.rand(20, 9, generator=torch.Generator().manual_seed(1))
    assert encoder(intensity).detach().numpy() == pytest.approx((intensity @ encoder.matrix().T).detach().numpy())
    assert bool((encoder(intensity).sum(dim=1) <= intensity.sum(dim=1) * (1 + 1e-6)).all())


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


def stated(pattern):
    """The brightness that the light of a pattern meets on average, over the mean of all pixels, as a logarithm."""
    return np.log((pattern * pattern / pattern.sum()).sum() / pattern.mean())


def slope_of(values, at, measure, step=1e-6):
    """The derivative of `measure` in one of the values, by a difference."""
    moved = np.eye(len(values))[at] * step
    return (measure(values + moved) - measure(values - moved)) / (2 * step)


@pytest.mark.parametrize("lit", [1, 7, 50])
def test_pixels_that_are_lit_alike_are_counted_and_their_brightness_does_not_matter(lit):
    patterns = torch.zeros(2, 50, dtype=torch.float64)
    patterns[0, :lit], patterns[1, 50 - lit :] = 1e-3, 80.0
    assert float(encoders.concentration(patterns)) == pytest.approx(np.log(50 / lit), rel=1e-12, abs=1e-12)


def test_slope_is_that_of_the_stated_measure():
    patterns = np.random.default_rng(0).random((3, 12))
    found = encoders.concentration_slope(torch.from_numpy(patterns)).numpy()
    assert float(encoders.concentration(torch.from_numpy(patterns))) == pytest.approx(
        np.mean([stated(p) for p in patterns])
    )
    for row, pixel in np.ndindex(*patterns.shape):
        assert found[row, pixel] == pytest.approx(slope_of(patterns[row], pixel, stated), rel=1e-6, abs=1e-7)


def test_an_automaton_takes_the_slope_by_how_often_a_state_is_reached():
    machine, sight = random_machine(3), Sight(ClickLaw(), 1 / 255, 0.0, torch.float64)
    grey = torch.tensor([[0, 10, 255, 30, 7], [200, 0, 90, 255, 255]], dtype=torch.float64)
    one_hot = torch.tensor([[1, 0], [0, 1], [0, 0], [0, 0]], dtype=torch.float64)
    passed = forward(machine, sight, grey)
    backward(machine, sight, grey, one_hot, passed, Aim(0.07))
    without = [level.light.root.grad.clone() for level in machine.levels]
    backward(machine, sight, grey, one_hot, passed, Aim(0.07, spread=0.3))
    for level, before, seen in zip(machine.levels, without, passed.steps):
        added = (level.light.root.grad - before).numpy()
        roots, reached = level.light.root.numpy(), seen.alpha.mean(dim=1).numpy()
        for state, pixel in np.ndindex(*roots.shape):
            slope = slope_of(roots[state], pixel, lambda root: stated(root**2))
            wanted = 0.3 / len(machine.levels) * reached[state] * slope
            assert added[state, pixel] == pytest.approx(wanted, rel=1e-4, abs=1e-8)


def test_limits_of_the_top_level_are_those_of_the_exposure_or_of_dark_counts():
    for name, most in (("oled-qcmos", None), ("dmd-spad", 0.05)):  # 100 dark counts per second, exposures up to 10 ms
        profile = load_profile(name)
        low, high = (exposure_us_of(profile, limit) for limit in top_limits(profile))
        assert low == pytest.approx(profile.exposure.min_us)
        dark = high * 1e-6 * profile.detector.dark_rate_hz
        assert (high, dark) == pytest.approx((profile.exposure.max_us, dark) if most is None else (high, most))


def scenes(n=3000, side=8):
    """A bright background of one shape and any brightness; class 1 has a faint spot of either sign on top."""
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 2, n)
    shape = np.outer(np.linspace(0.5, 1, side), np.linspace(1, 0.3, side)).ravel()
    spot = np.zeros((side, side))
    spot[2:4, 5] = 1
    signs = rng.choice([-1, 1], n) * labels
    fields = (
        rng.uniform(2, 6, (n, 1)) * shape + 0.2 * signs[:, None] * spot.ravel() + 0.02 * rng.normal(size=(n, side**2))
    )
    return torch.from_numpy(fields).float(), torch.from_numpy(labels), shape, spot.ravel()


def test_the_first_field_sees_the_event_and_not_the_background():
    fields, labels, shape, spot = scenes()
    basis = discriminant_basis(fields, labels, (8, 8), 2)
    assert basis.shape == (64, 4)
    torch.testing.assert_close((fields @ basis).square().mean(dim=0), torch.ones(4), rtol=1e-3, atol=0)
    first = basis[:, 3].double().numpy()  # class 1, the largest eigenvalue
    assert abs(first @ shape) < 0.02 * abs(first @ spot)
    power = (fields @ basis[:, 3:]).square()[:, 0]
    assert float(power[labels == 1].mean() / power[labels == 0].mean()) > 50


@pytest.mark.parametrize("complex_field", [False, True])
def test_an_encoder_of_coordinates_is_one_of_pixels(complex_field):
    rng = torch.Generator().manual_seed(1)
    x, basis = torch.rand(20, 30, generator=rng), torch.rand(30, 5, generator=rng)
    encoder = encoders.CoherentField(3, 5, rng, complex_field=complex_field)
    torch.testing.assert_close(in_pixels(encoder, basis)(x), encoder(x @ basis), rtol=1e-4, atol=1e-5)


SHAPE = (6, 7)
FLAT = np.linspace(0.5, 1.5, 42).reshape(SHAPE)
TABLE = Imaging(0.4, -0.3, 5.0, 1.02, 0.6, black=0.02, gain=1.1, flat=FLAT)


def test_the_light_of_patterns_is_that_of_the_runtimes_model():
    rng = np.random.default_rng(0)
    objects, patterns = torch.from_numpy(rng.random((5, 42))), torch.from_numpy(rng.random((3, 42)))
    full = patterns.amax(dim=1, keepdim=True)
    light = through(TABLE, objects, SHAPE) @ torch.cat([patterns, full], dim=1).T
    wanted = met(TABLE, patterns.numpy(), SHAPE, full.numpy()) @ objects.numpy().T
    np.testing.assert_allclose(light.numpy(), wanted.T, rtol=1e-12)


@pytest.mark.parametrize("low", [0.01, 1.5])
def test_an_encoder_lights_dark_pixels_by_its_brightest_level(low):
    random = torch.Generator().manual_seed(0)
    encoder = encoders.ActiveIllumination(3, 42, (low, 2.0), random)
    objects = torch.rand((4, 42), generator=random, dtype=torch.float64)
    for levels in (None, 16):
        if levels:
            encoder.start_quantising(levels)
        patterns = encoder.patterns().detach().double()
        full = float(max(patterns.max(), low) if levels is None else encoder.top().detach())
        wanted = objects.numpy() @ met(TABLE, patterns.numpy(), SHAPE, full).T
        found = encoder(through(TABLE, objects, SHAPE).float()).detach().numpy()
        np.testing.assert_allclose(found, wanted, rtol=1e-5)


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("dose", [1e-2, 0.7, 1e5])
def test_patterns_bleach_in_training_as_they_do_elsewhere(dose: float, mixed: bool) -> None:
    light = torch.from_numpy(np.random.default_rng(3).random((4, 6)) * 2)
    light[1, 2] = 0.0
    law = Bleaching(dose, mixed)
    np.testing.assert_allclose(bleached_patterns(law, light).numpy(), bleached(law, light.numpy()), rtol=1e-9)
    small = light.float()[:3, :2].double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: bleached_patterns(law, x), (small,), eps=1e-6 * min(1.0, dose), rtol=1e-3)


def test_training_can_raise_the_brightest_level_from_its_least():
    encoder = encoders.ActiveIllumination(1, 42, (0.1, 2.0), torch.Generator().manual_seed(2))
    encoder.start_quantising(1 << 16)
    encoder.pulled = True
    one = torch.zeros(1, 43)
    one[0, 7], one[0, 42] = 1.0, 0.002  # an object of one pixel, and what dark pixels leak on it
    optimiser = torch.optim.Adam(encoder.parameters(), lr=0.02)
    for _ in range(150):
        optimiser.zero_grad()
        (encoder(one) - 0.7).square().sum().backward()
        optimiser.step()
        encoder.dim_to_top()
    assert float(encoder(one).detach()) == pytest.approx(0.7, rel=0.05)
