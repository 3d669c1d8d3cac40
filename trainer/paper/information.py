"""What readouts know of the label, against photons: frames beside click words (paper, Fig. 2C).

Owns the levels and the page; the information is that of evaluate/information.py, the posterior that of baselines/bayes.py. Both see the
same light, counted in photoelectrons per decision.
Of frames the information is bounded from below (their readouts cannot be enumerated), of click words it is a
sum. SIMULATED, ideal shot noise, no dark counts; FashionMNIST.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial

import numpy as np

from pans.runtime.instrument.click_law import ClickLaw, click_probability
from pans.runtime.instrument.profile import load_profile
from pans.trainer.baselines.bayes import log_joint
from pans.trainer.baselines.common import Measurement, detect, measure
from pans.trainer.evaluate.accuracy import light_of
from pans.trainer.evaluate.information import fisher, fisher_of_frames, posterior_information, word_information
from pans.trainer.tasks.registry import Objects, Task, load_task
from pans.trainer.verdicts import against, claim, sampling_error

from . import plots
from .page import Asked, Made, Row, Rows, Table, columns, pages
from .swept import shipped_bundle

PHOTONS = (1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e5)
POSTERIOR_MAX = 1e3  # beyond it the mixture of the training objects is a nearest neighbour and knows nothing new
FLOOR = 5e-3  # of full transmission, by which the posterior lifts every pixel
FRAMES = 1000  # test objects whose frames are read out
FISHER_OBJECTS = 6000


def information_page(asked: Asked) -> Made:
    """Return one row per way and photon level."""
    bundle = shipped_bundle()
    task = load_task(bundle.task, asked.data_dir)
    test = Objects(task.test.images[:FRAMES], task.test.labels[:FRAMES])
    rows = _frames(replace(task, test=test), asked.report) + _words(task, asked.report)
    return Made(rows, {"": partial(plots.information, rows=rows)})


def _frames(task: Task, report: Callable[[str], None]) -> Rows:
    measurement = measure(task, None)
    light = measurement.photoelectrons(measurement.train[:FISHER_OBJECTS], 1.0).astype(np.float64)
    ratios = fisher_of_frames(light, measurement.train_labels[:FISHER_OBJECTS], PHOTONS)
    rows = []
    for photons, ratio in zip(PHOTONS, ratios):
        row: Row = {"way": "frames", "photons": photons, "fisher": asdict(ratio), "objects": FRAMES}
        if photons <= POSTERIOR_MAX:
            row |= _posterior(measurement, photons)
        report(f"frames, {photons:g} photons: {row.get('bits', float('nan')):.2f} bits, trace ratio {ratio.trace:.4f}")
        rows.append(row)
    return rows


def _posterior(measurement: Measurement, photons: float) -> Row:
    readouts = detect(measurement.photoelectrons(measurement.test, photons), "counting", np.random.default_rng([0, 4]))
    joint = log_joint(measurement, readouts, photons, "counting", floor=FLOOR)
    known = posterior_information(joint, measurement.test_labels)
    right = joint.argmax(axis=1) == measurement.test_labels
    return {
        "bits": known.lower_bits,
        "bits_se": known.lower_bits_se,
        "believed_bits": known.believed_bits,
        "accuracy": float(right.mean()),
        "clicks": float((readouts > 0).sum(axis=1).mean()),
    }


def _words(task: Task, report: Callable[[str], None]) -> Rows:
    """The shipped patterns with all light scaled, behind a detector without dark counts or read noise."""
    bundle, law, n_classes = shipped_bundle(), ClickLaw(), len(task.classes)
    profile = load_profile(str(bundle.provenance["profile"]))
    train, test = (light_of(bundle, profile, part.images).photoelectrons for part in (task.train, task.test))
    given = float(test.sum(axis=1).mean())
    rows = []
    for photons in PHOTONS:
        eta = photons / given
        known = word_information(eta * train, task.train.labels, eta * test, task.test.labels, n_classes, law=law)
        p = click_probability(law, eta * test)
        ratio = fisher(p, p * (1 - p), task.test.labels)
        row = {"way": "click words", "photons": photons, "bits": known.heldout_bits, "bits_se": None}
        row |= {"accuracy": known.heldout_bayes_accuracy, "clicks": known.clicks, "fisher": asdict(ratio)}
        report(f"click words, {photons:g} photons: {known.heldout_bits:.2f} bits")
        rows.append(row | {"objects": len(test), "illumination": bundle.illumination() * eta})
    return rows


def information_tables(rows: Rows) -> list[Table]:
    """Return one line per way and photon level, click words beside the frames of as many photons by their accuracy."""
    frames = {row["photons"]: row for row in rows if row["way"] == "frames" and "accuracy" in row}
    shown = [row | {"beside": _held_against(row, frames.get(row["photons"]))} for row in rows]
    return [Table(columns("information"), shown, claims=[claim("Click words", "frames", [r["beside"] for r in shown])])]


def _held_against(row: Row, frames: Row | None) -> Row | None:
    """The accuracy of click words beside that of frames; both errors are binomial, since none of objects was kept."""
    if frames is None or row is frames:
        return None
    accuracies = [100 * one["accuracy"] for one in (row, frames)]
    return against(*accuracies, *(sampling_error(a, one["objects"]) for a, one in zip(accuracies, (row, frames))))


PAGES = pages({"fig-2c": (information_page, information_tables)})
