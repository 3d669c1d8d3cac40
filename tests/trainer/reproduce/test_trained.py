"""Pages of the trained rows: patterns or shots, light, dark counts, confusion, single shots; measured once and collected again."""

import itertools
import json

import numpy as np
import pytest
from bundles import made_bundle
from heads import onnx_chain

from pans.bundle.heads.layers import Layer
from pans.bundle.sensor.bundle import load_bundle, write_bundle
from pans.instrument.profile import load_profile
from pans_trainer.evaluate.accuracy import decision_shares, evaluate_exactly, light_of
from pans_trainer.options import plain_options
from pans_trainer.reproduce import active, trained
from pans_trainer.reproduce.page import Asked, of_table, page_of, write_page
from pans_trainer.reproduce.printed import ACTIVE
from pans_trainer.tasks.registry import Objects, Task

CLASSES = ("T-shirt/top", "Trouser", "Pullover", "Dress", "Coat", "Sandal", "Shirt", "Sneaker", "Bag", "Ankle boot")


def columns() -> Task:
    """A bright column names the class."""
    rng = np.random.default_rng(0)
    labels = rng.permutation(np.arange(600) % 10)
    images = rng.integers(0, 8, (600, 10, 10), dtype=np.uint8)
    images[np.arange(600), :, labels] = 250
    parts = [Objects(images[at], labels[at]) for at in (slice(300), slice(300, 600))]
    return Task("columns", CLASSES, *parts, "0" * 64, "")


def code_bundle():
    """Four patterns that ask for the four bits of the column's number; no class 5: its score is far too low."""
    bits = (np.arange(10) >> np.arange(4)[:, None]) & 1
    bias = -4.0 * bits.sum(axis=0) - 99.0 * np.eye(10)[5]
    head = Layer((8.0 * bits - 4.0).astype(np.float32), bias.astype(np.float32), False)
    patterns = np.broadcast_to(bits[:, None, :], (4, 10, 10)).reshape(4, 100).astype(np.int64)
    facts = {"name": "code", "task": "columns", "classes": CLASSES, "image_shape": (10, 10), "levels": 2}
    return made_bundle(**facts, pattern_levels=patterns, photons_per_level=0.3, head_onnx=onnx_chain((head,)))


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """One row of either table."""
    folder = tmp_path_factory.mktemp("cache")
    for name in ACTIVE:
        row = next(row for row in ACTIVE[name] if row.features == 4)
        path = active.row_path(folder, name, 4)
        write_bundle(code_bundle(), path.with_suffix(".pans"))
        figures = active.measure_row(load_bundle(path.with_suffix(".pans"))[0], columns())
        path.write_text(json.dumps(figures | {"options": plain_options(active.options_of(name, row))}))
    return folder


@pytest.fixture
def asked(cache, monkeypatch):
    monkeypatch.setattr(trained, "load_task", lambda *_: columns())
    said = []
    return lambda name, **how: Asked(name, cache, report=said.append, **how), said


def write(folder, name, made):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    write_page(folder, page_of(name), made)
    assert set(page_of(name).drawn(made).pictures) == {*page_of(name).pictures}
    assert all((folder / f"{name}{ending}.png").stat().st_size > 5000 for ending in page_of(name).drawn(made).pictures)


def test_points_meet_where_the_curves_of_more_patterns_reach():
    def point(features, shots, value, spent):
        shared = {"set": "mnist", "features": features, "shots": shots, "detections": spent, "photons": spent}
        figures = {key: value for key in ("value", "first_200", "simulation")}
        return shared | figures | {"clicks": spent, "paper_clicks": spent, "error_objects": 0.3, "first_error": 0.3}

    few = [point(3, k, v, 3 * k) for k, v in ((1, 50.0), (2, 60.0), (3, 62.0), (5, 64.0))]
    many = [point(6, k, v, 6 * k) for k, v in ((1, 65.0), (2, 61.0), (3, 66.0), (5, 60.0))]
    rows = trained.duels(few + many)
    assert [(row["whose"], row["equal"]) for row in rows][-1] == ("ours, all", "photons")
    ours = rows[-1]
    assert ours["duels"] == 3  # 3 x 1 lies outside
    # 65 against 60; half way (in the logarithm) from 65 to 61 against 62; between 61 and 66 against 64
    between = 61 + 5 * np.log(15 / 12) / np.log(18 / 12) - 64
    assert ours["least"] == pytest.approx(min(65 + (61 - 65) * np.log2(1.5) - 62, between))
    assert (ours["above"], ours["level"], ours["below"]) == (1, 2, 0)


def test_shots_and_fig_3_stand_on_the_figures_of_the_table(asked, cache, tmp_path):
    question, said = asked
    first = trained.fig_3_page(question("fig-3"))
    assert [(row["set"], row["features"]) for row in first.rows] == [("fashion-mnist", 4), ("mnist", 4)]
    figures = json.loads((cache / "fashion-mnist-4.json").read_text())
    assert first.rows[0]["value"] == pytest.approx(100 * figures["all"]["1"]["accuracy_mean"])
    assert (first.rows[0]["simulation"], first.rows[0]["experiment_std"]) == (65.11, 2.03)
    assert "fashion-mnist d_f=6 is not trained yet: pans reproduce fashion-mnist --rows 6" in said
    write(tmp_path, "fig-3", first)
    shots = trained.multi_shot_page(question("multi-shot"))
    assert {row["duels"] for row in of_table(shots.rows, "duels")} == {0}  # one number of patterns alone
    write(tmp_path, "multi-shot", shots)


@pytest.mark.parametrize("name", ["eta", "dark-counts"])
def test_light_and_dark_counts_are_measured_once(asked, monkeypatch, tmp_path, name):
    question, said = asked
    assert trained.swept_page(question(name, collect=True)).rows == []
    assert f"{name}: {name}-fashion-mnist-4 is not measured yet" in said
    made = trained.swept_page(question(name))
    monkeypatch.setattr(trained, "judged", None)
    assert trained.swept_page(question(name, collect=True)).rows == made.rows
    (base,), rows = of_table(made.rows, "trained"), {row["setting"]: row for row in of_table(made.rows, "swept")}
    if name == "eta":
        assert rows[1.0]["value"] == pytest.approx(base["value"])
        assert rows[0.1]["photons"] == pytest.approx(0.1 * base["photons"])
    else:
        assert rows[1.0]["value"] < base["value"]
        assert rows[1.0]["photons"] == pytest.approx(base["photons"])
        assert rows[1.0]["clicks"] > rows[0.01]["clicks"]
    assert sum(row["shown"] for row in rows.values()) == (5 if name == "eta" else 4)
    write(tmp_path, name, made)


def test_what_light_and_dark_counts_change_is_read_off_the_curve():
    etas = [{"setting": eta, "value": 80 - 5 * abs(np.log10(eta / 10))} for eta in trained.SETTINGS["eta"]]
    found = trained.over_light(etas)
    assert (found["best"], found["gain"], found["at_tenth"]) == pytest.approx((10.0, 5.0, -5.0))
    assert (found["low"], found["high"]) == pytest.approx((10**0.75, 10**1.25))
    darks = [{"setting": dark, "value": 80 - 10 * dark} for dark in trained.SETTINGS["dark"]]
    assert trained.over_dark({"value": 80.0}, darks) == pytest.approx({"change": -1.0, "below": -0.9, "above": -9.0})


def test_a_confusion_matrix_is_the_mean_share_of_every_class(cache):
    test = columns().test
    bundle, _ = load_bundle(cache / "fashion-mnist-4.pans")
    light = light_of(bundle, load_profile("ideal"), test.images)
    shares = decision_shares(bundle, light)
    matrix = trained.confusion(shares, test)
    assert matrix.sum(axis=1) == pytest.approx(np.ones(10))
    assert matrix[3] == pytest.approx(shares[test.labels == 3].mean(axis=0))
    right = (matrix.diagonal() * np.bincount(test.labels)).sum() / len(test)
    assert evaluate_exactly(bundle, light, test.labels).accuracy_mean == pytest.approx(right)


def test_the_confusion_page_names_the_best_and_the_poorest_class(asked, tmp_path):
    question, _ = asked
    made = trained.confusion_page(question("confusion"))
    assert [row["set"] for row in made.rows] == ["fashion-mnist", "mnist"]
    assert made.rows[0]["poorest"].startswith("Sandal ")  # no click asks for class 5
    matrix = np.array([[0.9, 0.1], [0.4, 0.6]])
    found = trained.named_confusions(matrix, ["a", "b"])
    assert (found["best"], found["poorest"]) == ("a 90", "b 60")
    assert found["confused"].startswith("b → a 40, a → b 10")
    write(tmp_path, "confusion", made)


def test_clicks_that_differ_are_counted_over_all_pairs():
    rng = np.random.default_rng(5)
    p, labels = rng.uniform(size=(12, 4)), np.arange(12) % 3
    found = trained.differing(p, labels)
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
    assert trained.neighbours_agree(apart, labels) == 1.0
    assert abs(trained.neighbours_agree(rng.normal(size=(300, 2)), labels) - 1 / 3) < 5 * np.sqrt(2 / 9 / 300)


def test_single_shots_agree_with_their_expectation(asked, monkeypatch, tmp_path):
    pytest.importorskip("sklearn", reason="needs the plot extra")
    question, _ = asked
    monkeypatch.setattr(trained, "SHOT_FEATURES", (4,))
    monkeypatch.setattr(trained, "PIPELINE", ("Shirt", 4))
    monkeypatch.setattr(trained, "MAPPED", 120)
    made = trained.single_shot_page(question("single-shot"))
    test, images = columns().test, of_table(made.rows, "images")
    for label, one in enumerate(images):
        assert test.labels[one["object"]] == label
        assert not (test.labels[: one["object"]] == label).any()  # the first of its class
        clicks = np.array([[int(bit) for bit in word] for word in one["words"]]).sum(axis=1).mean()
        assert abs(clicks - one["clicks"]) < 5 * np.sqrt(4 / 4 / trained.SHOWN_TRIALS)
        share = np.bincount(one["decided"], minlength=10) / trained.SHOWN_TRIALS
        assert np.abs(share - one["expected"]).max() < 5 * np.sqrt(1 / 4 / trained.SHOWN_TRIALS)
        assert one["right"] == (np.array(one["decided"]) == label).sum()
        assert one["expected_right"] == pytest.approx(100 * one["expected"][label])
    write(tmp_path, "single-shot", made)
