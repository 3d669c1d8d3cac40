"""The frontier: points of its recipes, means and margins against figures by hand, rows of every kind measured once."""

import math
from dataclasses import replace

import pytest
from trainings import columns_task

from pans.bundle.sensor.bundle import load_bundle
from pans.instrument.profile import load_profile
from pans_trainer.options import METHODS, AutomatonOptions, BaselineOptions, Options, check_options
from pans_trainer.reproduce import curves, ways
from pans_trainer.reproduce.curves import EXACT, STOPPING
from pans_trainer.reproduce.page import Asked, of_table, page_of, read_rows, write_page
from pans_trainer.reproduce.printed import ACTIVE
from pans_trainer.reproduce.ways import BY_SENT, Point
from pans_trainer.tasks.registry import Task
from pans_trainer.train.automaton import train as adaptive_train

QUICK = {"exposures": 4, "states": 3, "grow_epochs": 1, "tune_epochs": 1, "epochs": 1, "reroutes": 0}
SENT = STOPPING + BY_SENT
GROWN = Point("mnist", "automaton", 2.0, "automaton", (("photons", 2.0), *QUICK.items()))


@pytest.fixture(scope="module")
def halves() -> Task:
    return columns_task(1200, 300, 2, 4, "mnist")


@pytest.fixture
def asked(halves, tmp_path, monkeypatch):
    monkeypatch.setattr(ways, "_task", lambda *_: halves)
    return Asked("frontier", tmp_path, report=lambda _: None, seeds=1)


def made(way: str, level: float, photons: float, value: float, clicks: float = 1.0, task: str = "mnist"):
    shared = {"task": task, "way": way, "level": level, "exposures": 5}
    light = {"clicks": clicks, "photons": photons, "illumination": 10.0}
    return shared | light | {"value": value, "error_objects": 0.3, "first_200": value + 1}


def test_the_points_can_be_trained_and_every_start_is_there():
    found = [point for page in ("frontier", "fig-2e", "end-to-end", "barcode-bound") for point in ways.points(page)]
    assert len({point.stem for point in found}) >= len(found) - 4  # levels of direct imaging are on two pages
    for point in found:
        assert point.task in (*ACTIVE, "barcode")
        if point.kind == "fixed":
            check_options(Options(**dict(point.options)), load_profile("ideal"))
        if point.kind == "baseline":
            assert point.level in (point.sent if point.by_sent else point.levels)
            options = BaselineOptions(**dict(point.options))
            assert options.method in METHODS[options.paradigm]
        if point.kind == "automaton":
            AutomatonOptions(**dict(point.options))
    twice = next(point for point in found if point.way == "larger automaton, trained on twice")
    assert twice.start.start.way == "larger automaton"
    assert twice.training_seed(0) == 2  # other distortions each time
    brighter = next(point for point in found if point.way == "automaton, held to light sent, trained on twice")
    assert (brighter.level, brighter.start.level, brighter.start.start.level) == (250, 115, 115)


def test_seeds_are_put_together_with_their_standard_error():
    rows = [made("automaton", 10, 9.9, value) for value in (80.0, 82.0, 84.0)]
    (found,) = curves.by_point(rows)
    assert (found["seeds"], found["value"], found["first_200"]) == (3, pytest.approx(82), pytest.approx(83))
    assert found["error_seeds"] == pytest.approx(2 / math.sqrt(3))
    assert curves.error_of(found) == pytest.approx(math.hypot(2 / math.sqrt(3), 0.3))
    (one,) = curves.by_point(rows[:1])
    assert one["error_seeds"] is None
    assert curves.error_of(one) == 0.3


def test_margins_are_over_the_best_direct_imaging_at_the_same_light():
    rows = [made(EXACT, 4, 4.0, 40.0), made(EXACT, 16, 16.0, 60.0), made("automaton", 8, 8.0, 75.0)]
    rows += [made("automaton", 40, 40.0, 90.0), made("masks", 4, 4.0, 50.0)]  # 40 is beyond direct imaging's levels
    rows += [made(EXACT, 8, 8.0, 10.0, task="fashion-mnist")]
    rows += [made(STOPPING, 6, 6.0, 30.0), made(STOPPING, 10, 32 / 3, 50.0)]  # not for 4 photons, worse elsewhere
    for row in rows:
        row["illumination"] = row["photons"] * (10 if row["way"] == EXACT else 20)
    found = {(row["way"], row["level"]): row for row in curves.beside_direct(curves.by_point(rows))}
    automaton = found["automaton", 8]
    assert (automaton["there"], automaton["ahead"]) == pytest.approx((50, 25))  # half way in the logarithm
    assert automaton["error"] == pytest.approx(0.3 * math.sqrt(2))
    # at its 160 units the single frame has 60, the stopped one 40
    assert (automaton["light_there"], automaton["light_verdict"]) == (pytest.approx(60), "above")
    assert (found["masks", 4]["ahead"], found["masks", 4]["light_ahead"]) == pytest.approx((10, 0))
    assert "ahead" not in found["automaton", 40]
    assert not {"ahead", "light_ahead"} & set(found[EXACT, 4])
    better = [row | {"value": 70.0} if row["way"] == STOPPING else row for row in rows]
    found = {(row["way"], row["level"]): row for row in curves.beside_direct(curves.by_point(better))}
    assert found["automaton", 8]["ahead"] == pytest.approx(5)


def test_a_point_is_on_the_front_where_none_is_as_right_with_no_more_light_of_either_kind():
    rows = [made("a", 1, 1.0, 50.0), made("b", 1, 2.0, 60.0), made("c", 1, 2.0, 55.0), made("d", 1, 3.0, 60.0)]
    rows[3]["illumination"] = 5.0  # more photons, but less is sent
    rows += [made("e", 1, 9.0, 10.0, task="fashion-mnist")]
    assert [row["front"] for row in curves.on_front(rows)] == ["yes", "yes", "", "yes", "yes"]


def test_click_budgets_take_the_automaton_that_spends_most_within_them_and_not_the_best():
    rows = [made("automaton", 4, 4.0, 99.0, clicks=2.0), made("automaton", 6, 6.0, 70.0, clicks=2.1)]
    rows += [made("automaton, held to clicks", 9, 9.0, 80.0, clicks=4.9)]

    def budgets():
        return {(row["task"], row["features"]): row for row in curves.click_budgets(curves.by_point(rows))}

    found = budgets()
    assert len(found) == 13
    assert "value" not in found["fashion-mnist", 3]
    assert found["mnist", 4]["value"] == 70.0  # 2.164 clicks in the paper
    assert found["mnist", 9]["ahead"] == pytest.approx(80 - 81.23)
    assert found["mnist", 4]["paper_photons"] == pytest.approx(curves.photons_at_least(2.164, 4))
    rows += [made("automaton, trained on", 6, 6.0, 75.0, clicks=1.9)]  # it takes the place of that of 6
    assert budgets()["mnist", 4]["value"] == 99.0


def test_an_automaton_is_trained_once_and_trained_on_from_the_one_in_the_cache(asked, monkeypatch):
    on = Point("mnist", "automaton, trained on", 2.0, "automaton", (("photons", 1.5), ("epochs", 2)), start=GROWN)
    first, second = ways.point_row(asked, GROWN, 0), ways.point_row(asked, on, 0)
    assert first["value"] > 60
    assert first["exposures"] <= 4
    assert second["photons"] == pytest.approx(1.5, rel=0.1)
    start, digest = load_bundle(asked.cache / f"{GROWN.stem}-seed0.pans")
    assert start.provenance["command"] == "pans reproduce frontier"
    trained_on = load_bundle(asked.cache / f"{on.stem}-seed0.pans")[0].provenance["options"]
    assert (trained_on["start"], trained_on["seed"], trained_on["epochs"]) == (digest, 1, 2)
    collect = replace(asked, collect=True)
    assert (ways.point_row(collect, GROWN, 0), ways.point_row(collect, on, 0)) == (first, second)
    assert ways.point_row(collect, GROWN, 1) is None
    assert ways.point_row(collect, replace(GROWN, options=(*GROWN.options, ("patterns", 3))), 0) is None

    def never(*_args, **_named):
        raise AssertionError("trained again")

    monkeypatch.setattr(adaptive_train, "train_automaton", never)
    (asked.cache / f"{on.stem}-seed0.json").unlink()
    again = ways.point_row(asked, on, 0)  # measured again, from its bundle
    assert again["value"] == pytest.approx(second["value"], rel=1e-12)
    with pytest.raises(AssertionError, match="trained again"):
        ways.point_row(asked, GROWN, 1)


def test_the_page_measures_every_kind_of_point_and_is_drawn(asked, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    bayes = {"paradigm": "direct", "method": "bayes", "trials": 1}
    stopping = bayes | {"method": "stopping", "epochs": 1}
    fixed = {"features": 3, "alpha": 0.0, "photons": 3.0, "epochs": 2, "hidden": 8, "batch": 50}
    wanted = [
        {"name": EXACT, "kind": "baseline", "options": bayes, "levels": {"mnist": {"0.5": {}, "100": {}}}},
        {
            "name": STOPPING,
            "kind": "baseline",
            "options": stopping,
            "levels": {"mnist": {"3": {}, "1000": {}, "6 sent": {}}},
        },
        {"name": "fixed", "kind": "fixed", "options": fixed, "levels": {"mnist": {"3": {}}}},
    ]
    monkeypatch.setattr(ways, "WAYS", wanted)
    page = curves.frontier_page(asked)
    points = {(row["way"], row["level"]): row for row in of_table(page.rows, "mnist")}
    assert set(points) == {(EXACT, 0.5), (EXACT, 100), (STOPPING, 3), (SENT, 6), ("fixed", 3)}  # no 1000 for stopping
    assert points[SENT, 6]["illumination"] == pytest.approx(6, rel=0.25)
    assert points[EXACT, 0.5]["photons"] == pytest.approx(0.5, rel=1e-4)
    assert points["fixed", 3]["exposures"] == 3
    assert "ahead" in points["fixed", 3]
    assert curves.frontier_page(replace(asked, collect=True)).rows == page.rows
    write_page(tmp_path, page_of("frontier"), page)
    assert (tmp_path / "frontier.png").stat().st_size > 5000
    # one way alone, the others as the page has them
    wanted[2]["levels"]["mnist"]["4"] = {"photons": 4.0}
    known = tuple(read_rows(tmp_path, "frontier"))
    again = curves.frontier_page(replace(asked, cache=tmp_path, ways=("fixed",), known=known))
    found = {(row["way"], row["level"]): row for row in of_table(again.rows, "mnist")}
    assert set(found) == {*points, ("fixed", 4)}
    assert found[EXACT, 0.5] == {key: points[EXACT, 0.5][key] for key in found[EXACT, 0.5]}
    assert found["fixed", 3]["ahead"] == points["fixed", 3]["ahead"]
