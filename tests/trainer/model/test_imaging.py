"""Objects through drawn optics, as training sees them: held against the light that pans.runtime.imaging states."""

import numpy as np
import pytest
import torch

from pans.runtime.imaging import Bleaching, Imaging, bleached, met
from pans.trainer.model.encoders import ActiveIllumination
from pans.trainer.model.imaging import bleached_patterns, through

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
    encoder = ActiveIllumination(3, 42, (low, 2.0), random)
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
    encoder = ActiveIllumination(1, 42, (0.1, 2.0), torch.Generator().manual_seed(2))
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
