"""The paper's tables of the other tasks: accuracy or SSIM over patterns and dark counts, ours beside the paper's.

Owns the recipes and the measuring of a row; the command and the files are in reproduce.py. One model per row and dark count, trained with
that dark count in the click law. SIMULATED on the profile `ideal`.

`mmf-mnist` and `mmf-mnist-image` are fully specified in the release and use its way for comparison (speckle *intensity*, normalised
over a batch, fed as a real field to a real W), see task_mmf.py for what is unphysical in it.
`barcode` is judged on all 1024 strings by their exact weights. The images of the other tasks are ours: equal difficulty is meant, equal
figures are no proof.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pans.runtime.profile import load_profile

from . import task_barcode, task_mmf
from .detection import click_probability, click_words, sample_clicks, word_probabilities
from .options import EXACT_FEATURES_MAX, Options, plain_options, same_options
from .paper_tables import CLICKS_TOLERANCE, PASSIVE, PassiveRow
from .ssim import ssim
from .tasks import Objects, Task, load_task
from .train import Trained, train
from .training_data import CHUNK, encoder_input

PROFILE = "ideal"
TRIALS = 5
CLICKS_AIM = 1.02
CLICKS_AIM_MMF = 0.98  # the test images click a few percent more than the training images
FRONT_RATES = {
    "transient": 5e-4,
    "fiber": 2e-3,
    "cells": 5e-3,
}  # bright or large scenes: one step moves the sum over all pixels
ENCODERS = {"barcode": "active", "cells": "active"}  # the others are coherent in the paper
TASKS = {"cells": "cells-3"}  # the paper's figures are of the release's three classes


def recipe(name: str, row: PassiveRow, dark: float, *, conserving: bool = False) -> Options:
    """Return what one model is trained with. The clicks are held to the paper's at its first dark count."""
    encoder = ENCODERS.get(name, "coherent")
    shared = Options(
        features=row.features, alpha=0.0, clicks=CLICKS_AIM * row.clicks, encoder=encoder, dark=dark, head_rate=3e-3
    )
    if name == "barcode":
        small = replace(
            shared, epochs=120, warm=0.5, light=30.0, batch=200, front_rate=3e-2, restarts=6
        )  # ten bars: seconds each
        return replace(small, hidden=64, polish=0.3) if row.features <= 8 else replace(small, hidden=128)
    if name == "mmf-mnist-image":
        return replace(shared, estimator="ste", epochs=30, hidden=512)
    exact = row.features <= EXACT_FEATURES_MAX
    aim = CLICKS_AIM_MMF if name == "mmf-mnist" else CLICKS_AIM
    return replace(
        shared,
        clicks=aim * row.clicks,
        front_rate=FRONT_RATES.get(name, shared.front_rate),
        estimator="exact" if exact else "local",
        epochs=30 if exact else 44,
        warm=0.4,
        starts=2 if row.features <= 6 else 1,
        polish=0.4 if exact else 0.0,
        hidden=128 if exact else 256,
        conserving=conserving,
    )


def load(name: str, data_dir: str | None) -> Task:
    """Return the task; MMF tasks with the release's input: normalised speckle intensity as a real field."""
    task = load_task(TASKS.get(name, name), data_dir)
    if task.optics != "mmf":
        return task
    return replace(task, light="field", optics="none", train=_speckle(task.train), test=_speckle(task.test))


def _speckle(objects: Objects) -> Objects:
    speckle = task_mmf.release_intensity(objects.images)
    return Objects(np.rint(255 * speckle).astype(np.uint8), objects.labels)


def finished_cell(cache: Path, name: str, row: PassiveRow, dark: float) -> dict[str, Any] | None:
    """Return the figures of a model that was trained by the present recipe, or None."""
    path = _path(cache, name, row, dark)
    if not path.is_file():
        return None
    found: dict[str, Any] = json.loads(path.read_text())
    return found if same_options(found["options"], recipe(name, row, dark)) else None


def _path(cache: Path, name: str, row: PassiveRow, dark: float) -> Path:
    return cache / f"{name}-{row.features}-{dark:g}.json"


def make_cell(
    cache: Path, name: str, row: PassiveRow, dark: float, data_dir: str | None, report: Callable[[str], None]
) -> dict[str, Any]:
    """Train and measure one model; its figures go to the cache and are returned."""
    options = recipe(name, row, dark)
    path = _path(cache, name, row, dark)
    task, profile = load(name, data_dir), load_profile(PROFILE)
    target = load_task(TASKS.get(name, name), data_dir)  # of images: what lies behind the speckle
    started = time.process_time()
    trained = train(task, profile, options)
    figures = {
        "task": name,
        "features": row.features,
        "dark": dark,
        "options": plain_options(options),
        "cpu_seconds": time.process_time() - started,
        **measure(name, task, target, trained),
    }
    report(f"{name} d_f={row.features} dark={dark:g}: {figures['value']:.3f} at {figures['clicks']:.2f} clicks")
    beside = path.with_suffix(".part")
    beside.write_text(json.dumps(figures, indent=1))
    os.replace(beside, path)
    return figures


def measure(name: str, task: Task, target: Task, trained: Trained) -> dict[str, Any]:
    """Return accuracy in % (or SSIM), its spreads, clicks, photons and illumination over the held-out objects."""
    objects, weights = task.test, np.full(len(task.test), 1 / len(task.test))
    if name == "barcode":  # all strings there are
        bars, labels = task_barcode.all_strings()
        objects, weights = Objects((bars * np.uint8(255))[:, None, :], labels), task_barcode.weights()
    light = light_of(task, objects, trained)
    p = click_probability(light, trained.law)
    share = torch.from_numpy(weights)
    with torch.no_grad():
        if task.target == "image":
            value, over_trials, of_object = _similarity(trained, p, target.test.images)
        else:
            value, over_trials, of_object = _accuracy(trained, p, torch.from_numpy(objects.labels), share)
        return {
            "value": value,
            "spread_trials": over_trials,
            "error_objects": float(of_object.std()) / len(of_object) ** 0.5 if name != "barcode" else 0.0,
            "objects": len(objects),
            "clicks": float((p.sum(dim=1) * share).sum()),
            "photons": float((light.sum(dim=1) * share).sum()),
            "illumination": float(trained.encoder.illumination()),
        }


def light_of(task: Task, objects: Objects, trained: Trained) -> Tensor:
    """Return photoelectrons, float64 (n, d_f), of `objects` through the trained optics; active ones in whole levels."""
    x = encoder_input(task, objects, load_profile(PROFILE), trained.options)
    with torch.no_grad():
        if trained.quantised is not None:
            return x.double() @ torch.from_numpy(trained.quantised.patterns()).T
        return torch.cat([trained.encoder(part).double() for part in x.split(CHUNK)])


def _accuracy(trained: Trained, p: Tensor, labels: Tensor, share: Tensor) -> tuple[float, float, Tensor]:
    """Accuracy in %, spread over trials, and each object's: exact where the words can be enumerated, else of 5 trials."""
    if p.shape[1] <= EXACT_FEATURES_MAX:
        decided = trained.head(click_words(p.shape[1])).argmax(dim=1)
        parts = [
            (word_probabilities(part) * (decided == wanted.unsqueeze(1))).sum(dim=1)
            for part, wanted in zip(p.split(CHUNK), labels.split(CHUNK))
        ]
        right = torch.cat(parts)
        spread = float((share**2 * right * (1 - right)).sum().clamp(min=0) ** 0.5)
    else:
        random = torch.Generator().manual_seed(1)
        trials = [trained.head(sample_clicks(p, random).float()).argmax(dim=1) == labels for _ in range(TRIALS)]
        hits = torch.stack(trials).double()
        right, spread = hits.mean(dim=0), float((hits @ share).std())
    return 100 * float((right * share).sum()), 100 * spread, 100 * right


def _similarity(trained: Trained, p: Tensor, images: Any) -> tuple[float, float, Tensor]:
    """SSIM of the pictures given back, as the paper's release counts it (ssim.py): one trial."""
    random = torch.Generator().manual_seed(1)
    wanted = torch.from_numpy(images.astype(np.float32) / 255)
    found = torch.cat([trained.head(sample_clicks(part, random).float()) for part in p.split(CHUNK)])
    pictures = found.clamp(0, 1).reshape(wanted.shape)
    values = torch.cat([ssim(a, b) for a, b in zip(pictures.split(CHUNK), wanted.split(CHUNK))]).double()
    return float(values.mean()), 0.0, values


def markdown(name: str, done: list[tuple[PassiveRow, dict[str, Any]]]) -> str:
    """Return the page of one task."""
    table = PASSIVE[name]
    ahead = [figures["value"] - row.values[table.dark.index(figures["dark"])] for row, figures in done]
    over = [
        f"{row.features} (dark {f['dark']:g})" for row, f in done if f["dark"] == table.dark[0] and not _fine(row, f)
    ]
    lines = [
        f"# {name}: the paper's table",
        "",
        f"SIMULATED on the profile `ideal`. Command: `pans reproduce {name}` (one thread, seed 0). {table.measure}, K = 1; one model per "
        "row and dark count, trained with it. Clicks are held to the paper's, which names them at its first dark count only.",
        "",
        f"- at or above the paper in {sum(value >= 0 for value in ahead)} of {len(done)} measured cells "
        f"(of {len(table.rows) * len(table.dark)} in the paper)",
        "- clicks within +5 % of the paper's, where it names them: "
        + (f"not at d_f = {', '.join(over)}" if over else "all"),
        "",
        "| d_f | dark | paper | ours | ahead | trials | objects | clicks: paper | ours | photons | illumination | minutes |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        *(_line(name, row, figures) for row, figures in done),
        "",
        *_NOTES.get(name, _OUR_IMAGES),
        "",
    ]
    return "\n".join(lines)


_OUR_IMAGES = (
    "The paper's images are not public: these are drawn by our generators (docs/TASKS.md). The paper's figures stand beside ours for "
    "orientation, not as a comparison.",
)
_NOTES = {
    "barcode": (
        "Judged on all 1024 strings by their exact weights (classes equally likely), exact expectation over all click words: "
        "neither trials nor objects have a spread. The paper draws 1000 test strings and does not say how.",
    ),
    "mmf-mnist": (
        "Input as in the release, for comparison: speckle intensity, min-max normalised over batches (an image depends on its batch), fed "
        "as a real field to an unconstrained real W. Neither is physical: an intensity is no field, and such a W may create photons. The "
        "release draws its phase mask by a generator that is not named; ours is numpy's, seed 42.",
    ),
}
_NOTES["mmf-mnist-image"] = _NOTES["mmf-mnist"]


def _fine(row: PassiveRow, figures: dict[str, Any]) -> bool:
    return bool(figures["clicks"] <= CLICKS_TOLERANCE * row.clicks)


def _line(name: str, row: PassiveRow, figures: dict[str, Any]) -> str:
    table = PASSIVE[name]
    paper = row.values[table.dark.index(figures["dark"])]
    digits = 3 if table.measure == "SSIM" else 2
    clicks = f"{row.clicks:.2f}" if figures["dark"] == table.dark[0] else "-"
    return (
        f"| {row.features} | {figures['dark']:g} | {paper:.{digits}f} | {figures['value']:.{digits}f} "
        f"| {figures['value'] - paper:+.{digits}f} | {figures['spread_trials']:.2f} | {figures['error_objects']:.{digits}f} | {clicks} "
        f"| {figures['clicks']:.2f} | {figures['photons']:.1f} | {figures['illumination']:.0f} | {figures['cpu_seconds'] / 60:.1f} |"
    )
