"""Accuracy of FashionMNIST against photons: PANS beside the alternatives (paper, Fig. 2E), end-to-end optimisation, compressive sensing.

PANS' rows are those of `pans reproduce fashion-mnist` in the same cache folder; every curve is one `pans baseline` command.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pans.trainer.baselines.common import Decide, measure, run_trials, silent
from pans.trainer.baselines.networks import EpochOfFit, clean_mlp, patterns
from pans.trainer.baselines.options import METHODS, BaselineOptions
from pans.trainer.baselines.rows import baseline_rows
from pans.trainer.evaluate.accuracy import row_of
from pans.trainer.tasks.registry import load_task

from .active import finished_row, shot_figures
from .page import FIRST_OBJECTS, Asked, Made, Row, Rows, against, by_epoch, flat, interpolated, kept
from .printed import ACTIVE, DIRECT

TASK = "fashion-mnist"
LEVELS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0, 1e3, 5e3, 1e4, 1e6)
POSTERIOR_LEVELS = LEVELS[:7]  # at more it is a nearest neighbour
SENSING_LEVELS = (5.0, 100.0)
NETWORK_LEVELS = (100.0, 1e3, 1e4)  # a training each
E2E_FEATURES = (3, 4, 6, 8, 10, 16, 24, 32, 64)  # the paper's
PANS, ENVELOPE = "PANS", "end-to-end, envelope"

FEATURES = (4, 16, 32, 64, 128, 256, 784)  # of the page `compressive`
SENSINGS = (  # patterns, convolutions, epochs, d_f
    *(("binary", False, 15, features) for features in FEATURES),
    ("gaussian", False, 15, 64),
    ("binning", False, 15, 64),
    ("binary", True, 5, 64),
    ("binning", True, 5, 64),
    ("gaussian", True, 5, 64),
)
PHOTONS = (10.0, 1e2, 1e3, 1e4, 1e5, 1e6)
TRIALS = 3


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


def curve_rows(asked: Asked, curve: Curve) -> Rows:
    """Return the rows of a curve, each with its `way`; none where it was not measured and nothing is to be measured."""
    name = "-".join(word.lstrip("-").replace(".", "") for word in curve.words[: curve.words.index("--photons")])

    def make() -> Row:
        return {"rows": list(baseline_rows(load_task(TASK, asked.data_dir), curve.options, curve.levels, silent))}

    found = kept(asked.cache / f"baseline-{name}.json", {"words": curve.words}, make, collect=asked.collect)
    words = f"pans baseline {curve.words[0]} --task {TASK} {' '.join(curve.words[1:])}"
    asked.report(f"{curve.way}: {'not measured yet' if found is None else 'measured'} ({words})")
    rows = [] if found is None else found["rows"]
    facts: Row = {"table": "curves", "way": curve.way}
    return [facts | {key: r[key] for key in ("features", "photons_asked")} | flat(r, r["first_200"]) for r in rows]


def end_to_end_rows(asked: Asked) -> Rows:
    """Return conventional end-to-end optimisation with every number of patterns."""
    curves = [
        Curve(f"end-to-end, d_f = {d}", BaselineOptions("e2e", "qat", features=d, trials=5), LEVELS)
        for d in E2E_FEATURES
        if asked.wants(d)
    ]
    return [row for curve in curves for row in curve_rows(asked, curve)]


def envelope(rows: Rows) -> Rows:
    """Return the best of all rows at each photon level, as rows of the way `ENVELOPE`; chosen by all test objects."""
    levels = sorted({row["photons_asked"] for row in rows})
    best = [max((r for r in rows if r["photons_asked"] == n), key=lambda r: float(r["value"])) for n in levels]
    return [row | {"way": ENVELOPE, "table": "envelope"} for row in best]


def fig_2e_page(asked: Asked) -> Made:
    """Return the rows of every curve and of the envelope, and PANS beside direct imaging and the envelope at equal light."""
    curves = [row for curve in CURVES for row in curve_rows(asked, curve)]
    best = [row | {"table": "curves"} for row in envelope(end_to_end_rows(asked))]
    posterior = [row for row in curves if row["way"] == POSTERIOR.way]
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
                there, error = (interpolated(curve, mine[of], of, key) for key in ("value", "error_objects"))
                if there is not None and error is not None:
                    prefix = f"{name}_{of}_"
                    mine |= {f"{prefix}value": there} | against(
                        mine["value"], there, mine["error_objects"], error, prefix=prefix
                    )
        pans.append(mine)
    rows = [*pans, *curves, *best]
    return Made(rows)


def _levels_between(measured: Rows) -> Rows:
    """Return the printed levels of direct imaging between those of this page: interpolation needs them."""
    if not measured:
        return []
    of_a_photon = measured[0]["illumination"] / measured[0]["photons"]
    known = {row["photons_asked"] for row in measured}
    return [row | {"illumination": row["photons"] * of_a_photon} for row in DIRECT[TASK] if row["photons"] not in known]


def end_to_end_page(asked: Asked) -> Made:
    """Return the envelope, and the rows of every number of patterns."""
    rows = end_to_end_rows(asked)
    best = envelope(rows)
    return Made(best + rows)


# ---- compressive sensing ----


def compressive_page(asked: Asked) -> Made:
    """Return one row per patterns, classifier, number of patterns and photons, and the epochs of the trainings on clean measurements."""
    cells, trainings = [], []
    for family, convolutions, epochs, features in SENSINGS:
        if not asked.wants(features):
            continue
        made_with = {"family": family, "features": features, "photons": PHOTONS, "epochs": epochs, "trials": TRIALS}
        made_with |= {"convolutions": True} if convolutions else {}
        path = asked.cache / f"compressive-{family}{'-conv' if convolutions else ''}-{features}.json"
        make = partial(sensed, asked.data_dir, features, family, convolutions, epochs)
        found = kept(path, made_with, make, collect=asked.collect)
        asked.report(f"compressive, {family}, d_f = {features}: {'not measured yet' if found is None else 'measured'}")
        if found is not None:
            classifier = "convolutions" if convolutions else "one hidden layer"
            facts: Row = {"family": family, "classifier": classifier, "features": features}
            trainings += by_epoch(found["epochs"], **facts)
            for cell in found["cells"]:
                light = {"table": "cells", "photons_asked": cell["photons_asked"]}
                cells.append(light | facts | flat(cell, cell["first_200"]))
    return Made(cells + trainings)


def sensed(data_dir: str | None, features: int, family: str, convolutions: bool, epochs: int) -> Row:
    """Train on clean measurements by that many patterns, and judge at every photon level."""
    task = load_task(TASK, data_dir)
    measurement = measure(task, patterns(family, features, task.image_shape, seed=0))
    clean = measurement.photoelectrons(measurement.test, 1.0)
    course: dict[str, list[float]] = {"loss": [], "training": [], "held_out": []}

    def watch(epoch: EpochOfFit, decide: Decide) -> None:
        course["loss"].append(round(epoch.loss, 4))
        course["training"].append(round(100 * epoch.accuracy, 2))
        course["held_out"].append(round(100 * float((decide(clean) == measurement.test_labels).mean()), 2))

    at = clean_mlp(measurement, seed=0, epochs=epochs, convolutions=convolutions, watch=watch)
    cells = []
    for photons in PHOTONS:
        done = run_trials(measurement, photons, "counting", at(photons, "counting"), trials=TRIALS, seed=0)
        first = row_of(done.measured(FIRST_OBJECTS))
        cells.append({"photons_asked": photons, **row_of(done.measured()), "first_200": first})
    return {"epochs": course, "cells": cells}
