"""Rows of automata: trained once, found again as bundles, and never another recipe's."""

# ruff: noqa: E402  (what follows needs torch)
from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.bundle.model import load_bundle
from pans.trainer.adaptive import train as adaptive_train
from pans.trainer.adaptive.options import AutomatonOptions
from pans.trainer.frontier import automata, ways
from pans.trainer.paper import Asked
from pans.trainer.paper.tables import FIRST
from pans.trainer.tasks.registry import Objects, Task

BUDGET = {"photons": 2.0}


@pytest.fixture(scope="module")
def halves() -> Task:
    rng = np.random.default_rng(8)
    labels = rng.integers(0, 2, 1500)
    bright = 190 * (np.arange(4)[None, None] // 2 == labels[:, None, None])
    images = (rng.integers(0, 60, (1500, 4, 4)) + bright).astype(np.uint8)
    parts = [Objects(images[at], labels[at]) for at in (slice(1200), slice(1200, 1500))]
    return Task("halves", ("left", "right"), *parts, "0" * 64, "made here")


@pytest.fixture
def quick(monkeypatch):
    """The recipe with few exposures and states, so that a training takes a second."""

    def of(**given):
        size = {"exposures": 4, "states": 3, "grow_epochs": 1, "tune_epochs": 1, "epochs": 1, "reroutes": 0}
        return AutomatonOptions(**(size | given))

    monkeypatch.setattr("pans.trainer.adaptive.options.AutomatonOptions", of)  # where recipes are made
    return of


def test_an_automaton_is_trained_once_and_measured_from_its_bundle(halves, tmp_path, quick, monkeypatch):
    asked = Asked("frontier", tmp_path, report=lambda _: None)
    path = automata.bundle_path(tmp_path, "frontier-halves-automaton-2", 0)
    row = automata.automaton_row(asked, path, halves, BUDGET, seed=0)
    bundle, digest = load_bundle(path)
    assert row["sha256"] == digest
    assert row["exposures"] == row["all"]["exposures_mean"] <= 4
    assert row["all"]["accuracy_mean"] == pytest.approx(bundle.expected["accuracy"], abs=1e-6)
    assert row["all"]["accuracy_mean"] > 0.6
    assert row[FIRST]["objects"] == 200
    assert bundle.provenance["command"] == "pans reproduce frontier"
    assert [path.suffix for path in tmp_path.iterdir()] == [".pans"]  # no checkpoint is left

    def never(*_args, **_named):
        raise AssertionError("trained again")

    monkeypatch.setattr(adaptive_train, "train_automaton", never)
    again = automata.automaton_row(asked, path, halves, BUDGET, seed=0)
    for part in ("all", FIRST):  # measured anew, equal but for the last digits
        assert again.pop(part) == pytest.approx(row[part], rel=1e-12)
    assert again == {name: value for name, value in row.items() if name not in ("all", FIRST)}
    assert row["training_seconds"] > 0
    point = ways.Point("halves", ways.AUTOMATON, 2.0, tuple(BUDGET.items()))
    assert point.stem == "frontier-halves-automaton-2"
    kept = ways.row_of(asked, point, 0, halves)
    assert kept == ways.row_of(asked, point, 0, None)
    assert kept is not None
    assert (kept["all"]["accuracy_mean"], kept["exposures"]) == (row["all"]["accuracy_mean"], row["exposures"])
    with monkeypatch.context() as patch:  # another default of the trainer: another recipe, and no row of it
        patch.setattr("pans.trainer.adaptive.options.AutomatonOptions", lambda **given: quick(**given, half=5.0))
        assert ways.row_of(asked, point, 0, None) is None
    file = tmp_path / f"{point.stem}-seed0.json"
    older = json.loads(file.read_text())
    del older["made_with"]["patterns"]  # a row from before there was that option: it was not used
    file.write_text(json.dumps(older))
    assert ways.row_of(asked, point, 0, None) == kept
    assert ways.row_of(asked, replace(point, recipe=(*point.recipe, ("patterns", 3))), 0, None) is None
    with pytest.raises(AssertionError, match="trained again"):  # another seed, another recipe
        automata.automaton_row(asked, path, halves, BUDGET, seed=1)
    with pytest.raises(AssertionError, match="trained again"):
        automata.automaton_row(asked, path, halves, {"photons": 3.0}, seed=0)


def test_an_automaton_is_trained_on_from_the_one_in_the_cache(halves, tmp_path, quick, monkeypatch):
    asked = Asked("frontier", tmp_path, report=lambda _: None)
    grown = ways.Point("halves", ways.AUTOMATON, 2.0, tuple(BUDGET.items()))
    on = ways.Point("halves", ways.ON, 2.0, (("photons", 1.5), ("epochs", 2)), grown)
    row = ways.row_of(asked, on, 0, halves)
    assert row is not None
    start, path = (automata.bundle_path(tmp_path, point.stem, 0) for point in (grown, on))
    first, trained_on = load_bundle(start)[1], load_bundle(path)[0].provenance["options"]
    assert (trained_on["start"], trained_on["seed"], trained_on["epochs"]) == (first, 1, 2)
    assert load_bundle(start)[0].provenance["options"]["seed"] == 0
    assert row["all"]["photons_mean"] == pytest.approx(1.5, rel=0.1)
    assert row == ways.row_of(asked, on, 0, None)
    other = replace(grown, recipe=(*grown.recipe, ("half", 5.0)))  # trained on from another one: another row
    assert ways.row_of(asked, replace(on, start=other), 0, None) is None
    assert ways.row_of(asked, on, 1, None) is None

    def never(*_args, **_named):
        raise AssertionError("trained again")

    monkeypatch.setattr(adaptive_train, "train_automaton", never)
    (tmp_path / f"{on.stem}-seed0.json").unlink()
    assert ways.row_of(asked, on, 0, halves)["all"] == pytest.approx(
        row["all"], rel=1e-12
    )  # measured again, from its bundle
    start.write_bytes(automata.bundle_path(tmp_path, on.stem, 0).read_bytes())  # not what it began with
    (tmp_path / f"{on.stem}-seed0.json").unlink()
    with pytest.raises(AssertionError, match="trained again"):
        ways.row_of(asked, on, 0, halves)


def test_a_default_that_was_spelt_out_is_the_same_recipe():
    wanted = asdict(automata.automaton_recipe("mnist", {"photons": 6.0}, seed=0))
    assert wanted["tune_epochs"] is None
    assert automata.made_so(wanted, wanted | {"tune_epochs": 3})
    assert automata.made_so(wanted | {"tune_epochs": 3}, wanted)
    assert not automata.made_so(wanted, wanted | {"tune_epochs": 2})
    assert not automata.made_so(wanted | {"tune_epochs": 0}, wanted)


def test_a_bundle_that_was_not_made_for_a_page_is_not_replaced(halves, tmp_path, quick):
    asked = Asked("frontier", tmp_path, report=lambda _: None)
    path = automata.bundle_path(tmp_path, "mine", 0)
    path.write_bytes(b"something of somebody")
    with pytest.raises(Exception, match=r"mine-seed0\.pans"):
        automata.automaton_row(asked, path, halves, BUDGET, seed=0)
    assert path.read_bytes() == b"something of somebody"
