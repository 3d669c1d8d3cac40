"""What trained patterns do when one thing is changed: shots, light, dark counts; and which classes they confuse.

Owns the settings, the measuring and the pages `eta`, `dark-counts`, `confusion` (of the trained rows of the active tables) and `sweeps`
(of the shipped bundle). Nothing is trained. SIMULATED; exact where all click words can be enumerated.
"""

from __future__ import annotations

import importlib.resources
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
    row_of,
    sampled_shares,
)
from pans.trainer.tasks.registry import Objects, load_task

from . import images, plots
from .active import PROFILE, TrainedRow, by_table, measured_on, parts_of, trained_rows
from .page import Asked, Column, Draw, Made, Row, Rows, Table, columns, pages
from .tables import ACTIVE, FIRST, FIRST_OBJECTS

SWEPT_SHOTS = (1, 2, 3, 5, 8, 13, 21)
ETAS = tuple(10.0 ** (exponent / 4) for exponent in range(-8, 9))
DARKS = tuple(10.0 ** (exponent / 4) for exponent in range(-12, 1))
TRIALS = {FIRST_OBJECTS: 100}
TRIALS_OF_ALL = 10
EXACT_WORK_MAX = 1 << 25  # objects times click words
SWEEPS = {"K": "shots", "eta": "all light times", "dark": "dark counts of an exposure"}
SWEPT_TABLE = "fashion-mnist"  # of eta and dark counts
ETAS_SHOWN = (0.01, 0.1, 10**-0.5, 10**0.5, 10.0, 100.0)  # of which a table tells the change
DARKS_SHOWN = (0.01, 10**-1.5, 0.1, 10**-0.5, 1.0)
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
        row[part] = row_of(_measured(bundle, lit, objects, int(setting) if sweep == "K" else 1))
    return row


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
    found = []
    for sweep, words in SWEEPS.items():
        mine = [row for row in rows if row["sweep"] == sweep]
        found.append(Table((Column(sweep, "{setting:.3g}"), *columns("swept")), mine, f"## {words} ({sweep})"))
    return found


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


def _at(swept: Rows, setting: float) -> Row:
    """The row of a setting, up to rounding."""
    return min(swept, key=lambda row: abs(float(row["setting"]) - setting))


def _over_light(trained: Row, swept: Rows) -> Row:
    """What the light does to a row: its best settings, where it is level with the best, and the change in points at `ETAS_SHOWN`."""
    one = _at(swept, 1.0)
    best = {}
    for part in ("all", FIRST):
        top = max(swept, key=partial(_percent, part=part))
        best[part] = {"setting": top["setting"], "gain": _percent(top, part) - _percent(one, part)}
    level = [row["setting"] for row in swept if _percent(row) >= max(map(_percent, swept)) - LEVEL]
    accuracy = [_percent(_at(swept, eta)) for eta in ETAS_SHOWN]
    change = [value - _percent(one) for value in accuracy]
    return {"best": best, "level": (min(level), max(level)), "accuracy": accuracy, "change": change}


def _over_dark(trained: Row, swept: Rows) -> Row:
    """What dark counts do to a row: the change in points at `DARKS_SHOWN`, and per decade below and above 0.1."""
    change = [_percent(_at(swept, dark)) - _percent(trained) for dark in DARKS_SHOWN]
    return {"change": change, "decade": (change[2] - change[0], change[4] - change[2])}


def swept_tables(sweep: str, rows: Rows) -> list[Table]:
    """Return the rows as trained, what the sweep does to each, and accuracy and clicks with settings down and d_f across."""
    trained = [row for row in rows if row["setting"] == "trained"]
    of = {row["features"]: [other for other in rows if other["features"] == row["features"]][1:] for row in trained}
    what, change = ("the light", _over_light) if sweep == "eta" else ("dark counts", _over_dark)
    changed = [row | change(row, of[row["features"]]) for row in trained]
    across = [
        {"setting": line[0]["setting"], **{str(row["features"]): row for row in line}} for line in zip(*of.values())
    ]

    def shown(template: str) -> list[Column]:
        heads = [Column(f"d_f = {d}", template.replace("D", str(d))) for d in of]
        return [Column(sweep, "{setting:.3g}"), *heads]

    both = shown("{D.first_200.accuracy_mean:.1f %} / {D.all.accuracy_mean:.1f %}")
    return [
        Table(columns("trained"), trained, "## As trained (eta = 1, no dark counts)"),
        Table(columns(sweep), changed, f"## What {what} change, in points (all images)"),
        Table(both, across, f"## Accuracy in %, first {FIRST_OBJECTS} / all"),
        Table(shown("{D.all.clicks_mean:.2f}"), across, "## Clicks of a decision, all images"),
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


def _named(row: Row) -> Row:
    """The classes that are told best and worst, and the most frequent confusions, with shares in %."""
    matrix, classes = np.array(row["all"]["matrix"]), row["classes"]
    right = matrix.diagonal()
    best, poorest = (f"{classes[place]} {100 * right[place]:.0f}" for place in (right.argmax(), right.argmin()))
    wrong = matrix * (1 - np.eye(len(classes)))
    places = [np.unravel_index(place, wrong.shape) for place in np.argsort(-wrong, axis=None)[:WORST]]
    confused = ", ".join(f"{classes[i]} → {classes[j]} {100 * wrong[i, j]:.0f}" for i, j in places)
    return {"best": best, "poorest": poorest, "confused": confused}


def confusion_tables(rows: Rows) -> list[Table]:
    """Return per data set the classes that are told best and worst, and every class's share of right decisions."""
    found = []
    for table, mine in by_table(rows):
        found.append(Table(columns("confusion"), [row | _named(row) for row in mine], f"## {table}"))
        names = mine[0]["classes"] if mine else ()
        right = [Column(name, f"{{all.matrix.{i}.{i}:.1f %}}") for i, name in enumerate(names)]
        found.append(Table((*columns("d_f"), *right), mine, f"### {table}: right decisions of each class, %"))
    return found


PAGES = pages(
    {
        "sweeps": (sweeps_page, sweeps_tables),
        "confusion": (confusion_page, confusion_tables),
        "dark-counts": (dark_page, partial(swept_tables, "dark")),
        "eta": (eta_page, partial(swept_tables, "eta")),
    }
)
