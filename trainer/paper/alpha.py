"""The paper's training dynamics: accuracy and illumination against the epoch for several weights alpha, and how patterns change.

Owns the recipe, the walk over d_f and alpha and the two pages (`alpha`, `evolution`); a training is followed by
train/history.py. Every finished training lies in the cache folder, those that `evolution` shows with their patterns.
SIMULATED on the profile `ideal`; FashionMNIST.
"""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.runtime.instrument.profile import load_profile
from pans.runtime.outputs import replace_file
from pans.trainer.options import Options, differing_options
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.history import follow
from pans.trainer.verdicts import against, claim

from . import images, plots
from .page import Asked, Draw, Made, Row, Rows, Table, columns, kept, pages
from .passive import PROFILE, measure

TASK = "fashion-mnist"
FEATURES = (10, 16, 24, 32)
ALPHAS = (0.0, 1e-5, 1e-4, 1e-3, 1e-2)
EPOCHS = 16
SHOWN = (10, 1e-4)  # d_f and alpha of the paper's evolution of patterns
STAGES = (1, 3, 8, EPOCHS)  # epochs after which it is shown
LATE = 5  # epochs at the end, over which the growth of the light is told
SHORT, PAPER = "short", "the paper's"  # schedules
PAPER_EPOCHS = 100  # of up to 500
PAPER_CELLS = tuple((10, alpha) for alpha in (0.0, 1e-4, 1e-2))  # d_f and alpha: both ends and the middle


def recipe(features: int, alpha: float, schedule: str = SHORT) -> Options:
    """Return what a course is trained with: straight-through from first to last and constant rates, as the paper trains."""
    as_the_paper = Options(features, alpha=alpha, estimator="ste", constant=True, hidden=512)
    if schedule == PAPER:
        return replace(as_the_paper, epochs=PAPER_EPOCHS, batch=128, front_rate=1e-3, head_rate=1e-4)
    return replace(as_the_paper, epochs=EPOCHS, batch=512, front_rate=5e-3, head_rate=1e-3)


def course_of(asked: Asked, features: int, alpha: float, schedule: str = SHORT) -> Row | None:
    """Return one training: `features`, `alpha`, `epochs` (columns of course.EpochFigures) and `final`; None if not made."""
    options = recipe(features, alpha, schedule)
    path = asked.cache / f"alpha-{features}-{alpha:g}{'' if schedule == SHORT else '-paper'}.json"
    shown = (features, alpha, schedule) == (*SHOWN, SHORT)
    if shown and not path.with_suffix(".npz").is_file():
        path.unlink(missing_ok=True)  # figures without their patterns are half a part

    def make() -> Row:
        task, profile = load_task(TASK, asked.data_dir), load_profile(PROFILE)
        course = follow(task, profile, options, patterns_after=STAGES if shown else ())
        if shown:
            _keep_patterns(path.with_suffix(".npz"), course.patterns)
        final = measure(TASK, task, course.trained)
        which = {} if schedule == SHORT else {"schedule": schedule}
        return {"features": features, "alpha": alpha, **which, "epochs": course.columns(), "final": final}

    found = kept(path, differing_options(options), make, collect=asked.collect)
    if found is not None:
        final = found["final"]
        asked.report(
            f"d_f = {features}, alpha = {alpha:g}: {final['value']:.2f} % at {final['illumination']:.0f} illumination"
        )
    return found


def _keep_patterns(path: Path, patterns: dict[int, NDArray[np.float32]]) -> None:
    archive = io.BytesIO()
    np.savez_compressed(
        archive, after=np.array(sorted(patterns)), patterns=np.array([patterns[e] for e in sorted(patterns)])
    )
    replace_file(path, archive.getvalue())


def alpha_page(asked: Asked) -> Made:
    """Return one row per training, and one picture per d_f; then the trainings by the paper's schedule, with a picture of theirs."""
    wanted = [features for features in FEATURES if asked.wants(features)]
    found = [course_of(asked, features, alpha) for features in wanted for alpha in ALPHAS]
    rows = [row for row in found if row is not None]
    pictures: dict[str, Draw] = {}
    for features in wanted:
        if mine := [row for row in rows if row["features"] == features]:
            pictures[f"-{features}"] = partial(plots.courses, rows=mine)
    cells = [cell for cell in PAPER_CELLS if asked.wants(cell[0])]
    made = [course_of(asked, features, alpha, PAPER) for features, alpha in cells]
    if long := [row for row in made if row is not None]:
        pictures["-paper"] = partial(plots.courses, rows=long)
    return Made(rows + long, pictures)


def growth(row: Row) -> float:
    """Return by how many percent the illumination grew over the last `LATE` epochs."""
    light = row["epochs"]["illumination"]
    return 100 * (float(light[-1]) / float(light[-min(LATE + 1, len(light))]) - 1)


def alpha_tables(rows: Rows) -> list[Table]:
    """Return one line per training, of the finished model: the short schedule, then the paper's beside it."""
    short = [row for row in rows if "schedule" not in row]
    by_cell = {(row["features"], row["alpha"]): row["final"] for row in short}
    long = [row | {"short": _beside_short(row, by_cell)} for row in rows if row.get("schedule") == PAPER]
    tables = [_table("alpha", short)]
    if long:
        heading = f"## The paper's batches and rates, {PAPER_EPOCHS} epochs"
        tables.append(_table("alpha_long", long, heading))
    return tables


def _table(name: str, rows: Rows, heading: str = "") -> Table:
    unweighed = {row["features"]: row["final"] for row in rows if row["alpha"] == 0}
    shown = [row | {"grows": growth(row), "beside": _held_against(row, unweighed.get(row["features"]))} for row in rows]
    claims = [
        claim(f"alpha = {alpha:g}", "alpha = 0", compared)
        for alpha in ALPHAS
        if alpha and (compared := [row["beside"] for row in shown if row["alpha"] == alpha])
    ]
    return Table(columns(name), shown, heading, claims)


def _beside_short(row: Row, by_cell: dict[tuple[int, float], Row]) -> Row | None:
    """A training by the paper's schedule beside the short one."""
    short, final = by_cell.get((row["features"], row["alpha"])), row["final"]
    if short is None:
        return None
    compared = against(final["value"], short["value"], final["error_objects"], short["error_objects"])
    return {"value": short["value"], "illumination": short["illumination"]} | compared


def _held_against(row: Row, unweighed: Row | None) -> Row | None:
    """A training beside the one without alpha; both errors are from having few objects."""
    if unweighed is None or row["alpha"] == 0:
        return None
    final = row["final"]
    return against(final["value"], unweighed["value"], final["error_objects"], unweighed["error_objects"])


# ---- the evolution of patterns ----


def evolution_page(asked: Asked) -> Made:
    """Return one row per stage: the patterns of one training after that epoch."""
    features, alpha = SHOWN
    row = course_of(asked, features, alpha)
    if row is None:
        asked.report("not trained yet: pans reproduce evolution")
        return Made([])
    with np.load(asked.cache / f"alpha-{features}-{alpha:g}.npz", allow_pickle=False) as kept_patterns:
        patterns = {int(after): shown for after, shown in zip(kept_patterns["after"], kept_patterns["patterns"])}
    normal = {after: shown / shown.mean() for after, shown in patterns.items()}
    rows = [stage_row(row, after, shown) for after, shown in normal.items()]
    return Made(rows, {"": partial(images.stages, patterns=normal, peaks=row["epochs"]["peak"])})


def stage_row(row: Row, after: int, normal: NDArray[np.floating]) -> Row:
    """Return one stage: how uneven `normal` (d_f, pixels, mean 1) is, and the course's figures after that epoch."""
    brightest_first = np.sort(normal.ravel())[::-1]
    light = np.cumsum(brightest_first) / brightest_first.sum()
    at = {key: values[after - 1] for key, values in row["epochs"].items()}
    return {
        "epoch": after,
        "peak": float(normal.max()),
        "means": [float(mean) for mean in normal.mean(axis=1)],
        "pixels_with_half_the_light": float((np.searchsorted(light, 0.5) + 1) / light.size),
        "pixels_below_a_tenth_of_the_mean": float((normal < 0.1).mean()),
        **{key: at[key] for key in ("held_out", "held_out_first_200", "clicks", "photons", "illumination")},
    }


def evolution_tables(rows: Rows) -> list[Table]:
    """Return one line per stage."""
    return [
        Table(columns("evolution"), [row | {"least": min(row["means"]), "most": max(row["means"])} for row in rows])
    ]


PAGES = pages({"alpha": (alpha_page, alpha_tables), "evolution": (evolution_page, evolution_tables)})
