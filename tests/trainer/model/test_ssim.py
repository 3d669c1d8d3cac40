"""SSIM against a slow oracle, against scikit-image inside the edge, and against closed forms."""

from __future__ import annotations

import naive_ssim
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from pans.trainer.model.ssim import C1, ssim, ssim_map  # noqa: E402

EDGE = 5


def pictures() -> dict[str, np.ndarray]:
    y, x = np.mgrid[0:28, 0:28]
    waves = 0.5 + 0.5 * np.sin(x / 3.0) * np.cos(y / 5.0)
    disturbed = np.clip(0.8 * waves + 0.1 * np.sin(x * y / 20.0) + 0.05, 0, 1)
    disc = ((x - 13.5) ** 2 + (y - 13.5) ** 2 < 64).astype(float)
    return {"waves": waves, "disturbed": disturbed, "disc": disc}


# scikit-image 0.26.0: structural_similarity(a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
# data_range=1, full=True)[1]: the mean over [5:-5, 5:-5], where padding plays no part, and the pixel [10, 7]
SCIKIT_IMAGE = [
    ("waves", "disturbed", 0.8364426165271877, 0.8443227478520271),
    ("waves", "disc", 0.14631691857422383, 0.0068479030456543855),
    ("disturbed", "disc", 0.09551571816088425, -0.1573832065431918),
]


@pytest.mark.parametrize(("one", "other", "mean", "pixel"), SCIKIT_IMAGE)
def test_the_interior_is_that_of_scikit_image(one: str, other: str, mean: float, pixel: float) -> None:
    images = [torch.from_numpy(pictures()[name]) for name in (one, other)]
    found = ssim_map(*images).numpy()
    assert found[EDGE:-EDGE, EDGE:-EDGE].mean() == pytest.approx(mean, abs=1e-12)
    assert found[10, 7] == pytest.approx(pixel, abs=1e-12)


def test_scikit_image_itself_when_it_is_there() -> None:
    metrics = pytest.importorskip("skimage.metrics", reason="scikit-image is not installed; its figures are above")
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 31, 24))
    wanted = metrics.structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, full=True
    )[1]
    found = ssim_map(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    inside = slice(EDGE, -EDGE)
    np.testing.assert_allclose(found[inside, inside], wanted[inside, inside], atol=1e-12)


def test_every_pixel_is_that_of_the_slow_oracle_the_edge_included() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 9, 14))
    wanted = np.array(naive_ssim.ssim_map(a.tolist(), b.tolist()))
    found = ssim_map(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert float(ssim(torch.from_numpy(a), torch.from_numpy(b))) == pytest.approx(wanted.mean(), abs=1e-12)


def test_flat_images_leave_only_the_luminance() -> None:
    flat = torch.ones(15, 15, dtype=torch.float64)
    found = ssim_map(flat, 0.5 * flat)
    assert float(found[7, 7]) == pytest.approx((2 * 0.5 + C1) / (1 + 0.25 + C1), abs=1e-12)
    assert float(found[0, 0]) != pytest.approx(float(found[7, 7]), abs=1e-3), "zeros beyond the edge must be seen"


def test_equal_images_give_one_and_the_order_does_not_matter() -> None:
    a, b = torch.rand(2, 3, 28, 28, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert ssim(a, a).tolist() == pytest.approx([1.0] * 3, abs=1e-12)
    assert (ssim(a, b) - ssim(b, a)).abs().max() < 1e-13
    black = torch.zeros(8, 8)
    assert float(ssim(black, black)) == 1.0


def test_a_batch_is_its_images_one_by_one() -> None:
    a, b = torch.rand(2, 2, 3, 16, 20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    together = ssim(a, b)
    assert together.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            assert float(together[i, j]) == pytest.approx(float(ssim(a[i, j], b[i, j])), abs=1e-13)


def test_float32_is_good_to_five_digits() -> None:
    a, b = torch.rand(2, 20, 28, 28, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert (ssim(a.float(), b.float()) - ssim(a, b)).abs().max() < 1e-5


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


def test_following_the_gradient_makes_images_alike() -> None:
    generator = torch.Generator().manual_seed(3)
    wanted, shown = torch.rand(2, 16, 16, generator=generator, dtype=torch.float64)
    shown.requires_grad_(True)
    before = ssim(shown, wanted)
    before.backward()
    with torch.no_grad():
        after = ssim(shown + 1e-3 * shown.grad / shown.grad.abs().max(), wanted)
    assert after > before


@pytest.mark.parametrize(
    ("shown", "wanted"),
    [((8, 8), (8, 9)), ((8,), (8,)), ((0, 8), (0, 8))],
)
def test_unequal_or_empty_images_are_refused(shown: tuple[int, ...], wanted: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="allowed"):
        ssim(torch.zeros(shown), torch.zeros(wanted))


def test_bytes_are_refused() -> None:
    with pytest.raises(ValueError, match="floating"):
        ssim(torch.zeros(8, 8, dtype=torch.uint8), torch.zeros(8, 8, dtype=torch.uint8))
