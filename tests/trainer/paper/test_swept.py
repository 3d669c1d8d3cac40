"""Figures from the trained rows: patterns or shots, light, dark counts, confusion, single shots; measured once, told as they are."""

import dataclasses
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
from pans.trainer.evaluate.accuracy import decision_shares, evaluate_exactly, light_of, sampled_shares
from pans.trainer.options import plain_options
from pans.trainer.paper import Asked, active, page_of, readouts, shots, swept, write_page
from pans.trainer.paper.tables import ACTIVE
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
    for module in (swept, readouts):
        monkeypatch.setattr(module, "load_task", lambda *_: columns())
    said = []
    return Asked("page", cache, report=said.append), said


def named(asked, name, **changes):
    return Asked(name, asked.cache, report=asked.report, **changes)


def test_every_printed_accuracy_has_its_spread():
    for row in (row for rows in ACTIVE.values() for row in rows):
        assert all(0 < value < 3 for value in row.simulation_std + row.experiment_std)


def test_points_meet_where_the_curves_of_more_patterns_reach():
    curves = {
        3: [(3, 50.0, 3.0), (6, 60.0, 0.3), (9, 62.0, 3.0), (15, 64.0, 0.3)],
        6: [(6, 65.0, 0.4), (12, 61.0, 0.04), (18, 66.0, 0.04), (30, 70.0, 0.1)],
    }
    found = shots.duels(curves)
    assert [(duel.shots, duel.exact) for duel in found] == [(2, True), (3, False), (5, False)]  # 3 x 1 lies outside
    assert found[0].ahead == pytest.approx(5.0)
    between = 65 + (61 - 65) * np.log(9 / 6) / np.log(2)
    assert found[1].ahead == pytest.approx(between - 62)
    assert found[0].error == pytest.approx(0.5)  # 0.3 and 0.4
    assert found[1].error == pytest.approx(np.hypot(3.0, 0.4 + (0.04 - 0.4) * np.log(9 / 6) / np.log(2)))
    assert [round(duel.ahead, 1) for duel in found] == [5.0, 0.7, -0.2]
    assert shots._won(found[:2]) == "1 / 1 / 0 (+0.7)"
    assert shots._won(found) == "1 / 2 / 0 (-0.2)"
    assert shots._won([found[2]._replace(error=0.05)]) == "**0 / 0 / 1 (-0.2)**"  # one comparison lost
    assert shots._won([]) is None


def test_shots_and_fig_3_stand_on_the_figures_of_the_table(asked, cache, tmp_path):
    question, said = asked
    page = shots.multi_shot_page(named(question, "multi-shot"))
    assert len(page.rows) == 8
    figures = json.loads((cache / "fashion-mnist-4.json").read_text())
    row = next(row for row in page.rows if (row["table"], row["features"], row["shots"]) == ("fashion-mnist", 4, 5))
    assert row["all"] == figures["all"]["5"]
    assert row["detections"] == 20
    assert row["paper"]["simulation"] == 68.38
    assert row["sha256"] == load_bundle(cache / "fashion-mnist-4.pans")[1]
    assert "fashion-mnist d_f=6 is not trained yet: pans reproduce fashion-mnist --rows 6" in said
    first = shots.fig_3_page(named(question, "fig-3"))
    assert [(row["table"], row["features"], row["shots"]) for row in first.rows] == [
        ("fashion-mnist", 4, 1),
        ("mnist", 4, 1),
    ]
    write_pages(tmp_path, {"multi-shot": page, "fig-3": first})


def write_pages(folder, pages):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    for name, page in pages.items():
        write_page(folder, name, page_of(name), page)
        assert {f"{name}.json", f"{name}.md"} <= {path.name for path in folder.iterdir()}
        for ending in page.pictures:
            assert (folder / f"{name}{ending}.png").stat().st_size > 5000


def test_rows_of_an_earlier_recipe_are_said_to_be(asked, monkeypatch):
    question, said = asked
    other = dataclasses.replace(active.recipe("fashion-mnist", ACTIVE["fashion-mnist"][1]), epochs=7)
    monkeypatch.setattr(active, "recipe", lambda *_: other)
    assert [row.features for row in active.trained_rows(question, "fashion-mnist")] == [4]
    assert "fashion-mnist d_f=4 was trained by an earlier recipe than today's" in said


def test_light_and_dark_counts_are_measured_once(asked, monkeypatch, tmp_path):
    question, said = asked
    monkeypatch.setattr(swept, "ETAS", (0.01, 0.1, 10**-0.5, 1.0, 10**0.5, 10.0, 100.0))
    monkeypatch.setattr(swept, "DARKS", (0.01, 10**-1.5, 0.1, 10**-0.5, 1.0))
    assert swept.eta_page(named(question, "eta", collect=True)).rows == []
    assert "eta: fashion-mnist, d_f = 4 is not measured yet: pans reproduce eta" in said
    eta, dark = swept.eta_page(named(question, "eta")), swept.dark_page(named(question, "dark-counts"))
    monkeypatch.setattr(swept, "measure_setting", None)
    assert swept.eta_page(named(question, "eta", collect=True)).rows == eta.rows
    rows = {(row["features"], row["setting"]): row for row in eta.rows}
    assert {row["sha256"] for row in eta.rows} == {load_bundle(question.cache / "fashion-mnist-4.pans")[1]}
    assert rows[4, 1.0]["all"] == pytest.approx(rows[4, "trained"]["all"])
    assert rows[4, 0.1]["all"]["photons_mean"] == pytest.approx(0.1 * rows[4, 1.0]["all"]["photons_mean"])
    told = {(row["features"], row["setting"]): row["all"] for row in dark.rows}
    assert told[4, 1.0]["accuracy_mean"] < told[4, "trained"]["accuracy_mean"]
    assert told[4, 1.0]["photons_mean"] == pytest.approx(told[4, "trained"]["photons_mean"])
    assert told[4, 1.0]["clicks_mean"] > told[4, 0.01]["clicks_mean"]
    write_pages(tmp_path, {"eta": eta, "dark-counts": dark})


def test_a_peak_far_from_the_trained_light_stands_in_the_table():
    def curve(features, best):
        def row(setting):
            value = {"accuracy_mean": 0.8 - 0.05 * abs(np.log10((1 if setting == "trained" else setting) / best))}
            value |= dict.fromkeys(
                ("accuracy_std", "accuracy_se_objects", "clicks_mean", "photons_mean", "illumination"), 0.0
            )
            return {"features": features, "setting": setting, "all": value, "first_200": value}

        return [row(eta) for eta in ("trained", 0.01, 0.1, 10**-0.5, 1.0, 10**0.5, 10.0, 100.0)]

    trained, changes, accuracy, clicks = swept.swept_tables("eta", curve(3, 1.0) + curve(4, 10.0))
    assert len(trained.rows) == 2
    assert changes.lines()[-2:] == [
        "| 3 | 1.00 | +0.00 | 1.00 | +0.00 | 1 to 1 | -5.0 | -2.5 | -2.5 | -5.0 | 70.0 | 70.0 |",
        "| 4 | 10.00 | +5.00 | 10.00 | +5.00 | 10 to 10 | -5.0 | -2.5 | +2.5 | +5.0 | 65.0 | 75.0 |",
    ]
    assert accuracy.lines()[4] == "| 0.01 | 70.0 / 70.0 | 65.0 / 65.0 |"
    assert clicks.lines()[2:4] == ["| eta | d_f = 3 | d_f = 4 |", "| --- | --- | --- |"]


def test_a_confusion_matrix_is_the_mean_share_of_every_class(cache):
    test = columns().test
    bundle, _ = load_bundle(cache / "fashion-mnist-4.pans")
    light = light_of(bundle, load_profile("ideal"), test.images)
    shares = decision_shares(bundle, light)
    matrix = swept.confusion(shares, test)
    assert matrix.sum(axis=1) == pytest.approx(np.ones(10))
    for label in range(10):
        assert matrix[label] == pytest.approx(shares[test.labels == label].mean(axis=0))
    assert evaluate_exactly(bundle, light, test.labels).accuracy_mean == pytest.approx(
        (matrix.diagonal() * np.bincount(test.labels)).sum() / len(test)
    )
    sampled = sampled_shares(bundle, light, trials=40, seed=3)
    error = np.sqrt((shares * (1 - shares)).sum(axis=0) / 40) / len(test)
    assert np.all(np.abs(sampled.mean(axis=0) - shares.mean(axis=0)) <= 5 * error + 1e-12)


def test_the_confusion_page_names_the_best_and_the_poorest_class(asked, tmp_path):
    question, _ = asked
    page = swept.confusion_page(named(question, "confusion"))
    assert [(row["table"], row["features"]) for row in page.rows] == [
        ("fashion-mnist", 4),
        ("mnist", 4),
    ]
    right = np.array([row["all"]["matrix"] for row in page.rows]).diagonal(axis1=1, axis2=2)
    assert right[:, 5].max() < 0.05 < np.delete(right, 5, axis=1).min()  # no click asks for class 5
    named_rows, shares, *_ = swept.confusion_tables(page.rows)
    assert f" | Sandal {100 * right[0, 5]:.0f} | " in named_rows.lines()[-1]
    assert shares.lines()[-1] == f"| 4 | {' | '.join(f'{100 * value:.1f}' for value in right[0])} |"
    write_pages(tmp_path, {"confusion": page})


def test_clicks_that_differ_are_counted_over_all_pairs():
    rng = np.random.default_rng(5)
    p, labels = rng.uniform(size=(12, 4)), np.arange(12) % 3
    found = readouts.differing(p, labels)
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
    assert readouts.neighbours_agree(apart, labels) == 1.0
    assert abs(readouts.neighbours_agree(rng.normal(size=(300, 2)), labels) - 1 / 3) < 5 * np.sqrt(2 / 9 / 300)


def test_single_shots_are_told_with_their_expectation(asked, monkeypatch, tmp_path):
    pytest.importorskip("sklearn", reason="needs the plot extra")
    question, said = asked
    monkeypatch.setattr(readouts, "SHOT_FEATURES", (4, 32))
    monkeypatch.setattr(readouts, "PIPELINE_FEATURES", 4)
    monkeypatch.setattr(readouts, "MAPPED_SHOTS", 120)
    page = readouts.single_shot_page(named(question, "single-shot"))
    (row,) = page.rows
    assert "fashion-mnist d_f=32 is not trained yet: pans reproduce fashion-mnist --rows 32" in said
    test = columns().test
    for label, one in enumerate(row["objects"]):
        assert test.labels[one["object"]] == label
        assert not (test.labels[: one["object"]] == label).any()  # the first of its class
        assert np.array(one["outputs"]).sum(axis=1) == pytest.approx(np.ones(readouts.TRIALS), abs=0.01)
        assert sum(one["expected"]) == pytest.approx(1, abs=1e-3)
        clicks = np.array([[int(bit) for bit in word] for word in one["words"]]).sum(axis=1).mean()
        assert abs(clicks - one["clicks"]) < 5 * np.sqrt(4 / 4 / readouts.TRIALS)
        share = np.bincount(one["decided"], minlength=10) / readouts.TRIALS
        assert np.abs(share - one["expected"]).max() < 5 * np.sqrt(1 / 4 / readouts.TRIALS)
    assert "images" not in row
    assert "places" not in row
    write_pages(tmp_path, {"single-shot": page})
