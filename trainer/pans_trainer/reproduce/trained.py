"""Pages that measure the trained rows of FashionMNIST and MNIST further: shots, light, dark counts, confusions, single shots."""

from __future__ import annotations

import math
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.bundle.backends import make_decider
from pans.bundle.sensor import Bundle
from pans.calibrate.refit import log_softmax
from pans.instrument.profile import load_profile
from pans_trainer.evaluate.accuracy import Light, decision_shares, light_of
from pans_trainer.evaluate.pictures import tsne
from pans_trainer.tasks.registry import Objects, load_task

from . import plots
from .active import (
    EXACT_WORK_MAX,
    PARTS,
    PROFILE,
    TRIALS,
    TRIALS_OF_ALL,
    TrainedRow,
    beside_paper,
    enumerable,
    judged,
    measured_on,
    shot_figures,
    trained_rows,
)
from .page import FIRST_OBJECTS, Asked, Draw, Made, Row, Rows, beside_curve, flat, sampling_error
from .printed import ACTIVE, SHOTS

SWEPT = "fashion-mnist"  # of eta, dark counts and single shots
SETTINGS = {  # factors of the light, dark counts of an exposure
    "eta": tuple(10.0 ** (exponent / 4) for exponent in range(-8, 9)),
    "dark": tuple(10.0 ** (exponent / 4) for exponent in range(-12, 1)),
}
SHOWN = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0)  # settings that the page names
LEVEL = 2.0  # points below the best that still count as level with it
WORST = 3  # confusions that a table names
SHOT_FEATURES = (16, 32)  # of the page single-shot
SHOWN_TRIALS = 30  # as the paper's experiment
SAMPLED_TRIALS = 10_000  # where the words are too many to enumerate
MAPPED = 1000  # shots on a map
NEIGHBOURS = 10
UNCERTAIN = (0.1, 0.9)  # click probabilities between which an exposure tells trials apart
DUELS = (  # whose, what is equal, key of it, of the accuracy, and of its error
    ("paper, simulation", "detections", "detections", "simulation", "paper_error"),
    ("paper, simulation", "clicks", "paper_clicks", "simulation", "paper_error"),
    (f"ours, first {FIRST_OBJECTS}", "detections", "detections", "first_200", "first_error"),
    ("ours, all", "detections", "detections", "value", "error_objects"),
    ("ours, all", "clicks", "clicks", "value", "error_objects"),
    ("ours, all", "photons", "photons", "value", "error_objects"),
)
PIPELINE = ("Shirt", 16)  # the paper's example: class and number of patterns

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


# ---- more patterns, more shots ----


def fig_3_page(asked: Asked) -> Made:
    """Return one row per data set and number of patterns at one shot, beside the paper's simulation and experiment."""
    return Made(_points(asked, (1,)))


def multi_shot_page(asked: Asked) -> Made:
    """Return, per data set and measure of the expense, the duels of more patterns against more shots; then the points."""
    points = _points(asked, SHOTS)
    return Made(duels(points) + points)


def _points(asked: Asked, shots: tuple[int, ...]) -> Rows:
    rows = [(name, row) for name in ACTIVE for row in trained_rows(asked, name)]
    return [{"set": name} | beside_paper(row.paper, k, row.figures, [row.figures]) for name, row in rows for k in shots]


def duels(points: Rows) -> Rows:
    """Hold every point of several shots against the curves of more patterns where they reach as far: one row per set and expense.

    A row counts in how many duels more patterns are above, level and below, and names their least lead in points.
    """
    rows: Rows = []
    for name in dict.fromkeys(row["set"] for row in points):
        mine = [
            row | {"paper_error": sampling_error(row["simulation"], FIRST_OBJECTS)}
            for row in points
            if row["set"] == name
        ]
        for whose, equal, spent, value, error in DUELS:
            curves: dict[int, Rows] = {}
            for row in mine:
                point = {"spent": row[spent], "value": row[value], "error_objects": row[error]}
                curves.setdefault(row["features"], []).append(point)
            pairs = [(row, curves[many]) for few, many in combinations(sorted(curves), 2) for row in curves[few]]
            found = [compared for row, curve in pairs if (compared := beside_curve(row, curve, "spent"))]
            fewer = [compared["verdict"] for compared in found]  # of fewer patterns
            counts = {"above": fewer.count("below"), "level": fewer.count("level"), "below": fewer.count("above")}
            facts = {"table": "duels", "set": name, "whose": whose, "equal": equal, "duels": len(found)}
            rows.append(facts | counts | {"least": min((-compared["ahead"] for compared in found), default=None)})
    return rows


# ---- light and dark counts ----


def swept_page(asked: Asked) -> Made:
    """Return one row per number of patterns as trained, with the effect of the sweep, and one per setting."""
    sweep = "dark" if asked.name == "dark-counts" else "eta"
    settings, trained, rows = SETTINGS[sweep], [], []
    facts = {"settings": settings, "trials": [TRIALS, TRIALS_OF_ALL], "exact": EXACT_WORK_MAX}
    for row in trained_rows(asked, SWEPT):
        made = measured_on(asked, row, facts, partial(_all_settings, row, asked.data_dir, sweep))
        if made is not None:
            swept = [flat(found["all"], found["first_200"]) | {"setting": found["setting"]} for found in made["rows"]]
            base, of_row = shot_figures(row.figures), {"features": row.features}
            effect = over_light(swept) if sweep == "eta" else over_dark(base, swept)
            trained.append({"table": "trained"} | of_row | base | effect)
            for found in swept:
                shown = any(math.isclose(found["setting"], setting) for setting in SHOWN)
                rows.append({"table": "swept", "shown": shown} | of_row | found)
    return Made(trained + rows)


def _all_settings(row: TrainedRow, data_dir: str | None, sweep: str) -> Row:
    """The figures at every factor of the light (`eta`), or with that many dark counts per exposure (`dark`)."""
    test, rows = load_task(SWEPT, data_dir).test, []
    for setting in SETTINGS[sweep]:
        how: dict[str, Any] = {sweep: setting}
        parts = {part: judged(row.bundle, test.first(count), **how) for part, count in PARTS.items()}
        rows.append({"setting": setting, **parts})
    return {"rows": rows}


def _at(swept: Rows, setting: float) -> float:
    """Return the accuracy at a setting, up to rounding."""
    return float(min(swept, key=lambda row: abs(float(row["setting"]) - setting))["value"])


def over_light(swept: Rows) -> Row:
    """Return the best factor of the light, its gain over the trained light, and the range within `LEVEL` points of the best."""
    top = max(swept, key=lambda row: float(row["value"]))
    level = [row["setting"] for row in swept if row["value"] >= top["value"] - LEVEL]
    changes = {"at_third": _at(swept, 10**-0.5) - _at(swept, 1.0), "at_tenth": _at(swept, 0.1) - _at(swept, 1.0)}
    best = {"best": top["setting"], "gain": top["value"] - _at(swept, 1.0)}
    return best | {"low": level[0], "high": level[-1]} | changes


def over_dark(base: Row, swept: Rows) -> Row:
    """Return the change of the accuracy in points at 0.1 dark counts, and per decade below and above."""
    low, middle, high = (_at(swept, dark) for dark in (0.01, 0.1, 1.0))
    return {"change": middle - base["value"], "below": middle - low, "above": high - middle}


# ---- confusion ----


def confusion(shares: F64, objects: Objects) -> F64:
    """Return the matrix (true class, decided class) of P(decided | object) (n, classes): rows sum to 1, or to 0 without objects."""
    matrix = np.zeros((shares.shape[1], shares.shape[1]))
    np.add.at(matrix, objects.labels, shares)
    return matrix / np.maximum(np.bincount(objects.labels, minlength=len(matrix)), 1)[:, None]


def confusion_page(asked: Asked) -> Made:
    """Return one row per data set and number of patterns: the classes told best and worst, and the most frequent confusions."""
    rows: Rows = []
    pictures: dict[str, Draw] = {}
    for name in ACTIVE:
        drawn = []
        for row in trained_rows(asked, name):
            facts = {"trials": [TRIALS, TRIALS_OF_ALL]}
            made = measured_on(asked, row, facts, partial(_matrix, row, asked.data_dir))
            if made is not None:
                found = {"table": "confusion", "set": name, "features": row.features} | shot_figures(row.figures)
                rows.append(found | named_confusions(np.array(made["all"]), made["classes"]))
                drawn.append(found | {"matrix": made["all"], "classes": made["classes"]})
        pictures[f"-{name}"] = partial(plots.confusions, rows=drawn, name=name)
    return Made(rows, pictures)


def _matrix(row: TrainedRow, data_dir: str | None) -> Row:
    task = load_task(row.name, data_dir)
    shares = shares_of(row.bundle, light_of(row.bundle, load_profile(PROFILE), task.test.images), TRIALS_OF_ALL)
    return {"classes": list(task.classes), "all": confusion(shares, task.test).round(5).tolist()}


def shares_of(bundle: Bundle, lit: Light, trials: int) -> F64:
    """Return P(decided class | object), (n, classes): exact where all outcomes can be enumerated, else of so many trials."""
    return decision_shares(bundle, lit, None if enumerable(bundle, len(lit.probability)) else trials, seed=1)


def named_confusions(matrix: F64, classes: list[str]) -> Row:
    """Return the classes that are told best and worst, and the most frequent confusions, with shares in %."""
    right = matrix.diagonal()
    best, poorest = (f"{classes[place]} {100 * right[place]:.0f}" for place in (right.argmax(), right.argmin()))
    wrong = matrix * (1 - np.eye(len(classes)))
    places = [np.unravel_index(place, wrong.shape) for place in np.argsort(-wrong, axis=None)[:WORST]]
    confused = ", ".join(f"{classes[i]} → {classes[j]} {100 * wrong[i, j]:.0f}" for i, j in places)
    return {"best": best, "poorest": poorest, "confused": confused}


# ---- single shots ----


def neighbours_agree(points: NDArray[np.floating], labels: I64, count: int = NEIGHBOURS) -> float:
    """Return the share of points whose class most of their `count` nearest others have (a tie goes to the lowest class)."""
    norms = (points**2).sum(axis=1)
    away = norms[:, None] + norms[None, :] - 2 * points @ points.T
    np.fill_diagonal(away, np.inf)
    nearest = labels[np.argsort(away, axis=1, kind="stable")[:, :count]]
    votes = (nearest[:, :, None] == np.arange(labels.max() + 1)).sum(axis=1)
    return float((votes.argmax(axis=1) == labels).mean())


def single_shot_page(asked: Asked) -> Made:
    """Return one row per number of patterns, and one per first test image of every class."""
    rows, images, shown = [], [], []
    facts: Row = {"trials": [SHOWN_TRIALS, SAMPLED_TRIALS], "mapped": MAPPED, "neighbours": NEIGHBOURS}
    facts |= {"uncertain": UNCERTAIN}
    for row in trained_rows(asked, SWEPT):
        wanted = row.features in SHOT_FEATURES
        made = measured_on(asked, row, facts, partial(_single_shots, row, asked.data_dir)) if wanted else None
        if made is not None:
            of_row = {"features": row.features}
            varying = {"table": "varying"} | of_row | shot_figures(row.figures) | made["differing"]
            varying |= {f"near_{key}": 100 * value for key, value in made["near"].items()}
            rows.append(varying | {"uncertain": 100 * made["differing"]["uncertain"]})
            for one in made["objects"]:
                named = row.features == PIPELINE[1]  # the table names the images of the paper's example
                images.append({"table": "images", "shown": named} | of_row | one | _decided(one, made["classes"]))
            shown.append(of_row | made | {"patterns": row.bundle.patterns()})
    pictures: dict[str, Draw] = {}
    if shown:
        pictures = {"-frames": partial(plots.click_frames, shown=shown), "-tsne": partial(plots.shot_maps, shown=shown)}
    for one in shown:
        if one["features"] == PIPELINE[1]:
            pictures["-pipeline"] = partial(plots.pipeline, one=one, name=PIPELINE[0])
            pictures["-outputs"] = partial(plots.outputs, one=one)
    return Made(rows + images, pictures)


def _single_shots(row: TrainedRow, data_dir: str | None) -> Row:
    test = load_task(SWEPT, data_dir).test
    lit = light_of(row.bundle, load_profile(PROFILE), test.images)
    chosen = np.array([int(np.flatnonzero(test.labels == label)[0]) for label in range(row.bundle.n_classes)])
    labels = test.labels[:MAPPED]
    words = np.random.default_rng([1, row.features]).binomial(1, lit.probability[:MAPPED])
    places, decided = tsne(words.astype(np.float64)), make_decider(row.bundle).decide_batch(words, 1)
    near = {"map": neighbours_agree(places, labels), "clicks": neighbours_agree(words.astype(np.float64), labels)}
    return {
        "classes": list(row.bundle.classes),
        "objects": _trials(row.bundle, lit, chosen),
        "images": test.images[chosen].tolist(),
        "differing": differing(lit.probability, test.labels),
        "near": near | {"head": float((decided == labels).mean())},
        "places": places.round(2).tolist(),
        "labels": labels.tolist(),
    }


def _trials(bundle: Bundle, lit: Light, chosen: I64) -> Rows:
    """Return per chosen object: clicks and outputs of every trial, the decisions, and their expected shares."""
    decider = make_decider(bundle)
    part = Light(lit.photoelectrons[chosen], lit.probability[chosen], lit.law, lit.illumination)
    expected = shares_of(bundle, part, SAMPLED_TRIALS)
    rng = np.random.default_rng([0, bundle.n_features])
    found = []
    for i, index in enumerate(chosen):
        words = rng.binomial(1, part.probability[i], (SHOWN_TRIALS, bundle.n_features))
        light = {"clicks": float(part.probability[i].sum()), "photons": float(part.photoelectrons[i].sum())}
        facts: Row = {"object": int(index), "class": bundle.classes[i], **light, "illumination": part.illumination}
        facts["words"] = ["".join(map(str, word)) for word in words]
        facts["decided"] = decider.decide_batch(words, 1).tolist()
        facts["outputs"] = np.exp(log_softmax(decider.scores_batch(words, 1).astype(np.float64))).round(3).tolist()
        found.append(facts | {"expected": expected[i].round(4).tolist()})
    return found


def differing(probability: F64, labels: I64) -> dict[str, float]:
    """Return how many of d_f clicks differ on average between two shots of one object, of two of a class, of two of other classes.

    `uncertain` is the share of exposures whose click probability is within `UNCERTAIN`.
    """
    sizes = np.bincount(labels)
    means = np.stack([probability[labels == label].mean(axis=0) for label in range(len(sizes))])
    own = 2 * (probability * (1 - probability)).sum(axis=1)
    within = []
    for label, n in enumerate(sizes):  # all pairs of a class, without an object against itself
        pairs = n * n * 2 * (means[label] * (1 - means[label])).sum()
        within.append(float(pairs - own[labels == label].sum()) / (n * (n - 1)))
    between = means @ (1 - means).T
    between = between + between.T
    uncertain = ((probability > UNCERTAIN[0]) & (probability < UNCERTAIN[1])).mean()
    others = float(between[~np.eye(len(sizes), dtype=bool)].mean())
    pairs = {"object": float(own.mean()), "class": float(np.mean(within)), "others": others}
    return {"uncertain": float(uncertain)} | pairs


def _decided(one: Row, classes: list[str]) -> Row:
    label, wrong = classes.index(one["class"]), np.array(one["expected"])
    expected, wrong[label] = 100 * float(wrong[label]), 0.0
    other, right = int(wrong.argmax()), sum(decided == label for decided in one["decided"])
    most = f"{classes[other]} {100 * wrong[other]:.0f} %"
    return {"different": len(set(one["words"])), "right": right, "expected_right": expected, "wrong": most}
