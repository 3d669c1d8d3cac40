"""What the models of the other tasks are trained with: one recipe per task and size, and the input that the encoder gets.

Owns the choices; never trains and never measures. The clicks are held to the paper's at its first dark count where it prints any.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.runtime.bundle.optics import incident_field
from pans.trainer.model.field_basis import discriminant_basis
from pans.trainer.options import EXACT_FEATURES_MAX, Options
from pans.trainer.tasks import mmf as task_mmf
from pans.trainer.tasks.registry import Objects, Task, load_task

from .tables import CLICKS_TOLERANCE, PASSIVE, PassiveRow

CLICKS_AIM = 1.02
CLICKS_AIM_MMF = 0.98  # the test images click a few percent more than the training images
CLICKS_AIM_FEW = 1.01  # of up to 5 detectors, for which that margin is wider than need be
CLICKS_AIM_MANY = 1.03  # of 24 detectors and more, for which test images click about as often as training images
CLICKS_AIM_FIBER = 1.03  # on turned objects held-out ones click as often
CLICKS_AIM_CELLS = (
    0.98  # held-out images click more; there is accuracy to spare, so that no row needs more clicks than the paper's
)
ENCODERS = {"barcode": "active", "cells": "active", "cells-4": "active"}  # the others are coherent in the paper
TASKS = {"cells": "cells-3", "cells-4": "cells"}  # the paper's figures are of the release's three classes
BASIS_SIZE = 60  # fields per class, of the tasks below
FIELD_RATES = {"transient": 3e-3, "fiber": 1e-2, "nebula": 1e-2, "tissue": 3e-3}  # scenes with a bright background
SEARCH_SIZE = {"fiber": 150}  # fields of the second class, of tasks that anomaly_search.py solves
SAME_LIGHT = (
    "fiber",
    "mmf-mnist",
    "mmf-mnist-image",
    "cells",
    "cells-4",
)  # more dark counts take nothing of their light
CELLS_STARTS = {("cells", 3): 6, ("cells-4", 3): 6, ("cells-4", 10): 4}  # where fewer may all end in a poor valley
CELLS_RATE = 5e-3  # 10 000 pixels: one step moves the sum over all of them


def recipe(name: str, row: PassiveRow, dark: float, *, conserving: bool = False) -> Options:
    """Return what one model is trained with."""
    options = _recipe(name, row, dark, conserving)
    if name not in SAME_LIGHT or options.clicks is None:
        return options
    return replace(options, clicks=options.clicks + added_clicks(name, row, dark))


def added_clicks(name: str, row: PassiveRow, dark: float) -> float:
    """Return what more dark counts than the table's first add to the clicks of the paper's light, in detectors that it leaves silent."""
    return (row.features - row.clicks) * -math.expm1(min(0.0, PASSIVE[name].dark[0] - dark)) if name in PASSIVE else 0.0


def _recipe(name: str, row: PassiveRow, dark: float, conserving: bool) -> Options:
    shared = Options(
        features=row.features,
        alpha=0.0,
        clicks=CLICKS_AIM * row.clicks,
        encoder=ENCODERS.get(name, "coherent"),
        dark=dark,
        head_rate=3e-3,
        conserving=conserving,
    )
    if name == "barcode":
        return _barcode(shared, row)
    if name == "fiber":
        return _fiber(shared, row)
    if name in FIELD_RATES:
        return _field(name, shared)
    if name == "mmf-mnist-image":
        return _picture(shared)
    return _digits(shared, row) if name == "mmf-mnist" else _cells(name, shared, row)


def _barcode(shared: Options, row: PassiveRow) -> Options:
    """train/barcode_search.py: searches, not epochs."""
    clicks = 0.995 * CLICKS_TOLERANCE * row.clicks
    return replace(shared, clicks=clicks, restarts=3 if row.features < 10 else 2, hidden=128)


def _field(name: str, shared: Options) -> Options:
    """Scenes with a bright background."""
    return replace(
        shared,
        epochs=30,
        warm=0.3,
        polish=0.4,
        hidden=64,
        batch=256,
        restarts=2,
        front_rate=FIELD_RATES[name],
        estimator="exact" if shared.features <= EXACT_FEATURES_MAX else "local",
    )


def _fiber(shared: Options, row: PassiveRow) -> Options:
    """train/anomaly_search.py: many encoders at once."""
    return replace(
        shared,
        clicks=CLICKS_AIM_FIBER * row.clicks,
        restarts=16,
        epochs=56,
        batch=2048,
        front_rate=3e-2,
        light=16.0,  # starts that nearly always click end in better rules than dim ones
        hidden=64,
    )


def _picture(shared: Options) -> Options:
    decoder = replace(shared, head="decoder", similarity=0.9)
    if shared.features >= 48:  # more clicks than a decoder of the paper's width makes use of
        return replace(decoder, estimator="ste", hidden=1024, epochs=30, copies=2)
    disarmed = replace(decoder, estimator="disarm", warm=0.5, hidden=512)
    return replace(disarmed, epochs=30) if shared.features <= 10 else replace(disarmed, epochs=24, copies=2)


def _digits(shared: Options, row: PassiveRow) -> Options:
    digits = replace(_plain(shared), clicks=CLICKS_AIM_MMF * row.clicks)
    if row.features > EXACT_FEATURES_MAX:
        hidden = 128 if row.features <= 16 else 256
        clicks = (CLICKS_AIM if row.features == 16 else CLICKS_AIM_MANY) * row.clicks
        return replace(digits, clicks=clicks, epochs=20, copies=3, warm=0.15, polish=0.4, hidden=hidden)
    if row.features > 5:
        return digits
    return replace(digits, clicks=CLICKS_AIM_FEW * row.clicks, epochs=60, starts=4, restarts=2)


def _cells(name: str, shared: Options, row: PassiveRow) -> Options:
    plain = _plain(shared)
    cells = replace(plain, front_rate=CELLS_RATE, starts=CELLS_STARTS.get((name, row.features), plain.starts))
    return cells if row.features == 3 else replace(cells, clicks=CLICKS_AIM_CELLS * row.clicks)


def _plain(shared: Options) -> Options:
    exact = shared.features <= EXACT_FEATURES_MAX
    return replace(
        shared,
        estimator="exact" if exact else "local",
        epochs=30 if exact else 44,
        warm=0.4,
        starts=2 if shared.features <= 6 else 1,
        polish=0.4 if exact else 0.0,
        hidden=128 if exact else 256,
    )


def basis_of(name: str, task: Task, options: Options) -> Tensor | None:
    """Return the fields (pixels, size) in which the encoder of `name` is trained, or None: pixel by pixel."""
    return None if name not in FIELD_RATES or options.conserving else _fields(task)


@functools.lru_cache(maxsize=1)  # the rows of a table share it
def _fields(task: Task) -> Tensor:
    x = torch.from_numpy(incident_field(task.train.images, task.light, task.optics)).flatten(1)
    return discriminant_basis(x, torch.from_numpy(task.train.labels), task.image_shape, BASIS_SIZE)


@functools.lru_cache(maxsize=1)
def load(name: str, data_dir: str | None, data_seed: int = 0) -> Task:
    """Return the task; MMF tasks with the release's input: normalised speckle intensity as a real field."""
    task = load_task(TASKS.get(name, name), data_dir, data_seed=data_seed)
    if task.optics != "mmf":
        return task
    train, test = (Objects(_speckle(part.images), part.labels, behind=part.images) for part in (task.train, task.test))
    return replace(task, light="field", optics="none", train=train, test=test, imaged=_speckle)


def _speckle(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.rint(255 * task_mmf.release_intensity(images)).astype(np.uint8)
