"""Pages of the alternatives, of readouts and of trainings that are followed: measured once, read between levels, drawn."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="needs the plot extra")
pytest.importorskip("sklearn", reason="needs the plot extra")
from trainings import columns_task, short_fits  # noqa: F401 - a fixture

from pans.instrument.profile import load_profile
from pans_trainer.options import Options
from pans_trainer.reproduce import curves, readouts, ways
from pans_trainer.reproduce.page import Asked, of_table, page_of, write_page
from pans_trainer.train.gradient.history import follow
from pans_trainer.train.gradient.loop import train


@pytest.fixture(scope="module")
def task():
    return columns_task(600, 240, 3, 6)


@pytest.fixture
def asked(tmp_path):
    (tmp_path / "cache").mkdir()
    said = []
    return Asked("page", tmp_path / "cache", report=said.append), said


def write(folder, name, made):
    write_page(folder, page_of(name), made)
    assert all((folder / f"{name}{ending}.png").stat().st_size > 3000 for ending in page_of(name).drawn(made).pictures)


def row(way, photons, value, features=10):
    light = {"level": photons, "clicks": photons / 2, "photons": photons, "illumination": 3 * photons}
    return {"table": "curves", "way": way, "features": features, "value": value, "error_objects": 0.4} | light


def test_the_envelope_is_the_best_at_each_level():
    rows = [row("a", 5.0, 30.0, 3), row("b", 5.0, 20.0, 32), row("a", 100.0, 60.0, 3), row("b", 100.0, 80.0, 32)]
    best = curves.envelope(rows)
    assert [(r["level"], r["value"], r["features"]) for r in best] == [(5.0, 30.0, 3), (100.0, 80.0, 32)]
    assert {r["way"] for r in best} == {curves.ENVELOPE}


def test_pans_stands_beside_the_others_at_its_own_light(asked, monkeypatch):
    page, said = asked
    found = {
        "fig-2e": [row(curves.EXACT, n, a, 784) for n, a in ((10.0, 50.0), (1000.0, 90.0))],
        "end-to-end": [row("e2e", n, a, 6) for n, a in ((5.0, 30.0), (5000.0, 83.0))],
    }
    pans = {3: row("PANS", 100.0, 72.0, 3), 32: row("PANS", 2000.0, 90.0, 32)}
    monkeypatch.setattr(curves, "DIRECT", {curves.TASK: []})  # no levels but those of these rows
    monkeypatch.setattr(curves, "curve_rows", lambda _, name: found[name])
    monkeypatch.setattr(curves, "finished_row", lambda _cache, _task, printed: pans.get(printed.features))
    monkeypatch.setattr(curves, "shot_figures", lambda figures: {**figures, "table": "pans"})
    made = curves.fig_2e_page(page)
    first, last = of_table(made.rows, "pans")
    assert (first["direct_photons_there"], first["direct_photons_verdict"]) == (pytest.approx(70), "above")
    assert first["direct_photons_ahead"] == pytest.approx(2)
    assert first["direct_photons_error"] == pytest.approx(0.4 * 2**0.5)
    assert first["envelope_illumination_verdict"] == "above"
    assert "direct_photons_there" not in last  # beyond the curve
    assert "PANS d_f = 24: not trained yet (pans reproduce fashion-mnist --rows 24)" in said


def test_pages_of_curves_are_put_together_from_what_is_finished(task, asked, tmp_path, monkeypatch):
    def way(name, page, paradigm, method, **options):
        levels = {curves.TASK: {"5": {}, "30": {}, "5000": {}}}
        options |= {"paradigm": paradigm, "method": method}
        return {"name": name, "page": page, "kind": "baseline", "options": options, "levels": levels}

    few = way("end-to-end, d_f = 3", "end-to-end", "e2e", "qat", features=3, epochs=60, trials=2)
    many = way("end-to-end, d_f = 9", "end-to-end", "e2e", "qat", features=9, trials=2)
    direct = way(curves.EXACT, "fig-2e", "direct", "bayes", trials=1)
    monkeypatch.setattr(ways, "WAYS", [few, many, direct])
    monkeypatch.setattr(ways, "_task", lambda *_: task)
    page, said = asked
    made = curves.end_to_end_page(dataclasses.replace(page, rows=(3,)))
    assert [r["way"] for r in made.rows] == [curves.ENVELOPE] * 3 + ["end-to-end, d_f = 3"] * 3
    assert (made.rows[0]["features"], made.rows[0]["photons"]) == (3, pytest.approx(5, rel=1e-4))
    assert made.rows[0]["value"] < made.rows[2]["value"]
    write(tmp_path, "end-to-end", made)
    collected = curves.fig_2e_page(dataclasses.replace(page, rows=(3,), collect=True))
    assert [r["way"] for r in collected.rows] == [curves.ENVELOPE] * 3
    assert f"page: {next(ways.points('fig-2e')).stem}-seed0 is not measured yet" in said
    write(tmp_path, "fig-2e", collected)


def test_compressive_sensing_learns_on_clean_light_and_fails_on_little(task, asked, tmp_path, monkeypatch):
    monkeypatch.setattr(curves, "load_task", lambda *_: task)
    wanted = (("binary", False, 30, 4), ("binary", False, 30, 16), ("gaussian", True, 10, 16))
    monkeypatch.setattr(curves, "SENSINGS", wanted)
    page, said = asked
    made = curves.compressive_page(page)
    trainings, cells = of_table(made.rows, "epochs"), of_table(made.rows, "cells")
    assert trainings[59]["held_out"] > 80  # by chance 33
    values = [cell["value"] for cell in cells if (cell["family"], cell["features"]) == ("binary", 16)]
    assert values[0] < 60 < values[-1]
    assert (trainings[-1]["classifier"], len(cells)) == ("convolutions", 3 * len(curves.PHOTONS))
    assert curves.compressive_page(dataclasses.replace(page, collect=True)).rows == made.rows
    write(tmp_path, "compressive", made)
    (tmp_path / "cache" / "compressive-binary-16.json").unlink()
    partly = curves.compressive_page(dataclasses.replace(page, collect=True))
    assert {one["family"] for one in of_table(partly.rows, "epochs") if one["features"] == 16} == {"gaussian"}
    assert "page: compressive-binary-16 is not measured yet" in said


def test_frames_are_drawn_mapped_and_judged(task, asked, tmp_path, monkeypatch):
    monkeypatch.setattr(readouts, "load_task", lambda *_: task)
    monkeypatch.setattr(readouts, "MAPPED_FRAMES", 120)
    page, _ = asked
    made = readouts.frames_page(page)
    many, *_, few = made.rows
    assert many["map_neighbours"] > 90
    assert few["map_value"] > 50  # the posterior sees what the map does not
    frames = readouts.drawn_frames(task)
    assert [drawn.shape for drawn in frames.values()] == [(3, draws, 6, 6) for draws in readouts.SHOWN.values()]
    assert frames[1e3].sum() / 9 == pytest.approx(1000, rel=0.3)  # some objects are brighter than others
    write(tmp_path, "direct-frames", made)


def test_automata_stand_beside_cameras_of_their_light_and_what_no_scheme_is_above(asked, tmp_path, monkeypatch):
    options = (("illumination", 8.0), ("exposures", 4), ("states", 4), ("epochs", 1), ("tune_epochs", 0))
    monkeypatch.setattr(readouts, "points", lambda _: [ways.Point("barcode", "automaton", 8.0, "automaton", options)])
    monkeypatch.setattr(
        readouts.strings, "bounds", lambda levels, light: [{"value": level, "bits": 0.5} for level in levels]
    )
    made = readouts.bound_page(dataclasses.replace(asked[0], name="barcode-bound"))
    ours, as_bright, as_lit = made.rows
    assert ours["objects"] == 1024
    assert as_bright["photons"] == pytest.approx(ours["photons"])
    assert as_lit["illumination"] == pytest.approx(ours["illumination"])
    assert (ours["photons_value"], ours["illumination_value"]) == (ours["photons"], ours["illumination"])
    assert ours["bits_per_illumination"] == pytest.approx(ours["bits"] / ours["illumination"])
    write(tmp_path, "barcode-bound", made)
    assert "|8|" in (tmp_path / "barcode.md").read_text()


def test_readouts_of_the_shipped_patterns_stand_beside_frames(asked, tmp_path, monkeypatch):
    task = columns_task(500, 200, 10, 28, "fashion-mnist")
    monkeypatch.setattr(readouts, "load_task", lambda *_: task)
    monkeypatch.setattr(readouts, "PHOTONS", (3.0, 1e4))
    page, _ = asked
    made = readouts.information_page(page)
    by_way = {way: [row for row in made.rows if row["way"] == way] for way in readouts.WAYS}
    (words, more), (walks,) = by_way[readouts.WAYS[1]], by_way[readouts.WAYS[2]]
    frames, *_, same_light = sorted(
        by_way[readouts.WAYS[0]],
        key=lambda row: (row["photons"] != 3.0, row["illumination"] == pytest.approx(walks["illumination"])),
    )
    assert same_light["illumination"] == pytest.approx(walks["illumination"])
    assert any(row["photons"] == walks["photons"] for row in by_way[readouts.WAYS[0]])
    assert walks["bits_per_photon"] == pytest.approx(walks["bits"] / walks["photons"])
    assert words["bits"] < np.log2(10)
    assert words["photons"] == frames["photons"] == 3.0
    assert words["ahead"] == pytest.approx(words["value"] - frames["value"])
    assert "ahead" not in more  # frames have no posterior there
    write(tmp_path, "fig-2c", made)
    maps = readouts.maps_page(page)
    assert [row["way"] for row in maps.rows] == 2 * [*readouts.WAYS[:2]]
    assert maps.rows[0]["photons"] == pytest.approx(maps.rows[1]["photons"])
    assert ["verdict" in row for row in maps.rows] == [False, True, False, True]
    assert readouts.maps_page(dataclasses.replace(page, collect=True)).rows == maps.rows
    write(tmp_path, "fig-2f", maps)


SMALL = Options(features=3, estimator="ste", alpha=1e-3, epochs=6, hidden=8, batch=25, front_rate=5e-2, head_rate=2e-2)


@pytest.mark.usefixtures("short_fits")
def test_a_followed_training_ends_where_an_ordinary_one_does(task):
    profile = load_profile("ideal")
    course = follow(task, profile, SMALL, patterns_after=(1, 6))
    plain = train(task, profile, SMALL)
    assert np.array_equal(course.trained.quantised.pattern_levels, plain.quantised.pattern_levels)
    assert min(course.trained.validation_losses) == min(plain.validation_losses)
    columns = course.columns
    assert columns["loss"][-1] < columns["loss"][0]
    assert list(course.patterns) == [1, 6]
    assert columns["peak"][-1] == pytest.approx(course.patterns[6].max() / course.patterns[6].mean(), rel=1e-4)


def test_a_stage_tells_how_uneven_patterns_are():
    epochs = {key: [1.0, 2.0] for key in ("held_out", "held_out_first_200", "clicks", "photons", "illumination")}
    even = curves.stage_row(epochs, 1, np.ones((2, 10)))
    assert (even["peak"], even["half_of_light"], even["dark_pixels"]) == (1, pytest.approx(50), 0)
    spot = np.zeros((2, 10))
    spot[0, 3] = 20.0
    uneven = curves.stage_row(epochs, 2, spot)
    assert (uneven["peak"], uneven["least"], uneven["most"], uneven["value"]) == (20, 0.0, 2.0, 2.0)
    assert (uneven["half_of_light"], uneven["dark_pixels"]) == pytest.approx((5, 95))


@pytest.mark.usefixtures("short_fits")
def test_pages_of_trainings_are_made_once_and_collected(task, asked, tmp_path, monkeypatch):
    monkeypatch.setattr(curves, "load_task", lambda *_: task)
    monkeypatch.setattr(curves, "CELLS", {curves.SHORT: ((3, 0.0), (3, 0.1)), curves.PAPER: ((3, 0.1),)})
    monkeypatch.setattr(curves, "SHOWN", (3, 0.1))
    monkeypatch.setattr(curves, "STAGES", (1, 6))
    more = {curves.SHORT: 0, curves.PAPER: 1}

    def options(_features, alpha, schedule=curves.SHORT):
        return dataclasses.replace(SMALL, alpha=alpha, epochs=SMALL.epochs + more[schedule])

    monkeypatch.setattr(curves, "options_of", options)
    page, _ = asked
    assert curves.evolution_page(dataclasses.replace(page, collect=True)).rows == []
    made = curves.alpha_page(page)
    free, held, longer = of_table(made.rows, "alpha")
    assert held["illumination"] < free["illumination"]
    assert (held["of_epochs"], longer["of_epochs"]) == (6, 7)
    assert held["ahead"] == pytest.approx(held["value"] - free["value"])
    assert "ahead" not in free
    stages = curves.evolution_page(dataclasses.replace(page, collect=True))
    assert [row["epoch"] for row in stages.rows] == [1, 6]
    write(tmp_path, "evolution", stages)
    write(tmp_path, "alpha", made)
