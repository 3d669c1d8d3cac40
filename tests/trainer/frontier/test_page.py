"""The frontier's rows and tables: means, margins and budgets against figures by hand, rows kept and missing, the page as it stands."""

# ruff: noqa: E402  (what follows needs torch)
from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tree import ROOT

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.cli import main
from pans.runtime.errors import UsageError
from pans.trainer.baselines import rows as baseline_rows
from pans.trainer.commands.baseline import BASELINE
from pans.trainer.commands.reproduce import REPRODUCE
from pans.trainer.commands.train import TRAIN
from pans.trainer.frontier import PAGES, fixed, page, summary, ways
from pans.trainer.frontier.automata import bundle_path
from pans.trainer.paper import Asked
from pans.trainer.paper.page import BEGIN, END, Row, generated
from pans.trainer.paper.tables import ACTIVE, FIRST
from pans.trainer.tasks.registry import Objects, Task

COMMANDS = {"train": TRAIN, "baseline": BASELINE, "reproduce": REPRODUCE}
RESULTS = ROOT / "docs" / "results"


def made(
    way: str, level: float, photons: float, accuracy: float, seed: int = 0, clicks: float = 1.0, task: str = "mnist"
) -> Row:
    figures = {"accuracy_mean": accuracy, "accuracy_se_objects": 0.003, "clicks_mean": clicks, "photons_mean": photons}
    figures |= {"illumination": 10.0, "objects": 10_000}
    shared = {"task": task, "way": way, "level": level, "seed": seed, "exposures": 5}
    return shared | {"all": figures, FIRST: figures | {"objects": 200, "accuracy_mean": accuracy + 0.01}}


def test_seeds_are_put_together_with_their_standard_error():
    rows = [made(ways.AUTOMATON, 10, 9.9, a, seed) for seed, a in enumerate((0.80, 0.82, 0.84))]
    (found,) = summary.by_point(rows)
    assert found["seeds"] == 3
    assert found["all"]["accuracy_mean"] == pytest.approx(0.82)
    assert found["all"]["se_seeds"] == pytest.approx(0.02 / math.sqrt(3))
    assert found[FIRST]["accuracy_mean"] == pytest.approx(0.83)
    assert summary.error_of(found) == pytest.approx(math.hypot(0.02 / math.sqrt(3), 0.003))
    (one,) = summary.by_point(rows[:1])
    assert one["all"]["se_seeds"] is None
    assert summary.error_of(one) == 0.003


def test_margins_are_over_direct_imaging_at_the_same_photons():
    rows = [made(ways.DIRECT, 4, 4.0, 0.4), made(ways.DIRECT, 16, 16.0, 0.6), made(ways.AUTOMATON, 8, 8.0, 0.75)]
    rows += [made(ways.AUTOMATON, 40, 40.0, 0.9), made(ways.MASKS, 4, 4.0, 0.5)]  # 40 is beyond direct imaging's levels
    rows += [made(ways.DIRECT, 8, 8.0, 0.1, task="fashion-mnist")]
    rows += [made(ways.STOPPING, 6, 6.0, 0.6), made(ways.STOPPING, 10, 32 / 3, 0.8)]  # not for 4 photons
    found = {row["way"]: row for row in summary.margins(summary.by_point(rows))}
    assert set(found) == {ways.AUTOMATON, ways.MASKS}
    assert found[ways.AUTOMATON]["beside"]["accuracy_mean"] == pytest.approx(0.5)  # half way in the logarithm
    assert found[ways.AUTOMATON]["ahead"] == pytest.approx(0.25)
    assert found[ways.AUTOMATON]["error"] == pytest.approx(0.003 * math.sqrt(2))
    assert found[ways.MASKS]["ahead"] == pytest.approx(0.1)
    assert found[ways.AUTOMATON]["sure"]["ahead"] == pytest.approx(0.05)
    assert "sure" not in found[ways.MASKS]
    (best,) = summary.largest(list(found.values()))
    assert (best["way"], best["task"]) == (ways.AUTOMATON, "mnist")


def test_automata_have_a_command_for_every_level_and_other_ways_one():
    rows = [made(way, n, n, 0.5) | {"command": f"{way} {n}"} for way in (ways.AUTOMATON, ways.DIRECT) for n in (4, 10)]
    found = [
        row["command"] for row in summary.commands([*rows, made(ways.AUTOMATON, 4, 4, 0.6, 1) | {"command": "seed 1"}])
    ]
    assert found == [f"{ways.AUTOMATON} 4", f"{ways.AUTOMATON} 10", f"{ways.DIRECT} 4"]


def test_click_budgets_take_the_automaton_that_spends_most_within_them_and_not_the_best():
    rows = list(fixed.paper_rows())
    rows += [made(ways.AUTOMATON, 4, 4.0, 0.99, clicks=2.0), made(ways.AUTOMATON, 6, 6.0, 0.7, clicks=2.1)]
    rows += [made(ways.HELD_TO_CLICKS, 9, 9.0, 0.8, clicks=4.9)]
    found = {(row["task"], row["features"]): row for row in summary.click_budgets(summary.by_point(rows))}
    assert len(found) == 13
    assert "ours" not in found["fashion-mnist", 3]
    assert found["mnist", 4]["ours"]["level"] == 6  # 2.164 clicks in the paper
    assert found["mnist", 9]["ours"]["way"] == ways.HELD_TO_CLICKS
    assert found["mnist", 9]["ahead"] == pytest.approx(0.8 - 0.8123)
    rows += [made(ways.ON, 6, 6.0, 0.75, clicks=1.9)]  # of the one of 6, which it takes the place of
    found = {(row["task"], row["features"]): row for row in summary.click_budgets(summary.by_point(rows))}
    assert (found["mnist", 4]["ours"]["way"], found["mnist", 4]["ours"]["level"]) == (ways.AUTOMATON, 4)
    rows += [made(ways.LARGER, 4, 4.0, 0.8, clicks=1.5), made(ways.LARGER_ON[0], 4, 4.0, 0.8, clicks=1.4)]
    found = {(row["task"], row["features"]): row for row in summary.click_budgets(summary.by_point(rows))}
    assert (found["mnist", 4]["ours"]["way"], found["mnist", 4]["ours"]["level"]) == (ways.ON, 6)


def test_no_photons_give_those_clicks_with_less_than_the_bound():
    rng = np.random.default_rng(0)
    for _ in range(200):
        light = rng.gamma(0.7, 2.0, 10)
        clicks = float(-np.expm1(-light).sum())
        assert light.sum() >= fixed.photons_at_least(clicks, 10) - 1e-12
    assert fixed.photons_at_least(float(-10 * np.expm1(-0.4)), 10) == pytest.approx(4.0)  # equal light reaches it
    with pytest.raises(ValueError, match="allowed: below 10"):
        fixed.photons_at_least(10.0, 10)


def test_rows_of_other_pages_are_taken_from_their_json_and_not_measured_again(tmp_path):
    rows = fixed.fixed_rows(RESULTS)
    table = json.loads((RESULTS / "fashion-mnist.json").read_text())["rows"]
    mine = [row for row in rows if (row["task"], row["way"]) == ("fashion-mnist", fixed.FIXED)]
    assert len(mine) == sum(1 + len(row["other_seeds"]) for row in table)
    ten = next(row for row in table if row["features"] == 10)
    found = next(row for row in mine if row["level"] == 10 and row["seed"] == 0)
    assert found["all"] == ten["all"]["1"]
    assert any(row["way"] == fixed.FIXED_LIGHT for row in rows)
    for name in ways.TASKS:
        for way in (fixed.FIXED_BUDGET, fixed.FIXED_SENT):
            of_way = [row for row in rows if (row["task"], row["way"]) == (name, way)]
            assert sorted((row["level"], row["seed"]) for row in of_way) == [
                (level, seed) for level in (7.0, 17.0, 33.0) for seed in range(5)
            ]
            if way == fixed.FIXED_BUDGET:
                assert all(0.9 < row["all"]["photons_mean"] / row["level"] < 1.0 for row in of_way)
    assert fixed.fixed_rows(tmp_path) == fixed.fixed_rows(None) == []
    (tmp_path / "mnist.json").write_text("[]")
    with pytest.raises(UsageError, match="is no page of results"):
        fixed.fixed_rows(tmp_path)


@pytest.fixture(scope="module")
def halves() -> Task:
    rng = np.random.default_rng(8)
    labels = rng.integers(0, 2, 700)
    images = (rng.integers(0, 60, (700, 6, 6)) + 190 * (np.arange(6)[None, None] // 3 == labels[:, None, None])).astype(
        np.uint8
    )
    parts = [Objects(images[at], labels[at]) for at in (slice(400), slice(400, 700))]
    return Task("halves", ("left", "right"), *parts, "0" * 64, "made here")


def small(point: ways.Point) -> ways.Point:
    kept = dict(point.recipe)
    return replace(point, recipe=tuple((kept | ({"features": 4, "epochs": 1} if kept.get("features") else {})).items()))


@pytest.mark.parametrize("way", [ways.DIRECT, ways.STOPPING, ways.MASKS, ways.HADAMARD])
def test_a_row_is_made_once_for_each_recipe_and_seed(way, halves, tmp_path, monkeypatch):
    monkeypatch.setattr(ways, "STOPPING_PHOTONS", (1.5, 1e6))
    asked = Asked("frontier", tmp_path, report=lambda _: None)
    point = small(replace(next(p for p in ways.points() if p.way == way), level=1.5))
    assert ways.row_of(asked, point, 0, None) is None
    row = ways.row_of(asked, point, 0, halves)
    assert row is not None
    assert row["all"]["photons_mean"] == pytest.approx(1.5, rel=0.35 if way == ways.STOPPING else 1e-3)
    assert {"accuracy_mean", "clicks_mean", "illumination"} <= row[FIRST].keys()
    assert row["exposures"] == {ways.MASKS: 4, ways.HADAMARD: 8}.get(way, 1)

    def never(*_args, **_named):
        raise AssertionError("measured again")

    with monkeypatch.context() as patch:
        patch.setattr(ways, "baseline_rows", never)
        assert ways.row_of(asked, point, 0, None) == row == ways.row_of(asked, point, 0, halves)
        assert ways.row_of(asked, point, 1, None) is None
        other = replace(point, recipe=tuple((dict(point.recipe) | {"dark": 0.5}).items()))
        assert ways.row_of(asked, other, 0, None) is None
        if way == ways.STOPPING:  # a level that cannot be reached is no row, and not tried again
            beyond = replace(point, level=1e6)
            assert ways.row_of(asked, beyond, 0, halves) is None
            assert ways.beyond_reach(asked, beyond, 0)
            assert not ways.beyond_reach(asked, point, 0)
            assert not ways.beyond_reach(asked, beyond, 1)
    assert baseline_rows.baseline_rows is ways.baseline_rows


def test_points_differ_in_the_names_of_their_files_and_cover_every_budget():
    found = list(ways.points())
    assert len({point.stem for point in found}) == len(found)
    for name in ways.TASKS:
        clicks = [point.level for point in found if (point.task, point.way) == (name, ways.HELD_TO_CLICKS)]
        assert set(clicks) <= {row.clicks for row in ACTIVE[name]}
        photons = [point.level for point in found if (point.task, point.way) == (name, ways.AUTOMATON)]
        assert photons == list(ways.AUTOMATA_OF[name])


def goes_on_from(point: ways.Point) -> list[ways.Point]:
    return [] if point.start is None else [point.start, *goes_on_from(point.start)]


def test_every_command_is_one_that_the_parser_takes():
    for point in ways.points():
        words = point.command(3).split()[1:]
        parser = argparse.ArgumentParser()
        COMMANDS[words[0]].configure(parser)
        args = parser.parse_args(words[1:])
        if words[0] == "reproduce":
            continue
        assert args.seed == point.training_seed(3) == 3 + len(goes_on_from(point))
        if point.start is not None:  # the bundle of a point of its own
            assert args.start == bundle_path(Path(), point.start.stem, 3)
            assert point.start in ways.points()
        wanted = args.photons if words[0] == "train" else args.photons[0]
        assert 0.92 * point.level <= (wanted or args.clicks) <= point.level


def test_a_page_of_nothing_measured_says_so_and_has_the_papers_rows(tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    words = ["reproduce", "frontier", "--collect", "--seeds", "3", "--cache", str(tmp_path / "cache"), "--json"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert sum(row["way"] == fixed.PAPER for row in rows) == 13
    lacking = [row for row in rows if "missing" in row]
    assert {(row["task"], row["way"]) for row in lacking} == {(p.task, p.way) for p in ways.points()}
    text = (tmp_path / "out" / "frontier.md").read_text()
    assert "## Not measured yet" in text
    assert "| mnist | automaton | 10: 0 of 3, 18: 0 of 3, 40: 0 of 3 |" in text
    assert (tmp_path / "out" / "frontier.png").stat().st_size > 10_000
    (tmp_path / "out" / "frontier.md").write_text(text.replace("| 54.46 |", "| 99.99 |"))
    assert main(["reproduce", "frontier", "--from-json", "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "frontier.md").read_text() == text
    assert main(["reproduce", "frontier", "--seeds", "0"]) == 2
    assert "--seeds is 0, allowed: 1 to 100" in capsys.readouterr().err


def test_what_is_measured_stands_in_the_tables(tmp_path):
    rows = [*fixed.paper_rows(), *(made(ways.DIRECT, n, n, a) for n, a in ((2.0, 0.3), (40.0, 0.8)))]
    rows += [made(ways.AUTOMATON, 10, 9.9, 0.80, 0, 4.0), made(ways.AUTOMATON, 10, 9.7, 0.82, 1, 4.0)]
    tables = {table.heading: table for table in page.frontier_tables(rows)}
    lines = tables["## MNIST, accuracy %"].lines()
    assert any(
        line.startswith("| automaton | 10 | 2 | 5.0 | 81.00 | 1.00 | 0.30 | 82.00 | 1.00 | 4.00 | 9.80 | 10 |")
        for line in lines
    )
    assert "## Not measured yet" not in tables
    assert (
        page._missing(Asked("frontier", tmp_path, seeds=1, report=lambda _: None), {(p, 0): {} for p in ways.points()})
        == []
    )


def test_the_page_is_that_of_its_json():
    text = (RESULTS / "frontier.md").read_text(encoding="utf-8")
    assert generated(RESULTS, "frontier", PAGES["frontier"]) in text
    assert text.startswith(f"# {PAGES['frontier'].title}\n")
    by_hand = text.partition(BEGIN)[0] + text.partition(END)[2]
    assert "\n| " not in by_hand
