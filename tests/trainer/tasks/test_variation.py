"""Changes of images: each kind does what it says, also in pictures that are not square, and nothing else."""

import numpy as np
import pytest

from pans.trainer.tasks.changes import Variation, enlarged, varied
from pans.trainer.tasks.registry import Objects, Task

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


def test_no_change_is_no_change_and_a_seed_repeats_itself(rods):
    assert np.array_equal(varied(rods, Variation(), [1]), rods)
    turned = varied(rods, Variation(turn_deg=20), [1])
    assert np.array_equal(turned, varied(rods, Variation(turn_deg=20), [1]))
    assert not np.array_equal(turned, varied(rods, Variation(turn_deg=20), [2]))


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


def test_bends_move_parts_but_hardly_the_whole(rods):
    before, _, _ = moments(rods)
    found = varied(rods, Variation(bend=0.02), [1])
    assert not (found == rods).all(axis=(1, 2)).any()
    assert abs(moments(found)[0].mean(axis=0) - before.mean(axis=0)).max() < 0.3


def test_a_task_is_enlarged_by_its_training_objects_alone(rods):
    labels = np.arange(200) % 3
    task = Task("rods", ("a", "b", "c"), Objects(rods, labels), Objects(rods[:9], labels[:9]), "0" * 64, "here")
    found = enlarged(task, Variation(shift=0.1), 1000, kept=20, seed=1)
    assert len(found.train) == 5 * 180 + 200
    assert np.array_equal(found.train.labels[:180], labels[:180])
    assert np.array_equal(found.train.labels[-200:], labels)
    assert np.array_equal(found.train.images[-200:], rods)
    assert np.array_equal(found.test.images, task.test.images)
    assert found.sha256 != task.sha256  # a checkpoint of other copies is another training's
    assert enlarged(task, Variation(), 1000, kept=20, seed=1) is task
    assert enlarged(task, Variation(shift=0.1), 200, kept=20, seed=1) is task


def test_the_changes_are_named():
    assert str(Variation(turn_deg=180, mirror_y=True)) == "turned by up to 180 degrees, mirrored top to bottom"
    assert str(Variation()) == ""
