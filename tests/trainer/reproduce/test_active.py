"""The active tables: rows trained, resumed, told from those of another recipe, and put beside the paper's and direct imaging."""

import dataclasses
import json

import numpy as np
import pytest
from trainings import columns_task

from pans_trainer.options import Options
from pans_trainer.reproduce import active
from pans_trainer.reproduce.page import Asked, of_table, page_of, write_page
from pans_trainer.reproduce.printed import ACTIVE, ActiveRow

ROW = ActiveRow(3, 1.5, 9.0, (40.0,) * 4, (1.0,) * 4, (40.0,) * 4, (1.0,) * 4)


@pytest.fixture
def bars(monkeypatch):
    """A table of one row with a second seed: bright columns name the class."""
    task = columns_task(280, 220, 3, 4, "mnist")
    small = Options(features=3, clicks=1.5, epochs=6, hidden=8, batch=50, front_rate=5e-2, head_rate=2e-2, shots=2)
    changes = {"load_task": lambda *_: task, "recipe": lambda *_: small, "TRIALS": 3, "TRIALS_OF_ALL": 3}
    changes |= {"ACTIVE": {"mnist": (ROW,)}, "OTHER_SEEDS": {("mnist", 3): (1000,)}}
    for name, value in changes.items():
        monkeypatch.setattr(active, name, value)


def figures_of(accuracy, clicks, photons=20.0):
    one = {"accuracy_mean": accuracy, "accuracy_std": 0.01, "accuracy_se_objects": 0.02, "clicks_mean": clicks}
    one |= {"photons_mean": photons, "illumination": 80.0, "objects": 200, "trials": 0}
    of_part = {str(shots): one for shots in (1, 2, 3, 5)}
    return {"first_200": of_part, "all": of_part, "options": {"seed": 1000}}


def test_a_row_stands_beside_the_papers_direct_imaging_and_another_seed():
    rows = active.row_beside("mnist", ACTIVE["mnist"][0], [figures_of(0.6, 2.1), figures_of(0.61, 2.2)])
    one = rows[0]
    assert (one["simulation"], one["experiment"], one["first_200"]) == (60.28, 58.33, 60.0)
    assert one["ahead"] == pytest.approx(-0.28)
    # 2 points from our objects, 0.71 between two trainings that differ by 1, and the paper's on 200 images: 3.46
    assert one["error"] == pytest.approx(np.sqrt(2**2 + 0.5 + 3.46**2), abs=0.01)
    assert (one["verdict"], one["experiment_ahead"]) == ("level", pytest.approx(1.67))
    assert [row["paper_clicks"] for row in of_table(rows, "shots")] == pytest.approx([2.164, 4.328, 6.492, 10.82])
    (direct,) = of_table(rows, "direct")
    assert direct["direct"] == pytest.approx(active.direct_at("mnist", 20.0))
    assert (direct["verdict"], direct["trainings"]) == ("below", 2)
    assert [row["value"] for row in of_table(rows, "seeds")] == pytest.approx([61.0] * 4)
    alone = active.row_beside("mnist", ACTIVE["mnist"][0], [figures_of(0.6, 2.1)])
    assert len(alone) == 5  # no other seed, no rows of it


def test_direct_imaging_is_interpolated_and_never_extrapolated():
    assert active.direct_at("mnist", 5) == pytest.approx(54.43)
    assert active.direct_at("mnist", np.sqrt(100 * 300)) == pytest.approx((95.29 + 96.42) / 2)
    assert active.direct_at("mnist", 1e4) == pytest.approx(96.42)
    assert active.direct_at("mnist", 1.0, "error_objects") == pytest.approx(0.47)


def test_a_row_is_trained_measured_and_resumed(bars, tmp_path):
    stop = []

    def interrupt(_line):
        if not stop:
            stop.append(True)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        active.make_row(Asked("mnist", tmp_path, report=interrupt), ROW)
    found = active.make_row(Asked("mnist", tmp_path, report=lambda _line: None), ROW)
    assert found["first_200"]["1"]["accuracy_mean"] > 0.5  # by chance a third
    assert found["first_200"]["1"]["objects"] == 200
    assert found["all"]["5"]["shots"] == 5
    assert active.finished_row(tmp_path, "mnist", ROW) == json.loads(json.dumps(found))
    assert {path.name for path in tmp_path.iterdir()} == {"mnist-3.json", "mnist-3.pans"}


def test_a_page_trains_every_row_from_its_seeds_and_collects_them_again(bars, tmp_path):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    asked = Asked("mnist", tmp_path / "cache", report=lambda _line: None)
    (tmp_path / "cache").mkdir()
    collecting = dataclasses.replace(asked, collect=True)
    assert active.active_page(collecting).rows == []
    made = active.active_page(asked)
    assert [row["table"] for row in made.rows] == 4 * ["shots"] + ["direct"] + 4 * ["seeds"]
    assert made.rows[-1]["seed"] == 1000
    assert active.active_page(collecting).rows == json.loads(json.dumps(made.rows))
    (row,) = active.trained_rows(asked, "mnist")
    assert row.bundle.n_features == 3
    write_page(tmp_path, page_of("mnist"), made)
    assert (tmp_path / "mnist.png").stat().st_size > 5000
