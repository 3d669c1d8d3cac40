"""What trained patterns do when one thing is changed: shots, light, dark counts; and which classes they confuse.

Owns the settings, the measuring and the pages `eta`, `dark-counts`, `confusion` (of the trained rows of the active tables) and `sweeps`
(of the shipped bundle). Nothing is trained. SIMULATED; exact where all click words can be enumerated.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.instrument.profile import Profile, load_profile
from pans.trainer.evaluate.accuracy import (
    Light,
    Measured,
    decision_shares,
    evaluate_exactly,
    evaluate_sampled,
    light_of,
    sampled_shares,
)
from pans.trainer.tasks.registry import Objects, load_task

from . import images, plots
from .active import FEATURES, MEASURED, PROFILE, TrainedRow, by_table, measured_on, trained_rows
from .page import Asked, Column, Draw, Made, Page, Row, Rows, Table, light, percent
from .tables import ACTIVE, FIRST, FIRST_OBJECTS

SWEPT_SHOTS = (1, 2, 3, 5, 8, 13, 21)
ETAS = tuple(10.0 ** (exponent / 4) for exponent in range(-8, 9))
DARKS = tuple(10.0 ** (exponent / 4) for exponent in range(-12, 1))
TRIALS = {FIRST_OBJECTS: 100}
TRIALS_OF_ALL = 10
EXACT_WORK_MAX = 1 << 25  # objects times click words
SWEEPS = {"K": "shots", "eta": "all light times", "dark": "dark counts of an exposure"}
SWEPT_TABLE = "fashion-mnist"  # of eta and dark counts
LEVEL = 2.0  # points below the best that still count as level with it
WORST = 3  # confusions that a table names

F64 = NDArray[np.float64]


# ---- measuring ----


def shipped_bundle() -> Bundle:
    """Return the bundle that comes with the package: ten patterns, FashionMNIST."""
    return load_bundle(Path(str(importlib.resources.files("pans.runtime") / "shipped" / "fashion10.pans")))[0]


def measure_setting(bundle: Bundle, profile: Profile, test: Objects, sweep: str, setting: float) -> Row:
    """Return what `bundle` does where one thing of `SWEEPS` is set otherwise: `sweep`, `setting`, `first_200`, `all`."""
    row: Row = {"sweep": sweep, "setting": setting}
    eta, dark = setting if sweep == "eta" else 1.0, setting if sweep == "dark" else None
    for part, objects in parts_of(test).items():
        lit = light_of(bundle, profile, objects.images, eta=eta, dark=dark)
        row[part] = asdict(_measured(bundle, lit, objects, int(setting) if sweep == "K" else 1))
    return row


def parts_of(test: Objects) -> dict[str, Objects]:
    """Return the first test objects, which the paper takes, and all of them."""
    return {FIRST: Objects(test.images[:FIRST_OBJECTS], test.labels[:FIRST_OBJECTS]), "all": test}


def enumerable(bundle: Bundle, objects: int) -> bool:
    """Return whether a page enumerates all click words of one shot for that many objects, or samples them."""
    return objects << bundle.n_features <= EXACT_WORK_MAX


def _measured(bundle: Bundle, lit: Light, objects: Objects, shots: int) -> Measured:
    if shots == 1 and enumerable(bundle, len(objects)):
        return evaluate_exactly(bundle, lit, objects.labels)
    trials = TRIALS.get(len(objects), TRIALS_OF_ALL)
    return evaluate_sampled(bundle, lit, objects.labels, shots=shots, trials=trials, seed=1)


def confusion(shares: F64, objects: Objects) -> F64:
    """Return the matrix (classes, classes) from P(decided | object) (n, classes).

    A row is a true class, its numbers are the shares of that class's decisions and sum to 1; a class without objects has zeros.
    """
    matrix = np.zeros((shares.shape[1], shares.shape[1]))
    np.add.at(matrix, objects.labels, shares)
    return matrix / np.maximum(np.bincount(objects.labels, minlength=len(matrix)), 1)[:, None]


# ---- the shipped bundle ----


def sweeps_page(asked: Asked) -> Made:
    """Return one row per setting: `sweep`, `setting`, `first_200`, `all`."""
    bundle = shipped_bundle()
    profile, test = load_profile(str(bundle.provenance["profile"])), load_task(bundle.task, asked.data_dir).test
    settings = {"K": tuple(map(float, SWEPT_SHOTS)), "eta": ETAS, "dark": DARKS}
    rows = []
    for sweep, setting in ((sweep, setting) for sweep, values in settings.items() for setting in values):
        row = measure_setting(bundle, profile, test, sweep, setting)
        asked.report(f"{SWEEPS[sweep]} {setting:.3g}: {100 * row['all']['accuracy_mean']:.2f} %")
        rows.append(row)
    return Made(rows, {"": partial(plots.sweeps, rows=rows)})


def sweeps_tables(rows: Rows) -> list[Table]:
    """Return one table per sweep."""
    measured = (*MEASURED, Column("clicks", "all.clicks_mean", ".2f"), Column("photons", "all.photons_mean", ".2f"))
    columns = (*measured, Column("illumination", "all.illumination", ".1f"))
    return [
        Table(
            (Column(sweep, "setting", ".3g"), *columns),
            [row for row in rows if row["sweep"] == sweep],
            f"## {words} ({sweep})",
        )
        for sweep, words in SWEEPS.items()
    ]


# ---- light and dark counts ----


def eta_page(asked: Asked) -> Made:
    """Return one row per d_f and factor of the light, after one as trained."""
    return _swept(asked, "eta", ETAS)


def dark_page(asked: Asked) -> Made:
    """Return one row per d_f and dark count, after one as trained."""
    return _swept(asked, "dark", DARKS)


def _swept(asked: Asked, sweep: str, settings: tuple[float, ...]) -> Made:
    """Measure every trained row at every setting; finished rows lie in the cache."""
    rows: Rows = []
    for row in trained_rows(asked, SWEPT_TABLE):
        facts = {"settings": settings, "trials": [TRIALS[FIRST_OBJECTS], TRIALS_OF_ALL], "exact": EXACT_WORK_MAX}
        made = measured_on(asked, row, facts, partial(_all_settings, row, asked.data_dir, sweep, settings))
        if made is None:
            continue
        of_row = {"table": SWEPT_TABLE, "features": row.features}
        base = {"sweep": sweep, "setting": "trained", FIRST: row.figures[FIRST]["1"], "all": row.figures["all"]["1"]}
        rows += [of_row | found | {"sha256": row.sha256} for found in (base, *made["rows"])]
    return Made(rows, {"": partial(plots.robustness, rows=rows, sweep=sweep)})


def _all_settings(row: TrainedRow, data_dir: str | None, sweep: str, settings: tuple[float, ...]) -> Row:
    test, profile = load_task(SWEPT_TABLE, data_dir).test, load_profile(PROFILE)
    return {"rows": [measure_setting(row.bundle, profile, test, sweep, setting) for setting in settings]}


def _percent(row: Row, part: str = "all") -> float:
    return 100 * float(row[part]["accuracy_mean"])


def _setting(row: Row, setting: float) -> Row:
    """The swept row of a setting, up to rounding; `row` has them all under "swept"."""
    found: Row = min(row["swept"], key=lambda other: abs(float(other["setting"]) - setting))
    return found


def _change(header: str, setting: float, against: Callable[[Row], Row], form: str = "+.1f") -> Column:
    """Points of accuracy on all images at a setting over those of another row."""
    return Column(header, lambda row: _percent(_setting(row, setting)) - _percent(against(row)), form)


def _best(part: str) -> Callable[[Row], Row]:
    def best(row: Row) -> Row:
        found: Row = max(row["swept"], key=partial(_percent, part=part))
        return found

    return best


def _level(row: Row) -> str:
    top = max(map(_percent, row["swept"]))
    level = [other["setting"] for other in row["swept"] if _percent(other) >= top - LEVEL]
    return f"{min(level):.2g} to {max(level):.2g}"


def _one(row: Row) -> Row:
    return _setting(row, 1.0)


def _gain(header: str, part: str) -> Column:
    return Column(header, lambda row: _percent(_best(part)(row), part) - _percent(_one(row), part), "+.2f")


_TRAINED_COLUMNS = (FEATURES, *MEASURED, *light("all"))
_ETA_COLUMNS = (
    FEATURES,
    Column("best eta (all)", lambda row: _best("all")(row)["setting"], ".2f"),
    _gain("gain over eta = 1", "all"),
    Column(f"best eta (first {FIRST_OBJECTS})", lambda row: _best(FIRST)(row)["setting"], ".2f"),
    _gain("gain", FIRST),
    Column(f"within {LEVEL:g} points of the best", _level),
    *(
        _change(words, eta, _one)
        for words, eta in (("change at 0.1", 0.1), ("at 0.32", 10**-0.5), ("at 3.2", 10**0.5), ("at 10", 10.0))
    ),
    Column("accuracy at 0.01", lambda row: _percent(_setting(row, 0.01)), ".1f"),
    Column("at 100", lambda row: _percent(_setting(row, 100.0)), ".1f"),
)
_DARK_COLUMNS = (
    FEATURES,
    *(_change(f"change at {dark:.2g}", dark, lambda row: row) for dark in (0.01, 10**-1.5, 0.1, 10**-0.5, 1.0)),
    _change("points per decade, 0.01 to 0.1", 0.1, partial(_setting, setting=0.01)),
    _change("0.1 to 1", 1.0, partial(_setting, setting=0.1)),
)


def swept_tables(sweep: str, rows: Rows) -> list[Table]:
    """Return the rows as trained, what the sweep does to each, and accuracy and clicks with settings down and d_f across."""
    trained = [
        row
        | {"swept": [other for other in rows if other["features"] == row["features"] and other["setting"] != "trained"]}
        for row in rows
        if row["setting"] == "trained"
    ]
    if not trained:
        return []
    settings = [other["setting"] for other in trained[0]["swept"]]
    by = {(row["features"], row["setting"]): row for row in rows}
    across = [
        {"setting": setting, **{str(d): by[d, setting] for d in (r["features"] for r in trained)}}
        for setting in settings
    ]

    def accuracies(row: Row, d: str) -> str:
        return f"{_percent(row[d], FIRST):.1f} / {_percent(row[d]):.1f}"

    what, columns = ("the light", _ETA_COLUMNS) if sweep == "eta" else ("dark counts", _DARK_COLUMNS)
    heads = [(str(row["features"]), f"d_f = {row['features']}") for row in trained]
    setting = Column(sweep, "setting", ".3g")
    shown = (setting, *(Column(head, partial(accuracies, d=d)) for d, head in heads))
    clicks = (setting, *(Column(head, f"{d}.all.clicks_mean", ".2f") for d, head in heads))
    return [
        Table(_TRAINED_COLUMNS, trained, "## As trained (eta = 1, no dark counts)"),
        Table(columns, trained, f"## What {what} change, in points (all images)"),
        Table(shown, across, f"## Accuracy in %, first {FIRST_OBJECTS} / all"),
        Table(clicks, across, "## Clicks of a decision, all images"),
    ]


# ---- confusion ----


def confusion_page(asked: Asked) -> Made:
    """Return one row per table and d_f, with `matrix` of the first 200 and of all."""
    rows: Rows = []
    pictures: dict[str, Draw] = {}
    for table in ACTIVE:
        mine = []
        for row in trained_rows(asked, table):
            facts = {"trials": [TRIALS[FIRST_OBJECTS], TRIALS_OF_ALL]}
            made = measured_on(asked, row, facts, partial(_matrices, row, asked.data_dir))
            if made is not None:
                measured = {part: row.figures[part]["1"] | {"matrix": made[part]} for part in (FIRST, "all")}
                of_row = {"table": table, "features": row.features, "classes": made["classes"]}
                mine.append(of_row | measured | {"sha256": row.sha256})
        pictures[f"-{table}"] = partial(images.confusions, rows=mine, table=table)
        rows += mine
    return Made(rows, pictures)


def _matrices(row: TrainedRow, data_dir: str | None) -> Row:
    task, profile = load_task(row.table, data_dir), load_profile(PROFILE)
    found: Row = {"classes": list(task.classes)}
    for part, objects in parts_of(task.test).items():
        lit = light_of(row.bundle, profile, objects.images)
        if enumerable(row.bundle, len(objects)):
            shares = decision_shares(row.bundle, lit)
        else:
            shares = sampled_shares(row.bundle, lit, trials=TRIALS.get(len(objects), TRIALS_OF_ALL), seed=1)
        found[part] = confusion(shares, objects).round(5).tolist()
    return found


def _right(choose: Callable[[F64], np.intp]) -> Callable[[Row], str]:
    def named(row: Row) -> str:
        right = np.diagonal(row["all"]["matrix"])
        return f"{row['classes'][choose(right)]} {100 * right[choose(right)]:.0f}"

    return named


def _confused(row: Row) -> str:
    wrong = np.array(row["all"]["matrix"]) * (1 - np.eye(len(row["classes"])))
    places = [np.unravel_index(place, wrong.shape) for place in np.argsort(-wrong, axis=None)[:WORST]]
    return ", ".join(f"{row['classes'][i]} → {row['classes'][j]} {100 * wrong[i, j]:.0f}" for i, j in places)


def confusion_tables(rows: Rows) -> list[Table]:
    """Return per data set the classes that are told best and worst, and every class's share of right decisions."""
    columns = (
        *_TRAINED_COLUMNS,
        Column("best class", _right(np.argmax)),
        Column("poorest class", _right(np.argmin)),
        Column("most frequent confusions, true → decided", _confused),
    )

    def right(label: int, name: str) -> Column:
        return percent(name, lambda row: row["all"]["matrix"][label][label], ".1f")

    found = []
    for table, mine in by_table(rows):
        found.append(Table(columns, mine, f"## {table}"))
        if mine:
            shares = [right(label, name) for label, name in enumerate(mine[0]["classes"])]
            found.append(Table((FEATURES, *shares), mine, f"### {table}: right decisions of each class, %"))
    return found


PAGES = {
    "sweeps": Page(
        "Sweeps over shots, light and dark counts",
        sweeps_page,
        sweeps_tables,
        {"": "accuracy over shots, light and dark counts"},
    ),
    "confusion": Page(
        "Confusion matrices, single shot",
        confusion_page,
        confusion_tables,
        {f"-{table}": f"confusion matrices, {table}" for table in ACTIVE},
    ),
    "dark-counts": Page(
        "Accuracy against dark counts",
        dark_page,
        partial(swept_tables, "dark"),
        {"": "accuracy over dark counts, one curve per number of patterns"},
    ),
    "eta": Page(
        "Accuracy against the light, times the trained light (eta)",
        eta_page,
        partial(swept_tables, "eta"),
        {"": "accuracy over the light, one curve per number of patterns"},
    ),
}
