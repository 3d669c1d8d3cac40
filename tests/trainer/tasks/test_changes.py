"""Distorted copies of training objects: where they stand, how far they move, and that validation objects never lend theirs."""

# ruff: noqa: E402  (what follows needs torch)

import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

import numpy as np

from pans_trainer.tasks.changes import Variation, distorted, enlarged, shifted, varied, with_copies
from pans_trainer.tasks.registry import Objects, Task


def objects(n: int, side: int = 28) -> Objects:
    """A bright square per object, its grey value the number of the object."""
    images = np.zeros((n, side, side), np.uint8)
    images[:, side // 4 : 3 * side // 4, side // 4 : 3 * side // 4] = np.arange(1, n + 1, dtype=np.uint8)[:, None, None]
    return Objects(images, np.arange(n))


def centres(images: np.ndarray) -> np.ndarray:
    weights = images.sum(axis=(1, 2), dtype=float)
    axes = np.arange(images.shape[1]), np.arange(images.shape[2])
    return np.stack([images.sum(axis=2) @ axes[0], images.sum(axis=1) @ axes[1]], axis=1) / weights[:, None]


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


def test_an_image_of_something_is_made_again_from_its_distorted_copy() -> None:
    behind = objects(8)
    task_like = Objects(255 - behind.images, behind.labels, behind=behind.images)
    more = with_copies(task_like, 2, 1, 0, imaged=lambda pictures: 255 - pictures)
    np.testing.assert_array_equal(more.images, 255 - more.pictures)
    np.testing.assert_array_equal(more.pictures[6:], behind.images)


def test_shifts_are_uniform_and_reproducible() -> None:
    images = np.zeros((4000, 9, 11), np.uint8)
    images[:, 4, 5] = 200
    spots = Objects(images, np.arange(4000))
    moved = shifted(spots, 3, 1, 5)
    np.testing.assert_array_equal(moved.images, shifted(spots, 3, 1, 5).images)
    _, y, x = np.nonzero(moved.images)
    assert len(y) == 4000
    for found, most in ((x - 5, 3), (y - 4, 1)):
        counts = np.bincount(found + most, minlength=2 * most + 1)
        expected = 4000 / (2 * most + 1)
        assert len(counts) == 2 * most + 1
        assert abs(counts - expected).max() < 5 * np.sqrt(expected)


def test_what_moves_out_is_lost_and_what_moves_in_is_black() -> None:
    full = Objects(np.full((200, 9, 11), 7, np.uint8), np.zeros(200, np.int64))
    moved = shifted(full, 20, 0, 2).images
    lost = 11 - (moved == 7).all(axis=1).sum(axis=1)
    assert {0, 11} <= set(lost.tolist())
    for image, gone in zip(moved, lost):
        columns = image[0] == 7
        assert columns[: 11 - gone].all() or columns[gone:].all()
        assert image.sum() == 7 * 9 * (11 - gone)


HEIGHT, WIDTH = 24, 40


@pytest.fixture(scope="module")
def rods():
    """200 images, 24 x 40 pixels, of one soft rod that lies along the rows, off the middle to the lower right."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rod = 255 * np.exp(-(((y - 13.0) / 3.0) ** 2) - ((x - 22.0) / 7.0) ** 4)
    return np.repeat(rod.astype(np.uint8)[None], 200, axis=0)


def moments(images):
    """Return the middle (x, y), and the length and direction of the long axis, of every image."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    light = images.astype(float)
    light /= light.sum(axis=(1, 2), keepdims=True)
    middle = np.stack([(light * x).sum(axis=(1, 2)), (light * y).sum(axis=(1, 2))], axis=1)
    dx, dy = x - middle[:, 0, None, None], y - middle[:, 1, None, None]
    second = np.stack([(light * a * b).sum(axis=(1, 2)) for a, b in ((dx, dx), (dx, dy), (dy, dy))], axis=1)
    matrices = second[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    size, axes = np.linalg.eigh(matrices)
    return middle, np.sqrt(size), np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1])) % 180


def test_a_turned_rod_keeps_its_length_and_width_in_a_picture_that_is_not_square(rods):
    found = varied(rods, Variation(turn_deg=40), [1])
    _, size, direction = moments(found)
    _, wanted, _ = moments(rods)
    assert np.allclose(size, wanted, rtol=0.06)
    direction = (direction + 90) % 180 - 90
    assert 35 < abs(direction).max() <= 41
    assert abs(direction.mean()) < 8  # 5 sigma of 200 uniform draws


def test_shift_size_and_stretch_change_what_they_say_and_nothing_else(rods):
    before, wanted, _ = moments(rods)
    middle, size, _ = moments(varied(rods, Variation(shift=0.1), [1]))
    moved = middle - before
    assert np.allclose(size, wanted, rtol=0.03)
    assert 0.08 * WIDTH < abs(moved[:, 0]).max() <= 0.1 * WIDTH + 0.1
    assert 0.08 * HEIGHT < abs(moved[:, 1]).max() <= 0.1 * HEIGHT + 0.1
    _, size, _ = moments(varied(rods, Variation(size=0.2), [1]))
    ratio = size / wanted
    assert np.allclose(ratio[:, 0], ratio[:, 1], rtol=0.08)
    assert ratio[:, 1].min() < 0.85 < 1.15 < ratio[:, 1].max()
    _, size, _ = moments(varied(rods, Variation(stretch=0.2), [1]))
    ratio = size / wanted
    assert np.allclose(ratio.prod(axis=1), 1, rtol=0.08)
    assert ratio[:, 1].min() < 0.93 < 1.07 < ratio[:, 1].max()


def test_mirrors_exchange_sides_in_half_of_the_images(rods):
    for name, axis in (("mirror_x", 2), ("mirror_y", 1)):
        found = varied(rods, Variation(**{name: True}), [1])
        as_it_was = (found == rods).all(axis=(1, 2))
        assert (as_it_was | (found == np.flip(rods, axis=axis)).all(axis=(1, 2))).all()
        assert 64 < as_it_was.sum() < 136  # 5 sigma


def test_a_task_is_enlarged_by_its_training_objects_alone(rods):
    labels = np.arange(200) % 3
    task = Task("rods", ("a", "b", "c"), Objects(rods, labels), Objects(rods[:9], labels[:9]), "0" * 64, "here")
    found = enlarged(task, Variation(shift=0.1), 1000, kept=20, seed=1)
    assert len(found.train) == 999 + 20  # whole numbers of each class, and those kept apart
    assert np.bincount(found.train.labels[:-20]).tolist() == [333, 333, 333]
    assert np.array_equal(found.train.labels[-200:], labels)
    assert np.array_equal(found.train.images[-200:], rods)
    assert np.array_equal(found.test.images, task.test.images)
    assert found.sha256 != task.sha256  # a checkpoint of other copies is another training's
    assert enlarged(task, Variation(), 1000, kept=20, seed=1) is task
    assert enlarged(task, Variation(shift=0.1), 180, kept=20, seed=1) is task
