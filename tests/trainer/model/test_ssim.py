"""SSIM against a slow oracle, and its gradient against that of the pixels."""

from __future__ import annotations

import naive_ssim
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from pans.trainer.model.ssim import ssim, ssim_map  # noqa: E402


def test_every_pixel_is_that_of_the_slow_oracle_the_edge_included() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 9, 14))
    wanted = np.array(naive_ssim.ssim_map(a.tolist(), b.tolist()))
    found = ssim_map(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert float(ssim(torch.from_numpy(a), torch.from_numpy(b))) == pytest.approx(wanted.mean(), abs=1e-12)


@pytest.mark.parametrize("both", [False, True])
def test_the_gradient_is_that_of_the_pixels(both: bool) -> None:
    a, b = torch.rand(2, 3, 9, 13, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    a, b = a.requires_grad_(True), b.requires_grad_(both)
    weight = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    wanted = torch.autograd.grad((weight * ssim_map(a, b).mean(dim=(-2, -1))).sum(), (a, b) if both else (a,))
    found = torch.autograd.grad((weight * ssim(a, b)).sum(), (a, b) if both else (a,))
    for ours, slow in zip(found, wanted):
        np.testing.assert_allclose(ours.numpy(), slow.numpy(), rtol=1e-10, atol=1e-14)
    black = torch.zeros(1, 12, 12, requires_grad=True)
    ssim(black, torch.zeros(1, 12, 12)).sum().backward()
    assert black.grad is not None
    assert not black.grad.any()  # at its best already
