"""The page `one-photon`: what one photon, and a few, tell of an image at best through passive optics that lose nothing.

Owns the cases and the table. It is what a figure of "accuracy at one detected photon" is held against: above the bound, photons were lost
on the way and not counted, or the light was shaped before it met the object. Exact expectations on all test images. SIMULATED.
"""

from __future__ import annotations

import math
from functools import partial

from pans.trainer.baselines.common import F64
from pans.trainer.baselines.one_photon import (
    ITERATIONS,
    class_chances,
    class_moments,
    fields_of,
    minimum_error,
    several,
)
from pans.trainer.paper.page import Asked, Made, Row, Rows, Table, columns, kept
from pans.trainer.paper.tables import FIRST_OBJECTS
from pans.trainer.tasks.registry import load_task

TASKS = ("mnist", "fashion-mnist")
# the field of an image: what a modulator of amplitude writes, and what one of intensity does
AMPLITUDES = {"grey": 1.0, "root of grey": 0.5}
PHOTONS = (1, 4)
FITTED_STEP = 5  # of the training objects, from which the decision from several photons is taken


def one_photon_page(asked: Asked) -> Made:
    """Return one row per task, meaning of grey and number of photons."""
    rows: Rows = []
    for name in TASKS:
        for field, power in AMPLITUDES.items():
            made_with = {"task": name, "field": field, "iterations": ITERATIONS, "step": FITTED_STEP}
            path = asked.cache / f"one-photon-{name}-{power:g}.json"
            found = kept(path, made_with, partial(_part, asked, name, power), collect=asked.collect)
            rows += [{"task": name, "field": field, **row} for row in (found or {"rows": []})["rows"]]
    return Made(rows)


def _part(asked: Asked, name: str, power: float) -> Row:
    task = load_task(name, asked.data_dir)
    train, test = (fields_of(part.images, power) for part in (task.train, task.test))
    lit = train.any(axis=0)  # what no training image lights, decides nothing
    train, test = train[:, lit], test[:, lit]
    measurement = minimum_error(class_moments(train, task.train.labels, len(task.classes)))
    fitted, labels = class_chances(measurement, train[::FITTED_STEP]), task.train.labels[::FITTED_STEP]
    chances = class_chances(measurement, test)
    rows = [_row(several(chances, task.test.labels, fitted, labels, photons), photons) for photons in PHOTONS]
    rows[0] |= {"train": 100 * measurement.right, "bound": 100 * measurement.bound}
    asked.report(f"{name}, amplitude grey**{power:g}: {rows[0]['value']:.2f} % from one photon")
    return {"rows": rows}


def _row(right: F64, photons: int) -> Row:
    return {
        "photons": photons,
        "value": 100 * float(right.mean()),
        "error_objects": 100 * float(right.std(ddof=1)) / math.sqrt(len(right)),
        "first_200": 100 * float(right[:FIRST_OBJECTS].mean()),
        "first_200_error": 100 * float(right[:FIRST_OBJECTS].std(ddof=1)) / math.sqrt(FIRST_OBJECTS),
    }


def one_photon_tables(rows: Rows) -> list[Table]:
    """Return the one table."""
    return [Table(columns("one_photon"), rows)]
