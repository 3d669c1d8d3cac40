"""The paper's training dynamics on FashionMNIST: accuracy, light and patterns over the epochs, for several weights alpha."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pans.runtime.instrument.profile import load_profile
from pans.runtime.npz_file import npz_bytes
from pans.runtime.outputs import replace_file
from pans.trainer.options import Options, differing_options
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.history import follow

from . import plots
from .active import PROFILE
from .page import Asked, Made, Row, Rows, against, by_epoch
from .passive import measure
from .printed import ACTIVE, recipe

TASK = "fashion-mnist"
FEATURES = (10, 16, 24, 32)
ALPHAS = (0.0, 1e-5, 1e-4, 1e-3, 1e-2)
SHOWN = (10, 1e-4)  # d_f and alpha of the paper's evolution of patterns
STAGES = (1, 3, 8, 16)  # epochs after which it is shown
LATE = 5  # epochs at the end, over which the growth of the light is given
SHORT, PAPER = "alpha", "alpha-paper"  # recipes
CELLS = {  # d_f and alpha of each recipe
    SHORT: tuple((features, alpha) for features in FEATURES for alpha in ALPHAS),
    PAPER: tuple((10, alpha) for alpha in (0.0, 1e-4, 1e-2)),
}


def options_of(features: int, alpha: float, schedule: str = SHORT) -> Options:
    """Return what a training is made with."""
    (row,) = (row for row in ACTIVE[TASK] if row.features == features)
    return replace(recipe(schedule, row), alpha=alpha)


def training(asked: Asked, features: int, alpha: float, schedule: str = SHORT) -> Row | None:
    """Return one training: `epochs` (columns of history.Course) and `final`; None if it was not made."""
    options = options_of(features, alpha, schedule)
    name = f"alpha-{features}-{alpha:g}{'' if schedule == SHORT else '-paper'}"
    path = asked.cache / f"{name}.json"
    shown = (features, alpha, schedule) == (*SHOWN, SHORT)
    if shown and not path.with_suffix(".npz").is_file():
        path.unlink(missing_ok=True)  # figures without their patterns are half a part

    def make() -> Row:
        task = load_task(TASK, asked.data_dir)
        course = follow(task, load_profile(PROFILE), options, patterns_after=STAGES if shown else ())
        if shown:
            after = sorted(course.patterns)
            kept = npz_bytes(after=np.array(after), patterns=np.array([course.patterns[epoch] for epoch in after]))
            replace_file(path.with_suffix(".npz"), kept)
        return {"epochs": course.columns, "final": measure(TASK, task, course.trained)}

    return asked.kept(name, differing_options(options), make)


def alpha_page(asked: Asked) -> Made:
    """Return one row per training, beside that without alpha, and their epochs."""
    rows, epochs = [], []
    for schedule, cells in CELLS.items():
        done: Rows = []
        for features, alpha in cells:
            found = training(asked, features, alpha, schedule) if asked.wants(features) else None
            if found is not None:
                facts: Row = {"features": features, "alpha": alpha, "schedule": schedule}
                epochs += by_epoch(found["epochs"], **facts)
                course = {key: found["epochs"][key] for key in ("training", "illumination")}
                facts |= {"table": "alpha", "of_epochs": len(course["training"]), "training": course["training"][-1]}
                done.append(facts | {"grows": growth(course["illumination"])} | found["final"])
        for row in done:
            other = next((each for each in done if (each["features"], each["alpha"]) == (row["features"], 0)), row)
            if other is not row:
                row |= against(row["value"], other["value"], row["error_objects"], other["error_objects"])
        rows += done
    return Made(rows + epochs)


def growth(light: list[float]) -> float:
    """Return by how many percent the illumination grew over the last `LATE` epochs."""
    return 100 * (light[-1] / light[-min(LATE + 1, len(light))] - 1)


def evolution_page(asked: Asked) -> Made:
    """Return one row per stage: the patterns of one training after that epoch."""
    row = training(asked, *SHOWN)
    if row is None:
        return Made([])
    with np.load(asked.cache / f"alpha-{SHOWN[0]}-{SHOWN[1]:g}.npz", allow_pickle=False) as archive:
        normal = {int(after): shown / shown.mean() for after, shown in zip(archive["after"], archive["patterns"])}
    rows = [stage_row(row["epochs"], after, shown) for after, shown in normal.items()]
    lines = {f"epoch {after}\nto {shown.max():.0f}": shown / shown.shape[1] for after, shown in normal.items()}
    return Made(rows, {"": partial(plots.patterns, lines=lines, title="patterns over their common mean")})


def stage_row(epochs: Row, after: int, normal: NDArray[np.floating]) -> Row:
    """Return one stage: how uneven `normal` (d_f, pixels, mean 1) is, and the figures of the training after that epoch."""
    light = np.cumsum(np.sort(normal.ravel())[::-1]) / normal.sum()
    means = normal.mean(axis=1)
    at = {key: values[after - 1] for key, values in epochs.items()}
    return {
        "table": "stages",
        "epoch": after,
        "peak": float(normal.max()),
        "least": float(means.min()),
        "most": float(means.max()),
        "half_of_light": 100 * float((np.searchsorted(light, 0.5) + 1) / light.size),
        "dark_pixels": 100 * float((normal < 0.1).mean()),
        "value": at["held_out"],
        "first_200": at["held_out_first_200"],
        **{key: at[key] for key in ("clicks", "photons", "illumination")},
    }
