"""Accuracy against light: PANS beside the alternatives (paper, Fig. 2E), end-to-end optimisation, compressive sensing, and the frontier;
and over the epochs of trainings with several weights alpha: accuracy, light and patterns.

PANS' rows are those of `pans reproduce fashion-mnist` in the same cache folder; the other ways are in ways.toml.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import replace
from functools import partial
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from pans.base.files import npz_bytes, replace_file
from pans.instrument.profile import load_profile
from pans_trainer.baselines.common import Decide, measure, run_trials
from pans_trainer.baselines.networks import clean_mlp, patterns
from pans_trainer.evaluate.accuracy import row_of
from pans_trainer.options import Options, differing_options
from pans_trainer.tasks.registry import load_task
from pans_trainer.train.gradient.history import follow

from . import plots
from .active import OTHER_SEEDS, PROFILE, finished_row, shot_figures
from .page import FIRST_OBJECTS, Asked, Made, Row, Rows, against, beside_curve, by_epoch, flat, sampling_error
from .passive import measure as judged_as_trained
from .printed import ACTIVE, DIRECT, recipe
from .ways import BY_SENT, best_of, measured_points, points

TASK = "fashion-mnist"
PANS, ENVELOPE = "PANS", "end-to-end, envelope"
EXACT, STOPPING, CLEAN = "direct, exact posterior", "direct, stops when sure", "direct, network of clean frames"
FRAMES = (EXACT, STOPPING, STOPPING + BY_SENT)  # of direct imaging, of which the best counts
FIXED, FIXED_LIGHT = "ours, fixed, held to clicks", "ours, fixed, light weighed"
LARGER = ("larger automaton", "larger automaton, trained on", "larger automaton, trained on twice")
LONGER = ("automaton", "automaton, trained on", *LARGER)
# ways that the paper's click budgets are compared with
BUDGETED = (*LONGER, "small automaton", "automaton, held to clicks")
MEANS = ("exposures", "value", "error_objects", "first_200", "clicks", "photons", "illumination")
SENSINGS = (  # of the page compressive: patterns, convolutions, epochs, d_f
    *(("binary", False, 15, features) for features in (4, 16, 32, 64, 128, 256, 784)),
    ("gaussian", False, 15, 64),
    ("binning", False, 15, 64),
    ("binary", True, 5, 64),
    ("binning", True, 5, 64),
    ("gaussian", True, 5, 64),
)
PHOTONS = (10.0, 1e2, 1e3, 1e4, 1e5, 1e6)
TRIALS = 3
FEATURES = (10, 16, 24, 32)  # of the page alpha
ALPHAS = (0.0, 1e-5, 1e-4, 1e-3, 1e-2)
SHOWN = (10, 1e-4)  # d_f and alpha of the paper's evolution of patterns
STAGES = (1, 3, 8, 16)  # epochs after which it is shown
LATE = 5  # epochs at the end, over which the growth of the light is given
SHORT, PAPER = "alpha", "alpha-paper"  # recipes
CELLS = {  # d_f and alpha of each recipe
    SHORT: tuple((features, alpha) for features in FEATURES for alpha in ALPHAS),
    PAPER: tuple((10, alpha) for alpha in (0.0, 1e-4, 1e-2)),
}


def curve_rows(asked: Asked, page: str) -> Rows:
    """Return the ways of a page over their levels of photons."""
    return [{"table": "curves"} | row for row in measured_points(asked, page)]


def envelope(rows: Rows) -> Rows:
    """Return the best of all rows at each photon level, as rows of the way `ENVELOPE`; chosen by all test objects."""
    return [row | {"table": "envelope"} for row in best_of(rows, ENVELOPE)]


def fig_2e_page(asked: Asked) -> Made:
    """Return the rows of every curve and of the envelope, and PANS beside direct imaging and the envelope at equal light."""
    curves = curve_rows(asked, "fig-2e")
    best = [row | {"table": "curves"} for row in envelope(curve_rows(asked, "end-to-end"))]
    posterior = [row for row in curves if row["way"] == EXACT]
    posterior += _levels_between(posterior)
    pans = []
    for row in ACTIVE[TASK]:
        figures = finished_row(asked.cache, TASK, row)
        if figures is None:
            asked.report(f"{PANS} d_f = {row.features}: not trained yet (pans reproduce {TASK} --rows {row.features})")
            continue
        mine: Row = {"table": "pans", "way": PANS, "features": row.features} | shot_figures(figures)
        for name, curve in (("direct", posterior), ("envelope", best)):
            for of in ("photons", "illumination"):
                mine |= beside_curve(mine, curve, of, f"{name}_{of}_")
        pans.append(mine)
    return Made([*pans, *curves, *best])


def _levels_between(measured: Rows) -> Rows:
    """Return the printed levels of direct imaging between those of this page: interpolation needs them."""
    if not measured:
        return []
    of_a_photon = measured[0]["illumination"] / measured[0]["photons"]
    known = {row["level"] for row in measured}
    return [row | {"illumination": row["photons"] * of_a_photon} for row in DIRECT[TASK] if row["photons"] not in known]


def end_to_end_page(asked: Asked) -> Made:
    """Return the envelope, and the rows of every number of patterns."""
    rows = curve_rows(asked, "end-to-end")
    return Made(envelope(rows) + rows)


# ---- compressive sensing ----


def compressive_page(asked: Asked) -> Made:
    """Return one row per patterns, classifier, number of patterns and photons, and the epochs of the trainings on clean measurements."""
    cells, trainings = [], []
    for family, convolutions, epochs, features in SENSINGS:
        if not asked.wants(features):
            continue
        made_with = {"family": family, "features": features, "photons": PHOTONS, "epochs": epochs, "trials": TRIALS}
        made_with |= {"convolutions": True} if convolutions else {}
        name = f"compressive-{family}{'-conv' if convolutions else ''}-{features}"
        found = asked.kept(name, made_with, partial(sensed, asked.data_dir, features, family, convolutions, epochs))
        if found is not None:
            classifier = "convolutions" if convolutions else "one hidden layer"
            facts: Row = {"family": family, "classifier": classifier, "features": features}
            trainings += by_epoch(found["epochs"], **facts)
            for cell in found["cells"]:
                light = {"table": "cells", "level": cell["level"]}
                cells.append(light | facts | flat(cell, cell["first_200"]))
    return Made(cells + trainings)


def sensed(data_dir: str | None, features: int, family: str, convolutions: bool, epochs: int) -> Row:
    """Train on clean measurements by that many patterns, and judge at every photon level."""
    task = load_task(TASK, data_dir)
    measurement = measure(task, patterns(family, features, task.image_shape, seed=0))
    clean = measurement.photoelectrons(measurement.test, 1.0)
    course: dict[str, list[float]] = {"loss": [], "training": [], "held_out": []}

    def watch(loss: float, accuracy: float, decide: Decide) -> None:
        course["loss"].append(round(loss, 4))
        course["training"].append(round(100 * accuracy, 2))
        course["held_out"].append(
            round(100 * float((decide(clean).argmax(axis=1) == measurement.test_labels).mean()), 2)
        )

    at = clean_mlp(measurement, seed=0, epochs=epochs, convolutions=convolutions, watch=watch)
    cells = []
    for photons in PHOTONS:
        done = run_trials(measurement, photons, "counting", at(photons, "counting"), trials=TRIALS, seed=0)
        first = row_of(done.measured(FIRST_OBJECTS))
        cells.append({"level": photons, **row_of(done.measured()), "first_200": first})
    return {"epochs": course, "cells": cells}


# ---- the course of trainings ----


def options_of(features: int, alpha: float, schedule: str = SHORT) -> Options:
    """Return what a training is made with."""
    (row,) = (row for row in ACTIVE[TASK] if row.features == features)
    return replace(recipe(schedule, row), alpha=alpha)


def training(asked: Asked, features: int, alpha: float, schedule: str = SHORT) -> Row | None:
    """Return one training: `epochs` (columns of history.Course) and `final`; None if it was not made."""
    options = options_of(features, alpha, schedule)
    name = f"alpha-{features}-{alpha:g}{'' if schedule == SHORT else '-paper'}"
    path = asked.cache / f"{name}.json"
    shown = (features, alpha, schedule) == (*SHOWN, SHORT)
    if shown and not path.with_suffix(".npz").is_file():
        path.unlink(missing_ok=True)  # figures without their patterns are half a part

    def make() -> Row:
        task = load_task(TASK, asked.data_dir)
        course = follow(task, load_profile(PROFILE), options, patterns_after=STAGES if shown else ())
        if shown:
            after = sorted(course.patterns)
            kept = npz_bytes(after=np.array(after), patterns=np.array([course.patterns[epoch] for epoch in after]))
            replace_file(path.with_suffix(".npz"), kept)
        return {"epochs": course.columns, "final": judged_as_trained(TASK, task, course.trained)}

    return asked.kept(name, differing_options(options), make)


def alpha_page(asked: Asked) -> Made:
    """Return one row per training, beside that without alpha, and their epochs."""
    rows, epochs = [], []
    for schedule, cells in CELLS.items():
        done: Rows = []
        for features, alpha in cells:
            found = training(asked, features, alpha, schedule) if asked.wants(features) else None
            if found is not None:
                facts: Row = {"features": features, "alpha": alpha, "schedule": schedule}
                epochs += by_epoch(found["epochs"], **facts)
                course = {key: found["epochs"][key] for key in ("training", "illumination")}
                facts |= {"table": "alpha", "of_epochs": len(course["training"]), "training": course["training"][-1]}
                done.append(facts | {"grows": growth(course["illumination"])} | found["final"])
        for row in done:
            other = next((each for each in done if (each["features"], each["alpha"]) == (row["features"], 0)), row)
            if other is not row:
                row |= against(row["value"], other["value"], row["error_objects"], other["error_objects"])
        rows += done
    return Made(rows + epochs)


def growth(light: list[float]) -> float:
    """Return by how many percent the illumination grew over the last `LATE` epochs."""
    return 100 * (light[-1] / light[-min(LATE + 1, len(light))] - 1)


def evolution_page(asked: Asked) -> Made:
    """Return one row per stage: the patterns of one training after that epoch."""
    row = training(asked, *SHOWN)
    if row is None:
        return Made([])
    with np.load(asked.cache / f"alpha-{SHOWN[0]}-{SHOWN[1]:g}.npz", allow_pickle=False) as archive:
        normal = {int(after): shown / shown.mean() for after, shown in zip(archive["after"], archive["patterns"])}
    rows = [stage_row(row["epochs"], after, shown) for after, shown in normal.items()]
    lines = {f"epoch {after}\nto {shown.max():.0f}": shown / shown.shape[1] for after, shown in normal.items()}
    return Made(rows, {"": partial(plots.patterns, lines=lines, title="patterns over their common mean")})


def stage_row(epochs: Row, after: int, normal: NDArray[np.floating]) -> Row:
    """Return one stage: how uneven `normal` (d_f, pixels, mean 1) is, and the figures of the training after that epoch."""
    light = np.cumsum(np.sort(normal.ravel())[::-1]) / normal.sum()
    means = normal.mean(axis=1)
    at = {key: values[after - 1] for key, values in epochs.items()}
    return {
        "table": "stages",
        "epoch": after,
        "peak": float(normal.max()),
        "least": float(means.min()),
        "most": float(means.max()),
        "half_of_light": 100 * float((np.searchsorted(light, 0.5) + 1) / light.size),
        "dark_pixels": 100 * float((normal < 0.1).mean()),
        "value": at["held_out"],
        "first_200": at["held_out_first_200"],
        **{key: at[key] for key in ("clicks", "photons", "illumination")},
    }


# ---- the frontier ----


def fixed_rows(asked: Asked) -> Rows:
    """Return our fixed patterns from the finished parts of the pages `fashion-mnist`, `mnist` and `alpha`, none of them measured now."""
    rows: Rows = []
    for name, table in ACTIVE.items():
        for row in table:
            for seed in (0, *OTHER_SEEDS.get((name, row.features), ())):
                figures = finished_row(asked.cache, name, row, seed)
                if figures is not None:
                    facts: Row = {"task": name, "way": FIXED, "level": float(row.features), "exposures": row.features}
                    rows.append(facts | shot_figures(figures))
    for alpha in ALPHAS[1:]:
        found = training(replace(asked, collect=True, report=lambda _: None), 32, alpha)
        if found is not None:
            rows.append({"task": "fashion-mnist", "way": FIXED_LIGHT, "level": alpha, "exposures": 32} | found["final"])
    return rows


def photons_at_least(clicks: float, features: int) -> float:
    """Return the least photoelectrons of that many clicks of so many thresholded exposures: -d_f ln(1 - clicks / d_f).

    The mean of lambda over exposures is least, for a given mean of 1 - exp(-lambda), where all are equal (Jensen).

    >>> round(photons_at_least(4.939, 10), 2)
    6.81
    """
    return -features * math.log1p(-clicks / features)


def frontier_page(asked: Asked) -> Made:
    """Return one row per point beside direct imaging at its light, and the paper's click budgets beside our automata."""
    measured = by_point(measured_points(asked, "frontier", asked.seeds) + fixed_rows(asked))
    new, listed = {_key(row) for row in measured}, {(one.task, one.named, one.level) for one in points("frontier")}
    plain = ("table", "way", "level", "seeds", "error_seeds", *MEANS)  # what stands beside others is found anew
    known = [{key: row[key] for key in plain} | {"task": row["table"]} for row in asked.known if row["table"] in ACTIVE]
    kept = [
        row for row in known if _key(row) not in new and (_key(row) in listed or row["way"] in (FIXED, FIXED_LIGHT))
    ]
    rows = on_front(beside_direct(sorted(measured + kept, key=lambda row: (row["task"], row["way"], row["photons"]))))
    return Made(click_budgets(rows) + rows)


def _key(row: Row) -> tuple[str, str, float]:
    return row["task"], row["way"], row["level"]


def by_point(measured: Rows) -> Rows:
    """Return means over the seeds of each task, way and level, with `seeds` and the standard error over them (None of one seed)."""
    rows = []
    for (task, way, level), group in groupby(sorted(measured, key=_key), _key):
        found = list(group)
        values = [row["value"] for row in found]
        error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
        facts: Row = {"table": task, "task": task, "way": way, "level": level, "seeds": len(found)}
        rows.append(
            facts | {"error_seeds": error} | {mean: statistics.fmean(row[mean] for row in found) for mean in MEANS}
        )
    return rows


def error_of(row: Row) -> float:
    """Return the standard error of a point: from its seeds, where there are several, and from having few objects."""
    return math.hypot(row["error_seeds"] or 0.0, row["error_objects"])


def beside_direct(rows: Rows) -> Rows:
    """Return the points, those of other ways beside the best direct imaging, single frame or stopped, at their photons and illumination.

    Both errors count, as if the images were drawn for each: they are the same, so that the true error is smaller.
    """

    def beside(row: Row, of: str, prefix: str) -> Row:
        mine = row | {"error_objects": error_of(row)}
        found = [beside_curve(mine, curves[row["task"], way], of, prefix) for way in FRAMES]
        return max(found, key=lambda one: float(one.get(f"{prefix}there", -math.inf)))

    whole = [row | {"error_objects": error_of(row)} for row in rows]
    curves = {
        (task, way): [row for row in whole if (row["task"], row["way"]) == (task, way)]
        for task in ACTIVE
        for way in FRAMES
    }
    others = [row["way"] not in FRAMES for row in rows]
    return [
        row | beside(row, "photons", "") | beside(row, "illumination", "light_") if other else row
        for row, other in zip(rows, others)
    ]


def on_front(rows: Rows) -> Rows:
    """Return the points with `front`: "yes" where no other point of the task is as right with no more photons and no more illumination."""

    def beats(other: Row, row: Row) -> bool:
        ahead = [
            other["value"] - row["value"],
            row["photons"] - other["photons"],
            row["illumination"] - other["illumination"],
        ]
        return min(ahead) >= 0 and max(ahead) > 0

    def front(row: Row) -> str:
        return "" if any(other["task"] == row["task"] and beats(other, row) for other in rows) else "yes"

    return [row | {"front": front(row)} for row in rows]


def click_budgets(rows: Rows) -> Rows:
    """Return the paper's thirteen rows beside the automaton whose clicks on all images come nearest to the row's from below.

    It is chosen by clicks, not by accuracy. Of large automata of one level the one that was trained longest stands for all.
    """
    automata = [row for row in rows if row["way"] in BUDGETED]
    longest: dict[tuple[str, float], str] = {}
    for row in sorted((row for row in automata if row["way"] in LONGER), key=lambda row: LONGER.index(row["way"])):
        longest[row["task"], row["level"]] = row["way"]
    automata = [row for row in automata if row["way"] not in LONGER or row["way"] == longest[row["task"], row["level"]]]
    found = []
    for name, table in ACTIVE.items():
        for printed in table:
            line: Row = {"table": "budgets", "task": name, "features": printed.features, "paper": printed.simulation[0]}
            line |= {"paper_clicks": printed.clicks, "paper_illumination": printed.illumination}
            line["paper_photons"] = photons_at_least(printed.clicks, printed.features)
            below = [row for row in automata if row["task"] == name and row["clicks"] <= printed.clicks]
            if below:
                ours = max(below, key=lambda row: float(row["clicks"]))
                theirs = sampling_error(printed.simulation[0], FIRST_OBJECTS)
                line |= {key: ours[key] for key in ("way", "seeds", *MEANS)}
                line |= against(ours["value"], printed.simulation[0], error_of(ours), theirs)
            found.append(line)
    return found
