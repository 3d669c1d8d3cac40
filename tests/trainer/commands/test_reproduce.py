"""Reproduction: the paper's figures as transcribed, recipes within the rules, rows kept and told apart, pages that say what is weak."""

# ruff: noqa: E402  (what follows needs torch)
import dataclasses
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.cli import main
from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import Options, check_options, plain_options, same_options
from pans.trainer.paper import PAGES, active, passive, passive_recipes
from pans.trainer.paper.page import Asked
from pans.trainer.paper.tables import ACTIVE, PASSIVE, ActiveRow
from pans.trainer.tasks import mmf as task_mmf
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train.data import TrainingData

ROWS = [(name, row) for name, rows in ACTIVE.items() for row in rows]
CELLS = [(name, row, dark) for name, table in PASSIVE.items() for row in table.rows for dark in table.dark]


def quiet(name, cache):
    return Asked(name, cache, report=lambda _line: None)


def figures_of(row, accuracy, clicks, photons=20.0, direct=0.5):
    one = {"accuracy_mean": accuracy, "accuracy_std": 0.01, "accuracy_se_objects": 0.02, "clicks_mean": clicks}
    one |= {"photons_mean": photons, "illumination": 80.0, "objects": 200, "trials": 0, "shots": 1}
    of_part = {str(shots): one for shots in (1, 2, 3, 5)}
    return {"first_200": of_part, "all": of_part, "direct": {"accuracy_mean": direct}, "cpu_seconds": 60.0}


def test_the_papers_rows_are_all_there_and_plausible():
    assert [len(rows) for rows in ACTIVE.values()] == [7, 6]
    for _, row in ROWS:
        assert 0 < row.clicks < row.features
        assert list(row.experiment) == sorted(row.experiment, key=lambda value: round(value / 2))  # K helps, to a point
        assert row.simulation[0] < row.simulation[3]
    for table in PASSIVE.values():
        assert all(len(row.values) == len(table.dark) for row in table.rows)
        assert all(list(row.values) == sorted(row.values, reverse=True) for row in table.rows)  # dark counts hurt
        assert all(0 < row.clicks < row.features for row in table.rows)


@pytest.mark.parametrize(("name", "row"), ROWS)
def test_recipes_can_be_trained_and_aim_at_the_papers_clicks(name, row):
    options = active.recipe(name, row)
    check_options(options, load_profile("ideal"))
    darker = {"fashion-mnist": 1.0, "mnist": 1.07}[
        name
    ]  # the first 200 images, by which the clicks are counted, click less
    assert row.clicks <= options.clicks <= 1.05 * darker * row.clicks


def test_recipes_of_the_other_tasks_can_be_trained():
    for name, row, dark in CELLS:
        options = passive.recipe(name, row, dark)
        check_options(options, load_profile("ideal"))
        assert options.dark == dark
        assert options.encoder == ("active" if name in ("barcode", "cells") else "coherent")


def test_a_row_is_told_from_one_of_another_recipe(tmp_path):
    row = ACTIVE["mnist"][0]
    assert active.finished_row(tmp_path, "mnist", row) is None
    _, path = active.row_files(tmp_path, "mnist", row.features)
    path.write_text(json.dumps({"options": plain_options(active.recipe("mnist", row))}))
    assert active.finished_row(tmp_path, "mnist", row) is not None
    other = dataclasses.replace(active.recipe("mnist", row), seed=1)
    path.write_text(json.dumps({"options": plain_options(other)}))
    assert active.finished_row(tmp_path, "mnist", row) is None


def test_options_of_an_earlier_version_count_with_todays_defaults():
    options = Options(features=3, epochs=7)
    earlier = plain_options(options)
    del earlier["polish"], earlier["head"]
    assert same_options(earlier, options)
    assert not same_options(earlier, dataclasses.replace(options, polish=0.5))
    assert not same_options(earlier, dataclasses.replace(options, epochs=8))


def test_a_row_passes_only_within_the_papers_clicks():
    row = ActiveRow(4, (60.0, 61.0, 62.0, 63.0), (60.0, 61.0, 62.0, 63.0), 2.0, 30.0)
    assert active.passed(row, figures_of(row, 0.62, 2.1)) == (pytest.approx(2.0), True)
    assert active.passed(row, figures_of(row, 0.62, 2.11))[1] is False
    assert active.passed(row, figures_of(row, 0.62, 2.1), 5)[0] == pytest.approx(-1.0)


def test_the_tables_put_ours_beside_the_papers_row_and_another_seed():
    row = ACTIVE["mnist"][0]
    ours, other = figures_of(row, 0.6, 2.1, direct=0.8), figures_of(row, 0.61, 2.2)
    seeds = [other | {"features": 4, "options": {"seed": 1000}}]
    paper = {key: getattr(row, key) for key in ("features", "simulation", "experiment", "clicks", "illumination")}
    first, whole, moved = active.active_tables([ours | {"features": 4, "paper": paper, "other_seeds": seeds}])
    k = "60.00 / 60.00 / 60.00 / 60.00"
    assert first.lines()[-1].startswith(
        f"| 4 | 60.28 / 64.15 / 65.38 / 67.03 | 58.33 / 61.83 / 64.85 / 68.67 | {k} | -0.28 | 2.16"
    )
    assert whole.lines()[-1] == f"| 4 | {k} | 1.00 | 2.00 | 2.10 | 20.0 | 80.0 | exact | 1.0 |"
    assert moved.lines()[-1].endswith("| 2.20 | +1.00 | +1.00 | +1.00 | +1.00 |")
    assert len(active.active_tables([ours | {"features": 4, "paper": paper}])) == 2  # no other seed, no table of it


def test_direct_imaging_is_interpolated_and_never_extrapolated():
    assert active.direct_at("mnist", 5)["accuracy_mean"] == pytest.approx(0.5443)
    between = active.direct_at("mnist", np.sqrt(5 * 10))["accuracy_mean"]
    assert between == pytest.approx((0.5443 + 0.7254) / 2)
    assert active.direct_at("mnist", 1e4) == {"accuracy_mean": pytest.approx(0.9642), "photons_mean": 300}


def test_a_row_is_trained_measured_and_resumed(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 3, 500)
    images = rng.integers(0, 60, (500, 4, 4), dtype=np.uint8)
    images[np.arange(500), :, labels] = 255
    task = Task(
        "mnist", ("a", "b", "c"), Objects(images[:280], labels[:280]), Objects(images[280:], labels[280:]), "0" * 64, ""
    )
    monkeypatch.setattr(active, "load_task", lambda *_: task)
    monkeypatch.setattr(active, "TRIALS", {200: 3, 220: 3})
    small = Options(features=3, clicks=1.5, epochs=6, hidden=8, batch=50, front_rate=5e-2, head_rate=2e-2, shots=2)
    monkeypatch.setattr(active, "recipe", lambda *_: small)
    row = ActiveRow(3, (40.0,) * 4, (40.0,) * 4, 1.5, 9.0)
    stop = []

    def interrupt(_line):
        if not stop:
            stop.append(True)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        active.make_row(Asked("mnist", tmp_path, report=interrupt), row)
    found = active.make_row(quiet("mnist", tmp_path), row)
    assert found["first_200"]["1"]["accuracy_mean"] > 0.5  # by chance a third
    assert found["first_200"]["1"]["objects"] == 200
    assert found["all"]["5"]["shots"] == 5
    assert found["score_difference"] <= 1e-5
    assert active.finished_row(tmp_path, "mnist", row) == json.loads(json.dumps(found))
    assert {path.name for path in tmp_path.iterdir()} == {"mnist-3.json", "mnist-3.pans", "mnist-3.seconds"}


def test_the_command_lists_collects_and_refuses(tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    assert main(["reproduce", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == list(PAGES)
    words = ["reproduce", "mnist", "--collect", "--cache", str(tmp_path / "cache"), "--json"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == []
    assert (tmp_path / "out" / "mnist.md").read_text().startswith("# mnist")
    assert main([*words, "--rows", "5"]) == 2
    assert "mnist has 4, 9, 16" in capsys.readouterr().err


def test_a_barcode_cell_is_judged_on_all_strings_and_kept(tmp_path, monkeypatch):
    row = PASSIVE["barcode"].rows[0]
    small = dataclasses.replace(passive.recipe("barcode", row, 0.01), restarts=1, hidden=8)
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    said = []
    found = passive.make_cell(Asked("barcode", tmp_path, report=said.append), row, 0.01)
    assert found["objects"] == 1024
    assert 50 < found["value"] < 90  # two classes, equally likely; three patterns cannot tell all strings apart
    assert found["error_objects"] == 0.0
    assert 0 < found["clicks"] < 3
    assert len(said) == 1
    assert passive.finished_cell(tmp_path, "barcode", row, 0.01) == found
    assert passive.finished_cell(tmp_path, "barcode", row, 0.03) is None
    (table,) = passive.passive_tables("barcode", [found])
    assert table.lines()[-1].startswith(
        f"| 3 | 0.01 | 69.16 | {found['value']:.2f} | {found['value'] - 69.16:+.2f} | - |"
    )


def test_pictures_given_back_are_judged_by_their_similarity(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    images = (rng.uniform(size=(80, 1, 1)) * np.ones((1, 12, 12)) * 255).astype(np.uint8)  # grey: one click says a lot
    objects = Objects(images, np.zeros(80, np.int64))
    task = Task("grey", ("a", "b"), objects, objects, "0" * 64, "", light="field", target="image")
    row = PASSIVE["mmf-mnist-image"].rows[0]
    small = dataclasses.replace(
        passive.recipe("mmf-mnist-image", row, 0.01), epochs=60, batch=20, hidden=16, head_rate=1e-2, front_rate=3e-2
    )
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    monkeypatch.setattr(passive, "load", lambda *_: task)
    found = passive.make_cell(quiet("mmf-mnist-image", tmp_path), row, 0.01)
    assert found["spread_trials"] is None  # of one trial
    ((title, samples),) = passive.samples_of(tmp_path, "mmf-mnist-image", [found])
    assert title.startswith("d_f = 4, dark 0.01")
    assert np.array_equal(samples.pictures, images[:1])  # all are of one class
    assert 0 < samples.clicks.max() <= 4
    assert not passive.samples_of(tmp_path, "mmf-mnist-image", [found | {"dark": 0.1}])
    assert 0.2 < found["value"] < 1.0
    assert found["illumination"] == 0.0
    assert found["photons"] > 0


def test_a_table_of_pictures_shows_speckle_and_asks_for_the_digit(monkeypatch):
    images = np.random.default_rng(1).integers(0, 256, (5, 28, 28), dtype=np.uint8)
    digits = Objects(images, np.arange(5))
    task = Task(
        "mmf-mnist-image", ("a", "b"), digits, digits, "0" * 64, "", light="field", optics="mmf", target="image"
    )
    monkeypatch.setattr(passive_recipes, "load_task", lambda *_, **__: task)
    passive_recipes.load.cache_clear()
    shown = passive_recipes.load("mmf-mnist-image", None)
    passive_recipes.load.cache_clear()
    options = Options(features=4, encoder="coherent")
    data = TrainingData(shown, load_profile("ideal"), options)
    assert data.target.numpy() == pytest.approx(images.reshape(5, -1) / 255, abs=1e-6)
    wanted = task_mmf.release_intensity(images).reshape(5, -1)
    assert data.shown.numpy() == pytest.approx(wanted, abs=0.51 / 255)
