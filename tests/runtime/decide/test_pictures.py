"""The map of clicks against its definition, and pictures that are written whole."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pans.runtime.cli import main
from pans.runtime.errors import UsageError
from pans.trainer.evaluate.tsne import divergence, gradient, joint_neighbours, tsne

RNG = np.random.default_rng(4)


def test_every_point_has_the_wanted_perplexity():
    features = np.concatenate([RNG.normal(size=(40, 5)), 50 + 10 * RNG.normal(size=(40, 5))])
    near = joint_neighbours(features, 12.0)
    assert near.sum() == pytest.approx(1.0)
    squared = ((features[:, None] - features[None]) ** 2).sum(axis=2)
    for point in (3, 70):  # perplexity by its definition, over a fine search of the width
        others = np.delete(squared[point], point)
        widths = np.geomspace(1e-5, 1e2, 20_000)
        weight = np.exp(-(others - others.min())[None] * widths[:, None])
        share = weight / weight.sum(axis=1, keepdims=True)
        entropy = -(share * np.log(np.maximum(share, 1e-300))).sum(axis=1)
        best = share[np.argmin(np.abs(entropy - np.log(12.0)))]
        row = 2 * len(features) * near[point]
        assert (np.delete(row, point) >= best - 2e-3).all()  # row = own share + the share that others give it


def test_the_gradient_is_that_of_the_divergence():
    near = joint_neighbours(RNG.normal(size=(30, 4)), 8.0)
    near /= near.sum()
    place = RNG.normal(size=(30, 2))
    slope = gradient(near, place)
    for point, axis in ((0, 0), (17, 1)):
        ahead, behind = place.copy(), place.copy()
        ahead[point, axis] += 1e-5
        behind[point, axis] -= 1e-5
        wanted = (divergence(near, ahead) - divergence(near, behind)) / 2e-5
        assert slope[point, axis] == pytest.approx(wanted, rel=1e-3, abs=1e-7)


def test_clusters_stay_apart_and_the_map_repeats():
    labels = np.repeat(np.arange(4), 40)
    features = np.eye(4)[labels] * 6 + RNG.normal(size=(160, 4))
    place = tsne(features, perplexity=15.0, steps=300)
    squared = ((place[:, None] - place[None]) ** 2).sum(axis=2) + np.diag(np.full(160, np.inf))
    assert (labels[squared.argmin(axis=1)] == labels).mean() > 0.95
    assert np.array_equal(place, tsne(features, perplexity=15.0, steps=300))


def test_equal_clicks_do_not_break_the_map():
    place = tsne(RNG.integers(0, 2, (150, 3)).astype(float), perplexity=20.0, steps=200)
    assert np.isfinite(place).all()


@pytest.mark.parametrize("n", [10, 3000])
def test_too_few_or_too_many_points_are_refused(n):
    with pytest.raises(UsageError, match="allowed for a map"):
        tsne(np.zeros((n, 2)))


@pytest.fixture
def short_fits(monkeypatch):
    """The last stage of a training takes 1500 steps however small the task is; nothing here asks for a good head."""
    pytest.importorskip("torch")
    pytest.importorskip("matplotlib")
    from pans.trainer.train import head_fit

    monkeypatch.setattr(head_fit, "fit_head_exactly", partial(head_fit.fit_head_exactly, steps=30))


def own_images(path):
    rng = np.random.default_rng(1)
    labels = np.arange(150) % 2
    images = rng.integers(0, 60, (150, 5, 6), dtype=np.uint8)
    images[labels == 1, :, 2] += 150
    np.savez(path, images=images, labels=labels)
    return str(path)


@pytest.mark.usefixtures("short_fits")
def test_a_training_leaves_its_history(tmp_path, capsys):
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
    capsys.readouterr()
    assert (
        main(["evaluate", str(tmp_path / "own.pans"), "--task", task, "--pictures", str(tmp_path / "seen"), "--json"])
        == 0
    )
    drawn = json.loads(capsys.readouterr().out)["pictures"]
    assert {path.name for path in map(Path, drawn)} == {"patterns.png", "confusion.png"}  # too few objects for a map
    assert all(Path(path).read_bytes().startswith(b"\x89PNG") for path in drawn)


@pytest.mark.usefixtures("short_fits")
def test_more_weight_on_light_means_less_light(tmp_path):
    from pans.trainer.commands.alpha_sweep import main as sweep

    task = own_images(tmp_path / "own.npz")
    words = [
        task,
        "--features",
        "2",
        "--epochs",
        "15",
        "--hidden",
        "8",
        "--alphas",
        "1e-4",
        "0.3",
        "-o",
        str(tmp_path / "sweep"),
    ]
    assert sweep(words) == 0
    rows = json.loads((tmp_path / "sweep" / "alpha.json").read_text())["rows"]
    assert rows[1]["illumination"] < rows[0]["illumination"]
    assert {"alpha.png", "curves.png", "alpha-0.0001.pans"} <= {path.name for path in (tmp_path / "sweep").iterdir()}
