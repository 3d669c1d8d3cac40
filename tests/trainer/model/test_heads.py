"""Heads: shapes for every number of patterns, flips against plain passes, the same start from the same generator."""

# ruff: noqa: E402  (what follows needs torch)
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.trainer.model.heads import ConvHead, DecoderHead, MlpHead, PictureHead, new_head
from pans.trainer.options import Options


def head_of(kind, d_f, seed=0):
    return new_head(Options(features=d_f, hidden=8, head=kind), 5, (9, 6), torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("d_f", [1, 2, 3, 4, 5, 7, 10, 16, 33, 64])
def test_the_convolutional_head_is_valid_for_every_number_of_patterns(d_f):
    head = head_of("conv", d_f)
    assert isinstance(head, ConvHead)
    assert head(torch.zeros(3, d_f)).shape == (3, 5)
    out = head(torch.rand(8, d_f, generator=torch.Generator().manual_seed(1)))
    out.sum().backward()
    assert all(bool((parameter.grad != 0).any()) for parameter in head.convolutions.parameters())


@pytest.mark.parametrize(("kind", "made"), [("picture", PictureHead), ("decoder", DecoderHead)])
def test_the_picture_heads_give_pictures_of_the_wanted_shape(kind, made):
    head = head_of(kind, 4)
    assert isinstance(head, made)
    assert head(torch.zeros(3, 4)).shape == (3, 54)


@pytest.mark.parametrize("kind", ["mlp", "deep", "conv", "picture", "decoder"])
def test_flipped_is_a_pass_of_every_flipped_word(kind):
    head = head_of(kind, 4).double()
    clicks = torch.randint(0, 2, (6, 4), generator=torch.Generator().manual_seed(2)).double()
    mean = torch.tensor([0.2, 0.5, 0.7, 0.4], dtype=torch.float64)
    with torch.no_grad():
        found = head.flipped(clicks, mean)
        for i in range(4):
            other = clicks.clone()
            other[:, i] = 1 - other[:, i]
            assert torch.allclose(found[:, i], head(other, mean), atol=1e-12)


@pytest.mark.parametrize("kind", ["mlp", "deep", "conv", "picture", "decoder"])
def test_heads_start_from_the_generator_alone(kind):
    torch.manual_seed(1)
    first = head_of(kind, 6)
    torch.manual_seed(2)
    again, other = head_of(kind, 6), head_of(kind, 6, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(first.state_dict().values(), again.state_dict().values()))
    assert not all(torch.equal(a, b) for a, b in zip(first.state_dict().values(), other.state_dict().values()))


def test_the_mlp_head_is_the_papers():
    head = head_of("mlp", 3)
    assert isinstance(head, MlpHead)
    clicks, mean = np.array([[1.0, 0.0, 1.0]], np.float32), np.array([0.5, 0.2, 0.9], np.float32)
    normal = (clicks - mean) / np.sqrt(mean * (1 - mean) + 1e-5)
    hidden = np.maximum(normal @ head.hidden.weight.detach().numpy().T + head.hidden.bias.detach().numpy(), 0)
    wanted = hidden @ head.output.weight.detach().numpy().T + head.output.bias.detach().numpy()
    found = head(torch.from_numpy(clicks), torch.from_numpy(mean)).detach().numpy()
    assert found == pytest.approx(wanted, rel=1e-5)
