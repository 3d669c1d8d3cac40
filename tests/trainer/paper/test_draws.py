"""Reproduction on drawn tasks: other draws told apart, named on the page, refused where nothing is drawn; patterns by photons."""

# ruff: noqa: E402  (what follows needs torch)
import dataclasses

import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.cli import main
from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import check_options
from pans.trainer.paper import equal, passive, passive_recipes
from pans.trainer.paper.page import Asked
from pans.trainer.paper.tables import PASSIVE
from pans.trainer.tasks.registry import draw_task

ROW = PASSIVE["cells"].rows[0]


@pytest.fixture(autouse=True)
def small_and_quick(monkeypatch):
    """120 cells and four epochs on one thread, as the command does."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    small = dataclasses.replace(passive.recipe("cells", ROW, 0.0), epochs=4, starts=1, batch=50, hidden=8, clicks=None)
    monkeypatch.setattr(passive, "recipe", lambda *_: small)
    monkeypatch.setattr(
        passive_recipes, "load_task", lambda name, _folder, *, data_seed: draw_task(name, data_seed, 120, 60)
    )
    passive_recipes.load.cache_clear()
    yield
    passive_recipes.load.cache_clear()
    torch.set_num_threads(threads)


def test_a_cell_of_another_draw_is_kept_apart_and_named(tmp_path):
    def made(seed):
        return passive.make_cell(Asked("cells", tmp_path, report=lambda _line: None, data_seed=seed), ROW, 0.0)

    first, tenth, other = made(0), made(10), made(7)
    assert (first["data_seed"], other["data_seed"]) == (0, 7)
    assert first["clicks"] != other["clicks"]  # other objects
    assert passive.finished_cell(tmp_path, "cells", ROW, 0.0) == first
    assert passive.finished_cell(tmp_path, "cells", ROW, 0.0, 7) == other
    assert passive.finished_cell(tmp_path, "cells", ROW, 0.0, 8) is None
    assert passive.other_draws(tmp_path, "cells", ROW, 0.0) == [other, tenth]  # in the order of the numbers
    assert passive.other_draws(tmp_path, "cells", ROW, 0.01) == []
    page = passive.passive_page(Asked("cells", tmp_path, rows=(3,), dark=(0.0,)))
    assert page.rows == [first, other, tenth]
    one, others = passive.passive_tables("cells", page.rows)
    assert [row["data_seed"] for row in one.rows] == [0]  # the table is of one draw alone
    assert [row["data_seed"] for row in others.rows] == [7, 10]
    assert f"| 3 | 0 | 7 | 80.11 | {other['value']:.2f} |" in others.lines()[4]
    assert len(passive.passive_tables("cells", [first])) == 1


def test_the_command_trains_on_another_draw(tmp_path, capsys):
    words = ["reproduce", "cells", "--rows", "3", "--dark", "0", "--cache", str(tmp_path), "--json"]
    assert main([*words, "--data-seed", "7"]) == 0
    assert (tmp_path / "cells-3-0-data7.json").is_file()
    assert not (tmp_path / "cells-3-0.json").exists()
    capsys.readouterr()
    assert main([*words, "--data-seed", "7", "-o", str(tmp_path / "out")]) == 2
    assert "the page is of draw 0" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["barcode", "mmf-mnist"])
def test_what_is_not_drawn_has_no_other_draws(name, capsys):
    assert main(["reproduce", name, "--data-seed", "7"]) == 2
    assert f"{name} is not drawn" in capsys.readouterr().err


def test_more_photons_get_more_patterns_where_ten_would_saturate():
    options = {photons: equal.recipe("cells-3", photons) for photons in equal.PHOTONS}
    assert options[3.0].features == equal.FEATURES
    assert options[3.0].estimator == "exact"
    for photons in (10.0, 25.0):
        assert options[photons].features > equal.FEATURES
        assert options[photons].estimator in ("local", "ste")  # too many words to enumerate
        check_options(options[photons], load_profile("ideal"))
    assert all(option.photons < photons and option.clicks is None for photons, option in options.items())
