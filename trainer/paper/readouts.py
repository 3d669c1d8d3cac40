"""What single readouts look like: shots of the trained patterns, and camera frames at falling photon levels (paper, both appendices).

Owns the pages `single-shot` and `direct-frames`: which images (the first test image of every class, none chosen), which trials (fixed
seeds), the t-SNE maps, and how the variation from shot to shot is put into numbers. SIMULATED; FashionMNIST; nothing is trained. Of
frames, light and detection are those of the baselines, the decision is the exact posterior's.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.decide.backends import make_decider
from pans.runtime.instrument.profile import load_profile
from pans.trainer.baselines.bayes import log_joint
from pans.trainer.baselines.common import Measurement, Trials, detect, measure
from pans.trainer.evaluate.accuracy import EXACT_OUTCOMES_MAX, Light, decision_shares, light_of, row_of, sampled_shares
from pans.trainer.evaluate.pictures import tsne
from pans.trainer.tasks.registry import Objects, Task, load_task

from . import images
from .active import PROFILE, TrainedRow, measured_on, trained_rows
from .page import Asked, Column, Draw, Made, Row, Rows, Table, columns, kept, pages
from .paradigms import CLEAN, POSTERIOR, TASK, curve_rows
from .tables import FIRST

SHOT_FEATURES = (16, 32)
TRIALS = 30  # as the paper's experiment
SAMPLED_TRIALS = 10_000  # where the words are too many to enumerate
MAPPED_SHOTS = 1000
NEIGHBOURS = 10
UNCERTAIN = (0.1, 0.9)  # click probabilities between which an exposure tells trials apart
PIPELINE_CLASS, PIPELINE_FEATURES = "Shirt", 16  # the paper's example

SHOWN = {1e6: 1, 1e3: 3, 1e2: 3, 1e1: 3}  # photons: frames drawn of each object
MAPPED = (1e6, 1e2, 1e1)
MAPPED_FRAMES = 600  # frames on a map, one of each of the first test images
FLOOR = 5e-3  # of full transmission, by which the posterior lifts every pixel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def neighbours_agree(points: NDArray[np.floating], labels: I64, count: int = NEIGHBOURS) -> float:
    """Return the share of points whose class most of their `count` nearest others have (a tie goes to the lowest class)."""
    norms = (points**2).sum(axis=1)
    away = norms[:, None] + norms[None, :] - 2 * points @ points.T
    np.fill_diagonal(away, np.inf)
    nearest = labels[np.argsort(away, axis=1, kind="stable")[:, :count]]
    votes = (nearest[:, :, None] == np.arange(labels.max() + 1)).sum(axis=1)
    return float((votes.argmax(axis=1) == labels).mean())


# ---- single shots of trained patterns ----


def single_shot_page(asked: Asked) -> Made:
    """Return one row per d_f, with one entry per image shown."""
    shown, rows = [], []
    for row in trained_rows(asked, TASK):
        if row.features not in SHOT_FEATURES:
            continue
        facts = {
            "trials": [TRIALS, SAMPLED_TRIALS],
            "mapped": MAPPED_SHOTS,
            "neighbours": NEIGHBOURS,
            "uncertain": UNCERTAIN,
        }
        made = measured_on(asked, row, facts, partial(_measure, row, asked.data_dir))
        if made is None:
            continue
        measured = {key: made[key] for key in ("differing", "near", "objects")} | {"sha256": row.sha256}
        one = {"table": TASK, "features": row.features, FIRST: row.figures[FIRST]["1"], "all": row.figures["all"]["1"]}
        rows.append(one | measured)
        drawn = {key: made[key] for key in ("images", "places", "labels", "classes")}
        shown.append(rows[-1] | drawn | {"patterns": row.bundle.patterns()})
    return Made(rows, _pictures(shown))


def _pictures(shown: Rows) -> dict[str, Draw]:
    if not shown:
        return {}
    pictures: dict[str, Draw] = {
        "-frames": partial(images.click_frames, shown=shown),
        "-tsne": partial(images.shot_maps, shown=shown),
    }
    for one in shown:
        if one["features"] == PIPELINE_FEATURES:
            pictures["-pipeline"] = partial(images.pipeline, one=one, name=PIPELINE_CLASS)
            pictures["-outputs"] = partial(images.outputs, one=one)
    return pictures


def _measure(row: TrainedRow, data_dir: str | None) -> Row:
    test = load_task(TASK, data_dir).test
    lit = light_of(row.bundle, load_profile(PROFILE), test.images)
    chosen = np.array([int(np.flatnonzero(test.labels == label)[0]) for label in range(row.bundle.n_classes)])
    place, near = _map(row, lit, test)
    return {
        "classes": list(row.bundle.classes),
        "objects": _trials(row, lit, chosen),
        "images": test.images[chosen].tolist(),
        "differing": differing(lit.probability, test.labels),
        "near": near,
        "places": place.round(2).tolist(),
        "labels": test.labels[:MAPPED_SHOTS].tolist(),
    }


def _trials(row: TrainedRow, lit: Light, chosen: I64) -> Rows:
    """One entry per chosen object: clicks and outputs of every trial, shares of the decisions, expected shares."""
    bundle, decider = row.bundle, make_decider(row.bundle)
    part = Light(lit.photoelectrons[chosen], lit.probability[chosen], lit.law, lit.illumination)
    if 1 << bundle.n_features <= EXACT_OUTCOMES_MAX:
        expected = decision_shares(bundle, part)
    else:
        expected = sampled_shares(bundle, part, trials=SAMPLED_TRIALS, seed=1)
    rng = np.random.default_rng([0, bundle.n_features])
    found = []
    for i, index in enumerate(chosen):
        words = rng.binomial(1, part.probability[i], (TRIALS, bundle.n_features))
        decided = decider.decide_batch(words, 1)
        found.append(
            {
                "object": int(index),
                "class": bundle.classes[i],
                "clicks": float(part.probability[i].sum()),
                "photons": float(part.photoelectrons[i].sum()),
                "illumination": part.illumination,
                "words": ["".join(map(str, word)) for word in words],
                "decided": decided.tolist(),
                "outputs": softmax(decider.scores_batch(words, 1)).round(3).tolist(),
                "expected": expected[i].round(4).tolist(),
            }
        )
    return found


def softmax(scores: NDArray[np.float32]) -> F64:
    """Return the outputs (n, classes) of rows of scores, each summing to 1."""
    wide = scores.astype(np.float64)
    grown = np.exp(wide - wide.max(axis=1, keepdims=True))
    return np.asarray(grown / grown.sum(axis=1, keepdims=True))


def differing(probability: F64, labels: I64) -> dict[str, float]:
    """Return how many of d_f clicks differ on average between two shots: of one object, of two of a class, of two
    of other classes; and `uncertain`, the share of exposures that are far from sure to click or not.
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
    apart = ~np.eye(len(sizes), dtype=bool)
    return {
        "uncertain": float(((probability > UNCERTAIN[0]) & (probability < UNCERTAIN[1])).mean()),
        "object": float(own.mean()),
        "class": float(np.mean(within)),
        "others": float(between[apart].mean()),
    }


def _map(row: TrainedRow, lit: Light, test: Objects) -> tuple[F64, dict[str, float]]:
    """The t-SNE of one shot of each of the first objects, and how well neighbours tell the class: on the map, by the clicks, the head."""
    labels = test.labels[:MAPPED_SHOTS]
    words = np.random.default_rng([1, row.features]).binomial(1, lit.probability[:MAPPED_SHOTS])
    place = tsne(words.astype(np.float64))
    head = make_decider(row.bundle).decide_batch(words, 1)
    return place, {
        "map": neighbours_agree(place, labels),
        "clicks": neighbours_agree(words.astype(np.float64), labels),
        "head": float((head == labels).mean()),
    }


def single_shot_tables(rows: Rows) -> list[Table]:
    """Return how much shots vary, one line per d_f, and for each d_f one line per image shown."""
    found = [Table(columns("single_shot"), rows)]
    for row in rows:
        how = "exact" if 1 << row["features"] <= EXACT_OUTCOMES_MAX else f"{SAMPLED_TRIALS} trials"
        names = [one["class"] for one in row["objects"]]
        shown = [one | _decided(one, names, label) for label, one in enumerate(row["objects"])]
        expected = Column(f"expected right % ({how})", "{expected_right:.1f %}")
        of_images = (*columns("shots_of_images"), expected, Column("decided most wrongly as", "{wrong}"))
        found.append(Table(of_images, shown, f"## d_f = {row['features']}, {TRIALS} trials of each image shown"))
    return found


def _decided(one: Row, names: list[str], label: int) -> Row:
    wrong = np.array(one["expected"])
    expected, wrong[label] = wrong[label], 0.0
    other = int(wrong.argmax())
    right = sum(decided == label for decided in one["decided"])
    most = f"{names[other]} {100 * wrong[other]:.0f} %"
    return {"different": len(set(one["words"])), "right": right, "expected_right": expected, "wrong": most}


# ---- camera frames ----


def frames_page(asked: Asked) -> Made:
    """Return one row per photon level."""
    task = load_task(TASK, asked.data_dir)
    maps = [found for photons in MAPPED if (found := _frame_map(asked, task, photons)) is not None]
    curves = {curve.way: curve_rows(replace(asked, collect=True), curve) for curve in (CLEAN, POSTERIOR)}
    rows = [_frame_row(photons, maps, curves) for photons in SHOWN]
    pictures: dict[str, Draw] = {"": partial(images.frames, classes=task.classes, shown=drawn_frames(task))}
    if maps:
        pictures["-map"] = partial(images.frame_maps, classes=task.classes, maps=maps)
    return Made(rows, pictures)


def drawn_frames(task: Task, seed: int = 0) -> dict[float, NDArray[np.float32]]:
    """Return photons -> counts, float32 (classes, draws, height, width), of the first test image of each class."""
    firsts = np.array([int(np.flatnonzero(task.test.labels == label)[0]) for label in range(len(task.classes))])
    measurement = measure(task, None)
    frames = {}
    for photons, draws in SHOWN.items():
        lit = measurement.photoelectrons(measurement.test[firsts], photons)
        rng = np.random.default_rng([seed, int(photons)])
        drawn = np.stack([detect(lit, "counting", rng) for _ in range(draws)], axis=1)
        frames[photons] = drawn.reshape(len(firsts), draws, *task.image_shape)
    return frames


def _frame_map(asked: Asked, task: Task, photons: float) -> Row | None:
    def make() -> Row:
        found = mapped_frames(task, photons)
        asked.report(f"map of frames at {photons:g} photons: neighbours agree for {100 * found['neighbours']:.1f} %")
        return found

    path = asked.cache / f"direct-frames-{photons:g}.json"
    return kept(path, {"objects": MAPPED_FRAMES, "photons": photons, "floor": FLOOR}, make, collect=asked.collect)


def mapped_frames(task: Task, photons: float, seed: int = 0) -> Row:
    """Return a t-SNE map of one frame of each of the first test images, and what the frames and the map decide."""
    part = replace(task, test=Objects(task.test.images[:MAPPED_FRAMES], task.test.labels[:MAPPED_FRAMES]))
    measurement = measure(part, None)
    lit = measurement.photoelectrons(measurement.test, photons)
    frames = detect(lit, "counting", np.random.default_rng([seed, 5]))
    place = tsne(frames, seed=seed)
    labels = part.test.labels
    return {
        "photons_asked": photons,
        "map": np.round(place, 2).tolist(),
        "labels": labels.tolist(),
        "neighbours": neighbours_agree(place, labels),
        "posterior": _judged(measurement, lit, frames, photons),
    }


def _judged(measurement: Measurement, lit: Any, frames: Any, photons: float) -> Row:
    """The exact posterior's decisions on these very frames."""
    decided = log_joint(measurement, frames, photons, "counting", floor=FLOOR).argmax(axis=1)
    right = (decided == measurement.test_labels)[None, :]
    clicks, given = (frames > 0).sum(axis=1).astype(np.float64), lit.sum(axis=1, dtype=np.float64)
    return row_of(Trials(right, clicks, given, measurement.illumination(photons)).measured())


def _frame_row(photons: float, maps: Rows, curves: dict[str, Rows]) -> Row:
    row: Row = {"photons_asked": photons}
    for found in maps:
        if found["photons_asked"] == photons:
            row |= {"neighbours": found["neighbours"], "on_the_map": found["posterior"]}
    for name, way in zip(("network", "posterior"), curves):
        at_level = next((each for each in curves[way] if each["photons_asked"] == photons), None)
        if at_level is not None:
            row[name] = at_level
    return row


def frames_tables(rows: Rows) -> list[Table]:
    """Return one line per photon level; light is that of the posterior's frames, else of the network's, else of those on the map."""
    of = ("posterior", "network", "on_the_map")
    shown = [row | {"light": next((row[key] for key in of if key in row), None)} for row in rows]
    return [Table(columns("direct_frames"), shown)]


PAGES = pages({"single-shot": (single_shot_page, single_shot_tables), "direct-frames": (frames_page, frames_tables)})
