"""Distorted copies of training objects: where they stand, how far they move, and that validation objects never lend theirs."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import Options
from pans.trainer.tasks.changes import distorted, with_copies
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train.data import TrainingData


def objects(n: int, side: int = 28) -> Objects:
    """A bright square per object, its grey value the number of the object."""
    images = np.zeros((n, side, side), np.uint8)
    images[:, side // 4 : 3 * side // 4, side // 4 : 3 * side // 4] = np.arange(1, n + 1, dtype=np.uint8)[:, None, None]
    return Objects(images, np.arange(n))


def centres(images: np.ndarray) -> np.ndarray:
    weights = images.sum(axis=(1, 2), dtype=float)
    axes = np.arange(images.shape[1]), np.arange(images.shape[2])
    return np.stack([images.sum(axis=2) @ axes[0], images.sum(axis=1) @ axes[1]], axis=1) / weights[:, None]


def test_no_copies_are_the_same_objects() -> None:
    some = objects(3)
    assert with_copies(some, 1, 0, 1) is some


def test_copies_come_first_and_validation_objects_have_none() -> None:
    some = objects(20)
    more = with_copies(some, 5, 2, 7)
    assert len(more) == 2 * 15 + 20
    np.testing.assert_array_equal(more.labels, [*range(15), *range(15), *range(20)])
    np.testing.assert_array_equal(more.images[30:], some.images)
    # the square's middle keeps its grey value: a copy bears its own label, and no validation object's
    np.testing.assert_array_equal(more.images[:30, 14, 14], more.labels[:30] + 1)
    assert (more.images[:15] != more.images[15:30]).any(axis=(1, 2)).all()


def test_distortions_are_reproducible_and_small() -> None:
    images = np.broadcast_to(objects(1).images * np.uint8(200), (3000, 28, 28))
    found = distorted(images, [1, 2])
    np.testing.assert_array_equal(found, distorted(images, [1, 2]))
    assert (found != distorted(images, [1, 3])).any()
    moved = centres(found) - centres(images[:1])
    assert np.abs(moved.mean(axis=0)).max() < 0.05  # no direction is favoured
    assert 0.2 < moved.std() < 1.0  # pixels: seen, but no digit leaves its place
    area = found.sum(axis=(1, 2), dtype=float) / images[0].sum(dtype=float)
    assert abs(area.mean() - 1) < 0.02
    assert 0.03 < area.std() < 0.2


def test_what_comes_in_from_outside_repeats_the_edge() -> None:
    assert (distorted(np.full((50, 28, 28), 77, np.uint8), [3]) == 77).all()


def test_an_image_of_something_is_made_again_from_its_distorted_copy() -> None:
    behind = objects(8)
    task_like = Objects(255 - behind.images, behind.labels, behind=behind.images)
    more = with_copies(task_like, 2, 1, 0, imaged=lambda pictures: 255 - pictures)
    np.testing.assert_array_equal(more.images, 255 - more.pictures)
    np.testing.assert_array_equal(more.pictures[6:], behind.images)


def test_images_too_small_or_too_many_are_refused() -> None:
    with pytest.raises(ValueError, match="1 x 40 pixels cannot be distorted"):
        with_copies(Objects(np.zeros((9, 1, 40), np.uint8), np.zeros(9, np.int64)), 1, 1, 0)
    with pytest.raises(ValueError, match=r"copies of .* MiB"):
        with_copies(Objects(np.zeros((60000, 28, 28), np.uint8), np.zeros(60000, np.int64)), 5000, 30, 0)


def test_a_run_trains_on_the_copies_and_chooses_by_the_originals() -> None:
    some = objects(48)
    task = Task("own", ("a", "b"), Objects(some.images, some.labels % 2), some, sha256="0" * 64, split="none")
    profile = load_profile("ideal")
    plain = TrainingData(task, profile, Options(features=2))
    more = TrainingData(task, profile, Options(features=2, copies=3))
    assert plain.n_fit == 44
    assert more.n_fit == 4 * 44
    assert len(more.labels) == 4 * 44 + 4
    assert (more.shown[more.n_fit :] == plain.shown[plain.n_fit :]).all()
