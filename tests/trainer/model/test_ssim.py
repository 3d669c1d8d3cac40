"""SSIM against a slow oracle, and its gradient against differences."""

from __future__ import annotations

import naive_ssim
import numpy as np
import pytest
import torch

from pans.trainer.model.ssim import ssim


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
    assert black.grad is not None
    assert not black.grad.any()  # at its best already
