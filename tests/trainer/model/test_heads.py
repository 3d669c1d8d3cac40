"""Heads: shapes for every number of patterns, flips against plain passes, the same start from the same generator."""

import pytest
import torch

from pans.trainer.model.heads import new_head
from pans.trainer.options import PICTURE_HEADS, Options


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
