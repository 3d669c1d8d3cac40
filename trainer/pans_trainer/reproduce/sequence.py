"""Clicks and decisions frame by frame while cells pass (paper, Fig. 4C).

All patterns are measured at once, one shot per frame. The window moves along a strip of cells and empty fields; where a cell is neither in
the middle nor nearly out, a frame has no truth and is not judged. At run time,
`pans run --flow cells` finds cells and decides once on each.
"""

from __future__ import annotations

import hashlib
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pans.instrument.profile import load_profile
from pans_trainer.model.detection import click_probability, click_words, word_probabilities
from pans_trainer.options import Options, differing_options
from pans_trainer.tasks.cells import CLASSES, draw
from pans_trainer.tasks.registry import Objects, Task
from pans_trainer.train.gradient.loop import Trained, train

from . import plots
from .active import PROFILE
from .page import Asked, Made, Row, Rows
from .passive import light_of
from .printed import recipe_facts

NULL = 3  # the empty field, of the same total light
SIDE_PX = 100
NEAR_PX, FAR_PX = 25, 45  # a cell as far from the middle is in it; one beyond is out, and the field counts as empty
STEP_PX = 4
TRAINED = 2000  # cells of each class, and as many empty fields for each
JUDGED = 900  # held-out cells, and as many empty frames
SHOWN = 3  # cells of each class in the sequence
FEATURES = 10
OPTIONS = Options(features=FEATURES, **recipe_facts("sequence")["options"])

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


# ---- frames in passing ----


def frame(above: U8, cell: U8, below: U8, offset: int) -> U8:
    """Return the window on three fields one below the other, (side, side), whose middle is `offset` rows (+-100) below that of `cell`."""
    start = SIDE_PX + offset
    return np.concatenate([above, cell, below])[start : start + SIDE_PX]


def passing(part: Objects, seed: int) -> Objects:
    """Return two frames of every cell of `part`, empty fields above and below: near the middle with its class, and nearly out as empty."""
    rng = np.random.default_rng([seed, 0xCE11])
    cells, labels, empty = _parts(part)
    images, found = [], []
    for i, (cell, label) in enumerate(zip(cells, labels)):
        above, below = empty[(2 * i) % len(empty)], empty[(2 * i + 1) % len(empty)]
        images.append(frame(above, cell, below, int(rng.integers(-NEAR_PX, NEAR_PX + 1))))
        images.append(frame(above, cell, below, int(rng.integers(FAR_PX, SIDE_PX + 1) * rng.choice([-1, 1]))))
        found += [int(label), NULL]
    order = rng.permutation(len(images))  # the last ones validate
    return Objects(np.stack(images)[order], np.array(found, np.int64)[order])


def task_in_passing(task: Task) -> Task:
    """Return frames in passing of the cells of `task`, training and held-out ones apart."""
    train_part, test_part = (passing(part, seed) for seed, part in enumerate((task.train, task.test)))
    named = hashlib.sha256(train_part.images.tobytes() + test_part.images.tobytes()).hexdigest()
    return Task("cells", task.classes, train_part, test_part, named, "other cells of the generator", source=task.source)


def truth_at(offset: int, label: int) -> int:
    """Return the class of a frame `offset` rows from a cell of class `label`: -1 where the cell is neither in nor out.

    >>> truth_at(-20, 1), truth_at(35, 1), truth_at(60, 1)
    (1, -1, 3)
    """
    if abs(offset) <= NEAR_PX:
        return label
    return NULL if abs(offset) >= FAR_PX else -1


def _parts(part: Objects) -> tuple[U8, I64, U8]:
    """Return cells, their classes, and empty fields."""
    cells = np.flatnonzero(part.labels != NULL)
    return part.images[cells], part.labels[cells], part.images[part.labels == NULL]


# ---- the page ----


def sequence_page(asked: Asked) -> Made:
    """Return one row per way to judge: single frames and whole passages. The pictures show a sequence of cells."""
    made_with: Row = {"options": differing_options(OPTIONS), "cells": [TRAINED, JUDGED, SHOWN]}
    made_with |= {"rows": [NEAR_PX, FAR_PX, STEP_PX], "tables": 2}
    found = asked.kept("sequence", made_with, _measured)
    if found is None:
        return Made([])
    strip = partial(plots.sequence, found=found, margin=SIDE_PX / (2 * STEP_PX))
    drawn = partial(
        plots.patterns, lines={"light": np.array(found["patterns"])}, title="ten patterns and their illumination"
    )
    return Made(found["rows"], {"": strip, "-patterns": drawn})


def _measured() -> Row:
    wanted = (("train", 4 * TRAINED), ("test", 4 * (JUDGED // NULL)))
    train_part, test_part = (Objects(*draw(0, part, count)) for part, count in wanted)
    whole = Task("cells", CLASSES, train_part, test_part, "0" * 64, "other cells of the generator")
    task = task_in_passing(whole)
    trained = train(task, load_profile(PROFILE), OPTIONS)
    shown = _sequence(task, whole, trained)
    rows = [*_of_frames(task, trained), _of_passages(task, whole, trained)]
    assert trained.quantised is not None, "active encoders have levels"
    patterns = np.round(trained.quantised.patterns(), 4).tolist()
    return {"rows": rows, **shown, "patterns": patterns, "classes": task.classes}


def _of_frames(task: Task, trained: Trained) -> Rows:
    """Single frames, the exact expectation over all click words: of cells in the middle, of empty fields, of both."""
    light, decided = light_of(task, task.test, trained), _log_outputs(trained).argmax(axis=1)
    p, labels = click_probability(light, trained.law), task.test.labels
    right = (word_probabilities(p).numpy() * (decided[None, :] == labels[:, None])).sum(axis=1)
    parts = {"cell in the middle": labels != NULL, "cell out": labels == NULL, "all": labels >= 0}
    clicks, photons = p.sum(dim=1).numpy(), light.sum(dim=1).numpy()
    return [
        _figures(f"one frame, {way}", right[mine], clicks[mine], photons[mine], trained) for way, mine in parts.items()
    ]


def _of_passages(task: Task, whole: Task, trained: Trained) -> Row:
    """A passage: the log outputs of all its frames near the middle, added; the class with the highest sum, the empty field excepted."""
    offsets = range(-NEAR_PX + NEAR_PX % STEP_PX, NEAR_PX + 1, STEP_PX)
    cells, labels, empty = _parts(whole.test)
    frames = [
        frame(empty[2 * i % len(empty)], cell, empty[(2 * i + 1) % len(empty)], offset)
        for i, cell in enumerate(cells)
        for offset in offsets
    ]
    light, words = _shots(task, np.stack(frames), trained, seed=2)
    sums = _log_outputs(trained)[words].reshape(len(cells), len(offsets), -1).sum(axis=1)
    right = (sums[:, :NULL].argmax(axis=1) == labels).astype(np.float64)
    clicks, photons = (
        each.sum(axis=1).reshape(len(cells), -1).sum(axis=1)
        for each in (words[:, None] >> np.arange(FEATURES) & 1, light)
    )
    return _figures(
        f"a passage, evidence of {len(offsets)} frames added", right, clicks, photons, trained, len(offsets)
    )


def _sequence(task: Task, whole: Task, trained: Trained) -> Row:
    """One strip: the first held-out cells of each class in turn, an empty field between them; one shot at each step."""
    cells, labels, empty = _parts(whole.test)
    order = [int(np.flatnonzero(labels == label)[k]) for k in range(SHOWN) for label in range(NULL)]
    fields = [empty[0]]
    for place, index in enumerate(order):
        fields += [cells[index], empty[place + 1]]
    strip = np.concatenate(fields)
    starts = range(0, len(strip) - SIDE_PX + 1, STEP_PX)
    _, words = _shots(task, np.stack([strip[s : s + SIDE_PX] for s in starts]), trained, seed=3)
    middles = np.array([(2 * place + 1) * SIDE_PX for place in range(len(order))])  # first row of a cell's own window
    nearest = np.abs(np.array(starts)[:, None] - middles).argmin(axis=1).tolist()
    return {
        "words": words.tolist(),
        "outputs": np.exp(_log_outputs(trained)[words]).round(3).tolist(),
        "truth": [truth_at(s - int(middles[k]), int(labels[order[k]])) for s, k in zip(starts, nearest)],
        "strip": strip[:: len(strip) // 600 + 1, :: SIDE_PX // 25].tolist(),
    }


def _shots(task: Task, images: U8, trained: Trained, seed: int) -> tuple[F64, I64]:
    """Expected photoelectrons (n, d_f) and one click word of each image."""
    light = light_of(task, Objects(images, np.zeros(len(images), np.int64)), trained)
    p = click_probability(light, trained.law).numpy()
    clicks = np.random.default_rng([seed, FEATURES]).random(p.shape) < p
    return light.numpy(), clicks @ (1 << np.arange(p.shape[1]))


def _log_outputs(trained: Trained) -> F64:
    with torch.no_grad():
        scores = trained.head(click_words(FEATURES)).double()
    return torch.log_softmax(scores, dim=1).numpy()


def _figures(way: str, right: F64, clicks: Any, photons: Any, trained: Trained, frames: int = 1) -> Row:
    with torch.no_grad():
        illumination = frames * float(trained.encoder.illumination())
    error = 100 * float(right.std(ddof=1)) / len(right) ** 0.5
    found: Row = {"table": "frames", "way": way, "value": 100 * float(right.mean())}
    found |= {"error_objects": error, "objects": len(right)}
    return found | {"clicks": float(clicks.mean()), "photons": float(photons.mean()), "illumination": illumination}
