"""Every drawn task: the same seed gives the same objects, classes are balanced, and brightness tells (almost) nothing."""

import numpy as np
import pytest
from brightness import brightness_rows, decide_on_total, total_intensity

from pans.runtime.errors import UsageError
from pans.trainer.tasks.draw import CHUNK
from pans.trainer.tasks.generators import GENERATORS
from pans.trainer.tasks.registry import draw_task

SCENES = [name for name in GENERATORS if name != "barcode"]


@pytest.mark.parametrize("name", GENERATORS)
def test_a_task_is_what_its_recipe_says(name):
    recipe = GENERATORS[name]
    drawn = draw_task(name, n_train=2 * CHUNK, n_test=CHUNK)
    assert drawn.train.images.shape == (2 * CHUNK, *recipe.image_shape)
    assert drawn.train.images.dtype == drawn.test.images.dtype == np.uint8
    assert drawn.train.labels.dtype == np.int64
    assert set(drawn.test.labels) == set(range(len(recipe.classes)))
    assert recipe.light in ("transmission", "field")
    assert "OUR generator" in recipe.source
    assert recipe.draw.__doc__ is not None
    assert "OUR" in recipe.draw.__doc__


@pytest.mark.parametrize("name", GENERATORS)
def test_an_object_depends_on_its_seed_part_and_place_alone(name, monkeypatch):
    few = draw_task(name, seed=5, n_train=7, n_test=7)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    more = draw_task(name, seed=5, n_train=CHUNK + 7, n_test=7)
    assert np.array_equal(few.train.images, more.train.images[:7])
    assert np.array_equal(few.train.labels, more.train.labels[:7])
    assert np.array_equal(few.test.images, more.test.images)
    assert not np.array_equal(few.train.images, few.test.images)
    assert not np.array_equal(few.train.images, draw_task(name, seed=6, n_train=7, n_test=1).train.images)


@pytest.mark.parametrize("name", SCENES)
def test_classes_have_equal_shares(name):
    recipe = GENERATORS[name]
    labels = draw_task(name, n_train=3 * CHUNK, n_test=1).train.labels
    assert np.array_equal(np.bincount(labels), np.full(len(recipe.classes), 3 * CHUNK // len(recipe.classes)))
    assert (np.diff(labels) == 0).any(), "the classes come in a fixed turn"


@pytest.mark.parametrize("name", SCENES)
def test_total_intensity_is_near_chance_for_every_pair_of_classes(name):
    n_classes = len(GENERATORS[name].classes)
    drawn = draw_task(name, seed=1, n_train=480 * n_classes, n_test=480 * n_classes)
    light = drawn.light
    fit, held_out = total_intensity(drawn.train.images, light), total_intensity(drawn.test.images, light)
    rows = brightness_rows(fit, drawn.train.labels, held_out, drawn.test.labels)
    assert len(rows) == 1 + (n_classes * (n_classes - 1) // 2 if n_classes > 2 else 0)
    for row in rows:
        assert row.chance == pytest.approx(1 / len(row.classes))
        assert row.excess < 0.05, row


@pytest.mark.parametrize("name", SCENES)
def test_images_use_the_grey_scale_and_hardly_saturate(name):
    images = draw_task(name, n_train=2 * CHUNK, n_test=1).train.images
    assert (images == 255).mean() < 2e-3
    assert np.median(images.max(axis=(1, 2))) > 50


def test_the_brightness_check_finds_what_there_is():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 2, 4000)
    inside = np.where(
        labels == 1, rng.uniform(1, 2, 4000), rng.choice([0.5, 2.5], 4000)
    )  # no single threshold parts them
    assert brightness_rows(inside[:2000], labels[:2000], inside[2000:], labels[2000:])[0].accuracy > 0.99
    noise = rng.uniform(0, 1, 4000)
    assert abs(brightness_rows(noise[:2000], labels[:2000], noise[2000:], labels[2000:])[0].accuracy - 0.5) < 0.056


def test_equal_totals_are_one_interval():
    totals, labels = np.array([1.0, 1.0, 1.0, 2.0]), np.array([1, 1, 0, 0])
    assert decide_on_total(totals, labels, np.array([1.0, 2.0, 5.0])).tolist() == [1, 0, 0]


def test_total_intensity_squares_amplitudes():
    images = np.array([[[255, 0]], [[51, 51]]], np.uint8)
    assert total_intensity(images, "transmission") == pytest.approx([0.5, 0.2])
    assert total_intensity(images, "field") == pytest.approx([0.5, 0.04])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"name": "cell"}, UsageError, "no generator"),
        ({"name": "fiber", "seed": -1}, UsageError, "seed -1"),
        ({"name": "fiber", "n_train": 0}, ValueError, "0 objects"),
    ],
)
def test_what_cannot_be_drawn_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        draw_task(**arguments)
