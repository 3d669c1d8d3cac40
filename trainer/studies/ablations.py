"""The page `ablations`: options of a training, each on and off, everything else the same.

Owns the arms, what is trained in each, and the tables. Every arm is trained on the first `OBJECTS` training images alone, so that several
seeds fit into minutes; its figures stand for differences, not for what a full training reaches. Seeds come one after the other over all
arms, so that a killed run has as many of each as it can. Nothing was chosen by them. Arms of one
study have the same light: a budget of photons, of clicks, or the light that reaches the optics. SIMULATED on the profile `ideal`.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import asdict, dataclass, replace
from functools import partial

from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import Options, differing_options, plain_options
from pans.trainer.paper.page import Asked, Made, Row, Rows, Table, columns, kept, pages
from pans.trainer.paper.passive import PROFILE, measure
from pans.trainer.paper.passive_recipes import CELLS_RATE, CLICKS_AIM_CELLS, load
from pans.trainer.tasks.registry import Task, load_task
from pans.trainer.train.loop import train
from pans.trainer.verdicts import against, claim

OBJECTS = 10_000  # training images
SEEDS = (0, 1, 2)
CLASSES, FIELD, RELEASE = "fashion-mnist", "mmf-mnist", "mmf-mnist, the release's speckle"
CELLS = "cells-3"

FEW = Options(features=10, alpha=0.0, photons=15.0, estimator="ste", epochs=20, batch=256, hidden=128)
MANY = replace(FEW, features=32, photons=40.0, epochs=30, hidden=512)
SPECKLE = Options(
    features=10,
    alpha=0.0,
    clicks=5.89,  # the paper's
    estimator="exact",
    epochs=30,
    warm=0.4,
    batch=256,
    hidden=128,
    head_rate=3e-3,
    encoder="coherent",
    dark=0.01,
)
IN_FLOW = Options(  # as the row of the table of cells, `passive_recipes`
    features=10,
    alpha=0.0,
    clicks=CLICKS_AIM_CELLS * 5.92,  # the paper's
    epochs=30,
    warm=0.4,
    polish=0.4,
    hidden=128,
    front_rate=CELLS_RATE,
    head_rate=3e-3,
    dark=0.0,
)
CONSERVING = replace(SPECKLE, clicks=None, conserving=True, input_photons=100.0)
# without a straight-through stage a cycle of the rates is half as high in front (train/schedule.py): twice the rate makes it the same
EXACT = replace(FEW, estimator="exact", warm=0.0, front_rate=2 * FEW.front_rate)


@dataclass(frozen=True, slots=True)
class Arm:
    """One way to train: what is asked (study), how it is called, on which images, and whether the others are held against it."""

    study: str
    name: str
    options: Options
    images: str = CLASSES
    reference: bool = False


HEAD, HEAD_OF_CELLS, GRADIENT, START = (
    "Head at d_f = 32",
    "Head of cells at d_f = 10",
    "Gradient at d_f = 10",
    "Slope and clamp at d_f = 10",
)
FIBRE, LOSSLESS = "Digits behind a fibre, clicks held", "Digits behind a fibre, light conserved"
ARMS = (
    Arm(HEAD, "one hidden layer of 512", MANY, reference=True),
    Arm(HEAD, "two convolutions, one hidden layer of 512", replace(MANY, head="conv")),
    Arm(GRADIENT, "damped straight-through", FEW, reference=True),
    Arm(GRADIENT, "identity straight-through", replace(FEW, estimator="identity")),
    Arm(GRADIENT, "exact", EXACT),
    Arm(GRADIENT, "damped straight-through, then exact", replace(FEW, estimator="exact")),
    Arm(START, "neither", FEW, reference=True),
    Arm(START, "slope rises from 0.2 to 1", replace(FEW, slope=0.2)),
    Arm(START, "clamp at 2 photoelectrons", replace(FEW, clamp=2.0)),
    Arm(FIBRE, "the release's intensity as a field, W real", SPECKLE, RELEASE),
    Arm(FIBRE, "field, W real", SPECKLE, FIELD, reference=True),
    Arm(FIBRE, "field, W complex", replace(SPECKLE, complex_field=True), FIELD),
    Arm(LOSSLESS, "field, W real", CONSERVING, FIELD, reference=True),
    Arm(LOSSLESS, "field, W complex", replace(CONSERVING, complex_field=True), FIELD),
    Arm(HEAD_OF_CELLS, "one hidden layer of 128", IN_FLOW, CELLS, reference=True),
    Arm(HEAD_OF_CELLS, "one hidden layer of 512", replace(IN_FLOW, hidden=512), CELLS),
    Arm(HEAD_OF_CELLS, "two hidden layers of 512", replace(IN_FLOW, head="deep", hidden=512), CELLS),
)


def ablations_page(asked: Asked) -> Made:
    """Return one row per arm and seed; arms of the same options share their trainings."""
    rows: Rows = []
    for seed in SEEDS:
        for arm in ARMS:
            if not asked.wants(arm.options.features):
                continue
            options = replace(arm.options, seed=seed)
            made_with = {"images": arm.images, "objects": OBJECTS, "options": differing_options(options)}
            found = kept(
                asked.cache / f"ablation-{_name(arm, seed)}.json",
                made_with,
                partial(_trained, asked, arm, options),
                collect=asked.collect,
            )
            if found is None:
                asked.report(f"{arm.study}, {arm.name}, seed {seed}: not trained yet (pans reproduce ablations)")
                continue
            figures = {key: value for key, value in found.items() if key != "made_with"}
            rows.append(
                {
                    "study": arm.study,
                    "arm": arm.name,
                    "seed": seed,
                    **figures,
                    **made_with,
                    "options": plain_options(options),
                }
            )
    return Made(rows)


def _name(arm: Arm, seed: int) -> str:
    """Of the part: what differs from the plain options, so that arms of the same options are one part."""
    plain = Options(features=arm.options.features)
    differs = [f"{key}{value}" for key, value in asdict(arm.options).items() if value != getattr(plain, key)]
    words = "-".join((arm.images.split(",")[0] + ("-release" if arm.images == RELEASE else ""), *differs))
    return f"{words}-{arm.options.features}-seed{seed}".replace("_", "").replace(".", "p")


def _trained(asked: Asked, arm: Arm, options: Options) -> Row:
    task = images_of(arm.images, asked.data_dir)
    found = measure(task.name, task, train(task, load_profile(PROFILE), options))
    asked.report(f"{arm.study}, {arm.name}, seed {options.seed}: {found['value']:.2f} % at {found['photons']:.1f}")
    return found


def images_of(images: str, data_dir: str | None) -> Task:
    """Return the task of an arm, with its first `OBJECTS` training images alone, the last twelfth of them for validation."""
    task = load("mmf-mnist", data_dir) if images == RELEASE else load_task(images, data_dir)
    # `measure` knows the release's speckle by its name; the field is that of an instrument
    name = task.name if images == RELEASE else images.replace("mmf-mnist", "mmf-mnist-field")
    return replace(task, name=name, train=task.train.first(OBJECTS), kept=0)


def ablations_tables(rows: Rows) -> list[Table]:
    """Return one table per study: means over seeds, each arm held against the reference."""
    tables = []
    for study in dict.fromkeys(arm.study for arm in ARMS):
        arms = [arm for arm in ARMS if arm.study == study]
        means = {arm.name: mean for arm in arms if (mean := _mean(arm, rows)) is not None}
        (reference,) = (arm.name for arm in arms if arm.reference)
        if reference not in means:
            continue
        for name, mean in means.items():
            if name != reference:
                mean["beside"] = _beside(mean, means[reference])
        shown = columns("ablation_reaching" if any("reaching" in mean for mean in means.values()) else "ablation")
        claims = [claim("Others", reference, [mean.get("beside") for mean in means.values()])]
        tables.append(Table(shown, list(means.values()), f"## {study}", claims))
    return tables


def _mean(arm: Arm, rows: Rows) -> Row | None:
    mine = [row for row in rows if (row["study"], row["arm"]) == (arm.study, arm.name)]
    if not mine:
        return None
    over = [key for key in FIGURES if key in mine[0]]
    mean: Row = {key: statistics.fmean(row[key] for row in mine) for key in over}
    spread = statistics.stdev(row["value"] for row in mine) if len(mine) > 1 else None  # of one it is not known
    return mean | {"arm": arm.name, "trainings": len(mine), "spread_seeds": spread}


FIGURES = ("value", "first_200", "error_objects", "clicks", "photons", "illumination", "reaching", "cpu_seconds")


def _beside(mean: Row, reference: Row) -> Row:
    """Errors of both: from the seeds, and from having so many test objects."""
    errors = [(one["spread_seeds"] or 0.0) / math.sqrt(one["trainings"]) for one in (mean, reference)]
    return against(mean["value"], reference["value"], *errors, mean["error_objects"], reference["error_objects"])


PAGES = pages({"ablations": (ablations_page, ablations_tables)})
