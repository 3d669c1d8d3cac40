"""The paper's comparison of paradigms: accuracy against photons, PANS beside the alternatives (its Fig. 2E and appendices).

Owns the curves of the baselines over photons, their place in the cache folder, what is read off them, and the pages `fig-2e`,
`end-to-end` and `compressive`. PANS' rows are those of `pans reproduce fashion-mnist` in the same cache folder. SIMULATED; FashionMNIST.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from pans.trainer.baselines.common import Decide, measure, run_trials, silent
from pans.trainer.baselines.networks import EpochOfFit, clean_mlp, patterns
from pans.trainer.baselines.options import METHODS, BaselineOptions
from pans.trainer.baselines.rows import baseline_rows
from pans.trainer.evaluate.accuracy import row_of
from pans.trainer.tasks.registry import load_task
from pans.trainer.verdicts import against, claim

from . import images, plots
from .active import finished_row
from .page import Asked, Column, Draw, Made, Row, Rows, Table, columns, kept, pages
from .tables import ACTIVE, DIRECT, DIRECT_ERRORS, FIRST, FIRST_OBJECTS, SHOTS

TASK = "fashion-mnist"
LEVELS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0, 1e3, 5e3, 1e4, 1e6)
POSTERIOR_LEVELS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0, 1e3)  # at more it is a nearest neighbour
SENSING_LEVELS = (5.0, 100.0)
NETWORK_LEVELS = (100.0, 1e3, 1e4)  # a training each
E2E_FEATURES = (3, 4, 6, 8, 10, 16, 24, 32, 64)  # the paper's
PANS, ENVELOPE = plots.PANS, plots.ENVELOPE
MEASURED = (
    "accuracy_mean",
    "accuracy_std",
    "accuracy_se_objects",
    "clicks_mean",
    "photons_mean",
    "illumination",
    "objects",
    "trials",
)

FAMILY = "binary"  # of the page `compressive`
FEATURES = (4, 16, 32, 64, 128, 256, 784)
OTHERS = (  # patterns, convolutions before the hidden layer or none, epochs, numbers of patterns
    ("gaussian", False, 15, (64,)),
    ("binning", False, 15, (64,)),
    ("binary", True, 5, (64,)),
    ("binning", True, 5, (64,)),
    ("gaussian", True, 5, (64,)),
)
PHOTONS = (10.0, 1e2, 1e3, 1e4, 1e5, 1e6)
EPOCHS = 15
TRIALS = 3


# ---- curves over photons ----


@dataclass(frozen=True, slots=True)
class Curve:
    """One way over photon levels, on `TASK`."""

    way: str
    options: BaselineOptions
    levels: tuple[float, ...]

    @property
    def words(self) -> tuple[str, ...]:
        """The words of `pans baseline` that measure the curve alone, but for the task; the cache knows the curve by them."""
        o = self.options
        of_patterns = () if o.paradigm == "direct" else ("--features", str(o.features))
        family = ("--patterns", o.patterns) if o.paradigm == "compressive" else ()
        method = () if o.method == METHODS["e2e"][0] else ("--method", o.method)
        epochs = () if o.epochs is None else ("--epochs", str(o.epochs))
        photons = ("--photons", *(f"{level:g}" for level in self.levels))
        return (o.paradigm, *of_patterns, *family, *method, *epochs, "--trials", str(o.trials), *photons)

    def command(self) -> str:
        """Return the command that measures the curve alone."""
        return f"pans baseline {self.words[0]} --task {TASK} {' '.join(self.words[1:])}"


def _sensing(family: str, method: str, trials: int) -> BaselineOptions:
    return BaselineOptions("compressive", method, features=64, patterns=family, trials=trials)


CLEAN = Curve("direct, network of clean frames", BaselineOptions("direct", "clean-cnn", epochs=2, trials=2), LEVELS)
POSTERIOR = Curve("direct, exact posterior", BaselineOptions("direct", "bayes", trials=2), POSTERIOR_LEVELS)
CURVES = (  # what takes longest is last
    CLEAN,
    POSTERIOR,
    Curve("random binary, clean features", _sensing("binary", "clean-mlp", 5), LEVELS),
    Curve("Hadamard, clean features", _sensing("hadamard", "clean-mlp", 5), LEVELS),
    Curve("random binary, exact posterior", _sensing("binary", "bayes", 2), SENSING_LEVELS),
    Curve("Hadamard, exact posterior", _sensing("hadamard", "bayes", 2), SENSING_LEVELS),
    Curve("direct, network of each level", BaselineOptions("direct", "cnn", epochs=2, trials=2), NETWORK_LEVELS),
)


def e2e_curve(features: int) -> Curve:
    """Return the curve of conventional end-to-end optimisation with that many patterns."""
    return Curve(f"end-to-end, d_f = {features}", BaselineOptions("e2e", "qat", features=features, trials=5), LEVELS)


def curve_rows(asked: Asked, curve: Curve) -> Rows:
    """Return the rows of a curve, each with its `way`; none where it was not measured and nothing is to be made."""
    name = "-".join(word.lstrip("-").replace(".", "") for word in curve.words[: curve.words.index("--photons")])

    def make() -> Row:
        rows = []
        for row in baseline_rows(load_task(TASK, asked.data_dir), curve.options, curve.levels, silent):
            asked.report(f"{curve.way}, {row['photons_asked']:g} photons: {100 * row['accuracy_mean']:.2f} %")
            rows.append(row)
        return {"rows": rows}

    found = kept(asked.cache / f"baseline-{name}.json", {"words": curve.words}, make, collect=asked.collect)
    if found is None:
        asked.report(f"{curve.way}: not measured yet ({curve.command()})")
        return []
    return [{"way": curve.way, **row} for row in found["rows"]]


def envelope(rows: Rows) -> Rows:
    """Return the best of all rows at each photon level, as rows of the way `ENVELOPE`; chosen by all test objects."""
    levels = sorted({row["photons_asked"] for row in rows})
    best = [max((r for r in rows if r["photons_asked"] == n), key=lambda r: float(r["accuracy_mean"])) for n in levels]
    return [row | {"way": ENVELOPE} for row in best]


def accuracy_at(rows: Rows, place: float, of: str, value: str = "accuracy_mean") -> float | None:
    """Return a curve's `value` where its figure `of` is `place`, by interpolation in its logarithm; None outside of the curve."""
    known = sorted((float(row[of]), float(row[value])) for row in rows)
    if not known or not known[0][0] <= place <= known[-1][0]:
        return None
    return float(np.interp(math.log(place), [math.log(x) for x, _ in known], [y for _, y in known]))


# ---- fig-2e and end-to-end ----


def fig_2e_page(asked: Asked) -> Made:
    """Return the rows of every curve, of the envelope of `end-to-end`, and of PANS."""
    rows = [row for curve in CURVES for row in curve_rows(asked, curve)] + envelope(_end_to_end(asked))
    one = str(SHOTS[0])
    for row in ACTIVE[TASK]:
        figures = finished_row(asked.cache, TASK, row)
        if figures is None:
            asked.report(f"{PANS} d_f = {row.features}: not trained yet (pans reproduce {TASK} --rows {row.features})")
            continue
        facts = {"way": PANS, "features": row.features, "cpu_seconds": figures["cpu_seconds"]}
        rows.append(figures["all"][one] | facts | {FIRST: figures[FIRST][one]})
    rows = [_plain(row) for row in rows]
    return Made(rows, {"": partial(plots.paradigms, rows=rows)})


def end_to_end_page(asked: Asked) -> Made:
    """Return the rows of every number of patterns, and of their envelope."""
    measured = _end_to_end(asked)
    rows = [_plain(row) for row in measured + envelope(measured)]
    return Made(rows, {"": partial(plots.end_to_end, rows=rows)})


def _end_to_end(asked: Asked) -> Rows:
    return [row for features in E2E_FEATURES if asked.wants(features) for row in curve_rows(asked, e2e_curve(features))]


def _plain(row: Row) -> Row:
    """Return what the page keeps of a row."""
    facts = {key: row[key] for key in ("way", "features", "photons_asked", "cpu_seconds", "seconds") if key in row}
    return facts | {key: row[key] for key in MEASURED} | {FIRST: {key: row[FIRST][key] for key in MEASURED}}


def curve_tables(rows: Rows) -> list[Table]:
    """Return accuracies of all test objects, one line per way and one column per photon level; and every row with its light."""
    by: dict[str, Row] = {}
    for row in rows:
        if "photons_asked" in row:
            by.setdefault(row["way"], {"way": row["way"]})[f"{row['photons_asked']:g}"] = row
    levels = [f"{level:g}" for level in LEVELS if any(f"{level:g}" in found for found in by.values())]
    matrix = [Column("way", "{way}"), *(Column(level, f"{{{level}.accuracy_mean:.1f %}}") for level in levels)]
    every = [row | {"how": "" if row["trials"] else " (exact)"} for row in rows]
    return [
        Table(matrix, list(by.values()), "## All 10 000 test images, accuracy % over photons"),
        Table(columns("curve"), every, "## Everything"),
    ]


def fig_2e_tables(rows: Rows) -> list[Table]:
    """Return the tables of the curves, PANS beside two of them at its own photons and its own illumination, and the commands."""
    curves = {key: [row for row in rows if row["way"] == way] for key, way in _BESIDE.items()}
    curves["posterior"] += _levels_between(curves["posterior"])
    pans = []
    for row in (row for row in rows if row["way"] == PANS):
        there = {key: {of: _held_against(row, curve, of) for of in _EQUAL} for key, curve in curves.items()}
        pans.append(row | there)
    heading = "## PANS beside direct imaging by the exact posterior and the end-to-end envelope, at equal light"
    claims = [
        claim("PANS", f"{way} at equal {words}", [row[key][of] for row in pans])
        for of, words in _EQUAL.items()
        for key, way in _BESIDE.items()
    ]
    return [*curve_tables(rows), Table(columns("at_equal_light"), pans, heading, claims), _commands(CURVES)]


_BESIDE = {"posterior": POSTERIOR.way, "envelope": ENVELOPE}
_EQUAL = {"photons_mean": "photons", "illumination": "illumination"}


def _levels_between(measured: Rows) -> Rows:
    """The levels of the same curve that other pages measured (tables.toml), between those of this page: interpolation needs them."""
    if not measured:
        return []
    first, *_ = measured
    of_a_photon = first["illumination"] / first["photons_mean"]
    known = {row["photons_asked"] for row in measured}
    return [
        {"photons_mean": n, "illumination": n * of_a_photon, "accuracy_mean": accuracy / 100}
        | {"accuracy_se_objects": DIRECT_ERRORS[TASK][n] / 100}
        for n, accuracy in DIRECT[TASK].items()
        if n not in known
    ]


def _held_against(row: Row, curve: Rows, of: str) -> Row | None:
    """Hold a row against a curve where that has as much of `of`; both errors are from having few objects. None outside of the curve."""
    there, error = (accuracy_at(curve, row[of], of, value) for value in ("accuracy_mean", "accuracy_se_objects"))
    if there is None or error is None:
        return None
    ours, ours_error = 100 * row["accuracy_mean"], 100 * row["accuracy_se_objects"]
    return {"accuracy_mean": there} | against(ours, 100 * there, ours_error, 100 * error)


def end_to_end_tables(rows: Rows) -> list[Table]:
    """Return the tables of the curves, of which patterns the envelope is, and the command of each curve."""
    matrix, _ = curve_tables(rows)
    _, everything = curve_tables([row for row in rows if row["way"] != ENVELOPE])
    best = [row for row in rows if row["way"] == ENVELOPE]
    commands = _commands(tuple(map(e2e_curve, E2E_FEATURES)))
    return [matrix, Table(columns("envelope"), best, "## Patterns of the envelope"), everything, commands]


def _commands(curves: tuple[Curve, ...]) -> Table:
    rows = [{"way": curve.way, "command": curve.command()} for curve in curves]
    return Table(columns("commands"), rows, "## Commands of the curves")


# ---- compressive sensing ----


def compressive_page(asked: Asked) -> Made:
    """Return one row per number of patterns, with its training on clean measurements and its cells."""
    plain = [(FAMILY, False, EPOCHS, features) for features in FEATURES]
    others = [(family, conv, epochs, features) for family, conv, epochs, each in OTHERS for features in each]
    rows, more = _sensings(asked, plain), _sensings(asked, others)
    pictures: dict[str, Draw] = {}
    if rows:
        pictures = {"": partial(images.sensing_map, rows=rows), "-training": partial(plots.sensing_training, rows=rows)}
    return Made(rows + more, pictures)


def _sensings(asked: Asked, wanted: list[tuple[str, bool, int, int]]) -> Rows:
    """The rows of patterns, classifiers, epochs and numbers of patterns, as far as they are asked for and finished."""
    rows = []
    for family, conv, epochs, features in wanted:
        if not asked.wants(features):
            continue
        made_with = {"family": family, "features": features, "photons": PHOTONS, "epochs": epochs, "trials": TRIALS}
        made_with |= {"convolutions": True} if conv else {}
        path = asked.cache / f"compressive-{family}{'-conv' if conv else ''}-{features}.json"
        make = partial(sensed, asked, features, family, conv, epochs)
        found = kept(path, made_with, make, collect=asked.collect)
        if found is None:
            asked.report(f"compressive: d_f = {features} is not measured yet: pans reproduce compressive")
        else:
            rows.append(found)
    return rows


def sensed(asked: Asked, features: int, family: str, conv: bool, epochs: int) -> Row:
    """Train on clean measurements by that many patterns, and judge at every photon level."""
    task = load_task(TASK, asked.data_dir)
    measurement = measure(task, patterns(family, features, task.image_shape, seed=0))
    clean = measurement.photoelectrons(measurement.test, 1.0)
    course: dict[str, list[float]] = {"loss": [], "training": [], "held_out": []}

    def watch(epoch: EpochOfFit, decide: Decide) -> None:
        course["loss"].append(round(epoch.loss, 4))
        course["training"].append(round(100 * epoch.accuracy, 2))
        course["held_out"].append(round(100 * float((decide(clean) == measurement.test_labels).mean()), 2))

    at = clean_mlp(measurement, seed=0, epochs=epochs, convolutions=conv, watch=watch)
    cells = []
    for photons in PHOTONS:
        done = run_trials(measurement, photons, "counting", at(photons, "counting"), trials=TRIALS, seed=0)
        cells.append({"photons_asked": photons, **row_of(done.measured()), FIRST: row_of(done.measured(FIRST_OBJECTS))})
        asked.report(
            f"compressive, {family}, d_f = {features}, {photons:g} photons: {100 * cells[-1]['accuracy_mean']:.2f} %"
        )
    return {"features": features, "epochs": course, "cells": cells}


def compressive_tables(rows: Rows) -> list[Table]:
    """Return the trainings, and every cell."""
    plain = [row for row in rows if _way(row) == _PLAIN]
    cells = [{"features": row["features"], **cell} for row in plain for cell in row["cells"]]
    found = [
        Table(columns("sensing_training"), plain, "## Training on clean measurements"),
        Table(columns("sensing"), cells, "## Every cell"),
    ]
    others = [_beside_plain(row, cell, plain) for row in rows if _way(row) != _PLAIN for cell in row["cells"]]
    if others:
        claims = [
            claim(f"{way[0]}, {way[1]}", "random binary, one hidden layer", of_way)
            for way in dict.fromkeys((row["family"], row["classifier"]) for row in others)
            if (of_way := [row.get("beside") for row in others if (row["family"], row["classifier"]) == way])
        ]
        found.append(Table(columns("sensing_other"), others, "## Other patterns and another classifier", claims))
    return found


_PLAIN = (FAMILY, "one hidden layer")


def _way(row: Row) -> tuple[str, str]:
    made_with = row["made_with"]
    return made_with["family"], "convolutions" if made_with.get("convolutions") else _PLAIN[1]


def _beside_plain(row: Row, cell: Row, plain: Rows) -> Row:
    """A cell of other patterns or another classifier, held against random binary patterns at the same number and photons."""
    family, classifier = _way(row)
    found = {"features": row["features"], "family": family, "classifier": classifier, **cell}
    for other in (one for one in plain if one["features"] == row["features"]):
        for there in (one for one in other["cells"] if one["photons_asked"] == cell["photons_asked"]):
            figures = [100 * one[key] for key in ("accuracy_mean", "accuracy_se_objects") for one in (cell, there)]
            found["beside"] = against(*figures)
    return found


PAGES = pages(
    {
        "fig-2e": (fig_2e_page, fig_2e_tables),
        "end-to-end": (end_to_end_page, end_to_end_tables),
        "compressive": (compressive_page, compressive_tables),
    }
)
