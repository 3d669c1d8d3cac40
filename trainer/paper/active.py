"""The paper's FashionMNIST and MNIST tables: train every row, measure it, put it beside the paper's figures.

Owns the recipes, the measuring of one row, the two pages, and the trained rows that other pages measure further (`trained_rows`). The
instrument is the profile `ideal`, which is what the paper simulates: a plain thresholded Poisson detector and a modulator with perfect
black. SIMULATED.

A row is trained once and kept in the cache folder, as a bundle and its figures: a killed run goes on where it was, and rows may
be trained by several processes. Rows are chosen by nothing but validation objects: the test images are used once, at the end.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.instrument.profile import Profile, load_profile
from pans.runtime.outputs import replace_file
from pans.trainer.evaluate.accuracy import (
    EXACT_OUTCOMES_MAX,
    Measured,
    evaluate_exactly,
    evaluate_sampled,
    light_of,
    row_of,
)
from pans.trainer.options import EXACT_FEATURES_MAX, Options, plain_options
from pans.trainer.tasks.registry import Objects, Task, load_task
from pans.trainer.verdicts import against, claim, sampling_error, training_spread

from . import plots
from .page import Asked, Made, Row, Rows, Table, check_cached_bundle, columns, finished, kept, pages
from .tables import ACTIVE, CLICKS_TOLERANCE, DIRECT, DIRECT_ERRORS, FIRST, FIRST_OBJECTS, SHOTS, ActiveRow

PROFILE = "ideal"
TRIALS = {FIRST_OBJECTS: 100, 10_000: 10}  # where the outcomes are too many to enumerate
# Times the paper's clicks, which it counted on the first 200 test images: these of MNIST are 9 % darker than the training images.
CLICKS_AIM = {"fashion-mnist": 1.02, "mnist": 1.085}
CLICKS_AIM_NINE = 1.11  # of MNIST's nine patterns, which no other row comes so close to the tolerance with
# Trained once more from another seed, to see how far a seed moves a row. Never chosen from: the table keeps seed 0.
OTHER_SEEDS = {("fashion-mnist", 10): (1000,), ("mnist", 9): (1000,)}  # far from 0, + 1, ...: those are its restarts


def recipe(name: str, row: ActiveRow) -> Options:
    """Return what a row is trained with: one schedule for all rows of a size."""
    shared = Options(features=row.features, clicks=CLICKS_AIM[name] * row.clicks, alpha=5e-5, shots=5)
    if row.features <= 6:  # few words, many poor valleys: many starts, and trained for decisions
        small = replace(shared, epochs=30, warm=0.27, polish=0.6, hidden=64, head_rate=5e-3, front_rate=2e-2)
        small = (
            replace(small, alpha=2e-4) if name == "mnist" else small
        )  # dark objects: light is spent more freely on them
        return replace(small, starts=8) if row.features > 4 else replace(small, starts=5, restarts=2)
    if row.features <= EXACT_FEATURES_MAX:
        exact = replace(shared, epochs=36, warm=0.3, starts=2, polish=0.4, hidden=128, head_rate=3e-3)
        if name != "mnist":
            return exact
        clicks = CLICKS_AIM_NINE * row.clicks
        return replace(exact, epochs=100, starts=3, alpha=1e-4, mix=0.66, clicks=clicks)
    local = replace(shared, estimator="local", warm=0.4, head_rate=2e-3, epochs=32, hidden=256)
    if row.features == 32:  # several shots gain least where the patterns were trained for one alone
        return replace(local, mix=0.5)
    if row.features < 36:
        return local
    if row.features == 36:
        return replace(local, epochs=44, alpha=1e-5)
    return replace(local, epochs=36, hidden=128, alpha=1e-5)


def row_files(cache: Path, name: str, features: int, seed: int = 0) -> tuple[Path, Path]:
    """Return where the bundle and the figures of a row are kept."""
    stem = f"{name}-{features}" + (f"-seed{seed}" if seed else "")
    return cache / f"{stem}.pans", cache / f"{stem}.json"


def finished_row(cache: Path, name: str, row: ActiveRow, seed: int = 0) -> dict[str, Any] | None:
    """Return the figures of a row that was trained by the present recipe from `seed`, or None."""
    return finished(row_files(cache, name, row.features, seed)[1], replace(recipe(name, row), seed=seed))


def row_with_seeds(asked: Asked, row: ActiveRow) -> Row | None:
    """Return the figures of a row of the table `asked.name`, `other_seeds` being those of `OTHER_SEEDS`; None where it is not made."""
    found = []
    for seed in (0, *OTHER_SEEDS.get((asked.name, row.features), ())):
        figures = finished_row(asked.cache, asked.name, row, seed)
        if figures is None and not asked.collect:
            figures = make_row(asked, row, seed)
        found.append(figures)
    first, *others = found
    return None if first is None else first | {"other_seeds": [figures for figures in others if figures is not None]}


def make_row(asked: Asked, row: ActiveRow, seed: int = 0) -> Row:
    """Train, export and measure one row of the table `asked.name`, or go on with it; its figures go to the cache and are returned."""
    from pans.trainer.export.writer import export_trained
    from pans.trainer.train.loop import train

    name = asked.name
    bundle_path, figures_path = row_files(asked.cache, name, row.features, seed)
    check_cached_bundle(bundle_path)
    task, profile = load_task(name, asked.data_dir), load_profile(PROFILE)
    options = replace(recipe(name, row), seed=seed)
    checkpoint = bundle_path.with_suffix(".checkpoint")
    clock = _Clock(figures_path.with_suffix(".seconds"), goes_on=checkpoint.is_file())

    def said(epoch: Any) -> None:
        clock.save()
        if epoch.epoch % 5 == 0:
            asked.report(
                f"{name} d_f={row.features} run {epoch.restart} epoch {epoch.epoch} {epoch.stage}: loss {epoch.loss:.3f}, "
                f"{epoch.clicks:.2f} clicks, {epoch.photons:.1f} photons"
            )

    trained = train(task, profile, options, checkpoint=checkpoint, resume=checkpoint.is_file(), report=said)
    provenance = {"task_argument": name, "command": f"pans reproduce {name}", "options": plain_options(options)}
    exported = export_trained(
        bundle_path, trained, task, profile, name=f"{name}-{row.features}", provenance=provenance, force=True
    )
    training = clock.save()
    figures = {
        "features": row.features,
        "options": plain_options(options),
        "sha256": exported.sha256,
        "score_difference": exported.score_difference,
        "validation_losses": list(trained.validation_losses),
        "cpu_seconds": training,
        **measure_row(bundle_path, task, profile),
    }
    figures["direct"] = direct_at(name, figures["all"]["1"]["photons_mean"])
    replace_file(figures_path, json.dumps(figures, indent=1).encode())
    checkpoint.unlink(missing_ok=True)
    return figures


def measure_row(bundle_path: Path, task: Task, profile: Profile) -> dict[str, Any]:
    """Return accuracy, clicks, photons and illumination at every number of shots, of the first 200 and of all test images."""
    bundle, _ = load_bundle(bundle_path)
    return {
        part: {str(shots): row_of(_measured(bundle, profile, objects, shots)) for shots in SHOTS}
        for part, objects in parts_of(task.test).items()
    }


def parts_of(test: Objects) -> dict[str, Objects]:
    """Return the first test objects, which the paper takes, and all of them."""
    return {FIRST: Objects(test.images[:FIRST_OBJECTS], test.labels[:FIRST_OBJECTS]), "all": test}


def direct_at(name: str, photons: float) -> dict[str, Any]:
    """Return noise-aware direct imaging at the same photons: accuracy by interpolation in log photons, none extrapolated."""
    levels = DIRECT[name]
    inside = min(max(photons, min(levels)), max(levels))
    accuracy, error = (_interpolated(of[name], inside) / 100 for of in (DIRECT, DIRECT_ERRORS))
    return {"accuracy_mean": accuracy, "accuracy_se_objects": error, "photons_mean": inside}


def _interpolated(levels: dict[float, float], photons: float) -> float:
    """Interpolate in the logarithm of the photons."""
    return float(np.interp(math.log(photons), [math.log(level) for level in levels], list(levels.values())))


def passed(row: ActiveRow, figures: dict[str, Any], shots: int = 1) -> tuple[float, bool]:
    """Return by how many points a row beats the paper's simulation on the first 200, and whether its clicks are within +5 %."""
    mine = figures[FIRST]
    ahead = 100 * mine[str(shots)]["accuracy_mean"] - row.simulation[SHOTS.index(shots)]
    return ahead, mine["1"]["clicks_mean"] <= CLICKS_TOLERANCE * row.clicks


class _Clock:
    """Seconds of this process's processor, added up over the runs that a row took."""

    def __init__(self, path: Path, *, goes_on: bool) -> None:
        self.path = path
        self.before = float(path.read_text()) if goes_on and path.is_file() else 0.0
        self.start = time.process_time()

    def save(self) -> float:
        total = self.before + time.process_time() - self.start
        replace_file(self.path, f"{total:.1f}".encode())
        return total


def _measured(bundle: Bundle, profile: Profile, objects: Objects, shots: int) -> Measured:
    light = light_of(bundle, profile, objects.images)
    outcomes = (shots + 1) ** bundle.n_features
    if outcomes <= EXACT_OUTCOMES_MAX and outcomes * len(objects) <= EXACT_OUTCOMES_MAX << 5:
        return evaluate_exactly(bundle, light, objects.labels, shots=shots)
    return evaluate_sampled(bundle, light, objects.labels, shots=shots, trials=TRIALS[len(objects)], seed=1)


# ---- the pages ----


def active_page(asked: Asked) -> Made:
    """Return one row per number of patterns, with the paper's figures beside ours."""
    name, done = asked.name, []
    for row in ACTIVE[name]:
        if not asked.wants(row.features):
            continue
        figures = row_with_seeds(asked, row)
        if figures is None:
            asked.report(f"{name} d_f={row.features}: not trained yet")
            continue
        ahead, clicks_fine = passed(row, figures)
        asked.report(
            f"{name} d_f={row.features}: {ahead:+.2f} points, clicks {'fine' if clicks_fine else 'above +5 %'}"
        )
        printed = {key: getattr(row, key) for key in ("features", "simulation", "experiment", "clicks", "illumination")}
        direct = direct_at(
            name, figures["all"]["1"]["photons_mean"]
        )  # not that of the cache: the curve may have more levels now
        done.append({"task": name, "paper": printed, **figures, "direct": direct})
    return Made(done, {"": partial(plots.accuracy_against_photons, name=name, rows=done)} if done else {})


def active_tables(rows: Rows) -> list[Table]:
    """Return the table of the paper's images, that of all, and that of other seeds."""
    shown = [row | _compared(row) for row in rows]
    others = [other | {"moved": _moved(row, other)} for row in rows for other in row.get("other_seeds", ())]
    first = f"## First {FIRST_OBJECTS} test images, as in the paper (accuracy %, K = 1 / 2 / 3 / 5)"
    seeds = Table(columns("active_seeds"), others, "## Other seeds (accuracy %, K = 1 / 2 / 3 / 5)")
    beside_paper = [
        claim(f"K = {shots}: ours", "the paper's simulation", [row["beside_paper"][i] for row in shown])
        for i, shots in enumerate(SHOTS)
    ]
    beside_direct = claim("Ours", "direct imaging at these photons", [row["beside_direct"] for row in shown])
    found = [
        Table(columns("active_first"), shown, first, beside_paper),
        Table(columns("active_all"), shown, "## All 10 000 test images, K = 1", [beside_direct]),
    ]
    return [*found, seeds] if others else found


def _compared(row: Row) -> Row:
    """What the tables say of a row beside the paper's simulation (per number of shots), and beside direct imaging (one shot)."""
    trials = row["all"]["1"]["trials"]
    trained = [row, *row.get("other_seeds", ())]
    direct, direct_error = (100 * row["direct"][key] for key in ("accuracy_mean", "accuracy_se_objects"))
    beside_paper = [
        beside(trained, FIRST, str(shots), printed, sampling_error(printed, FIRST_OBJECTS))
        for shots, printed in zip(SHOTS, row["paper"]["simulation"])
    ]
    return {
        "how": f"{trials} trials" if trials else "exact",
        "trainings": len(trained),
        "beside_paper": beside_paper,
        **{f"{key}_of_paper": [found[key] for found in beside_paper] for key in ("ahead", "error", "verdict")},
        "beside_direct": beside(trained, "all", "1", direct, direct_error),
    }


def beside(trained: Rows, part: str, shots: str, theirs: float, their_error: float) -> Row:
    """Hold the first of the trainings of a row against an accuracy in %.

    The errors: ours from having few objects, the spread of one training where there are several, and theirs.
    """
    ours = [found[part][shots] for found in trained]
    spread = training_spread([100 * found["accuracy_mean"] for found in ours])
    errors = (100 * ours[0]["accuracy_se_objects"], spread, their_error)
    return against(100 * ours[0]["accuracy_mean"], theirs, *errors)


def _moved(row: Row, other: Row) -> Row:
    """By how much another seed moves the accuracy."""
    return {
        part: {k: other[part][k]["accuracy_mean"] - row[part][k]["accuracy_mean"] for k in row[part]}
        for part in (FIRST, "all")
    }


PAGES = pages(dict.fromkeys(ACTIVE, (active_page, active_tables)))


# ---- trained rows, for the pages that measure them further ----


@dataclass(frozen=True, slots=True, eq=False)
class TrainedRow:
    """A row of the paper, our bundle for it with its SHA-256, and the figures of its table."""

    table: str
    paper: ActiveRow
    bundle: Bundle
    sha256: str
    figures: Row

    @property
    def features(self) -> int:
        """Number of patterns, d_f."""
        return self.paper.features


def trained_rows(asked: Asked, table: str) -> list[TrainedRow]:
    """Return the rows of `table` whose bundle and figures lie in the cache; what is missing or of an earlier recipe is reported."""
    found = []
    for row in ACTIVE[table]:
        if not asked.wants(row.features):
            continue
        bundle_path, figures_path = row_files(asked.cache, table, row.features)
        if not (bundle_path.is_file() and figures_path.is_file()):
            asked.report(f"{table} d_f={row.features} is not trained yet: pans reproduce {table} --rows {row.features}")
            continue
        if finished_row(asked.cache, table, row) is None:
            asked.report(f"{table} d_f={row.features} was trained by an earlier recipe than today's")
        bundle, sha256 = load_bundle(bundle_path)
        found.append(TrainedRow(table, row, bundle, sha256, json.loads(figures_path.read_text())))
    return found


def measured_on(asked: Asked, row: TrainedRow, facts: Row, make: Callable[[], Row]) -> Row | None:
    """Return what the page `asked.name` measured on `row` in the way of `facts`, now or before.

    With `collect` None where it did not; that is reported. A figure that was kept for another bundle is measured again.
    """

    def measured() -> Row:
        asked.report(f"{asked.name}: measuring {row.table}, d_f = {row.features}")
        return make()

    path = asked.cache / f"{asked.name}-{row.table}-{row.features}.json"
    found = kept(path, {"sha256": row.sha256, **facts}, measured, collect=asked.collect)
    if found is None:
        asked.report(
            f"{asked.name}: {row.table}, d_f = {row.features} is not measured yet: pans reproduce {asked.name}"
        )
    return found


def by_table(rows: Rows) -> list[tuple[str, Rows]]:
    """Return the rows of each active table, by their key `table`."""
    return [(table, [row for row in rows if row["table"] == table]) for table in ACTIVE]
