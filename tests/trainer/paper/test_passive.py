"""The tables over dark counts: recipes, cells judged and kept, pictures given back, other draws of the generator told apart and named."""

# ruff: noqa: E402  (what follows needs torch)
import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.cli import main
from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import Options, check_options
from pans.trainer.paper import Asked, passive, passive_recipes
from pans.trainer.paper.tables import PASSIVE
from pans.trainer.tasks import mmf as task_mmf
from pans.trainer.tasks.registry import Objects, Task, draw_task
from pans.trainer.train.data import TrainingData

CELLS = PASSIVE["cells"].rows[0]


def quiet(name, cache):
    return Asked(name, cache, report=lambda _line: None)


@pytest.fixture
def few_cells(monkeypatch):
    """120 cells and four epochs on one thread, as the command does."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    small = dataclasses.replace(
        passive.recipe("cells", CELLS, 0.0), epochs=4, starts=1, batch=50, hidden=8, clicks=None
    )
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    monkeypatch.setattr(
        passive_recipes, "load_task", lambda name, _folder, *, data_seed: draw_task(name, data_seed, 120, 60)
    )
    passive_recipes.load.cache_clear()
    yield
    passive_recipes.load.cache_clear()
    torch.set_num_threads(threads)


def test_recipes_of_the_other_tasks_can_be_trained():
    cells = [(name, row, dark) for name, table in PASSIVE.items() for row in table.rows for dark in table.dark]
    for name, row, dark in cells:
        options = passive.recipe(name, row, dark)
        check_options(options, load_profile("ideal"))
        assert options.dark == dark
        assert options.encoder == ("active" if name in ("barcode", "cells") else "coherent")


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
    *_, line, _, counted = table.lines()
    # all strings are judged: the error is the paper's on its 1000 strings alone, (0.6916 x 0.3084 / 1000)^(1/2)
    assert line.startswith(
        f"| 3 | 0.01 | 69.16 | {found['value']:.2f} | {found['value'] - 69.16:+.2f} | 1.46 | above |"
    )
    assert counted == "Ours against the paper: 1 above, 0 level, 0 below, of 1."


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


def test_a_cell_of_another_draw_is_kept_apart_and_named(few_cells, tmp_path):
    def made(seed):
        return passive.make_cell(Asked("cells", tmp_path, report=lambda _line: None, data_seed=seed), CELLS, 0.0)

    first, tenth, other = made(0), made(10), made(7)
    assert (first["data_seed"], other["data_seed"]) == (0, 7)
    assert first["clicks"] != other["clicks"]  # other objects
    assert passive.finished_cell(tmp_path, "cells", CELLS, 0.0) == first
    assert passive.finished_cell(tmp_path, "cells", CELLS, 0.0, 7) == other
    assert passive.finished_cell(tmp_path, "cells", CELLS, 0.0, 8) is None
    assert passive.other_draws(tmp_path, "cells", CELLS, 0.0) == [other, tenth]  # in the order of the numbers
    assert passive.other_draws(tmp_path, "cells", CELLS, 0.01) == []
    page = passive.passive_page(Asked("cells", tmp_path, rows=(3,), dark=(0.0,)))
    assert page.rows == [first, other, tenth]
    one, others = passive.passive_tables("cells", page.rows)
    assert [row["data_seed"] for row in one.rows] == [0]  # the table is of one draw alone
    assert [row["data_seed"] for row in others.rows] == [7, 10]
    assert f"| 3 | 0 | 7 | 80.11 | {other['value']:.2f} |" in others.lines()[4]
    assert len(passive.passive_tables("cells", [first])) == 1


def test_the_command_trains_on_another_draw(few_cells, tmp_path, capsys):
    words = ["reproduce", "cells", "--rows", "3", "--dark", "0", "--cache", str(tmp_path), "--json"]
    assert main([*words, "--data-seed", "7"]) == 0
    assert (tmp_path / "cells-3-0-data7.json").is_file()
    assert not (tmp_path / "cells-3-0.json").exists()
    capsys.readouterr()
    assert main([*words, "--data-seed", "7", "-o", str(tmp_path / "out")]) == 2
    assert "the page is of draw 0" in capsys.readouterr().err


def test_tasks_without_printed_figures_have_none_beside_ours():
    figures = {
        "features": 2,
        "dark": 0.01,
        "value": 81.0,
        "first_200": 80.0,
        "spread_trials": 0.3,
        "error_objects": 0.5,
        "clicks": 0.9,
    }
    figures |= {"photons": 3.0, "illumination": 0.0, "cpu_seconds": 30.0}
    (table,) = passive.passive_tables("nebula", [figures])
    assert table.lines()[-1] == "| 2 | 0.01 | - | 81.00 | - | - | - | 80.00 | 0.30 | 0.50 | - | 0.90 | 3.0 | 0 | 0.5 |"


def test_direct_imaging_stands_beside_a_row_at_its_photons_and_its_clicks():
    ours = {"task": "barcode", "features": 3, "dark": 0.0, "value": 73.92, "photons": 13.0, "clicks": 1.5}
    beside = passive._beside_direct("barcode", ours, [])["direct"]
    assert beside["photons"]["photons"] == pytest.approx(13.0)
    assert beside["clicks"]["clicks"] == pytest.approx(1.5)
    assert (beside["photons"]["verdict"], beside["clicks"]["verdict"]) == ("below", "above")
    curve = [
        {"photons": n, "value": v, "error_objects": e, "clicks": n}
        for n, v, e in ((10.0, 40.0, 0.5), (1000.0, 90.0, 0.3))
    ]
    row = {"task": "mmf-mnist", "features": 16, "dark": 0.01, "value": 66.0, "photons": 100.0, "error_objects": 0.4}
    found = passive._beside_direct("mmf-mnist", row, curve)["direct"]["photons"]
    assert (found["value"], found["ahead"]) == pytest.approx((65.0, 1.0))  # half way in the logarithm
    assert found["error"] == pytest.approx((0.4**2 + 0.4**2) ** 0.5)
    assert passive._beside_direct("mmf-mnist", row | {"photons": 5.0}, curve) == {}  # outside of what was measured
