"""Fields that one class has and the others lack: against the definition, on scenes where they are known, and back to pixels."""

import numpy as np
import pytest
import torch

from pans.trainer.model.encoders import CoherentField
from pans.trainer.model.field_basis import discriminant_basis, in_pixels


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
    encoder = CoherentField(3, 5, rng, complex_field=complex_field)
    torch.testing.assert_close(in_pixels(encoder, basis)(x), encoder(x @ basis), rtol=1e-4, atol=1e-5)
