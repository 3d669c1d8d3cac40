"""Every drawn task: the same seed gives the same objects, classes are balanced, and brightness tells (almost) nothing."""

from itertools import combinations

import numpy as np
import pytest

from pans_trainer.tasks import barcode as task_barcode
from pans_trainer.tasks import draw, fields
from pans_trainer.tasks.draw import CHUNK
from pans_trainer.tasks.generators import GENERATORS
from pans_trainer.tasks.registry import draw_task, load_task

SCENES = [name for name in GENERATORS if name != "barcode"]


@pytest.mark.parametrize("name", GENERATORS)
def test_a_task_is_what_its_recipe_says(name):
    recipe = GENERATORS[name]
    drawn = draw_task(name, n_train=2 * CHUNK, n_test=CHUNK)
    assert drawn.train.images.shape == (2 * CHUNK, *recipe.image_shape)
    assert drawn.train.images.dtype == drawn.test.images.dtype == np.uint8
    assert drawn.train.labels.dtype == np.int64
    assert set(drawn.test.labels) == set(range(len(recipe.classes)))
    assert (drawn.name, drawn.classes, drawn.light) == (name, recipe.classes, recipe.light)
    assert (drawn.optics, drawn.target, drawn.split_here) == ("none", "class", False)
    assert "OUR generator" in drawn.source
    assert "seed 0" in drawn.source


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


def total_intensity(images, light):
    """The mean intensity of every image; grey is an amplitude where `light` is "field"."""
    grey = images.reshape(len(images), -1) / 255.0
    return (grey**2 if light == "field" else grey).mean(axis=1)


@pytest.mark.parametrize("name", SCENES)
def test_total_intensity_is_near_chance_for_every_pair_of_classes(name):
    n_classes = len(GENERATORS[name].classes)
    drawn = draw_task(name, seed=1, n_train=480 * n_classes, n_test=480 * n_classes)
    parts = [(total_intensity(part.images, drawn.light), part.labels) for part in (drawn.train, drawn.test)]
    for group in (range(n_classes), *combinations(range(n_classes), 2)):
        (fit, known), (held_out, wanted) = ((x[np.isin(y, group)], y[np.isin(y, group)]) for x, y in parts)
        # the most frequent class of each of 32 equally filled intervals: no threshold on one number does better
        edges = np.unique(np.quantile(fit, np.arange(1, 32) / 32))
        counts = np.zeros((len(edges) + 1, n_classes), np.int64)
        np.add.at(counts, (np.searchsorted(edges, fit, side="right"), known), 1)
        found = counts.argmax(axis=1)[np.searchsorted(edges, held_out, side="right")]
        assert (found == wanted).mean() < 1 / len(group) + 0.05, group


@pytest.mark.parametrize("name", SCENES)
def test_classes_have_equal_shares_and_images_use_the_grey_scale_and_hardly_saturate(name):
    drawn, n = draw_task(name, n_train=2 * CHUNK, n_test=1).train, len(GENERATORS[name].classes)
    assert np.array_equal(np.bincount(drawn.labels), np.full(n, 2 * CHUNK // n))
    assert (np.diff(drawn.labels) == 0).any(), "the classes come in a fixed turn"
    assert (drawn.images == 255).mean() < 2e-3
    assert np.median(drawn.images.max(axis=(1, 2))) > 50


NONE, ALL = np.zeros(draw.CHUNK, np.int64), np.ones(draw.CHUNK, np.int64)


def with_and_without(scenes):
    """The same 60 scenes, drawn as class 0 and as class 1 from the same random numbers; amplitudes."""
    return [scenes(draw.random_stream(2, "x", "test", 0), labels) / 255.0 for labels in (NONE, ALL)]


def power(amplitude):
    return (amplitude**2).mean(axis=(1, 2))


def test_an_event_is_small_compact_and_of_either_sign():
    without, event = with_and_without(fields._scenes)
    change = power(event) / power(without) - 1
    assert np.abs(change).max() < 0.06
    assert 10 <= (change > 0).sum() <= 50
    assert power(without).std() / power(without).mean() > 0.2  # the background fluctuates far more
    touched = (np.abs(event - without) > 0.02).sum(axis=(1, 2))
    assert (touched > 0).all()
    assert touched.max() < 0.06 * 64 * 64


def test_defects_lie_on_the_mode_and_leave_the_power_alone():
    clean, dirty = with_and_without(fields._end_faces)
    assert power(dirty) == pytest.approx(power(clean), rel=0.01)
    away = np.abs(dirty - clean)
    assert (away.max(axis=(1, 2)) > 0.1).all()
    y, x = np.mgrid[:64, :64] - 31.5
    centroid = (clean**2 * x).sum(axis=(1, 2)) / (clean**2).sum(axis=(1, 2))
    assert np.abs(centroid).max() < 2.2
    assert away[:, np.hypot(y, x) > 28].max() < 0.1


def test_perfused_speckle_has_less_contrast():
    images, labels = fields.draw_tissue(4, "test", 120)
    intensity = (images / 255.0) ** 2
    contrast = intensity.std(axis=(1, 2)) / intensity.mean(axis=(1, 2))
    assert contrast[labels == 0].min() > 0.7
    assert contrast[labels == 1].max() < 0.5


def test_load_task_draws_the_recipe_and_follows_its_data_seed():
    task, other = load_task("barcode"), load_task("barcode", data_seed=5)
    assert (len(task.train), len(task.test)) == (4000, 1000)
    assert task.sha256 == load_task("barcode").sha256 != other.sha256
    assert "seed 5" in other.source


def test_spots_are_gaussians_where_they_were_put():
    y, x = np.array([[3.25, -6.0], [0.0, 40.0]]), np.array([[-2.5, 9.0], [0.0, 0.0]])
    sigma, weight = np.array([[1.5, 2.0], [1.0, 1.0]]), np.array([[1.0, 0.5], [2.0, 1.0]])
    found = draw.spots(20, 30, y, x, sigma, weight)
    rows, columns = np.arange(20) - 9.5, np.arange(30) - 14.5
    for i in range(2):
        wanted = np.zeros((20, 30))
        for k in range(2):
            away = (rows[:, None] - y[i, k]) ** 2 + (columns[None, :] - x[i, k]) ** 2
            wanted += weight[i, k] * np.exp(-away / (2 * sigma[i, k] ** 2))
        assert np.abs(found[i] - wanted).max() < 1e-4


def test_speckle_is_circular_gaussian_of_mean_one():
    field = draw.speckle(np.random.default_rng(7), 200, 32, 32, 3.0).astype(np.complex128)
    intensity = np.abs(field) ** 2
    grains = 200 * 32 * 32 * np.pi * (0.61 / 3) ** 2  # independent modes
    assert abs(intensity.mean() - 1) < 5 / np.sqrt(grains)
    assert intensity.std() == pytest.approx(1, abs=0.05)  # contrast of fully developed speckle
    assert abs((field**2).mean()) < 0.02  # no preferred phase
    correlation = (field[:, :, 3:] * field[:, :, :-3].conj()).mean().real
    assert abs(correlation) < 0.05  # the first zero of the Airy amplitude is one grain away


def test_all_strings_and_labels_against_python_strings():
    bars, labels = task_barcode.all_strings()
    for i in (0, 1, 10, 341, 682, 1023, *range(100, 160)):
        text = f"{i:010b}"
        assert "".join(map(str, bars[i])) == text
        assert labels[i] == ("1010" in text)
    assert labels.sum() == sum("1010" in f"{i:010b}" for i in range(1024)) == 357


def test_the_number_of_bright_bars_tells_nothing_under_the_uniform_prior():
    bars, labels = task_barcode.all_strings()
    best = {}
    for prior in task_barcode.PRIORS:
        joint = np.zeros((11, 2))
        np.add.at(joint, (bars.sum(axis=1), labels), task_barcode.weights(prior))
        best[prior] = joint.max(axis=1).sum()
    assert best["uniform"] == pytest.approx(667 / 1024)  # what the prior alone gives
    assert best["balanced"] == pytest.approx(0.5747, abs=1e-3)
    assert best["inserted"] == pytest.approx(0.5885, abs=1e-3)
