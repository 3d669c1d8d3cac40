"""The physics of the drawn scenes: what differs between the classes is what the generator says, and nothing else."""

import numpy as np
import pytest

from pans.trainer.tasks import cells as task_cells
from pans.trainer.tasks import draw
from pans.trainer.tasks import fiber as task_fiber
from pans.trainer.tasks import nebula as task_nebula
from pans.trainer.tasks import tissue as task_tissue
from pans.trainer.tasks import transient as task_transient
from pans.trainer.tasks.generators import GENERATORS
from pans.trainer.tasks.registry import draw_task, load_task

NONE, ALL = np.zeros(draw.CHUNK, np.int64), np.ones(draw.CHUNK, np.int64)


def with_and_without(task):
    """The same 60 scenes, drawn as class 0 and as class 1 from the same random numbers; amplitudes."""
    return [task._chunk(draw.random_stream(2, "x", "test", 0), labels) / 255.0 for labels in (NONE, ALL)]


def power(amplitude):
    return (amplitude**2).mean(axis=(1, 2))


def test_an_event_is_small_compact_and_of_either_sign():
    without, event = with_and_without(task_transient)
    change = power(event) / power(without) - 1
    assert np.abs(change).max() < 0.06
    assert 10 <= (change > 0).sum() <= 50
    assert power(without).std() / power(without).mean() > 0.2  # the background fluctuates far more
    touched = (np.abs(event - without) > 0.02).sum(axis=(1, 2))
    assert (touched > 0).all()
    assert touched.max() < 0.06 * 64 * 64


def test_defects_lie_on_the_mode_and_leave_the_power_alone():
    clean, dirty = with_and_without(task_fiber)
    assert power(dirty) == pytest.approx(power(clean), rel=0.01)
    away = np.abs(dirty - clean)
    assert (away.max(axis=(1, 2)) > 0.1).all()
    y, x = np.mgrid[:64, :64] - 31.5
    centroid = (clean**2 * x).sum(axis=(1, 2)) / (clean**2).sum(axis=(1, 2))
    assert np.abs(centroid).max() < 2.2
    assert away[:, np.hypot(y, x) > 28].max() < 0.1


def test_perfused_speckle_has_less_contrast():
    images, labels = task_tissue.draw(4, "test", 120)
    intensity = (images / 255.0) ** 2
    contrast = intensity.std(axis=(1, 2)) / intensity.mean(axis=(1, 2))
    assert contrast[labels == 0].min() > 0.7
    assert contrast[labels == 1].max() < 0.5


def test_planetary_nebulae_are_dimmer_inside_than_on_their_shell():
    images, labels = task_nebula.draw(4, "test", 240)
    intensity = (images / 255.0) ** 2
    y, x = np.mgrid[:64, :64] - 31.5
    r = np.hypot(y, x)
    ratio = intensity[:, r < 4].mean(axis=1) / intensity[:, (r > 8) & (r < 13)].mean(axis=1)
    inside, outside = np.log(ratio[labels == 0]), np.log(ratio[labels == 1])
    error = np.hypot(inside.std() / np.sqrt(len(inside)), outside.std() / np.sqrt(len(outside)))
    assert outside.mean() - inside.mean() > 5 * error
    assert inside.max() > outside.min()  # and yet they overlap


def test_organelles_are_where_they_belong():
    images, labels = task_cells.draw(4, "test", 480)
    y, x = np.mgrid[:100, :100] - 49.5
    light = images.astype(np.float64)
    share = light[:, np.hypot(y, x) < 16].sum(axis=1) / light.sum(axis=(1, 2))
    membrane, nucleolus, mitochondria, null = (share[labels == k].mean() for k in range(4))
    assert nucleolus > mitochondria > membrane > null
    assert null == pytest.approx(np.pi * 16**2 / 1e4, abs=0.03)  # haze is spread evenly


@pytest.mark.parametrize("name", ["barcode", "transient"])
def test_a_drawn_task_by_name(name):
    task = draw_task(name, seed=3, n_train=30, n_test=20)
    recipe = GENERATORS[name]
    assert (task.name, task.classes, task.image_shape) == (name, recipe.classes, recipe.image_shape)
    assert (task.light, task.optics, task.target) == (recipe.light, "none", "class")
    assert not task.split_here
    assert "OUR generator" in task.source
    assert "seed 3" in task.source
    assert task.sha256 != draw_task(name, seed=4, n_train=30, n_test=20).sha256


def test_load_task_draws_the_recipe():
    task = load_task("barcode")
    assert (len(task.train), len(task.test)) == (4000, 1000)
    assert task.sha256 == load_task("barcode").sha256
