"""Which changes keep a class is found from the images: shapes may be turned, letters and directions may not."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the train extra")
pytest.importorskip("PIL", reason="needs the train extra")

from trainings import practice_folder

from pans.trainer.choose.recipe import choose_variation
from pans.trainer.tasks.changes import Variation
from pans.trainer.tasks.registry import Objects, Task, load_task


def test_letters_are_not_mirrored_nor_turned_over(tmp_path):
    task = load_task(str(practice_folder(tmp_path / "letters", "letters", 200)))
    choice = choose_variation(task)
    assert choice.variation != Variation()
    assert choice.variation.turn_deg <= 25
    assert not choice.variation.mirror_x
    assert choice.loss < choice.loss_before


def test_rods_of_a_direction_are_not_turned_far_nor_mirrored(tmp_path):
    task = load_task(str(practice_folder(tmp_path / "rods", "rods", 300)))
    choice = choose_variation(task)
    assert choice.variation.turn_deg <= 8
    assert not choice.variation.mirror_x
    assert not choice.variation.mirror_y


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


def test_images_in_all_directions_are_turned():
    task = Task("wedges", ("wedge", "bar"), wedges(150, 1), wedges(10, 2), "0" * 64, "drawn")
    choice = choose_variation(task)
    assert choice.variation.turn_deg == 180
    assert choice == choose_variation(task)
    assert choice != choose_variation(task, seed=1)


def test_images_that_are_alike_in_a_class_are_left_as_they_are():
    """Every image of a class is the same: any change makes the left-out ones less likely."""
    rng = np.random.default_rng(0)
    two = rng.integers(0, 256, (2, 12, 12), dtype=np.uint8)
    labels = np.arange(80) % 2
    task = Task("twins", ("a", "b"), Objects(two[labels], labels), Objects(two, np.arange(2)), "0" * 64, "drawn")
    assert choose_variation(task).variation == Variation()
