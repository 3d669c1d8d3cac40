"""The active tables: recipes within the rules, rows trained, resumed, told apart and put beside the paper's; other seeds of a row."""

# ruff: noqa: E402  (what follows needs torch)
import dataclasses
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import Options, check_options, plain_options, same_options
from pans.trainer.paper import Asked, active
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
    small = Options(features=3, clicks=1.5, epochs=6, hidden=8, batch=50, front_rate=5e-2, head_rate=2e-2, shots=2)
    monkeypatch.setattr(active, "load_task", lambda *_: task)
    monkeypatch.setattr(active, "TRIALS", {200: 3, 220: 3})
    monkeypatch.setattr(active, "recipe", lambda *_: small)
    monkeypatch.setattr(active, "OTHER_SEEDS", {("mnist", 3): (1000,)})


def figures_of(row, accuracy, clicks, photons=20.0, direct=0.5):
    one = {"accuracy_mean": accuracy, "accuracy_std": 0.01, "accuracy_se_objects": 0.02, "clicks_mean": clicks}
    one |= {"photons_mean": photons, "illumination": 80.0, "objects": 200, "trials": 0, "shots": 1}
    of_part = {str(shots): one for shots in (1, 2, 3, 5)}
    return {
        "first_200": of_part,
        "all": of_part,
        "direct": {"accuracy_mean": direct, "accuracy_se_objects": 0.004},
        "cpu_seconds": 60.0,
    }


@pytest.mark.parametrize(("name", "row"), [(name, row) for name, rows in ACTIVE.items() for row in rows])
def test_recipes_can_be_trained_and_aim_at_the_papers_clicks(name, row):
    options = active.recipe(name, row)
    check_options(options, load_profile("ideal"))
    darker = {"fashion-mnist": 1.0, "mnist": 1.07}[
        name
    ]  # the first 200 images, by which the clicks are counted, click less
    assert row.clicks <= options.clicks <= 1.05 * darker * row.clicks


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
    ahead = "-0.28 / -4.15 / -5.38 / -7.03"
    # 2 points from our objects, 0.71 between two trainings that differ by 1, and the paper's on 200 images: 3.46, 3.39, 3.36, 3.32
    error = "4.06 / 4.00 / 3.98 / 3.94"
    assert first.lines()[4].startswith(
        f"| 4 | 60.28 / 64.15 / 65.38 / 67.03 | 58.33 / 61.83 / 64.85 / 68.67 | {k} | {ahead} | {error} | "
        "level / level / level / level | 2 | 2.16"
    )
    assert first.lines()[6] == "K = 1: ours against the paper's simulation: 0 above, 1 level, 0 below, of 1."
    # 2 points, 0.71 between trainings, 0.4 of direct imaging
    assert whole.lines()[4] == (
        f"| 4 | {k} | 1.00 | 2.00 | 2.10 | 20.0 | 80.0 | -20.00 | 2.16 | below | 2 | exact | 1.0 |"
    )
    assert moved.lines()[-1].endswith("| 2.20 | +1.00 | +1.00 | +1.00 | +1.00 |")
    assert len(active.active_tables([ours | {"features": 4, "paper": paper}])) == 2  # no other seed, no table of it


def test_direct_imaging_is_interpolated_and_never_extrapolated():
    assert active.direct_at("mnist", 5)["accuracy_mean"] == pytest.approx(0.5443)
    between = active.direct_at("mnist", np.sqrt(100 * 300))
    assert between["accuracy_mean"] == pytest.approx((0.9529 + 0.9642) / 2)
    assert between["accuracy_se_objects"] == pytest.approx((0.0021 + 0.0019) / 2)
    most = {"accuracy_mean": pytest.approx(0.9642), "accuracy_se_objects": pytest.approx(0.0019), "photons_mean": 300}
    assert active.direct_at("mnist", 1e4) == most


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
    assert found["score_difference"] <= 1e-5
    assert active.finished_row(tmp_path, "mnist", ROW) == json.loads(json.dumps(found))
    assert {path.name for path in tmp_path.iterdir()} == {"mnist-3.json", "mnist-3.pans", "mnist-3.seconds"}


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
