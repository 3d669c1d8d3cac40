"""Pages on the alternatives and on training: parts kept, curves read, courses followed, pages that say what is missing and what is weak."""

# ruff: noqa: E402  (what follows needs torch)
import argparse
import dataclasses
import json
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")
pytest.importorskip("matplotlib", reason="needs the plot extra")

from pans.runtime.instrument.profile import load_profile
from pans.trainer.baselines.common import measure
from pans.trainer.baselines.networks import clean_mlp, patterns
from pans.trainer.baselines.options import BaselineOptions
from pans.trainer.commands import baseline as cmd_baseline
from pans.trainer.options import Options, check_options
from pans.trainer.paper import Asked, alpha, page_of, paradigms, readouts, write_page
from pans.trainer.paper.page import kept
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train import head_fit
from pans.trainer.train.history import follow
from pans.trainer.train.loop import train

PNG = b"\x89PNG"


def bars(n, seed):
    """A bright column of a faint picture tells the class."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, n)
    images = rng.integers(0, 60, (n, 6, 6), dtype=np.uint8)
    images[np.arange(n), :, 2 * labels] = 230
    return Objects(images, labels)


@pytest.fixture(scope="module")
def task():
    return Task("bars", ("a", "b", "c"), bars(600, 1), bars(240, 2), "0" * 64, "")


def asked(tmp_path, **how):
    tmp_path.mkdir(exist_ok=True)
    said = []
    return Asked("page", tmp_path, report=said.append, **how), said


# ---- parts ----


def test_a_part_is_made_once_and_again_when_asked_for_otherwise(tmp_path):
    made = []

    def make():
        made.append(1)
        return {"value": (1, 2)}

    path = tmp_path / "part.json"
    assert kept(path, {"n": 1}, make, collect=True) is None
    first = kept(path, {"n": 1}, make, collect=False)
    assert first["value"] == [1, 2]  # as JSON gives it back, from the start
    assert kept(path, {"n": 1}, make, collect=True) == first
    assert kept(path, {"n": 2}, make, collect=True) is None
    assert len(made) == 1
    kept(path, {"n": 2}, make, collect=False)
    assert len(made) == 2
    assert [file.name for file in tmp_path.iterdir()] == ["part.json"]


# ---- baselines over photons ----


def test_every_curve_is_a_command_that_the_baselines_take():
    parser = argparse.ArgumentParser()
    cmd_baseline.BASELINE.configure(parser)
    every = [*paradigms.CURVES, *(paradigms.e2e_curve(features) for features in paradigms.E2E_FEATURES)]
    assert len({curve.way for curve in every}) == len(every)
    for curve in every:
        args = parser.parse_args(curve.command().split()[2:])
        cmd_baseline._check(args)
        assert cmd_baseline._options(args) == curve.options
        assert tuple(args.photons) == curve.levels == tuple(sorted(curve.levels))


def test_a_curve_is_measured_once_told_and_refused_to_none_when_collecting(task, tmp_path, monkeypatch):
    monkeypatch.setattr(paradigms, "load_task", lambda *_: task)
    curve = paradigms.Curve("end-to-end, d_f = 3", BaselineOptions("e2e", "qat", 3, epochs=60, trials=2), (5.0, 1e4))
    page, said = asked(tmp_path)
    assert paradigms.curve_rows(dataclasses.replace(page, collect=True), curve) == []
    assert curve.command() in said[0]
    few, many = paradigms.curve_rows(page, curve)
    assert few["photons_asked"] == 5
    assert few["photons_mean"] == pytest.approx(5, rel=1e-5)
    assert few["accuracy_mean"] < many["accuracy_mean"]
    assert many["features"] == 3
    assert len(said) == 3
    assert paradigms.curve_rows(dataclasses.replace(page, collect=True), curve) == [few, many]


def row(way, photons, accuracy, features=10, **more):
    one = {"accuracy_mean": accuracy, "accuracy_std": 0.01, "accuracy_se_objects": 0.004, "clicks_mean": photons / 2}
    one |= {"photons_mean": photons, "illumination": 3 * photons, "objects": 10_000, "trials": 2}
    return {"way": way, "features": features, "photons_asked": photons, **one, "first_200": one} | more


def test_the_envelope_is_the_best_at_each_level():
    rows = [row("a", 5.0, 0.3, 3), row("b", 5.0, 0.2, 32), row("a", 100.0, 0.6, 3), row("b", 100.0, 0.8, 32)]
    best = paradigms.envelope(rows)
    assert [(r["photons_asked"], r["accuracy_mean"], r["features"]) for r in best] == [(5.0, 0.3, 3), (100.0, 0.8, 32)]
    assert {r["way"] for r in best} == {paradigms.ENVELOPE}


def test_curves_are_read_between_their_ends_only():
    rows = [row("a", 10.0, 0.4), row("a", 1000.0, 0.8)]
    at = partial(paradigms.accuracy_at, rows, of="photons_mean")
    assert at(100.0) == pytest.approx(0.6)
    assert at(10.0) == pytest.approx(0.4)
    assert at(9.0) is None
    assert at(1001.0) is None
    assert paradigms.accuracy_at([], 5.0, "photons_mean") is None


def test_pans_stands_beside_the_others_at_its_own_light(monkeypatch):
    monkeypatch.setitem(paradigms.DIRECT, paradigms.TASK, {})  # no levels but those of these rows
    posterior = paradigms.POSTERIOR.way
    direct = [row(posterior, n, a, 784) for n, a in ((10.0, 0.5), (1000.0, 0.9))]
    best = [row(paradigms.ENVELOPE, n, a, 6) for n, a in ((5.0, 0.3), (30.0, 0.45), (5000.0, 0.83))]
    pans = [row("PANS", 20.0, 0.7, 4), row("PANS", 200.0, 0.72, 10), row("PANS", 2000.0, 0.9, 32)]
    for each in pans:
        del each["photons_asked"]
    matrix, everything, beside, commands = (table.lines() for table in paradigms.fig_2e_tables(direct + best + pans))
    assert matrix[2:] == [
        "| way | 5 | 10 | 30 | 1000 | 5000 |",
        "| --- | --- | --- | --- | --- | --- |",
        f"| {posterior} | - | 50.0 | - | 90.0 | - |",
        f"| {paradigms.ENVELOPE} | 30.0 | - | 45.0 | - | 83.0 |",
    ]
    assert everything[-1].startswith("| PANS | 32 | - | 90.00 | 1.00 | 0.40 | 90.00 |")
    assert [line.split(" | ")[1:9] for line in beside[4:7]] == [  # both errors are 0.4 points
        ["70.0", "20", "56.0", "+14.0 ± 0.6", "above", "41.6", "+28.4 ± 0.6", "above"],
        ["72.0", "200", "76.0", "-4.0 ± 0.6", "below", "59.1", "+12.9 ± 0.6", "above"],
        ["90.0", "2000", "-", "-", "-", "76.2", "+13.8 ± 0.6", "above"],  # beyond the curve
    ]
    assert beside[8] == f"PANS against {posterior} at equal photons: 1 above, 0 level, 1 below, of 2."
    assert f"| {paradigms.CLEAN.way} | `{paradigms.CLEAN.command()}` |" in commands


def test_pages_of_curves_are_put_together_from_what_is_finished(task, tmp_path, monkeypatch):
    monkeypatch.setattr(paradigms, "load_task", lambda *_: task)
    monkeypatch.setattr(paradigms, "LEVELS", (5.0, 30.0, 5000.0))
    page, said = asked(tmp_path / "cache", rows=(3,))
    made = paradigms.end_to_end_page(page)
    assert [r["way"] for r in made.rows] == ["end-to-end, d_f = 3"] * 3 + [paradigms.ENVELOPE] * 3
    write_page(tmp_path, "end-to-end", page_of("end-to-end"), made)
    assert (tmp_path / "end-to-end.png").read_bytes().startswith(PNG)
    collected = paradigms.fig_2e_page(dataclasses.replace(page, collect=True))
    assert [r["way"] for r in collected.rows] == [paradigms.ENVELOPE] * 3
    assert collected.rows[0]["first_200"]["objects"] == 200
    assert any(paradigms.CLEAN.command() in line for line in said)  # what is missing, and how to make it
    assert "PANS d_f = 32: not trained yet (pans reproduce fashion-mnist --rows 32)" in said


# ---- compressive sensing ----


def test_watching_a_training_changes_nothing(task):
    measurement = measure(task, patterns("binary", 6, task.image_shape, 0))
    seen = []
    before = torch.random.get_rng_state()
    watched = clean_mlp(measurement, seed=3, epochs=2, watch=lambda epoch, decide: seen.append((epoch, decide)))
    assert torch.equal(torch.random.get_rng_state(), before)
    alone = clean_mlp(measurement, seed=3, epochs=2)
    clean = measurement.photoelectrons(measurement.test, 50.0)
    assert np.array_equal(watched(50.0, "counting")(clean), alone(50.0, "counting")(clean))
    assert len(seen) == 2
    assert seen[1][0].loss < seen[0][0].loss
    assert 0 <= seen[1][0].accuracy <= 1


def test_compressive_sensing_learns_on_clean_light_and_fails_on_little(task, tmp_path, monkeypatch):
    monkeypatch.setattr(paradigms, "load_task", lambda *_: task)
    monkeypatch.setattr(paradigms, "FEATURES", (4, 16))
    monkeypatch.setattr(paradigms, "EPOCHS", 30)
    monkeypatch.setattr(paradigms, "OTHERS", (("binning", False, 30, (4,)), ("gaussian", True, 10, (16,))))
    page, said = asked(tmp_path / "cache")
    made = paradigms.compressive_page(page)
    sixteen = made.rows[1]
    assert sixteen["epochs"]["held_out"][-1] > 80  # by chance 33
    assert len(sixteen["epochs"]["loss"]) == 30
    accuracies = [cell["accuracy_mean"] for cell in sixteen["cells"]]
    assert accuracies[0] < 0.6 < accuracies[-1]
    assert sum(line.startswith("compressive") for line in said) == 4 * len(paradigms.PHOTONS)
    again = paradigms.compressive_page(dataclasses.replace(page, collect=True))
    assert again.rows == made.rows
    binned, convolved = made.rows[2:]
    assert binned["made_with"]["family"] == "binning"
    assert convolved["epochs"]["held_out"][-1] > 60  # by chance 33
    *_, other = (table.lines() for table in paradigms.compressive_tables(made.rows))
    assert other[0] == "## Other patterns and another classifier"
    assert [line.split(" | ")[1] for line in other[4:16]] == 6 * ["one hidden layer"] + 6 * ["convolutions"]
    assert other[-1].endswith("of 6.")
    write_page(tmp_path, "compressive", page_of("compressive"), made)
    assert {path.name for path in tmp_path.iterdir()} >= {
        "compressive.png",
        "compressive-training.png",
        "compressive.json",
    }
    (tmp_path / "cache" / "compressive-binary-16.json").unlink()
    partly = paradigms.compressive_page(dataclasses.replace(page, collect=True))
    assert [one["features"] for one in partly.rows] == [4, 4, 16]
    assert said[-1] == "compressive: d_f = 16 is not measured yet: pans reproduce compressive"


# ---- frames ----


def test_frames_are_drawn_mapped_and_judged(task, tmp_path, monkeypatch):
    monkeypatch.setattr(readouts, "load_task", lambda *_: task)
    monkeypatch.setattr(readouts, "MAPPED_FRAMES", 120)
    page, _ = asked(tmp_path / "cache")
    made = readouts.frames_page(page)
    many, *_, few = made.rows
    assert many["neighbours"] > 0.9
    assert few["on_the_map"]["photons_mean"] < 20
    assert few["on_the_map"]["objects"] == 120
    assert few["on_the_map"]["accuracy_mean"] > 0.5  # the posterior sees what the map does not
    frames = readouts.drawn_frames(task)
    assert [drawn.shape for drawn in frames.values()] == [(3, draws, 6, 6) for draws in readouts.SHOWN.values()]
    assert frames[1e3].sum() / 9 == pytest.approx(
        1000, rel=0.3
    )  # three objects, three draws; some are brighter than others
    write_page(tmp_path, "direct-frames", page_of("direct-frames"), made)
    assert (tmp_path / "direct-frames-map.png").read_bytes().startswith(PNG)
    assert (tmp_path / "direct-frames.png").read_bytes().startswith(PNG)


# ---- training dynamics ----


@pytest.fixture
def short_fits(monkeypatch):
    """The last stage of a training takes 1500 steps however small the task is; nothing here asks for a good head."""
    monkeypatch.setattr(head_fit, "fit_head_exactly", partial(head_fit.fit_head_exactly, steps=30))


SMALL = Options(features=3, estimator="ste", alpha=1e-3, epochs=6, hidden=8, batch=25, front_rate=5e-2, head_rate=2e-2)


@pytest.mark.usefixtures("short_fits")
def test_a_followed_training_ends_where_an_ordinary_one_does(task):
    profile = load_profile("ideal")
    course = follow(task, profile, SMALL, patterns_after=(1, 6))
    plain = train(task, profile, SMALL)
    assert np.array_equal(course.trained.quantised.pattern_levels, plain.quantised.pattern_levels)
    assert course.trained.validation_loss == plain.validation_loss
    columns = course.columns()
    assert {len(values) for values in columns.values()} == {6}
    assert columns["loss"][-1] < columns["loss"][0]
    assert columns["held_out"][-1] > 50  # by chance 33
    assert list(course.patterns) == [1, 6]
    last = course.patterns[6]
    assert columns["peak"][-1] == pytest.approx(last.max() / last.mean(), rel=1e-4)
    with pytest.raises(ValueError, match="'coherent'"):
        follow(task, profile, dataclasses.replace(SMALL, encoder="coherent"))


def test_the_recipes_of_the_courses_can_be_trained():
    for features in alpha.FEATURES:
        for weight in alpha.ALPHAS:
            check_options(alpha.recipe(features, weight), load_profile("ideal"))
    assert alpha.STAGES[-1] == alpha.EPOCHS
    assert all(a < b for a, b in pairwise(alpha.STAGES))


def test_a_stage_tells_how_uneven_patterns_are():
    epochs = {key: [1.0, 2.0] for key in ("held_out", "held_out_first_200", "clicks", "photons", "illumination")}
    even = alpha.stage_row({"epochs": epochs}, 1, np.ones((2, 10)))
    assert even["peak"] == 1
    assert even["pixels_with_half_the_light"] == pytest.approx(0.5)
    assert even["pixels_below_a_tenth_of_the_mean"] == 0
    spot = np.zeros((2, 10))
    spot[0, 3] = 20.0
    uneven = alpha.stage_row({"epochs": epochs}, 2, spot)
    assert uneven["peak"] == 20
    assert uneven["means"] == [2.0, 0.0]
    assert uneven["pixels_with_half_the_light"] == pytest.approx(1 / 20)
    assert uneven["pixels_below_a_tenth_of_the_mean"] == pytest.approx(19 / 20)
    assert uneven["held_out"] == 2.0


def test_growth_is_over_the_last_epochs():
    light = [1.0] * 5 + [100.0] + [110.0] * alpha.LATE
    assert alpha.growth({"epochs": {"illumination": light}}) == pytest.approx(10)
    assert alpha.growth({"epochs": {"illumination": [4.0, 5.0]}}) == pytest.approx(25)


@pytest.mark.usefixtures("short_fits")
def test_pages_of_courses_are_made_once_and_collected(task, tmp_path, monkeypatch):
    monkeypatch.setattr(alpha, "load_task", lambda *_: task)
    monkeypatch.setattr(alpha, "FEATURES", (3,))
    monkeypatch.setattr(alpha, "ALPHAS", (0.0, 0.1))
    monkeypatch.setattr(alpha, "SHOWN", (3, 0.1))
    monkeypatch.setattr(alpha, "STAGES", (1, 6))
    monkeypatch.setattr(alpha, "PAPER_CELLS", ((3, 0.1),))
    more = {alpha.SHORT: 0, alpha.PAPER: 1}
    monkeypatch.setattr(
        alpha,
        "recipe",
        lambda _, weight, schedule=alpha.SHORT: dataclasses.replace(
            SMALL, alpha=weight, epochs=SMALL.epochs + more[schedule]
        ),
    )
    page, said = asked(tmp_path / "cache")
    assert alpha.evolution_page(dataclasses.replace(page, collect=True)).rows == []
    assert said == ["not trained yet: pans reproduce evolution"]
    made = alpha.alpha_page(page)
    free, held, longer = made.rows
    assert held["final"]["illumination"] < free["final"]["illumination"]
    assert len(longer["epochs"]["loss"]) == len(held["epochs"]["loss"]) + 1
    short, paper = alpha.alpha_tables(made.rows)
    assert [row["alpha"] for row in short.rows] == [0.0, 0.1]
    assert [row["short"]["value"] for row in paper.rows] == [held["final"]["value"]]
    assert free["final"]["objects"] == 240
    write_page(tmp_path, "alpha", page_of("alpha"), made)
    assert (tmp_path / "alpha-3.png").read_bytes().startswith(PNG)
    assert json.loads((tmp_path / "alpha.json").read_text())["rows"] == made.rows
    evolution = alpha.evolution_page(dataclasses.replace(page, collect=True))
    assert [stage["epoch"] for stage in evolution.rows] == [1, 6]
    assert np.mean(evolution.rows[0]["means"]) == pytest.approx(1)
    drawn = {"": partial(evolution.pictures[""], shape=task.image_shape)}
    write_page(tmp_path, "evolution", page_of("evolution"), dataclasses.replace(evolution, pictures=drawn))
    assert (tmp_path / "evolution.png").read_bytes().startswith(PNG)
    (tmp_path / "cache" / "alpha-3-0.1.npz").unlink()  # half a part is none
    assert alpha.evolution_page(dataclasses.replace(page, collect=True)).rows == []
