"""Figures from the trained rows: patterns or shots, light, dark counts, confusion, single shots; measured once, told as they are."""

import dataclasses
import importlib
import itertools
import json

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the train extra")

from bundles import made_bundle
from heads import onnx_chain

from pans.runtime.bundle.layers import Layer
from pans.runtime.bundle.model import load_bundle, write_bundle
from pans.runtime.instrument.profile import load_profile
from pans.trainer.commands import reproduce
from pans.trainer.evaluate.accuracy import decision_shares, evaluate_exactly, light_of, sampled_shares
from pans.trainer.options import plain_options
from pans.trainer.paper import active, robust, shots, single, trained_rows
from pans.trainer.paper import confusion as confusing
from pans.trainer.paper.page import Asked, write_page
from pans.trainer.paper_tables import ACTIVE, EXPERIMENT_SPREADS, SIMULATION_SPREADS
from pans.trainer.tasks.registry import Objects, Task

CLASSES = ("T-shirt/top", "Trouser", "Pullover", "Dress", "Coat", "Sandal", "Shirt", "Sneaker", "Bag", "Ankle boot")


def columns() -> Task:
    """A bright column names the class."""
    rng = np.random.default_rng(0)
    labels = rng.permutation(np.arange(600) % 10)
    images = rng.integers(0, 8, (600, 10, 10), dtype=np.uint8)
    images[np.arange(600), :, labels] = 250
    return Task(
        "columns", CLASSES, Objects(images[:300], labels[:300]), Objects(images[300:], labels[300:]), "0" * 64, ""
    )


def code_bundle():
    """Four patterns that ask for the four bits of the column's number; no class 5: its score is far too low."""
    bits = (np.arange(10) >> np.arange(4)[:, None]) & 1
    weights = 8.0 * bits - 4.0
    head = Layer(weights.astype(np.float32), (-4.0 * bits.sum(axis=0) - 99.0 * np.eye(10)[5]).astype(np.float32), False)
    patterns = np.broadcast_to(bits[:, None, :], (4, 10, 10)).reshape(4, 100).astype(np.int64)
    facts = {"name": "code", "task": "columns", "classes": CLASSES, "image_shape": (10, 10), "levels": 2}
    return made_bundle(**facts, pattern_levels=patterns, photons_per_level=0.3, head_onnx=onnx_chain((head,)))


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """One row of either table, measured in the way of the real ones."""
    pytest.importorskip("onnx", reason="needs the train extra")
    folder = tmp_path_factory.mktemp("cache")
    for table, row in (("fashion-mnist", ACTIVE["fashion-mnist"][1]), ("mnist", ACTIVE["mnist"][0])):
        bundle_path, figures_path = active.row_files(folder, table, row.features)
        write_bundle(code_bundle(), bundle_path)
        figures = active.measure_row(bundle_path, columns(), load_profile("ideal"))
        options = {"options": plain_options(active.recipe(table, row))}
        figures_path.write_text(json.dumps(figures | options))
    return folder


@pytest.fixture
def asked(cache, monkeypatch):
    for module in (robust, confusing, single):
        monkeypatch.setattr(module, "load_task", lambda *_: columns())
    said = []
    return Asked("page", cache, report=said.append), said


def named(asked, name, **changes):
    return Asked(name, asked.cache, report=asked.report, **changes)


def test_every_page_has_a_function():
    for where in reproduce.PAGES.values():
        module, _, function = where.partition(":")
        assert callable(getattr(importlib.import_module(f"pans.trainer.paper.{module}"), function)), where


def test_every_printed_accuracy_has_its_spread():
    for spreads in (SIMULATION_SPREADS, EXPERIMENT_SPREADS):
        for table, rows in ACTIVE.items():
            assert list(spreads[table]) == [row.features for row in rows]
            assert all(0 < value < 3 for values in spreads[table].values() for value in values)


def test_points_meet_where_the_curves_of_more_patterns_reach():
    curves = {3: [(3, 50.0), (6, 60.0), (9, 62.0), (15, 64.0)], 6: [(6, 65.0), (12, 61.0), (18, 66.0), (30, 70.0)]}
    found = shots.duels(curves)
    assert [(duel.shots, duel.exact) for duel in found] == [(2, True), (3, False), (5, False)]  # 3 x 1 lies outside
    assert found[0].ahead == pytest.approx(5.0)
    between = 65 + (61 - 65) * np.log(9 / 6) / np.log(2)
    assert found[1].ahead == pytest.approx(between - 62)
    lost = shots._exact_says("t", found, found[:2], [found[0]._replace(ahead=-1.0)])
    assert "3 x 2 beats 6 patterns by 1.00" in lost[3]
    assert "the claim fails: 3 x 5 beats 6 patterns by 0.25" in lost[1]
    assert "holds in all 2 comparisons" in lost[2]


def test_shots_and_fig_3_stand_on_the_figures_of_the_table(asked, cache, tmp_path):
    question, said = asked
    page = shots.multi_shot_page(named(question, "multi-shot"))
    assert len(page["rows"]) == 8
    figures = json.loads((cache / "fashion-mnist-4.json").read_text())
    row = next(row for row in page["rows"] if (row["table"], row["features"], row["shots"]) == ("fashion-mnist", 4, 5))
    assert row["all"] == figures["all"]["5"]
    assert row["detections"] == 20
    assert row["paper"]["simulation"] == 68.38
    assert "train by `pans reproduce fashion-mnist --rows 3 6 10 16 24 32`" in page["markdown"]
    assert "fashion-mnist d_f=6 is not trained yet: pans reproduce fashion-mnist --rows 6" in said
    first = shots.fig_3_page(named(question, "fig-3"))
    assert "10 of 378 pairs are ordered otherwise" in first["markdown"]  # of the paper's own values
    assert "4.8 at d_f = 9" not in first["markdown"]  # that row is not there
    write_pages(tmp_path, {"multi-shot": page, "fig-3": first})


def write_pages(folder, pages):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    for name, page in pages.items():
        write_page(folder, name, page)
        assert {f"{name}.json", f"{name}.md"} <= {path.name for path in folder.iterdir()}
        for ending in page["pictures"]:
            assert (folder / f"{name}{ending}.png").stat().st_size > 5000


def test_rows_of_an_earlier_recipe_are_said_to_be(asked, monkeypatch):
    question, _ = asked
    other = dataclasses.replace(active.recipe("fashion-mnist", ACTIVE["fashion-mnist"][1]), epochs=7)
    monkeypatch.setattr(active, "recipe", lambda *_: other)
    (first, *_) = trained_rows.trained_rows(question, "fashion-mnist")
    assert not first.current
    assert "earlier recipe than today's: d_f = 4" in "\n".join(trained_rows.rows_say("fashion-mnist", [first]))


def test_light_and_dark_counts_are_measured_once(asked, monkeypatch, tmp_path):
    question, said = asked
    monkeypatch.setattr(robust, "ETAS", (0.01, 0.1, 10**-0.5, 1.0, 10**0.5, 10.0, 100.0))
    monkeypatch.setattr(robust, "DARKS", (0.01, 10**-1.5, 0.1, 10**-0.5, 1.0))
    assert robust.eta_page(named(question, "eta", collect=True))["rows"] == []
    assert "eta: d_f = 4 is not measured yet: pans reproduce eta" in said
    eta, dark = robust.eta_page(named(question, "eta")), robust.dark_page(named(question, "dark-counts"))
    monkeypatch.setattr(robust, "measure_setting", None)
    assert robust.eta_page(named(question, "eta", collect=True))["markdown"] == eta["markdown"]
    rows = {(row["features"], row["setting"]): row for row in eta["rows"]}
    assert rows[4, 1.0]["all"] == pytest.approx(rows[4, "trained"]["all"])
    assert rows[4, 0.1]["all"]["photons_mean"] == pytest.approx(0.1 * rows[4, 1.0]["all"]["photons_mean"])
    told = {(row["features"], row["setting"]): row["all"] for row in dark["rows"]}
    assert told[4, 1.0]["accuracy_mean"] < told[4, "trained"]["accuracy_mean"]
    assert told[4, 1.0]["photons_mean"] == pytest.approx(told[4, "trained"]["photons_mean"])
    assert told[4, 1.0]["clicks_mean"] > told[4, 0.01]["clicks_mean"]
    write_pages(tmp_path, {"eta": eta, "dark-counts": dark})


def test_a_peak_far_from_the_trained_light_is_named():
    def curve(best):
        def row(setting):
            value = {"accuracy_mean": 0.8 - 0.05 * abs(np.log10(setting / best))}
            return {"setting": setting, "all": value, "first_200": value}

        return [
            row(1.0) | {"setting": "trained"},
            *(row(eta) for eta in (0.01, 0.1, 10**-0.5, 1.0, 10**0.5, 10.0, 100.0)),
        ]

    said = "\n".join(robust._eta_says({3: curve(1.0), 4: curve(10.0)}))
    assert "1 of 2 rows; **not at d_f = 4 (10)**" in said
    assert "A third of the light costs accuracy in 2 of 2 rows, ten times the light in 1." in said
    assert "At 3.2 times the light d_f = 4 still gain." in said


def test_a_confusion_matrix_is_the_mean_share_of_every_class(cache):
    test = columns().test
    bundle, _ = load_bundle(cache / "fashion-mnist-4.pans")
    light = light_of(bundle, load_profile("ideal"), test.images)
    shares = decision_shares(bundle, light)
    matrix = confusing.confusion(shares, test)
    assert matrix.sum(axis=1) == pytest.approx(np.ones(10))
    for label in range(10):
        assert matrix[label] == pytest.approx(shares[test.labels == label].mean(axis=0))
    assert evaluate_exactly(bundle, light, test.labels).accuracy_mean == pytest.approx(
        (matrix.diagonal() * np.bincount(test.labels)).sum() / len(test)
    )
    sampled = sampled_shares(bundle, light, trials=40, seed=3)
    error = np.sqrt((shares * (1 - shares)).sum(axis=0) / 40) / len(test)
    assert np.all(np.abs(sampled.mean(axis=0) - shares.mean(axis=0)) <= 5 * error + 1e-12)


def test_the_confusion_page_holds_the_papers_words_against_the_matrices(asked, tmp_path):
    question, _ = asked
    page = confusing.confusion_page(named(question, "confusion"))
    assert [(row["table"], row["features"]) for row in page["rows"]] == [
        ("fashion-mnist", 4),
        ("mnist", 4),
    ]
    right = np.array([row["all"]["matrix"] for row in page["rows"]]).diagonal(axis1=1, axis2=2)
    assert right[:, 5].max() < confusing.GIVEN_UP < np.delete(right, 5, axis=1).min()
    assert "Few patterns give whole classes up (right below 5 %): Sandal at d_f = 4." in page["markdown"]
    assert f"the best class in {sum(values.argmax() == 1 for values in right[:1])} of 1 rows" in page["markdown"]
    write_pages(tmp_path, {"confusion": page})


def test_clicks_that_differ_are_counted_over_all_pairs():
    rng = np.random.default_rng(5)
    p, labels = rng.uniform(size=(12, 4)), np.arange(12) % 3
    found = single.differing(p, labels)
    pairs = {(i, j): float((p[i] * (1 - p[j]) + p[j] * (1 - p[i])).sum()) for i in range(12) for j in range(12)}
    assert found["object"] == pytest.approx(np.mean([pairs[i, i] for i in range(12)]))
    mates = [pair for pair in itertools.permutations(range(12), 2) if labels[pair[0]] == labels[pair[1]]]
    assert found["class"] == pytest.approx(np.mean([pairs[pair] for pair in mates]))
    others = [pair for pair in pairs if labels[pair[0]] != labels[pair[1]]]
    assert found["others"] == pytest.approx(np.mean([pairs[pair] for pair in others]))
    assert found["uncertain"] == np.mean((p > 0.1) & (p < 0.9))


def test_neighbours_tell_classes_that_lie_apart_and_no_others():
    rng = np.random.default_rng(6)
    labels = np.arange(300) % 3
    apart = rng.normal(size=(300, 2)) + 20 * np.eye(3)[labels][:, :2]
    assert single.neighbours_right(apart, labels) == 1.0
    assert abs(single.neighbours_right(rng.normal(size=(300, 2)), labels) - 1 / 3) < 5 * np.sqrt(2 / 9 / 300)


def test_single_shots_are_told_with_their_expectation(asked, monkeypatch, tmp_path):
    question, _ = asked
    monkeypatch.setattr(single, "FEATURES", (4, 32))
    monkeypatch.setattr(single, "PIPELINE_FEATURES", 4)
    monkeypatch.setattr(single, "MAPPED_OBJECTS", 120)
    page = single.single_shot_page(named(question, "single-shot"))
    (row,) = page["rows"]
    assert "Not here: d_f = 32" in page["markdown"]
    test = columns().test
    for label, one in enumerate(row["objects"]):
        assert test.labels[one["object"]] == label
        assert not (test.labels[: one["object"]] == label).any()  # the first of its class
        assert np.array(one["outputs"]).sum(axis=1) == pytest.approx(np.ones(single.TRIALS), abs=0.01)
        assert sum(one["expected"]) == pytest.approx(1, abs=1e-3)
        clicks = np.array([[int(bit) for bit in word] for word in one["words"]]).sum(axis=1).mean()
        assert abs(clicks - one["clicks"]) < 5 * np.sqrt(4 / 4 / single.TRIALS)
        share = np.bincount(one["decided"], minlength=10) / single.TRIALS
        assert np.abs(share - one["expected"]).max() < 5 * np.sqrt(1 / 4 / single.TRIALS)
    assert "images" not in row
    assert "places" not in row
    write_pages(tmp_path, {"single-shot": page})
