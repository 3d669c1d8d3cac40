"""The map of clicks, and the pictures of a training and of a bundle."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("matplotlib")
pytest.importorskip("sklearn")

from trainings import short_fits  # noqa: F401  a fixture

from pans.app.main import main
from pans_trainer.evaluate.pictures import tsne

RNG = np.random.default_rng(4)


def test_clusters_stay_apart_and_the_map_repeats():
    labels = np.repeat(np.arange(4), 40)
    features = np.eye(4)[labels] * 6 + RNG.normal(size=(160, 4))
    place = tsne(features, perplexity=15.0)
    squared = ((place[:, None] - place[None]) ** 2).sum(axis=2) + np.diag(np.full(160, np.inf))
    assert (labels[squared.argmin(axis=1)] == labels).mean() > 0.95
    assert np.array_equal(place, tsne(features, perplexity=15.0))


def own_images(path):
    rng = np.random.default_rng(1)
    labels = np.arange(150) % 2
    images = rng.integers(0, 60, (150, 5, 6), dtype=np.uint8)
    images[labels == 1, :, 2] += 150
    np.savez(path, images=images, labels=labels)
    return str(path)


@pytest.mark.usefixtures("short_fits")
def test_a_training_leaves_its_history(tmp_path, pans):
    task = own_images(tmp_path / "own.npz")
    words = ["--features", "2", "--epochs", "6", "--hidden", "8", "-o", str(tmp_path / "own.pans"), "--json"]
    assert main(["train", task, *words, "--history", str(tmp_path / "course")]) == 0
    course = json.loads((tmp_path / "course" / "history.json").read_text())
    assert [(epoch["restart"], epoch["epoch"]) for epoch in course["epochs"][-6:]] == [(0, i) for i in range(1, 7)]
    assert course["patterns_at"][-1] == 6
    assert len(course["patterns_at"]) >= 3
    for name in ("curves.png", "evolution.png"):
        assert (tmp_path / "course" / name).read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "own.pans.checkpoint").exists()
    pans.said()
    words = ["evaluate", str(tmp_path / "own.pans"), "--task", task, "--pictures", str(tmp_path / "seen"), "--json"]
    drawn = pans(*words)["pictures"]
    assert {path.name for path in map(Path, drawn)} == {"patterns.png", "confusion.png"}  # too few objects for a map
    assert all(Path(path).read_bytes().startswith(b"\x89PNG") for path in drawn)
