"""What a sensor for own images achieves is counted as statistics books do, and no image is judged by a sensor that has seen it."""

import io
import json
import re

import numpy as np
import pytest
from trainings import columns_task

from pans.base.errors import UsageError
from pans.bundle.sensor.bundle import load_bundle
from pans_trainer.baselines.common import Trials
from pans_trainer.own_images import own, recipe
from pans_trainer.own_images.own import train_own
from pans_trainer.own_images.results import Judged, balanced, confused_sheet, results_of
from pans_trainer.tasks.registry import Objects

QUICK = {"exposures": 4, "states": 6, "epochs": 1, "photons": 4.0}


def parts(counts, seed=0):
    """Two sensors' judgements of objects of three classes, in draws of 0 or 1, and a camera's."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(2):
        labels = np.repeat(np.arange(3), counts)
        n = len(labels)
        decided = np.where(rng.random(n) < 0.7, labels, rng.integers(0, 3, n))
        camera = Trials(rng.random((4, n)) < 0.5, np.ones(n), np.full(n, 3.0), 9.0)
        objects = Objects(rng.integers(0, 256, (n, 4, 4), dtype=np.uint8), labels)
        light = np.ones(n), np.full(n, 3.0), np.full(n, 8.0)
        found.append(Judged(objects, np.eye(3)[decided], *light, [camera, None]))
    return found


def test_figures_by_the_definitions():
    judged = parts([40, 25, 10])
    found = results_of(judged, ("a", "b", "c"), seconds=1.0, bundle=None, sha256="")
    labels = np.concatenate([part.objects.labels for part in judged])
    decided = np.concatenate([part.shares.argmax(axis=1) for part in judged])
    right = decided == labels
    recalls = [right[labels == label].mean() for label in range(3)]
    assert found.accuracy == pytest.approx(right.mean())
    assert list(found.recall.values()) == pytest.approx(recalls)
    assert found.balanced_accuracy == pytest.approx(np.mean(recalls))
    assert (found.majority_class, found.majority) == ("a", pytest.approx(80 / 150))
    assert found.images == {"a": 80, "b": 50, "c": 20}
    assert found.confusion.tolist() == [
        [int(((labels == i) & (decided == j)).sum()) for j in range(3)] for i in range(3)
    ]
    camera = np.concatenate([part.cameras[0].right.mean(axis=0) for part in judged])
    beside = found.camera_at_equal_photons
    assert beside.accuracy_gain == pytest.approx(right.mean() - camera.mean())
    assert beside.accuracy_gain_se == pytest.approx((right - camera).std(ddof=1) / np.sqrt(150))
    assert found.camera_at_equal_illumination is None
    assert (beside.photons, beside.illumination, found.illumination) == (3.0, 9.0, 8.0)
    assert json.loads(json.dumps(found.as_json()))["confused"][0].keys() == {"true", "decided", "share"}
    for words in ("balanced accuracy", "one of 2 sensors", "recall by class", "always naming 'a': accuracy 53.3 %"):
        assert words in "\n".join(found.lines()), words


def test_the_error_of_a_balanced_accuracy_is_its_spread_over_draws():
    rng, labels = np.random.default_rng(1), np.repeat([0, 1, 2], [300, 40, 12])
    chances = np.array([0.9, 0.6, 0.4])[labels]
    drawn = [balanced((rng.random(len(labels)) < chances).astype(float), labels) for _ in range(2000)]
    means, errors = np.array(drawn).T
    assert errors.mean() == pytest.approx(means.std(), rel=0.1)
    assert balanced(np.ones(6), np.repeat([0, 1], [5, 1])) == (1.0, 0.0)
    alone = balanced(np.array([1.0, 0.0, 1.0, 0.0, 1.0]), np.array([0, 0, 0, 0, 1]))
    assert alone[1] > 0.25  # one image of a class says little about it, though it was right


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(recipe, "OBJECTS", 200)
    monkeypatch.setattr(own, "FEW_HELD_OUT", 3)
    monkeypatch.setattr(recipe, "TRIES", {"shift": (0.1,)})


def test_arrays_are_trained_on_and_every_image_is_judged_once(few, tmp_path):
    task = columns_task(75, 1, 3, 9)
    labels = np.array(["left", "middle", "right"])[task.train.labels]
    labels[np.flatnonzero(labels == "right")[7:]] = "left"  # 7 of one class
    told = []
    found = train_own(
        task.train.images,
        labels,
        out=tmp_path / "s.pans",
        progress=lambda words, part: told.append((words, part)),
        **QUICK,
    )
    assert found.folds == 5
    assert sum(found.images.values()) == 75
    assert found.images["right"] == 7
    seen = np.concatenate([part.objects.images for part in found.judged]).reshape(75, -1)
    assert sorted(map(bytes, seen)) == sorted(map(bytes, task.train.images.reshape(75, -1)))
    assert load_bundle(tmp_path / "s.pans")[1] == found.sha256
    assert found.sensor.classes == found.classes == ("left", "middle", "right")
    assert 3 < found.photons < 6
    assert re.fullmatch(r"sensor 5 of 5: shown, accuracy [\d.]+ %, about \d+ s left", told[-1][0])
    assert all(0 <= part <= 1 for _, part in told)
    with pytest.raises(UsageError, match="exists"):
        train_own(task.train.images, labels, out=tmp_path / "s.pans", folds=1, **QUICK)
    image = pytest.importorskip("PIL.Image")
    with image.open(io.BytesIO(confused_sheet(found))) as sheet:
        assert sheet.width > 16 * 9


def test_what_an_interrupt_leaves_is_returned(few):
    def stop(words, _part):
        if words.startswith("sensor 3 of 5"):
            raise KeyboardInterrupt

    task = columns_task(75, 1, 3, 9)
    with pytest.warns(UserWarning, match="3 of 5 sensors are missing"):
        found = train_own(task.train.images, task.train.labels, folds=5, progress=stop, **QUICK)
    assert (found.folds, found.folds_missing, sum(found.images.values())) == (2, 3, 30)
    assert "interrupted, 3 more sensors are missing" in found.lines()[0]


def test_unfit_arrays_are_refused():
    images = np.zeros((12, 6, 6), np.uint8)
    for wrong in (images.astype(float), images[0], images[:11]):
        with pytest.raises(UsageError, match="allowed: uint8"):
            train_own(wrong, np.arange(12) % 2)
    with pytest.raises(UsageError, match="class 'b' has 2 images"):
        train_own(images, ["a"] * 10 + ["b"] * 2)
