"""The page `sequence`: clicks and decisions, frame by frame, while cells pass through the light (paper, Fig. 4C).

Owns the strip of cells and empty fields, what a frame in passing is called, the model trained on such frames, and the figures of single
frames and of whole passages. All patterns are measured at once, one shot per frame. The window moves along the strip by `STEP_PX` rows;
where a cell is neither in the middle nor nearly out, a frame has no truth and is not judged. SIMULATED on the profile `ideal`, with our
generator's cells; the runtime's own way to find cells and to decide once on each is `pans run --flow cells`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.detection import click_probability, click_words
from pans.trainer.options import Options, differing_options
from pans.trainer.paper.page import Asked, Draw, Made, Row, Rows, Table, columns, kept, pages
from pans.trainer.paper.passive import PROFILE, light_of
from pans.trainer.tasks.cells import CLASSES, draw
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train.loop import Trained, train

from . import pictures

NULL = 3  # the empty field, of the same total light
SIDE_PX = 100
NEAR_PX, FAR_PX = 25, 45  # a cell as far from the middle is in it; one beyond is out, and the field counts as empty
STEP_PX = 4
TRAINED = 2000  # cells of each class, and as many empty fields for each
JUDGED = 900  # held-out cells, and as many empty frames
SHOWN = 3  # cells of each class in the sequence
OPTIONS = Options(
    features=10,
    alpha=0.0,
    photons=10.0,
    epochs=30,
    warm=0.4,
    polish=0.4,
    batch=256,
    hidden=128,
    head_rate=3e-3,
    front_rate=5e-3,  # 10 000 pixels, as of the page `cells`
)

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


def frame(above: U8, cell: U8, below: U8, offset: int) -> U8:
    """Return the window on three fields one below the other, (side, side), whose middle is `offset` rows below that of `cell`."""
    if abs(offset) > SIDE_PX:
        raise ValueError(f"offset is {offset} rows, allowed: -{SIDE_PX} to {SIDE_PX}")
    start = SIDE_PX + offset
    return np.concatenate([above, cell, below])[start : start + SIDE_PX]


def passing(part: Objects, seed: int) -> Objects:
    """Return two frames in passing of every cell of `part`: near the middle with its class, and nearly out as an empty field.

    Empty fields of `part` stand above and below, in turn.
    """
    rng = np.random.default_rng([seed, 0xCE11])
    cells, labels = part.images[part.labels != NULL], part.labels[part.labels != NULL]
    empty = part.images[part.labels == NULL]
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


# ---- the page ----


def sequence_page(asked: Asked) -> Made:
    """Return rows of single frames and whole passages, one per cell of the sequence, and the sequence."""
    made_with = {
        "options": differing_options(OPTIONS),
        "cells": [TRAINED, JUDGED, SHOWN],
        "rows": [NEAR_PX, FAR_PX, STEP_PX],
    }
    found = kept(asked.cache / "sequence.json", made_with, partial(_measured, asked), collect=asked.collect)
    if found is None:
        asked.report("sequence: not measured yet (pans reproduce sequence)")
        return Made([])
    drawn: dict[str, Draw] = {
        "": partial(pictures.sequence, found=found, margin=SIDE_PX / (2 * STEP_PX)),
        "-patterns": partial(pictures.patterns, levels=found["patterns"], side=SIDE_PX),
    }
    rows = [row | {"cpu_seconds": found["cpu_seconds"]} for row in found["rows"]]
    return Made(rows, drawn)


def _measured(asked: Asked) -> Row:
    train_part, test_part = (
        Objects(*draw(0, part, 4 * each)) for part, each in (("train", TRAINED), ("test", JUDGED // NULL))
    )
    whole = Task("cells", CLASSES, train_part, test_part, "0" * 64, "other cells of the generator")
    task = task_in_passing(whole)
    trained = train(task, load_profile(PROFILE), OPTIONS)
    asked.report("sequence: trained")
    shown = _sequence(task, whole, trained)
    rows = [*_of_frames(task, trained), _of_passages(task, whole, trained), *_of_cells(shown, task.classes)]
    assert trained.quantised is not None, "active encoders have levels"
    return {
        "rows": rows,
        **shown,
        "patterns": np.round(trained.quantised.patterns(), 4).tolist(),
        "classes": task.classes,
    }


def _of_frames(task: Task, trained: Trained) -> Rows:
    """Single frames, the exact expectation over all click words: of cells in the middle, of empty fields, of both."""
    light, decided = light_of(task, task.test, trained), _decided(trained)
    p = click_probability(light, trained.law).numpy()
    chance = _word_chances(p)
    right = (chance * (decided[None, :] == task.test.labels[:, None])).sum(axis=1)
    empty = task.test.labels == NULL
    parts = (
        ("one frame, cell in the middle", ~empty),
        ("one frame, cell out", empty),
        ("one frame, all", empty | True),
    )
    return [
        _figures(way, right[mine], p[mine].sum(axis=1), light.numpy()[mine].sum(axis=1), _illumination(trained))
        for way, mine in parts
    ]


def _of_passages(task: Task, whole: Task, trained: Trained) -> Row:
    """A passage: the log outputs of all its frames near the middle, added; the class with the highest sum, the empty field excepted."""
    offsets = range(-NEAR_PX + NEAR_PX % STEP_PX, NEAR_PX + 1, STEP_PX)
    cells, labels, empty = _held_out(whole)
    frames = [
        frame(empty[2 * i % len(empty)], cell, empty[(2 * i + 1) % len(empty)], offset)
        for i, cell in enumerate(cells)
        for offset in offsets
    ]
    light, words = _shots(task, np.stack(frames), trained, seed=2)
    sums = _log_outputs(trained)[words].reshape(len(cells), len(offsets), -1).sum(axis=1)
    right = (sums[:, :NULL].argmax(axis=1) == labels).astype(np.float64)
    clicks = _bits(words, OPTIONS.features).sum(axis=1).reshape(len(cells), -1).sum(axis=1)
    photons = light.sum(axis=1).reshape(len(cells), -1).sum(axis=1)
    way = f"a passage, evidence of {len(offsets)} frames added"
    return _figures(way, right, clicks, photons, len(offsets) * _illumination(trained))


def _sequence(task: Task, whole: Task, trained: Trained) -> Row:
    """One strip: the first held-out cells of each class in turn, an empty field between them; one shot at each step."""
    cells, labels, empty = _held_out(whole)
    order = [int(np.flatnonzero(labels == label)[k]) for k in range(SHOWN) for label in range(NULL)]
    fields = [empty[0]]
    for place, index in enumerate(order):
        fields += [cells[index], empty[place + 1]]
    strip = np.concatenate(fields)
    starts = range(0, len(strip) - SIDE_PX + 1, STEP_PX)
    light, words = _shots(task, np.stack([strip[s : s + SIDE_PX] for s in starts]), trained, seed=3)
    middles = np.array([_middle(place) for place in range(len(order))])
    nearest = np.abs(np.array(starts)[:, None] - middles).argmin(axis=1).tolist()
    truth = [truth_at(s - _middle(k), int(labels[order[k]])) for s, k in zip(starts, nearest)]
    outputs = np.exp(_log_outputs(trained)[words])
    return {
        "illumination": _illumination(trained),
        "words": words.tolist(),
        "outputs": outputs.round(3).tolist(),
        "truth": truth,
        "cell": nearest,
        "photons": light.sum(axis=1).round(3).tolist(),
        "labels": [int(labels[index]) for index in order],
        "strip": strip[:: len(strip) // 600 + 1, :: SIDE_PX // 25].tolist(),
    }


def _middle(place: int) -> int:
    """The first row of the window on which the cell at this place of the sequence stands in the middle."""
    return (2 * place + 1) * SIDE_PX


def _of_cells(shown: Row, classes: Iterable[str]) -> Rows:
    """What was decided on each cell of the sequence: frames right of those in the middle, and the evidence of them added."""
    names = list(classes)
    outputs, truth, cell = (np.array(shown[key]) for key in ("outputs", "truth", "cell"))
    words, photons = np.array(shown["words"]), np.array(shown["photons"])
    rows = []
    for place, label in enumerate(shown["labels"]):
        here = (cell == place) & (truth == label)
        sums = np.log(outputs[here] + 1e-3).sum(axis=0)
        bits = _bits(words[here], OPTIONS.features)
        rows.append(
            {
                "cell": place + 1,
                "class": names[label],
                "frames": int(here.sum()),
                "right": int((outputs[here].argmax(axis=1) == label).sum()),
                "decided": names[int(sums[:NULL].argmax())],
                "clicks": int(bits.sum()),
                "photons": float(photons[here].sum()),
            }
        )
    judged = truth >= 0
    right = (outputs.argmax(axis=1) == truth)[judged]
    every = {"sequence": True, "frames": int(judged.sum()), "right": int(right.sum()), "all_frames": len(truth)}
    light = {"clicks": float(_bits(words, OPTIONS.features).sum(axis=1).mean()), "photons": float(photons.mean())}
    return [*rows, every | light | {"illumination": shown["illumination"]}]


def _held_out(whole: Task) -> tuple[U8, I64, U8]:
    """Held-out cells, their classes, and held-out empty fields."""
    part = whole.test
    cells = np.flatnonzero(part.labels != NULL)
    return part.images[cells], part.labels[cells], part.images[part.labels == NULL]


def _shots(task: Task, images: U8, trained: Trained, seed: int) -> tuple[F64, I64]:
    """Expected photoelectrons (n, d_f) and one click word of each image."""
    light = light_of(task, Objects(images, np.zeros(len(images), np.int64)), trained)
    p = click_probability(light, trained.law).numpy()
    clicks = np.random.default_rng([seed, OPTIONS.features]).random(p.shape) < p
    return light.numpy(), clicks @ (1 << np.arange(p.shape[1]))


def _log_outputs(trained: Trained) -> F64:
    with torch.no_grad():
        scores = trained.head(click_words(OPTIONS.features)).double()
    return torch.log_softmax(scores, dim=1).numpy()


def _decided(trained: Trained) -> I64:
    return np.asarray(_log_outputs(trained).argmax(axis=1))


def _word_chances(p: F64) -> F64:
    chance = np.ones((len(p), 1))
    for column in p.T[:, :, None]:
        chance = np.concatenate([chance * (1 - column), chance * column], axis=1)
    return chance


def _bits(words: I64, n: int) -> I64:
    return np.asarray(words[:, None] >> np.arange(n) & 1)


def _illumination(trained: Trained) -> float:
    with torch.no_grad():
        return float(trained.encoder.illumination())


def _figures(way: str, right: F64, clicks: Any, photons: Any, illumination: float) -> Row:
    return {
        "way": way,
        "value": 100 * float(right.mean()),
        "error_objects": 100 * float(right.std(ddof=1)) / len(right) ** 0.5,
        "objects": len(right),
        "clicks": float(clicks.mean()),
        "photons": float(photons.mean()),
        "illumination": illumination,
    }


def sequence_tables(rows: Rows) -> list[Table]:
    """Return the figures of frames and passages, and what was decided on each cell of the sequence."""
    ways = [row for row in rows if "way" in row]
    cells = [row for row in rows if "class" in row]
    whole = [row for row in rows if row.get("sequence")]
    return [
        Table(columns("sequence"), ways, "## Held-out cells"),
        Table(columns("sequence_cells"), cells, "## The sequence drawn below, cell by cell"),
        Table(columns("sequence_frames"), whole, "## The sequence, frame by frame"),
    ]


PAGES = pages({"sequence": (sequence_page, sequence_tables)})
