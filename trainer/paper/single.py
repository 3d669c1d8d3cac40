"""What single shots look like: click frames, outputs of the back end, decisions, a map of the clicks (paper, appendix on the experiment).

Owns the page `single-shot`: which images (the first test image of every class, none chosen), which trials (a fixed seed), and how the
variation from shot to shot is put into numbers. The trained rows are FashionMNIST's d_f = 16 and 32. SIMULATED; nothing is trained.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.decide.backends import make_decider
from pans.runtime.instrument.profile import load_profile
from pans.trainer.evaluate.accuracy import EXACT_OUTCOMES_MAX, Light, decision_shares, light_of, sampled_shares
from pans.trainer.evaluate.tsne import tsne
from pans.trainer.paper_tables import FIRST_OBJECTS
from pans.trainer.tasks.registry import Objects, load_task

from . import figures_single
from .active import PROFILE
from .page import Asked, Draw
from .trained_rows import (
    SPREADS_SAY,
    TrainedRow,
    measured_on,
    profile_says,
    rows_say,
    seconds_say,
    table_head,
    trained_rows,
)

TABLE = "fashion-mnist"
FEATURES = (16, 32)
TRIALS = 30  # as the paper's experiment
SAMPLED_TRIALS = 10_000  # where the words are too many to enumerate
MAPPED_OBJECTS = 1000
NEIGHBOURS = 10
UNCERTAIN = (0.1, 0.9)  # click probabilities between which an exposure tells trials apart
PIPELINE_CLASS, PIPELINE_FEATURES = "Shirt", 16  # the paper's example
FIRST = f"first_{FIRST_OBJECTS}"

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def single_shot_page(asked: Asked) -> dict[str, Any]:
    """Return one row per d_f (with one entry per image shown), and the page."""
    shown, rows, parts = [], [], []
    trained = [row for row in trained_rows(asked, TABLE) if row.features in FEATURES]
    for row in trained:
        facts = {
            "trials": [TRIALS, SAMPLED_TRIALS],
            "mapped": MAPPED_OBJECTS,
            "neighbours": NEIGHBOURS,
            "uncertain": UNCERTAIN,
        }
        made = measured_on(asked, row, facts, partial(_measure, row, asked.data_dir))
        if made is None:
            asked.report(f"single-shot: d_f = {row.features} is not measured yet: pans reproduce single-shot")
            continue
        parts.append(made)
        drawn = {key: made[key] for key in ("images", "places", "labels", "classes")}
        measured = {key: made[key] for key in ("differing", "near", "objects")}
        one = {"table": TABLE, "features": row.features, FIRST: row.figures[FIRST]["1"], "all": row.figures["all"]["1"]}
        rows.append(one | measured)
        shown.append(rows[-1] | drawn | {"patterns": row.bundle.patterns()})
    there = [row for row in trained if any(row.features == found["features"] for found in rows)]
    lines = [
        *_head(),
        *(rows_say(TABLE, there)[:1]),
        *_missing(rows),
        seconds_say(parts),
        "",
        *_tables(rows),
        *_says(rows),
    ]
    return {"rows": rows, "markdown": "\n".join([*lines, ""]), "pictures": _pictures(shown)}


def _pictures(shown: list[dict[str, Any]]) -> dict[str, Draw]:
    if not shown:
        return {}
    pictures: dict[str, Draw] = {
        "-frames": partial(figures_single.frames, shown=shown),
        "-tsne": partial(figures_single.maps, shown=shown),
    }
    for one in shown:
        if one["features"] == PIPELINE_FEATURES:
            pictures["-pipeline"] = partial(figures_single.pipeline, one=one, name=PIPELINE_CLASS)
            pictures["-outputs"] = partial(figures_single.outputs, one=one)
    return pictures


# ---- measuring ----


def _measure(row: TrainedRow, data_dir: str | None) -> dict[str, Any]:
    test = load_task(TABLE, data_dir).test
    light = light_of(row.bundle, load_profile(PROFILE), test.images)
    chosen = np.array([int(np.flatnonzero(test.labels == label)[0]) for label in range(row.bundle.n_classes)])
    place, near = _map(row, light, test)
    return {
        "classes": list(row.bundle.classes),
        "objects": _trials(row, light, chosen),
        "images": test.images[chosen].tolist(),
        "differing": differing(light.probability, test.labels),
        "near": near,
        "places": place.round(2).tolist(),
        "labels": test.labels[:MAPPED_OBJECTS].tolist(),
    }


def _trials(row: TrainedRow, light: Light, chosen: I64) -> list[dict[str, Any]]:
    """One entry per chosen object: clicks and outputs of every trial, shares of the decisions, expected shares."""
    bundle, decider = row.bundle, make_decider(row.bundle)
    part = Light(light.photoelectrons[chosen], light.probability[chosen], light.law, light.illumination)
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
    between_sure = (probability > UNCERTAIN[0]) & (probability < UNCERTAIN[1])
    uncertain = float(between_sure.mean())
    return {
        "uncertain": uncertain,
        "object": float(own.mean()),
        "class": float(np.mean(within)),
        "others": float(between[apart].mean()),
    }


def _map(row: TrainedRow, light: Light, test: Objects) -> tuple[F64, dict[str, float]]:
    """The t-SNE of one shot of each of the first objects, and how well neighbours tell the class: on the map, by the clicks, the head."""
    labels = test.labels[:MAPPED_OBJECTS]
    words = np.random.default_rng([1, row.features]).binomial(1, light.probability[:MAPPED_OBJECTS])
    place = tsne(words.astype(np.float64))
    head = make_decider(row.bundle).decide_batch(words, 1)
    return place, {
        "map": neighbours_right(place, labels),
        "clicks": neighbours_right(words.astype(np.float64), labels),
        "head": float((head == labels).mean()),
    }


def neighbours_right(points: F64, labels: I64, count: int = NEIGHBOURS) -> float:
    """Return the share of points whose class the majority of their `count` nearest others has (ties: the lowest class)."""
    norms = (points**2).sum(axis=1)
    away = norms[:, None] + norms[None, :] - 2 * points @ points.T
    np.fill_diagonal(away, np.inf)
    nearest = labels[np.argsort(away, axis=1, kind="stable")[:, :count]]
    votes = (nearest[:, :, None] == np.arange(labels.max() + 1)).sum(axis=1)
    return float((votes.argmax(axis=1) == labels).mean())


# ---- the page ----


def _head() -> list[str]:
    return [
        "# Single shots: clicks, outputs, decisions",
        "",
        f"{profile_says()} Command: `pans reproduce single-shot`; nothing is trained; seeds 0 (trials) and 1 (map). FashionMNIST, K = 1. "
        "The paper shows measured clicks of some test images, one pipeline (a Shirt, d_f = 16, six trials, five right) and the outputs of "
        f"{TRIALS} trials laid over each other. Ours are drawn from the same law; the images are **the first test image of every class**, "
        f"whatever they look like. {SPREADS_SAY}",
        "",
        "- [frames](single-shot-frames.png): clicks (white) of five trials per image; [map](single-shot-tsne.png): t-SNE of one shot of "
        f"each of the first {MAPPED_OBJECTS} test images",
        f"- [pipeline](single-shot-pipeline.png): image, patterns, and the first six trials of the {PIPELINE_CLASS}; "
        f"[outputs](single-shot-outputs.png): the outputs (softmax) of all {TRIALS} trials, and the share of trials per decision",
        "",
        "![clicks of single shots](single-shot-frames.png)",
        "",
    ]


def _missing(rows: list[dict[str, Any]]) -> list[str]:
    missing = [str(features) for features in FEATURES if all(row["features"] != features for row in rows)]
    if not missing:
        return []
    return [
        f"**Not here: d_f = {', '.join(missing)}**; train by `pans reproduce {TABLE} --rows {' '.join(missing)}`, then "
        "`pans reproduce single-shot`."
    ]


def _tables(rows: list[dict[str, Any]]) -> list[str]:
    parts = (f"first {FIRST_OBJECTS}", "trials", "objects", "all", "trials", "objects")
    differ = ("one image", "two of a class", "two of other classes")
    near = (f"{NEIGHBOURS} neighbours on the map", "by clicks", "the head")
    lines = table_head("d_f", *parts, "clicks", "photons", "illumination", *differ, *near)
    for row in rows:
        cells = [str(row["features"])]
        for part in (FIRST, "all"):
            cells += [f"{100 * row[part][key]:.2f}" for key in ("accuracy_mean", "accuracy_std", "accuracy_se_objects")]
        whole = row["all"]
        cells += [f"{whole['clicks_mean']:.2f}", f"{whole['photons_mean']:.1f}", f"{whole['illumination']:.0f}"]
        cells += [f"{row['differing'][key]:.2f}" for key in ("object", "class", "others")]
        cells += [f"{100 * row['near'][key]:.1f}" for key in ("map", "clicks", "head")]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "`one image` and the next two columns: clicks that differ between two shots, expectation over all 10 000 images. The last ",
    ]
    lines[-1] += (
        f"three: % of {MAPPED_OBJECTS} single shots told right by the majority of their neighbours, and by the trained head."
    )
    for row in rows:
        lines += ["", f"d_f = {row['features']}, {TRIALS} trials of each image shown:", "", *_objects(row)]
    return [*lines, ""]


def _objects(row: dict[str, Any]) -> list[str]:
    how = "exact" if 1 << row["features"] <= EXACT_OUTCOMES_MAX else f"{SAMPLED_TRIALS} trials"
    lines = table_head(
        "class", "test image", "clicks", "photons", "illumination", "different words", f"right of {TRIALS}", f"expected right % ({how})",
        "decided most wrongly as",
    )  # fmt: skip
    names = [one["class"] for one in row["objects"]]
    for label, one in enumerate(row["objects"]):
        right = sum(decided == label for decided in one["decided"])
        wrong = np.array(one["expected"])
        expected, wrong[label] = wrong[label], 0.0
        other = int(wrong.argmax())
        lines.append(
            f"| {one['class']} | {one['object']} | {one['clicks']:.2f} | {one['photons']:.1f} | {one['illumination']:.0f} "
            f"| {len(set(one['words']))} | {right} | {100 * expected:.1f} | {names[other]} {100 * wrong[other]:.0f} % |"
        )
    return lines


def _says(rows: list[dict[str, Any]]) -> list[str]:
    """The paper's words against these shots."""
    lines = []
    for row in rows:
        d_f, apart, near = row["features"], row["differing"], row["near"]
        lines.append(
            f"- *Detection patterns differ substantially across trials*: at d_f = {d_f} two shots of one image differ in "
            f"{apart['object']:.1f} of {d_f} clicks, two images of a class in {apart['class']:.1f}, two of different classes in "
            f"{apart['others']:.1f}. The paper speaks of *expected detection counts below one photon per pattern on average*; ours have "
            f"{row['all']['photons_mean'] / d_f:.1f}: held to clicks alone, channels are dark or saturated, and only "
            f"{100 * apart['uncertain']:.0f} % of exposures click with a probability between {UNCERTAIN[0]:g} and {UNCERTAIN[1]:g}. The "
            "paper prints no such figure of its own."
        )
        lines.append(
            f"- *Distinct class clusters emerge* in t-SNE: at d_f = {d_f} neighbours on the map tell {100 * near['map']:.0f} % of single "
            f"shots right, neighbours by clicks {100 * near['clicks']:.0f} %, the head {100 * near['head']:.0f} %."
        )
    for row in rows:
        if row["features"] == PIPELINE_FEATURES:
            lines += _pipeline_says(row)
    return lines


def _pipeline_says(row: dict[str, Any]) -> list[str]:
    names = [one["class"] for one in row["objects"]]
    label = names.index(PIPELINE_CLASS)
    shirt = row["objects"][label]
    six = shirt["decided"][:6]
    expected = {name: one["expected"][i] for i, (name, one) in enumerate(zip(names, row["objects"]))}
    surest = max(expected, key=expected.__getitem__)
    return [
        f"- *Five of six trials correctly predict Shirt*: our first Shirt has {sum(decided == label for decided in six)} of its first six, "
        f"{100 * expected[PIPELINE_CLASS]:.0f} % by expectation. One image says little: over all Shirts see [confusion](confusion.md).",
        f"- *Trouser shows a highly concentrated distribution*: ours is decided right in {100 * expected['Trouser']:.1f} % by "
        f"expectation; the surest of these images is {surest} ({100 * expected[surest]:.1f} %).",
    ]
