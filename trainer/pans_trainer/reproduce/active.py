"""The paper's FashionMNIST and MNIST tables: every row is trained, measured and put beside the paper's figures.

The instrument is the profile `ideal`: a thresholded Poisson detector and a modulator with perfect black, as the paper simulates.
A row is trained once; its bundle and figures stay in the cache, and other pages measure them further (`trained_rows`). Only validation
objects choose between restarts: the test images are used once, at the end.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pans.base.files import replace_file
from pans.bundle.sensor import Bundle, load_bundle
from pans.instrument.profile import load_profile
from pans_trainer.evaluate.accuracy import EXACT_OUTCOMES_MAX, evaluate_exactly, evaluate_sampled, light_of, row_of
from pans_trainer.options import Options, plain_options
from pans_trainer.tasks.registry import Objects, Task, load_task

from .page import (
    FIRST_OBJECTS,
    Asked,
    Made,
    Row,
    Rows,
    against,
    check_cached_bundle,
    finished,
    flat,
    interpolated,
    sampling_error,
)
from .printed import ACTIVE, DIRECT, SHOTS, ActiveRow, recipe

PROFILE = "ideal"
PARTS = {"first_200": FIRST_OBJECTS, "all": None}
TRIALS, TRIALS_OF_ALL = 100, 10  # of the first 200 and of all, where the outcomes are too many to enumerate
EXACT_WORK_MAX = 1 << 25  # objects times outcomes
# Trained once more, to see how far a seed moves a row. Never chosen from. Far from 0, 1, ...: those are the restarts of seed 0.
OTHER_SEEDS = {("fashion-mnist", 10): (1000,), ("mnist", 9): (1000,)}


def row_path(cache: Path, name: str, features: int, seed: int = 0) -> Path:
    """Return where the figures of a row are kept; its bundle is beside them (.pans)."""
    return cache / (f"{name}-{features}" + (f"-seed{seed}" if seed else "") + ".json")


def options_of(name: str, row: ActiveRow, seed: int = 0) -> Options:
    """Return the options that a row is trained with."""
    return replace(recipe(name, row), seed=seed)


def finished_row(cache: Path, name: str, row: ActiveRow, seed: int = 0) -> Row | None:
    """Return the figures of a row that was trained by the present recipe from `seed`, or None."""
    return finished(row_path(cache, name, row.features, seed), options_of(name, row, seed))


def make_row(asked: Asked, row: ActiveRow, seed: int = 0) -> Row:
    """Train, export and measure one row of the table `asked.name`, or resume it; return its figures, which stay in the cache."""
    from pans_trainer.export.writer import export_trained
    from pans_trainer.train.gradient.loop import train

    name, path = asked.name, row_path(asked.cache, asked.name, row.features, seed)
    options = options_of(name, row, seed)
    bundle_path, checkpoint = path.with_suffix(".pans"), path.with_suffix(".checkpoint")
    check_cached_bundle(bundle_path)
    task, profile = load_task(name, asked.data_dir), load_profile(PROFILE)

    def said(epoch: Any) -> None:
        if epoch.epoch % 5 == 0:
            where = f"{name} d_f={row.features} run {epoch.restart} epoch {epoch.epoch} {epoch.stage}"
            asked.report(f"{where}: loss {epoch.loss:.3f}, {epoch.clicks:.2f} clicks, {epoch.photons:.1f} photons")

    trained = train(task, profile, options, checkpoint=checkpoint, resume=checkpoint.is_file(), report=said)
    provenance = {"task_argument": name, "command": f"pans reproduce {name}", "options": plain_options(options)}
    title = f"{name}-{row.features}"
    exported = export_trained(bundle_path, trained, task, profile, name=title, provenance=provenance, force=True)
    facts: Row = {"features": row.features, "options": plain_options(options), "sha256": exported.sha256}
    figures = facts | measure_row(load_bundle(bundle_path)[0], task)
    replace_file(path, json.dumps(figures, indent=1).encode())
    checkpoint.unlink(missing_ok=True)
    return figures


def judged(bundle: Bundle, objects: Objects, *, shots: int = 1, eta: float = 1.0, dark: float | None = None) -> Row:
    """Return the figures of `bundle` on `objects`: exact where all outcomes can be enumerated, else of sampled trials."""
    light = light_of(bundle, load_profile(PROFILE), objects.images, eta=eta, dark=dark)
    if enumerable(bundle, len(objects), shots):
        return row_of(evaluate_exactly(bundle, light, objects.labels, shots=shots))
    trials = TRIALS if len(objects) == FIRST_OBJECTS else TRIALS_OF_ALL
    return row_of(evaluate_sampled(bundle, light, objects.labels, shots=shots, trials=trials, seed=1))


def enumerable(bundle: Bundle, objects: int, shots: int = 1) -> bool:
    """Return whether all outcomes of that many objects are enumerated."""
    outcomes = (shots + 1) ** bundle.n_features
    return outcomes <= EXACT_OUTCOMES_MAX and outcomes * objects <= EXACT_WORK_MAX


def measure_row(bundle: Bundle, task: Task) -> Row:
    """Return accuracy, clicks, photons and illumination at every number of shots, of the first 200 and of all test images."""
    parts = {part: task.test.first(count) for part, count in PARTS.items()}
    return {part: {str(k): judged(bundle, objects, shots=k) for k in SHOTS} for part, objects in parts.items()}


def shot_figures(figures: Row, shots: int = 1) -> Row:
    """Return the flat figures of a row at that many shots."""
    return flat(figures["all"][str(shots)], figures["first_200"][str(shots)])


# ---- the pages ----


def active_page(asked: Asked) -> Made:
    """Return one row per number of patterns and shots beside the paper, one per number of patterns beside direct imaging, other seeds."""
    name, rows = asked.name, []
    for row in ACTIVE[name]:
        found = []
        for seed in (0, *OTHER_SEEDS.get((name, row.features), ())) if asked.wants(row.features) else ():
            figures = finished_row(asked.cache, name, row, seed)
            if figures is None and not asked.collect:
                figures = make_row(asked, row, seed)
            if figures is not None:
                found.append(figures)
            else:
                asked.report(f"{name} d_f={row.features} seed {seed}: not trained yet")
        if found:
            rows += row_beside(name, row, found)
    order = ("shots", "direct", "seeds")
    rows.sort(key=lambda each: order.index(each["table"]))
    return Made(rows)


def row_beside(name: str, row: ActiveRow, trained: Rows) -> Rows:
    """Return the rows of one number of patterns: the first of its trainings beside the paper and direct imaging, then the others.

    Errors of ours are those from having few objects, and the spread of one training where there are several.
    """
    first, *others = trained
    rows = [beside_paper(row, shots, first, trained) for shots in SHOTS]
    one = shot_figures(first)
    direct = {key: direct_at(name, one["photons"], key) for key in ("value", "error_objects")}
    errors = one["error_objects"], spread(trained, "all", 1), direct["error_objects"]
    compared = against(one["value"], direct["value"], *errors)
    facts: Row = {"features": row.features, "direct": direct["value"], "trainings": len(trained)}
    rows.append({"table": "direct"} | one | facts | compared)
    for other in others:
        facts = {"table": "seeds", "features": row.features, "seed": other["options"]["seed"]}
        rows += [facts | {"shots": shots} | shot_figures(other, shots) for shots in SHOTS]
    return rows


def beside_paper(row: ActiveRow, shots: int, figures: Row, trained: Rows) -> Row:
    """Return a row at that many shots beside the paper's simulation and experiment, on its 200 images."""
    place, ours = SHOTS.index(shots), shot_figures(figures, shots)
    found = {"table": "shots", "features": row.features, "shots": shots, "detections": row.features * shots} | ours
    found |= {"paper_clicks": shots * row.clicks, "paper_illumination": shots * row.illumination}
    for kind, prefix in (("simulation", ""), ("experiment", "experiment_")):
        printed, deviation = getattr(row, kind)[place], getattr(row, f"{kind}_std")[place]
        errors = (ours["first_error"], spread(trained, "first_200", shots), sampling_error(printed, FIRST_OBJECTS))
        found |= {kind: printed, f"{kind}_std": deviation} | against(ours["first_200"], printed, *errors, prefix=prefix)
    return found


def spread(trained: Rows, part: str, shots: int) -> float:
    """Return the spread of one training in points, of trainings with several seeds; 0 where it is not known."""
    values = [100 * found[part][str(shots)]["accuracy_mean"] for found in trained]
    return statistics.stdev(values) if len(values) > 1 else 0.0


def direct_at(name: str, photons: float, of: str = "value") -> float:
    """Return a figure of direct imaging by the exact posterior at the same photons, or at the nearest that were measured."""
    levels = [row["photons"] for row in DIRECT[name]]
    found = interpolated(DIRECT[name], min(max(photons, min(levels)), max(levels)), "photons", of)
    assert found is not None, "inside of the curve"
    return found


# ---- trained rows, for the pages that measure them further ----


@dataclass(frozen=True, slots=True, eq=False)
class TrainedRow:
    """A row of the paper, our bundle for it with its SHA-256, and the figures of its table."""

    name: str
    paper: ActiveRow
    bundle: Bundle
    sha256: str
    figures: Row

    @property
    def features(self) -> int:
        """Number of patterns, d_f."""
        return self.paper.features


def trained_rows(asked: Asked, name: str) -> list[TrainedRow]:
    """Return the rows of a table whose bundle and figures are in the cache; report those that are missing or of an earlier recipe."""
    found = []
    for row in ACTIVE[name]:
        path = row_path(asked.cache, name, row.features)
        if not asked.wants(row.features):
            continue
        if not (path.is_file() and path.with_suffix(".pans").is_file()):
            asked.report(f"{name} d_f={row.features} is not trained yet: pans reproduce {name} --rows {row.features}")
            continue
        if finished_row(asked.cache, name, row) is None:
            asked.report(f"{name} d_f={row.features} was trained by an earlier recipe than today's")
        found.append(TrainedRow(name, row, *load_bundle(path.with_suffix(".pans")), json.loads(path.read_text())))
    return found


def measured_on(asked: Asked, row: TrainedRow, facts: Row, make: Callable[[], Row]) -> Row | None:
    """Return what the page `asked.name` measured on `row` by the method that `facts` states; with `collect` None where it did not."""
    return asked.kept(f"{asked.name}-{row.name}-{row.features}", {"sha256": row.sha256, **facts}, make)
