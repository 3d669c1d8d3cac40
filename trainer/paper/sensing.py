"""The paper's compressive sensing: training curves on clean measurements, and accuracy over patterns and photons.

Owns the page `compressive`; patterns, classifier and light are those of baseline_compressive.py and baselines.py. Every number of
patterns is a part of its own in the cache folder. SIMULATED; FashionMNIST.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from typing import Any

from pans.trainer.baselines.common import Decide, measure, run_trials
from pans.trainer.baselines.compressive import clean_mlp, patterns
from pans.trainer.baselines.nets import EpochOfFit
from pans.trainer.paper_tables import FIRST_OBJECTS, SENSING_FEW, SENSING_MANY
from pans.trainer.tasks.registry import load_task

from . import figures_baselines
from .baseline_curves import CURVES, TASK, curve_rows
from .cache import kept
from .page import Asked

FAMILY = "binary"
FEATURES = (4, 16, 32, 64, 128, 256, 784)
PHOTONS = (10.0, 1e2, 1e3, 1e4, 1e5, 1e6)
EPOCHS = 15
TRIALS = 3
CHANCE_MARGIN = 5.0  # points above chance that "near random guessing" may mean


def compressive_page(asked: Asked) -> dict[str, Any]:
    """Return the page `compressive`: one row per number of patterns, with its training and its cells."""
    found = [_row(asked, features) for features in FEATURES if asked.wants(features)]
    rows = [row for row in found if row is not None]
    pictures = {}
    if rows:
        pictures = {
            "": partial(figures_baselines.sensing_map, rows=rows),
            "-training": partial(figures_baselines.sensing_training, rows=rows),
        }
    return {"rows": rows, "markdown": markdown(rows, _knowing(asked)), "pictures": pictures}


def _knowing(asked: Asked) -> list[dict[str, Any]]:
    """Rows of the exact posterior at the photons of the paper's claim, as far as `fig-2e` has measured them."""
    curves = [curve for curve in CURVES if curve.words[0] == "compressive" and "bayes" in curve.words]
    rows = [row for curve in curves for row in curve_rows(replace(asked, collect=True), curve)]
    return [row for row in rows if row["photons_asked"] == SENSING_FEW[0]]


def _row(asked: Asked, features: int) -> dict[str, Any] | None:
    made_with = {"family": FAMILY, "features": features, "photons": PHOTONS, "epochs": EPOCHS, "trials": TRIALS}
    path = asked.cache / f"compressive-{FAMILY}-{features}.json"
    return kept(path, made_with, lambda: sensed(asked, features), collect=asked.collect)


def sensed(asked: Asked, features: int) -> dict[str, Any]:
    """Train on clean measurements by that many patterns, and judge at every photon level."""
    task = load_task(TASK, asked.data_dir)
    measurement = measure(task, patterns(FAMILY, features, task.image_shape, seed=0))
    clean = measurement.photoelectrons(measurement.test, 1.0)
    columns: dict[str, list[float]] = {"loss": [], "training": [], "held_out": []}

    def watch(epoch: EpochOfFit, decide: Decide) -> None:
        columns["loss"].append(round(epoch.loss, 4))
        columns["training"].append(round(100 * epoch.accuracy, 2))
        columns["held_out"].append(round(100 * float((decide(clean) == measurement.test_labels).mean()), 2))

    at = clean_mlp(measurement, seed=0, epochs=EPOCHS, watch=watch)
    cells = []
    for photons in PHOTONS:
        done = run_trials(measurement, photons, "counting", at(photons, "counting"), trials=TRIALS, seed=0)
        cells.append(
            {"photons_asked": photons, **asdict(done.measured()), "first_200": asdict(done.measured(FIRST_OBJECTS))}
        )
        asked.report(f"compressive, d_f = {features}, {photons:g} photons: {100 * cells[-1]['accuracy_mean']:.2f} %")
    return {"features": features, "epochs": columns, "cells": cells}


def markdown(rows: list[dict[str, Any]], knowing: list[dict[str, Any]]) -> str:
    """Return the page; `knowing` as in `_says`."""
    missing = [str(features) for features in FEATURES if features not in {row["features"] for row in rows}]
    lines = [
        "# Compressive sensing: training, and accuracy over patterns and photons",
        "",
        "SIMULATED, FashionMNIST, perfect photon counters, ideal shot noise, K = 1, seed 0. Command: `pans reproduce "
        "compressive`. Random "
        f"binary patterns (a fair coin per pixel); one hidden layer of 512 trained on **clean** measurements for {EPOCHS} "
        "epochs (the paper: a "
        f"convolutional classifier); then {TRIALS} trials of all 10 000 test images at every photon level, the readouts "
        "divided by the exposure.",
        "",
        "![accuracy](compressive.png)",
        "![training](compressive-training.png)",
        "",
        *([f"Not finished yet (`pans reproduce compressive`): d_f = {', '.join(missing)}.", ""] if missing else []),
        *_says(rows, knowing),
        "",
        "## Training on clean measurements",
        "",
        "| d_f | loss, first epoch | last | training objects, last % | test images, first % | last % | minutes with the trials |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        *(_training_line(row) for row in rows),
        "",
        "## Every cell",
        "",
        "`trials` is the spread of one trial, `objects` the error from having few images (of all, then of the first 200).",
        "",
        "| d_f | photons | all 10 000 % | trials | objects | first 200 % | objects | clicks | illumination |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        *(_cell_line(row["features"], cell) for row in rows for cell in row["cells"]),
        "",
    ]
    return "\n".join(lines)


def _training_line(row: dict[str, Any]) -> str:
    epochs = row["epochs"]
    return (
        f"| {row['features']} | {epochs['loss'][0]:.3f} | {epochs['loss'][-1]:.3f} | {epochs['training'][-1]:.1f} "
        f"| {epochs['held_out'][0]:.1f} | {epochs['held_out'][-1]:.1f} | {row['cpu_seconds'] / 60:.1f} |"
    )


def _cell_line(features: int, cell: dict[str, Any]) -> str:
    first = cell["first_200"]
    return (
        f"| {features} | {cell['photons_mean']:g} | {100 * cell['accuracy_mean']:.2f} | {100 * cell['accuracy_std']:.2f} "
        f"| {100 * cell['accuracy_se_objects']:.2f} | {100 * first['accuracy_mean']:.2f} | {100 * first['accuracy_se_objects']:.1f} "
        f"| {cell['clicks_mean']:.1f} | {cell['illumination']:.0f} |"
    )


def _says(rows: list[dict[str, Any]], knowing: list[dict[str, Any]]) -> list[str]:
    """What the cells say beside the paper's sentences; `knowing` are rows of a way that knows the noise, at few photons."""
    cells = {
        (row["features"], cell["photons_asked"]): 100 * cell["accuracy_mean"] for row in rows for cell in row["cells"]
    }
    lines = []
    features, many, value = SENSING_MANY
    if (features, many) in cells:
        best = max((cells[row["features"], many], row["features"]) for row in rows)
        lines.append(
            f"- The paper: about {value:g} % with {features} patterns at {many:g} photons. Ours: {cells[features, many]:.1f} "
            "%; the best is "
            f"{best[0]:.1f} % with {best[1]}."
        )
    few, chance = SENSING_FEW
    low = {where: accuracy for where, accuracy in cells.items() if where[1] <= few}
    if low:
        (highest, photons), accuracy = max(low.items(), key=lambda item: item[1])
        holds = accuracy <= chance + CHANCE_MARGIN
        lines.append(
            f"- The paper: near {chance:g} % up to {few:g} photons, whatever d_f. Ours: {min(low.values()):.1f} to "
            f"{accuracy:.1f} % (d_f = "
            f"{highest} at {photons:g} photons)" + (": the same." if holds else ": not chance, though far from useful.")
        )
    told = [f"{row['way'].split(',')[0]} {100 * row['accuracy_mean']:.1f} %" for row in knowing]
    if told:
        lines.append(
            "- The classifier never saw noise. The exact posterior over the training objects, which knows it, decides 64 "
            f"patterns at {few:g} "
            f"photons right in more of the cases: {', '.join(told)} (all in [fig-2e](fig-2e.md)). Light that all random "
            "patterns share drowns "
            "their differences; that stays."
        )
    return lines
