"""Fields that one class has and the others lack: against the definition, on scenes where they are known, and back to pixels."""

# ruff: noqa: E402  (what follows needs torch)
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.trainer.model.encoders import CoherentField
from pans.trainer.model.field_basis import discriminant_basis, in_pixels, principal_fields


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


def test_eigenvalues_are_the_ratios_of_second_moments():
    fields, labels, _, _ = scenes()
    basis = discriminant_basis(fields, labels, (8, 8), 3)[:, 3:].double()
    x = fields.double()
    ours, others = (x[labels == c].T @ x[labels == c] / int((labels == c).sum()) for c in (1, 0))
    ratio = torch.linalg.solve(others + 1e-6 * torch.eye(64), ours)
    largest = np.sort(torch.linalg.eigvals(ratio).real.numpy())[-3:]
    found = torch.diag(basis.T @ ours @ basis) / torch.diag(basis.T @ others @ basis)
    np.testing.assert_allclose(np.sort(found.numpy()), largest, rtol=2e-2)


def test_large_images_are_binned_and_uneven_sizes_fit():
    rng = torch.Generator().manual_seed(0)
    fields, labels = torch.rand(400, 45 * 41, generator=rng), torch.arange(400) % 2
    basis = discriminant_basis(fields, labels, (45, 41), 3)
    assert basis.shape == (45 * 41, 6)
    pictures = basis.T.reshape(6, 45, 41)
    torch.testing.assert_close(pictures[:, :44:2, :40:2], pictures[:, 1:45:2, 1:41:2])
    torch.testing.assert_close((fields @ basis).square().mean(dim=0), torch.ones(6), rtol=1e-2, atol=0)


@pytest.mark.parametrize("complex_field", [False, True])
def test_an_encoder_of_coordinates_is_one_of_pixels(complex_field):
    rng = torch.Generator().manual_seed(1)
    x, basis = torch.rand(20, 30, generator=rng), torch.rand(30, 5, generator=rng)
    encoder = CoherentField(3, 5, rng, complex_field=complex_field)
    torch.testing.assert_close(in_pixels(encoder, basis)(x), encoder(x @ basis), rtol=1e-4, atol=1e-5)


def test_principal_fields_hold_the_light_and_conserve_it():
    rng = torch.Generator().manual_seed(2)
    of_two = torch.rand(50, 2, generator=rng) @ torch.rand(2, 64, generator=rng)
    basis = principal_fields(of_two, (8, 8), 2)
    torch.testing.assert_close(basis.T @ basis, torch.eye(2), rtol=0, atol=1e-5)
    torch.testing.assert_close((of_two @ basis).square().sum(), of_two.square().sum(), rtol=1e-4, atol=0)
    cut = principal_fields(torch.rand(300, 45 * 41, generator=rng), (45, 41), 9)
    assert float(torch.linalg.matrix_norm(cut, ord=2)) <= 1 + 1e-5
    binned = principal_fields(torch.rand(300, 44 * 40, generator=rng), (44, 40), 9)
    encoder = CoherentField(3, 9, rng, light=50.0, conserving=True)
    whole = in_pixels(encoder, binned)
    fields = torch.rand(10, 44 * 40, generator=rng)
    torch.testing.assert_close(whole(fields), encoder(fields @ binned), rtol=1e-3, atol=1e-4)
    assert bool((whole(fields).sum(dim=1) <= fields.square().sum(dim=1)).all())
