"""The tables over dark counts: cells judged and kept, pictures given back, other draws of the generator, direct imaging beside a cell."""

import dataclasses
import re
import shlex
from functools import partial

import numpy as np
import pytest
import torch
from trainings import columns_task
from tree import ROOT

from pans.app.command import parser_of
from pans.app.main import main
from pans.instrument.profile import load_profile
from pans_trainer.commands.train import TRAIN
from pans_trainer.commands.trainings import fixed_options
from pans_trainer.device import one_thread
from pans_trainer.model.heads import MlpHead
from pans_trainer.options import Options
from pans_trainer.reproduce import passive, scenes
from pans_trainer.reproduce.page import Asked, page_of, write_page
from pans_trainer.reproduce.printed import PASSIVE, recipe
from pans_trainer.tasks.registry import Objects, Task, draw_task
from pans_trainer.train.gradient import exact_search
from pans_trainer.train.gradient.data import TrainingData

CELLS = PASSIVE["cells"].rows[0]
CURVE = [
    {"table": "direct", "photons": n, "value": v, "error_objects": 0.3, "first_200": v, "clicks": n}
    for n, v in ((10.0, 40.0), (1000.0, 90.0))
]


def quiet(name, cache, **how):
    return Asked(name, cache, report=lambda _line: None, **how)


@pytest.fixture
def few_cells(monkeypatch):
    """120 cells and four epochs on one thread, as the command does."""
    small = dataclasses.replace(recipe("cells", CELLS, 0.0), epochs=4, starts=1, batch=50, hidden=8, clicks=None)
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    monkeypatch.setattr(passive, "load_task", lambda name, _, *, data_seed: draw_task(name, data_seed, 120, 60))
    passive.load.cache_clear()
    with one_thread():
        yield
    passive.load.cache_clear()


def test_a_barcode_cell_is_judged_on_all_strings_and_kept(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    monkeypatch.setattr(exact_search, "search_bars", partial(exact_search.search_bars, steps=400))
    small = dataclasses.replace(recipe("barcode", PASSIVE["barcode"].rows[0], 0.0), restarts=1, hidden=8)
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    asked = quiet("barcode", tmp_path, rows=(3,), dark=(0.0,))
    made = passive.passive_page(asked)
    (row,) = made.rows
    assert row["objects"] == 1024
    assert 50 < row["value"] < 90  # three patterns cannot tell all strings apart
    assert 0 < row["clicks"] < 3
    # all strings are judged: the error is the paper's on its 1000 strings alone
    assert (row["error_objects"], row["error"]) == (0.0, pytest.approx(np.sqrt(0.694 * 0.306 / 1000) * 100))
    assert row["balanced"] > 50
    assert (row["direct_verdict"], row["clicks_verdict"]) == ("below", "above")
    assert passive.passive_page(dataclasses.replace(asked, collect=True)).rows == made.rows
    write_page(tmp_path, page_of("barcode"), made)
    assert "Classes equally likely" in (tmp_path / "barcode.md").read_text()


def test_pictures_given_back_are_judged_by_their_similarity(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    rng = np.random.default_rng(0)
    images = (rng.uniform(size=(80, 1, 1)) * np.ones((1, 12, 12)) * 255).astype(np.uint8)  # grey: one click says a lot
    objects = Objects(images, np.arange(80) % 2)
    task = Task("grey", ("a", "b"), objects, objects, "0" * 64, "", light="field", target="image", imaged=lambda x: x)
    fast = {"epochs": 60, "batch": 20, "hidden": 16, "head_rate": 1e-2, "front_rate": 3e-2}
    small = dataclasses.replace(recipe("mmf-mnist-image", PASSIVE["mmf-mnist-image"].rows[0], 0.01), **fast)
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    monkeypatch.setattr(passive, "load", lambda *_: task)
    made = passive.passive_page(quiet("mmf-mnist-image", tmp_path, rows=(4,), dark=(0.01,)))
    (row,) = made.rows
    assert row["spread_trials"] is None  # of one trial
    assert 0.2 < row["value"] < 1.0
    assert (row["illumination"], "reaching" in row) == (0.0, False)
    assert row["error"] == pytest.approx(row["error_objects"] * np.sqrt(1 + 80 / 10_000))
    write_page(tmp_path, page_of("mmf-mnist-image"), made)
    assert (tmp_path / "mmf-mnist-image-pictures.png").stat().st_size > 5000


def test_a_table_of_pictures_shows_speckle_and_asks_for_the_digit(monkeypatch):
    images = np.random.default_rng(1).integers(0, 256, (5, 28, 28), dtype=np.uint8)
    digits = Objects(images, np.arange(5))
    how = {"light": "field", "optics": "mmf", "target": "image"}
    task = Task("mmf-mnist-image", ("a", "b"), digits, digits, "0" * 64, "", **how)
    monkeypatch.setattr(passive, "load_task", lambda *_, **__: task)
    passive.load.cache_clear()
    shown = passive.load("mmf-mnist-image", None)
    passive.load.cache_clear()
    data = TrainingData(shown, load_profile("ideal"), Options(features=4, encoder="coherent"))
    assert data.target.numpy() == pytest.approx(images.reshape(5, -1) / 255, abs=1e-6)
    wanted = passive.release_intensity(images).reshape(5, -1)
    assert data.shown.numpy() == pytest.approx(wanted, abs=0.51 / 255)


def test_the_command_trains_on_another_draw_and_keeps_it_apart(few_cells, tmp_path, pans):
    words = ["reproduce", "cells", "--rows", "3", "--dark", "0", "--cache", str(tmp_path), "--json"]
    assert main([*words, "--data-seed", "7"]) == 0
    other = pans.said().out
    assert {path.name for path in tmp_path.iterdir()} >= {"cells-3-0-data7.json", "cells-3-0-data7.pans"}
    assert not (tmp_path / "cells-3-0.json").exists()
    assert main(words) == 0
    assert pans.said().out != other  # other objects
    assert "draw 0" in pans.refuses(*words, "--data-seed", "7", "-o", tmp_path / "out")


def test_direct_imaging_stands_beside_a_cell_at_its_photons():
    cell = {"value": 66.0, "photons": 100.0, "error_objects": 0.4}
    found = passive.beside_direct("mmf-mnist", cell, 0.01, CURVE)
    assert (found["direct_there"], found["direct_ahead"]) == pytest.approx((65.0, 1.0))  # half way in the logarithm
    assert found["direct_error"] == pytest.approx(0.5)
    assert passive.beside_direct("mmf-mnist", cell | {"photons": 5.0}, 0.01, CURVE) == {}  # outside of the curve


def test_a_row_of_the_field_is_compared_at_what_it_detects_and_at_what_must_reach_it():
    found = {"value": 70.0, "error_objects": 0.4, "photons": 100.0, "reaching": 5000.0}
    row = passive.field_row(PASSIVE["mmf-mnist"].rows[0], found, CURVE)
    assert (row["direct_there"], row["direct_verdict"]) == (pytest.approx(65), "above")
    # no more than the curve's last level
    assert (row["optics_there"], row["optics_verdict"]) == (pytest.approx(90), "below")
    assert "direct_there" not in passive.field_row(PASSIVE["mmf-mnist"].rows[0], found | {"photons": 5.0}, CURVE)


def test_digits_behind_a_fibre_are_measured_as_a_field_and_by_a_camera(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    task = dataclasses.replace(columns_task(240, 160, 2, 8, "mmf-mnist"), light="field")
    passive_light = {"encoder": "coherent", "complex_field": True, "conserving": True, "input_photons": 100.0}
    small = Options(4, alpha=0.0, **passive_light, epochs=3, hidden=8, batch=40)
    monkeypatch.setattr(passive, "load_task", lambda *_: task)
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    monkeypatch.setattr(passive, "SPECKLE_LEVELS", (1.0, 1000.0))
    made = passive.field_page(quiet(passive.FIELD, tmp_path, rows=(4,)))
    row, few, many = made.rows
    assert row["reaching"] == pytest.approx(100, rel=0.2)
    assert row["photons"] <= row["reaching"]
    assert few["value"] < many["value"]
    write_page(tmp_path, page_of(passive.FIELD), made)
    assert (tmp_path / f"{passive.FIELD}.png").stat().st_size > 5000


def test_samples_are_single_shots_of_the_first_object_of_every_class():
    rng = np.random.default_rng(3)
    shown, behind = (rng.integers(0, 256, (9, 6, 6), dtype=np.uint8) for _ in range(2))
    chosen = passive.first_of_each_class(Objects(shown, np.array([2, 0, 2, 1, 0, 1, 1, 0, 2]), behind))
    assert chosen.labels.tolist() == [0, 1, 2]
    assert np.array_equal(chosen.images, shown[[1, 3, 0]])
    assert np.array_equal(chosen.pictures, behind[[1, 3, 0]])
    head = MlpHead(5, 7, 36, torch.Generator().manual_seed(0)).eval()
    first, again = (passive.take_samples(head, torch.full((3, 5), 0.5).double(), chosen) for _ in range(2))
    assert np.array_equal(first.given_back, again.given_back)
    assert len({picture.tobytes() for picture in first.given_back.reshape(-1, 36)}) > 2


@pytest.mark.parametrize("name", ["transient", "fiber", "tissue", "nebula"])
def test_the_command_of_a_page_trains_the_page_s_model(name):
    """Same options, hence the same patterns and head as the row of the page."""
    text = (ROOT / "docs" / "results" / f"{name}.md").read_text(encoding="utf-8")
    words = shlex.split(re.search(rf"^\$ pans train ({name} .*)$", text, re.MULTILINE)[1])
    args, ideal = parser_of("train", TRAIN).parse_args(words), load_profile("ideal")
    assert args.profile == "ideal"
    row = PASSIVE[name].rows[0]
    options = fixed_options(args, draw_task(name, 0, 4, 4), ideal)
    wanted = recipe(name, row, args.dark)
    assert dataclasses.replace(options, clicks=round(options.clicks, 9)) == dataclasses.replace(
        wanted, clicks=round(wanted.clicks, 9)
    )
    assert f"\n{row.features}|{args.dark:g}|" in text


def test_a_scene_stands_beside_the_best_camera_and_its_cells_stay_as_they_are(tmp_path, monkeypatch):
    """`--ways` measures direct imaging alone; the cells are those of the page."""
    known = [{"table": "fiber", "features": 2, "dark": 0.01, "value": 90.0, "error_objects": 0.4, "photons": 20.0}]
    known[0]["reaching"] = 5e5
    levels = {"a": {10.0: 50.0, 40.0: 60.0}, "b": {10.0: 40.0, 40.0: 70.0, 1e5: 99.0}}
    rows = [
        {"task": "fiber", "way": way, "level": level, "photons": level, "value": value, "error_objects": 0.3}
        for way, values in levels.items()
        for level, value in values.items()
    ]
    monkeypatch.setattr(scenes, "measured_points", lambda *_: rows)
    made = scenes.scene_page(quiet("fiber", tmp_path, ways=("a", "b"), known=tuple(known)))
    cell, *direct = made.rows
    assert cell["value"] == 90.0
    assert (cell["direct_there"], cell["direct_verdict"]) == (pytest.approx(60), "above")  # half way from 50 to 70
    assert (cell["optics_there"], cell["optics_verdict"]) == (pytest.approx(99), "below")  # no more than its last level
    best = [row["value"] for row in direct if row["way"] == scenes.CAMERA]
    assert best == [50.0, 70.0, 99.0]
    assert "camera" in "".join(line for table in page_of("fiber").tables for line in table.lines(made.rows))
