"""Equal photons, sweeps and information: measured on small tasks, kept, put into pages that say where we are behind, and drawn."""

# ruff: noqa: E402  (what follows needs torch)
import dataclasses
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import Options, check_options, same_options
from pans.trainer.paper import equal, information, swept
from pans.trainer.paper.active import direct_at
from pans.trainer.paper.page import Asked
from pans.trainer.paper.passive_recipes import basis_of, recipe
from pans.trainer.paper.tables import UNPRINTED
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train import head_fit


def columns(n, side, n_classes, seed=0, light="transmission"):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, n_classes, n)
    images = rng.integers(0, 30, (n, side, side), dtype=np.uint8)
    images[np.arange(n), :, labels * (side // n_classes)] = 250
    half = n // 2
    train, test = Objects(images[:half], labels[:half]), Objects(images[half:], labels[half:])
    return Task("columns", tuple("abcdefghij"[:n_classes]), train, test, "0" * 64, "", light=light)


def test_all_ways_get_the_same_photons_and_are_measured_once(tmp_path, monkeypatch):
    monkeypatch.setattr(equal, "TASKS", ("columns",))
    monkeypatch.setattr(equal, "SETS", ())
    monkeypatch.setattr(equal, "PHOTONS", (3.0,))
    monkeypatch.setattr(equal, "NETWORK_EPOCHS_ELSE", 1)
    loaded = []
    monkeypatch.setattr(equal, "_task", lambda *_: loaded.append(1) or columns(900, 6, 3))
    small = Options(features=3, alpha=0.0, photons=2.9, epochs=12, hidden=16, batch=50, front_rate=3e-2, head_rate=1e-2)
    monkeypatch.setattr(equal, "recipe", lambda *_: small)
    assert equal.equal_page(Asked("equal-photons", tmp_path, collect=True)).rows == []
    found = equal.equal_page(Asked("equal-photons", tmp_path, report=lambda _line: None))
    rows = {row["way"]: row for row in found.rows}
    assert set(rows) == {"PANS", "posterior", "network"}  # light is made for an active task
    for way in ("posterior", "network"):
        assert rows[way]["photons"] == pytest.approx(3.0, rel=1e-5)
    assert rows["PANS"]["value"] > 45  # by chance a third
    assert rows["posterior"]["value"] > 45
    assert rows["PANS"]["illumination"] > 0
    assert {row["objects"] for row in rows.values()} == {450}  # all that were held out
    assert len(loaded) == 3  # one for each way
    again = equal.equal_page(Asked("equal-photons", tmp_path))
    assert json.dumps(again.rows) == json.dumps(found.rows)
    assert len(loaded) == 3
    for way, key in (("posterior", "frames"), ("posterior", "floor"), ("network", "epochs")):
        path = tmp_path / f"equal-columns-{way}-3.json"
        kept = path.read_text()
        path.write_text(json.dumps(json.loads(kept) | {key: "another"}))
        left = {row["way"] for row in equal.equal_page(Asked("equal-photons", tmp_path, collect=True)).rows}
        assert left == set(rows) - {way}  # made in another way, it counts as not made
        path.write_text(kept)


def test_public_sets_have_a_training_per_seed_and_their_means_stand_beside_direct_imaging(tmp_path, monkeypatch):
    monkeypatch.setattr(equal, "TASKS", ())
    monkeypatch.setattr(equal, "SETS", ("mnist",))
    monkeypatch.setattr(equal, "SET_PHOTONS", (5.0, 10.0))
    monkeypatch.setattr(equal, "MEAN_TRANSMISSION", {"mnist": 0.4})  # of the images below, nearly
    monkeypatch.setattr(equal, "SET_FEATURES", 3)
    small = {"epochs": 6, "hidden": 8, "batch": 50, "front_rate": 3e-2, "head_rate": 1e-2}
    monkeypatch.setattr(equal, "SET_SCHEDULE", small)
    monkeypatch.setattr(head_fit.fit_head_exactly, "__defaults__", (50, head_fit.RATE))
    drawn = dataclasses.replace(columns(400, 6, 3), name="mnist")
    monkeypatch.setattr(equal, "_task", lambda *_: drawn)
    said = []
    assert equal.equal_page(Asked("equal-photons", tmp_path, collect=True, seeds=1, report=said.append)).rows == []
    assert len(said) == 4  # both budgets at both levels
    rows = equal.equal_page(Asked("equal-photons", tmp_path, seeds=1, report=lambda _line: None)).rows
    of = {(row["way"], row["asked"]): row for row in rows}
    assert len(of) == 4 + 1  # and what was trained for 10 photons, dimmed to 5
    for key in ("photons", "illumination"):
        assert of["dimmed", 5.0][key] == pytest.approx(of["held to photons", 10.0][key] / 2)
    assert of["dimmed", 5.0]["clicks"] < of["held to photons", 10.0]["clicks"]
    assert of["held to illumination", 10.0]["options"]["illumination"] == pytest.approx(10 / 0.4)
    assert all(same_options(row["options"], equal.recipe_of_row(row)) for row in rows)
    again = equal.equal_page(Asked("equal-photons", tmp_path, seeds=2, collect=True)).rows
    assert json.dumps(again) == json.dumps(rows)
    other = [row | {"seed": 1, "value": row["value"] + 3} for row in rows]
    table = equal.equal_tables(rows + other)[-1]
    assert [row["trainings"] for row in table.rows] == [2] * 5
    first = table.rows[0]
    assert (first["way"], first["value"]) == (
        "held to photons",
        pytest.approx(of["held to photons", 5.0]["value"] + 1.5),
    )
    assert first["error_seeds"] == pytest.approx(1.5)  # of the mean of two that differ by 3
    there = direct_at("mnist", first["photons"])
    errors = (1.5, first["error_objects"], 100 * there["accuracy_se_objects"])
    assert first["at_photons"]["error"] == pytest.approx(sum(error**2 for error in errors) ** 0.5)
    assert first["at_photons"]["ahead"] == pytest.approx(first["value"] - 100 * there["accuracy_mean"])
    light = drawn.test.images.mean() / 255 * first["illumination"]  # what direct imaging detects of as much light
    assert first["at_illumination"]["photons"] == pytest.approx(light)
    assert len(table.claims) == 6


def test_ours_is_held_against_the_better_direct_way():
    def row(way, value, photons=3.0):
        row = {"task": "fiber", "way": way, "asked": 3.0, "value": value, "first_200": value, "photons": photons}
        return row | dict.fromkeys(("spread_trials", "error_objects", "clicks", "illumination", "cpu_seconds"), 1.0)

    rows = [row("PANS", 80), row("equal light", 60, photons=1.0), row("posterior", 70), row("network", 81)]
    assert equal.ahead(rows[0], rows[:1]) is None  # nothing to be held against
    assert equal.ahead(rows[0], rows[:3])["ahead"] == 10
    every, leads = equal.equal_tables(rows)
    assert [line.split(" | ")[2] for line in every.lines()[2:]] == list(equal.WAYS)
    assert leads.lines()[-6:] == [
        "| fiber | 3 | PANS | network | -1.00 | 1.41 | level |",  # both with an error of 1 point: 1.41 together
        "| fiber | 3 | equal light | network | -21.00 | 1.41 | below |",
        "",
        "`PANS` against the better direct way: 0 above, 1 level, 0 below, of 1.",
        "",
        "`equal light` against the better direct way: 0 above, 0 level, 1 below, of 1.",
    ]


def test_at_equal_light_no_light_is_made(monkeypatch):
    small = Options(
        features=3, alpha=0.0, photons=9.0, epochs=3, hidden=8, batch=50, head_rate=1e-2, encoder="coherent"
    )
    monkeypatch.setattr(equal, "recipe", lambda *_: small)
    monkeypatch.setattr(equal, "LIGHT_SIZE", 8)
    found = equal._pans(columns(600, 12, 2, light="field"), "equal light", 20.0)
    assert found["options"]["conserving"] is True
    assert found["options"]["input_photons"] == 20.0
    assert 0.1 < found["photons"] <= 20.5
    assert found["value"] > 60  # by chance a half


def test_light_shots_and_dark_counts_are_swept_each_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(swept, "load_task", lambda *_: columns(600, 28, 10))
    monkeypatch.setattr(swept, "SWEPT_SHOTS", (1, 2))
    monkeypatch.setattr(swept, "ETAS", (0.01, 1.0, 100.0))
    monkeypatch.setattr(swept, "DARKS", (1e-3, 1.0))
    monkeypatch.setattr(swept, "TRIALS_OF_ALL", 2)
    monkeypatch.setattr(swept, "TRIALS", {})
    found = swept.sweeps_page(Asked("sweeps", tmp_path, report=lambda _line: None))
    of = {(row["sweep"], row["setting"]): row["all"] for row in found.rows}
    one = of["eta", 1.0]
    assert of["K", 1.0] == one
    assert of["K", 2.0]["photons_mean"] == pytest.approx(2 * one["photons_mean"])
    assert of["eta", 0.01]["illumination"] == pytest.approx(0.01 * one["illumination"])
    assert of["eta", 0.01]["clicks_mean"] < 0.5 < 9 < of["eta", 100.0]["clicks_mean"]
    assert of["dark", 1e-3]["clicks_mean"] < of["dark", 1.0]["clicks_mean"] - 1
    assert of["dark", 1.0]["photons_mean"] == pytest.approx(one["photons_mean"])  # dark counts are no light
    tables = swept.sweeps_tables(found.rows)
    assert [(table.heading, len(table.rows)) for table in tables] == [
        ("## shots (K)", 2),
        ("## all light times (eta)", 3),
        ("## dark counts of an exposure (dark)", 2),
    ]
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    found.pictures[""](tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 5000


def test_information_of_frames_and_words_stands_at_the_same_photons(tmp_path, monkeypatch):
    monkeypatch.setattr(information, "load_task", lambda *_: columns(800, 28, 10))
    monkeypatch.setattr(information, "PHOTONS", (1.0, 30.0, 300.0))
    monkeypatch.setattr(information, "POSTERIOR_MAX", 30.0)
    monkeypatch.setattr(information, "FRAMES", 300)
    found = information.information_page(Asked("fig-2c", tmp_path, report=lambda _line: None))
    of = {(row["way"], row["photons"]): row for row in found.rows}
    assert of["frames", 30.0]["bits"] > of["frames", 1.0]["bits"] > 0.05
    assert 0.1 < of["click words", 1.0]["bits"] < np.log2(10)
    assert of["click words", 1.0]["clicks"] < of["click words", 30.0]["clicks"] < 10
    assert "bits" not in of["frames", 300.0]
    assert of["frames", 300.0]["fisher"]["trace"] > of["frames", 1.0]["fisher"]["trace"]
    assert of["click words", 1.0]["clicks"] < 1
    (table,) = information.information_tables(found.rows)
    assert table.lines()[4].startswith(
        "| frames | 300 | - | - | - | - | "
    )  # beyond the posterior: Fisher's ratios alone
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    found.pictures[""](tmp_path / "i.png")
    assert (tmp_path / "i.png").stat().st_size > 5000


def test_only_scenes_with_a_bright_background_start_in_a_basis():
    task = columns(200, 12, 2, light="field")
    row = UNPRINTED["nebula"].rows[0]
    options = recipe("nebula", row, 0.01)
    assert basis_of("nebula", task, options).shape[0] == 144
    assert basis_of("mmf-mnist", task, options) is None
    assert basis_of("nebula", task, dataclasses.replace(options, conserving=True)) is None


def test_more_photons_get_more_patterns_where_ten_would_saturate():
    options = {photons: equal.recipe("cells-3", photons) for photons in equal.PHOTONS}
    assert options[3.0].features == equal.FEATURES
    assert options[3.0].estimator == "exact"
    for photons in (10.0, 25.0):
        assert options[photons].features > equal.FEATURES
        assert options[photons].estimator in ("local", "ste")  # too many words to enumerate
        check_options(options[photons], load_profile("ideal"))
    assert all(option.photons < photons and option.clicks is None for photons, option in options.items())
