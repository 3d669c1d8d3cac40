"""The size of a training follows from the images, and every reason for a warning is told."""

from dataclasses import replace

import numpy as np
import pytest
from trainings import practice_folder

from pans.instrument.profile import load_profile
from pans_trainer.own_images import recipe
from pans_trainer.own_images.recipe import (
    BATCH,
    OBJECTS,
    choose_encoder,
    choose_training,
    choose_variation,
    warnings_of,
)
from pans_trainer.tasks.changes import Variation, enlarged
from pans_trainer.tasks.registry import Objects, Task, load_task, mixed_order

IDEAL = load_profile("ideal")
TURNED = Variation(turn_deg=180)


def task_of(counts, side=16, held_out=500):
    labels = np.repeat(np.arange(len(counts)), counts)
    images = np.zeros((len(labels), side, side), np.uint8)
    test = Objects(np.zeros((held_out, side, side), np.uint8), np.arange(held_out) % len(counts))
    return Task(
        "some", tuple(f"class{i}" for i in range(len(counts))), Objects(images, labels), test, "0" * 64, "drawn"
    )


@pytest.mark.parametrize("n", [240, 960, 2400, 20_000])
def test_small_sets_are_enlarged_and_take_steps_enough(n):
    recipe = choose_training(task_of([n // 4] * 4), TURNED, "automaton")
    assert recipe.objects == max(n, min(OBJECTS, 16 * n))
    assert recipe.kept == n // 12
    assert BATCH[0] <= recipe.batch <= BATCH[1]
    assert recipe.objects / recipe.batch >= 39
    assert "turned by up to 180 degrees" in recipe.reasons[0]


def test_the_encoder_follows_from_what_the_profile_can_show():
    assert choose_encoder(IDEAL)[0] == "automaton"
    encoder, why = choose_encoder(load_profile("wdm-snspd"))
    assert encoder == "active"
    assert "parallel" in why


def told(task, profile=IDEAL, clicks=None):
    return list(warnings_of(task, profile, choose_training(task, TURNED, "automaton"), clicks))


def test_warnings():
    assert told(task_of([100, 100])) == []
    assert "'class1' has 20 training images" in told(task_of([100, 20]))[0]
    assert "every class counts the same" in told(task_of([600, 100]))[0]
    unequal = told(task_of([298, 32, 6]))  # too few of one class does not hide that they are unequal
    assert "'class2' has 6 training images, wanted are" in unequal[0]
    assert "'class0' has 298 training images, 'class2' has 6: every class counts the same" in unequal[1]
    assert "60 held-out images: the standard error" in told(task_of([100, 100], held_out=60))[0]
    dark = load_profile("dmd-spad")
    assert told(task_of([100, 100]), dark) == []
    assert "dark counts alone" in told(task_of([100, 100]), dark, clicks=0.2)[0]
    hot = replace(dark, detector=replace(dark.detector, dark_rate_hz=1e4))
    assert "dark counts alone" in told(task_of([100, 100]), hot)[0]


def test_letters_are_not_mirrored_nor_turned_over_and_dark_ones_get_more_light(tmp_path, monkeypatch):
    task = load_task(str(practice_folder(tmp_path / "letters", "letters", 200)))
    choice = choose_variation(task)
    assert choice.variation != Variation()
    assert choice.variation.turn_deg <= 25
    assert not choice.variation.mirror_x
    assert choice.loss < choice.loss_before
    monkeypatch.setattr(recipe, "TRIES", {})
    images = 255 - task.train.images // 2
    dark = choose_variation(replace(task, train=Objects(images, task.train.labels))).light
    assert dark.photons > choice.light.photons == 10.0
    assert dark.nats < choice.light.nats
    assert dark.prices["first_price"] < choice.light.prices["first_price"] <= 0.2
    bigger = choose_training(task, TURNED, "automaton", dark)
    assert (
        bigger.photons == dark.photons == pytest.approx(bigger.illumination * task.train.images.mean() / 255, rel=0.05)
    )
    assert bigger.exposures == max(32, round(1.2 * dark.photons))


def wedges(n, seed):
    """Two classes, a wedge and a bar, in all directions: only turned images show what the classes are."""
    rng = np.random.default_rng(seed)
    labels = np.arange(n) % 2
    y, x = np.mgrid[:20, :20] - 9.5
    turn = rng.uniform(0, 2 * np.pi, (n, 1, 1))
    along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    bar = (abs(across) < 2.2) & (abs(along) < 8)
    wedge = (abs(across) < (8 - along) / 3.6) & (abs(along) < 8)
    images = np.where(labels[:, None, None] == 1, bar, wedge) * 200
    return Objects(images.astype(np.uint8), labels)


def test_images_in_all_directions_are_turned(monkeypatch):
    monkeypatch.setattr(recipe, "TRIES", {"turn_deg": (8.0, 25.0, 180.0)})
    task = Task("wedges", ("wedge", "bar"), wedges(30, 1), wedges(10, 2), "0" * 64, "drawn")
    choice = choose_variation(task)
    assert choice.variation.turn_deg == 180
    assert choice == choose_variation(task)
    assert choice != choose_variation(task, seed=1)


def test_classes_are_made_equal_by_changed_copies_and_the_last_images_stay_apart():
    task = task_of([60, 12, 4], side=8)
    n = len(task.train)
    images = np.broadcast_to(
        np.arange(n, dtype=np.uint8)[:, None, None], (n, 8, 8)
    )  # each its own grey, which no turn changes
    order = mixed_order(task.train.labels)
    task = replace(task, train=Objects(images, task.train.labels).take(order))
    kept = task.train.images[-8:, 0, 0]
    bigger = enlarged(task, TURNED, 900, 8, 0, equal=True)
    fitted, back = bigger.train.first(len(bigger.train) - bigger.kept), bigger.train.take(slice(-bigger.kept, None))
    assert np.bincount(fitted.labels).tolist() == [300, 300, 300]
    assert len(set(np.bincount(back.labels, minlength=3)) - {0}) == 1
    assert set(back.images[:, 0, 0]) == set(kept)
    assert not set(fitted.images[:, 4, 4]) & set(kept)
    given = np.bincount(task.train.labels[:-8])
    shares = enlarged(task, TURNED, 900, 8, 0).train
    assert np.bincount(shares.labels[:-8]).tolist() == pytest.approx((900 * given / given.sum()).tolist(), abs=1)
