"""Reproduction of the active tables: other seeds of a row, restarts chosen by what they shall be good at, a fair race."""

# ruff: noqa: E402  (what follows needs torch)
import dataclasses
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.trainer.options import Options, plain_options
from pans.trainer.paper import active, training
from pans.trainer.paper.page import Asked
from pans.trainer.paper.tables import ACTIVE, ActiveRow
from pans.trainer.tasks.registry import Objects, Task

ROW = ActiveRow(3, (40.0,) * 4, (40.0,) * 4, 1.5, 9.0)


@pytest.fixture
def bars(monkeypatch):
    """A table of one row with a second seed: bright columns name the class."""
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 3, 500)
    images = rng.integers(0, 60, (500, 4, 4), dtype=np.uint8)
    images[np.arange(500), :, labels] = 255
    task = Task(
        "mnist", ("a", "b", "c"), Objects(images[:280], labels[:280]), Objects(images[280:], labels[280:]), "0" * 64, ""
    )
    small = Options(features=3, clicks=1.5, epochs=4, hidden=8, batch=50, front_rate=5e-2, head_rate=2e-2, shots=2)
    monkeypatch.setattr(active, "load_task", lambda *_: task)
    monkeypatch.setattr(active, "TRIALS", {200: 3, 220: 3})
    monkeypatch.setattr(active, "recipe", lambda *_: small)
    monkeypatch.setattr(active, "OTHER_SEEDS", {("mnist", 3): (1000,)})


def test_a_row_is_trained_from_another_seed_too_and_both_are_kept(bars, tmp_path):
    asked = Asked("mnist", tmp_path, report=lambda _line: None)
    collecting = dataclasses.replace(asked, collect=True)
    assert active.row_with_seeds(collecting, ROW) is None
    found = active.row_with_seeds(asked, ROW)
    (other,) = found["other_seeds"]
    assert found["options"]["seed"] == 0
    assert other["options"]["seed"] == 1000
    assert found["sha256"] != other["sha256"]
    assert active.finished_row(tmp_path, "mnist", ROW, 1000) == json.loads(json.dumps(other))
    assert active.row_with_seeds(collecting, ROW) == json.loads(json.dumps(found))
    paper = {"simulation": ROW.simulation, "experiment": ROW.experiment, "clicks": 1.5, "illumination": 9.0}
    *_, seeds = active.active_tables([found | {"paper": paper}])
    moved = 100 * (other["all"]["5"]["accuracy_mean"] - found["all"]["5"]["accuracy_mean"])
    assert seeds.lines()[-1].startswith("| 3 | 1000 | ")
    assert seeds.lines()[-1].endswith(f" {moved:+.2f} |")


def test_the_seeds_of_the_tables_are_not_restarts_of_one_another():
    for (name, features), seeds in active.OTHER_SEEDS.items():
        (row,) = [row for row in ACTIVE[name] if row.features == features]
        options = active.recipe(name, row)
        assert plain_options(options)["seed"] == 0
        assert min(seeds) > (options.restarts + 1) * options.starts


def test_the_papers_recipe_is_given_ten_times_the_seconds_of_all_our_tries(tmp_path, monkeypatch):
    given = []

    class Judge:
        def __init__(self, row, _data_dir):
            self.row = row

        def train(self, options, *, each_epoch, cap):
            given.append((options, cap))
            seconds = cap if each_epoch else float(options.epochs)
            figures = {"seconds": seconds, "epochs": options.epochs, "reached": not each_epoch and options.epochs >= 18}
            numbers = ("accuracy", "best_accuracy", "accuracy_all", "clicks", "photons", "illumination")
            return figures | dict.fromkeys(numbers, 1.0)

    monkeypatch.setattr(training, "_Judge", Judge)
    asked = Asked("time", tmp_path, rows=(32,), report=lambda _line: None)
    found = training.time_page(asked)
    *ours, (paper, cap) = given
    assert [options.epochs for options, _ in ours] == [8, 12, 18]  # from short to long, until one reaches the goal
    assert all((options.shots, options.mix, options.restarts) == (1, 0.0, 1) for options, _ in ours)
    assert paper.estimator == "ste"
    assert (paper.front_rate, paper.head_rate, paper.batch) == (1e-3, 1e-4, 128)
    assert cap == pytest.approx(training.CAP * (8 + 12 + 18))
    _, ratios = training.time_tables(found.rows)
    assert ratios.lines()[-1] == "| 32 | more than 21.3 | more than 10.1 | 38 |"
    training.time_page(asked)
    assert len(given) == 4  # kept
