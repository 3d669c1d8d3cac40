"""The page `fig-2f`: t-SNE maps of single readouts, camera frames beside clicks of patterns, at equal photons (paper, Fig. 2F).

Owns the levels and the page. Both ways see the same test images with the same number of detected photoelectrons on average; frames are
counted by perfect pixels and decided by the exact posterior over all training images, clicks by the posterior table of the training
images at that light. SIMULATED, ideal shot noise; FashionMNIST; nothing is trained.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pans.runtime.instrument.click_law import ClickLaw, click_probability
from pans.runtime.instrument.profile import load_profile
from pans.trainer.baselines.bayes import log_joint
from pans.trainer.baselines.common import detect, measure
from pans.trainer.evaluate.accuracy import light_of
from pans.trainer.evaluate.pictures import tsne
from pans.trainer.paper.page import Asked, Made, Row, Rows, Table, columns, kept, pages
from pans.trainer.paper.readouts import neighbours_agree
from pans.trainer.paper.swept import shipped_bundle
from pans.trainer.tasks.registry import Objects, Task, load_task
from pans.trainer.verdicts import against, claim

from . import pictures

PHOTONS = (10.0, 30.0)
MAPPED = 1000  # test images, the first ones
FLOOR = 5e-3  # of full transmission, by which the posterior lifts every pixel
FRAMES, WORDS = "camera frames", "clicks of ten patterns"
_LEAST = 1e-9  # of a word's chance under a class

F64 = NDArray[np.float64]


def fig_2f_page(asked: Asked) -> Made:
    """Return one row per level and way, and the maps."""
    task = load_task(shipped_bundle().task, asked.data_dir)
    part = replace(task, test=task.test.first(MAPPED))
    panels = []
    for photons in PHOTONS:
        for way, make in ((FRAMES, _frames), (WORDS, _words)):
            name = "frames" if way == FRAMES else "words"
            found = kept(
                asked.cache / f"fig-2f-{name}-{photons:g}.json",
                {"objects": MAPPED, "photons": photons, "floor": FLOOR},
                partial(make, part, photons),
                collect=asked.collect,
            )
            if found is None:
                asked.report(f"{way} at {photons:g} photons: not measured yet (pans reproduce fig-2f)")
                continue
            asked.report(f"{way}, {photons:g} photons: {found['value']:.2f} %")
            panels.append({"way": way, "asked": photons, **found})
    rows = [{key: value for key, value in row.items() if key not in ("map", "labels", "made_with")} for row in panels]
    return Made(rows, {"": partial(pictures.maps, panels=panels, classes=list(task.classes))} if panels else {})


def _frames(task: Task, photons: float) -> Row:
    measurement = measure(task, None)
    lit = measurement.photoelectrons(measurement.test, photons)
    readouts = detect(lit, "counting", np.random.default_rng([0, 5]))
    right = log_joint(measurement, readouts, photons, "counting", floor=FLOOR).argmax(axis=1) == task.test.labels
    light = {"photons": float(lit.sum(axis=1).mean()), "illumination": measurement.illumination(photons)}
    return {"features": readouts.shape[1], **_mapped(readouts.astype(np.float64), task.test, right), **light}


def _words(task: Task, photons: float) -> Row:
    """The shipped patterns with all light scaled to `photons`, behind a detector without dark counts or read noise."""
    bundle, law = shipped_bundle(), ClickLaw()
    profile = load_profile(str(bundle.provenance["profile"]))
    train, test = (light_of(bundle, profile, images).photoelectrons for images in (task.train.images, task.test.images))
    eta = photons / float(test.sum(axis=1).mean())
    words = np.random.default_rng([0, 6]).random(test.shape) < click_probability(law, eta * test)
    table = class_table(click_probability(law, eta * train), task.train.labels, len(task.classes))
    index = words @ (1 << np.arange(words.shape[1]))
    right = table[index].argmax(axis=1) == task.test.labels
    light = {"photons": eta * float(test.sum(axis=1).mean()), "illumination": eta * bundle.illumination()}
    return {"features": words.shape[1], **_mapped(words.astype(np.float64), task.test, right), **light}


def class_table(probability: F64, labels: NDArray[np.int64], n_classes: int) -> F64:
    """Return log P(word, class), float64 (2**d_f, classes), of objects with click probabilities (n, d_f); bit i is pattern i."""
    table = np.empty((1 << probability.shape[1], n_classes))
    for label in range(n_classes):
        mine = probability[labels == label]
        chance = np.ones((len(mine), 1))
        for column in mine.T[:, :, None]:
            chance = np.concatenate([chance * (1 - column), chance * column], axis=1)
        table[:, label] = chance.sum(axis=0) / len(labels)
    return np.log(table + _LEAST)


def _mapped(readouts: F64, objects: Objects, right: NDArray[np.bool_]) -> Row:
    places = tsne(readouts)
    return {
        "map": places.round(2).tolist(),
        "labels": objects.labels.tolist(),
        "neighbours": neighbours_agree(places, objects.labels),
        "by_readouts": neighbours_agree(readouts, objects.labels),
        "value": 100 * float(right.mean()),
        "error_objects": 100 * float(right.std(ddof=1)) / len(right) ** 0.5,
        "clicks": float((readouts > 0).sum(axis=1).mean()),
    }


def fig_2f_tables(rows: Rows) -> list[Table]:
    """Return one line per level and way, clicks held against the frames of as many photons."""
    frames = {row["asked"]: row for row in rows if row["way"] == FRAMES}
    shown = []
    for row in rows:
        other = frames.get(row["asked"])
        compared = None
        if row["way"] == WORDS and other is not None:
            compared = against(row["value"], other["value"], row["error_objects"], other["error_objects"])
        shown.append(row | {"beside": compared})
    return [Table(columns("map"), shown, claims=[claim("Clicks", "frames", [row["beside"] for row in shown])])]


PAGES = pages({"fig-2f": (fig_2f_page, fig_2f_tables)})
