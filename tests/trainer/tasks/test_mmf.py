"""The fibre of MMF-MNIST: a fixed, unitary, linear mixing; the release's input beside it with its leak."""

import numpy as np
import pytest

from pans.runtime.bundle.optics import phase_mask, scatter
from pans.trainer.tasks.mmf import release_intensity
from pans.trainer.tasks.registry import FIBRE_TASKS, load_task

IMAGES = np.random.default_rng(1).integers(0, 256, (5, 28, 28), dtype=np.uint8)


def test_the_mask_is_pinned():
    mask = phase_mask()
    assert mask.shape == (28, 28)  # RandomState(42): .3745 .9507 .7320
    assert mask.ravel()[:3] == pytest.approx([2.353312, 5.973520, 4.599257], abs=1e-5)
    assert 0 <= mask.min() < mask.max() < 2 * np.pi


def test_the_fibre_loses_no_light():
    assert (np.abs(scatter(IMAGES)) ** 2).sum(axis=(1, 2)) == pytest.approx(
        ((IMAGES / 255) ** 2).sum(axis=(1, 2)), rel=1e-5
    )


def test_the_speckle_by_the_definition_of_the_fourier_transform():
    n = np.arange(28)
    fourier = np.exp(-2j * np.pi * np.outer(n, n) / 28)
    spectrum = fourier @ (IMAGES[0] / 255) @ fourier * np.exp(1j * phase_mask())
    wanted = fourier.conj() @ spectrum @ fourier.conj() / 784
    assert np.abs(scatter(IMAGES[:1])[0] - wanted).max() < 1e-5


def test_the_release_normalises_every_batch_by_itself():
    batched = release_intensity(IMAGES, batch=2)
    for start in (0, 2, 4):
        assert np.allclose(batched[start : start + 2], release_intensity(IMAGES[start : start + 2]))


@pytest.mark.data
@pytest.mark.parametrize("name", FIBRE_TASKS)
def test_mmf_mnist_is_mnist_behind_the_fibre(name, data_dir):
    task, digits = load_task(name, data_dir), load_task("mnist", data_dir)
    assert (task.name, task.light, task.optics, task.target) == (name, "field", "mmf", FIBRE_TASKS[name])
    assert np.array_equal(task.test.images, digits.test.images)
