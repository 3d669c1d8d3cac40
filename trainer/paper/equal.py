"""PANS against direct imaging at equal photons, on the tasks that our generators draw.

Owns the levels, the recipes and the page. At every level N each way gets N detected photoelectrons per decision, averaged over the
held-out objects (PANS: at most N), with ideal shot noise and no dark counts:

- **PANS**: ten patterns (cells at many photons: more), trained with N photons as its budget and no limit on clicks;
- **posterior**: 784 and more perfect photon counters, the exact Poisson likelihood over all training objects (baselines/bayes.py);
- **network**: the same frames, a convolutional network trained on fresh noisy frames of that level (baselines/direct.py).

FashionMNIST and MNIST stand apart (`SETS`): fixed patterns from several seeds, held to N photons, held to the light that direct imaging
sends for N, or trained for most photons and dimmed to N. Beside them direct imaging by the exact posterior (tables.toml), at the photons
and at the illumination of each row.

SIMULATED on the profile `ideal`. Finished figures lie in the cache folder, one file each.
"""

from __future__ import annotations

import functools
import json
import math
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pans.runtime.bundle.optics import incident_field
from pans.runtime.instrument.profile import load_profile
from pans.runtime.outputs import replace_file
from pans.trainer.baselines.bayes import bayes
from pans.trainer.baselines.common import Decide, Measurement, run_trials
from pans.trainer.baselines.common import measure as measure_frames
from pans.trainer.baselines.networks import aware_cnn
from pans.trainer.model.field_basis import principal_fields
from pans.trainer.options import EXACT_FEATURES_MAX, Options, plain_options
from pans.trainer.tasks.registry import Task, load_task
from pans.trainer.train.loop import Trained, train
from pans.trainer.verdicts import against, claim

from .active import direct_at
from .page import Asked, Made, Row, Rows, Table, cached_row, columns, finished, pages
from .passive import PROFILE, measure
from .passive_recipes import CELLS_RATE, FIELD_RATES, basis_of

TASKS = ("transient", "fiber", "cells-3", "cells", "nebula", "tissue")
PHOTONS = (1.0, 3.0, 10.0, 25.0)
FEATURES = 10
# ten clicks cannot tell what ten photons and more could: chosen on other draws of the generator (data seed 101)
MORE_FEATURES = {"cells-3": {10.0: 32, 25.0: 128}, "cells": {10.0: 32, 25.0: 128}}
LOCAL_FEATURES_MAX = 128  # beyond them the local estimator takes most of the time
AIM = 0.97  # of the photons, so that the held-out objects give no more than N
AIM_TISSUE = 0.82  # a speckle not seen before gives up to 18 % more than those trained on
NETWORK_EPOCHS = {"cells-3": 4, "cells": 4}  # 10 000 pixels; of the other tasks:
NETWORK_EPOCHS_ELSE = 12
FLOOR = (
    5e-3  # of the mean light, by which the posterior lifts every pixel: the middle one of those that it may choose from
)
TRIALS = 2
PANS, EQUAL_LIGHT, INCOHERENT = "PANS", "equal light", "equal light, incoherent"  # the last is of the page `reaching`
WAYS = (PANS, EQUAL_LIGHT, "posterior", "network")
DIRECT = WAYS[2:]
LIGHT_SIZE = 100  # fields in which an encoder that conserves light is sought: those that hold most of it
LIGHT_RATE = 1e-2
SETS = ("fashion-mnist", "mnist")
SET_PHOTONS = (7.0, 17.0, 33.0)
HELD, SENT, DIMMED = "held to photons", "held to illumination", "dimmed"
SET_WAYS = (HELD, SENT, DIMMED)
SET_FEATURES = 32
# Ten epochs are seconds: chosen among eight short schedules by the last 10 000 training images of FashionMNIST, 17 photons
SET_SCHEDULE: dict[str, Any] = {
    "estimator": "local",
    "epochs": 10,
    "warm": 0.6,
    "hidden": 64,
    "front_rate": 2e-2,
    "head_rate": 3e-3,
}
MEAN_TRANSMISSION = {"fashion-mnist": 0.2860, "mnist": 0.1307}  # of all training images


def recipe(name: str, photons: float) -> Options:
    """Return what PANS is trained with at a photon level."""
    features = MORE_FEATURES.get(name, {}).get(photons, FEATURES)
    aim = AIM_TISSUE if name == "tissue" else AIM
    shared = Options(features=features, alpha=0.0, photons=aim * photons, epochs=30, polish=0.4, head_rate=3e-3)
    if name in FIELD_RATES:
        return replace(shared, encoder="coherent", hidden=64, batch=256, front_rate=FIELD_RATES[name])
    shared = replace(shared, warm=0.4, front_rate=CELLS_RATE)
    if features <= EXACT_FEATURES_MAX:
        return replace(shared, hidden=128)
    if features <= LOCAL_FEATURES_MAX:
        return replace(shared, estimator="local", epochs=44, polish=0.0, hidden=256)
    return replace(shared, estimator="ste", epochs=50, polish=0.0, hidden=512, front_rate=2 * CELLS_RATE)


def light_recipe(name: str, photons: float) -> Options:
    """Return what PANS is trained with when that many photoelectrons' worth of light reach its optics, and none is made."""
    fields = replace(recipe(name, photons), photons=None, front_rate=LIGHT_RATE, light=0.2)
    return replace(fields, conserving=True, input_photons=photons)


def recipe_of(name: str, way: str, photons: float) -> Options:
    """Return what PANS is trained with in one of its ways; `INCOHERENT` is a mask of intensities, trained pixel by pixel."""
    if way == PANS:
        return recipe(name, photons)
    conserving = light_recipe(name, photons)
    return conserving if way == EQUAL_LIGHT else replace(conserving, encoder="incoherent", light=1.0)


def equal_page(asked: Asked) -> Made:
    """Return one row per task, way and level; with `collect` only what is finished."""
    rows = []
    for ways in (WAYS[:3], WAYS[3:]):  # the networks last: they take longest
        for name in TASKS:
            wanted = [way for way in ways if way != EQUAL_LIGHT or name in FIELD_RATES]
            rows += [equal_row(asked, name, way, photons) for way in wanted for photons in PHOTONS]
    return Made([row for row in rows if row is not None] + list(_set_rows(asked)))


def equal_row(asked: Asked, name: str, way: str, photons: float) -> Row | None:
    """Return the row of a task, way and level, measured now if need be; None where it is missing and `collect` is asked for."""
    path = asked.cache / f"equal-{name}-{way.replace(',', '').replace(' ', '-')}-{photons:g}.json"
    found = _finished(path, name, way, photons)
    if found is None and not asked.collect:
        found = _made(path, _task(name, asked.data_dir), way, photons)
        asked.report(f"{name}, {way}, {photons:g} photons: {found['value']:.2f} %")
    return found


@functools.lru_cache(maxsize=1)  # the rows of a task share it
def _task(name: str, data_dir: str | None) -> Task:
    return load_task(name, data_dir)


def _finished(path: Path, name: str, way: str, photons: float) -> Row | None:
    if way not in DIRECT:
        return finished(path, recipe_of(name, way, photons))
    found = cached_row(path, "way") or {}
    return found if direct_recipe(name, way).items() <= found.items() else None


def direct_recipe(name: str, way: str) -> Row:
    """Return what direct imaging is decided with: which frames, and the posterior's floor or the network's passes over fresh noise."""
    if way == "posterior":
        return {"frames": "all", "floor": FLOOR}
    return {"frames": "all", "epochs": NETWORK_EPOCHS.get(name, NETWORK_EPOCHS_ELSE)}


def _made(path: Path, task: Task, way: str, photons: float) -> Row:
    started = time.process_time()
    figures = _direct(task, way, photons) if way in DIRECT else _pans(task, way, photons)
    row = {"task": task.name, "way": way, "asked": photons, "cpu_seconds": time.process_time() - started, **figures}
    replace_file(path, json.dumps(row, indent=1).encode())
    return row


def _pans(task: Task, way: str, photons: float) -> Row:
    options, basis = recipe_of(task.name, way, photons), None
    if way == PANS:
        basis = basis_of(task.name, task, options)
    elif way == EQUAL_LIGHT:
        x = torch.from_numpy(incident_field(task.train.images, task.light, task.optics)).flatten(1)
        basis = principal_fields(x, task.image_shape, LIGHT_SIZE)
    trained = train(task, load_profile(PROFILE), options, basis=basis)
    return measure(task.name, task, trained) | {"options": plain_options(options)}


def _direct(task: Task, way: str, photons: float) -> Row:
    frames = measure_frames(task, None)
    how = direct_recipe(task.name, way)
    if way == "posterior":
        decide, _ = bayes(frames, photons, "counting", seed=0, floor=how["floor"])
    else:
        decide = aware_cnn(frames, photons, "counting", seed=0, epochs=how["epochs"])
    return how | direct_figures(task, frames, photons, decide)


def direct_figures(task: Task, frames: Measurement, photons: float, decide: Decide) -> Row:
    """Return the figures of a row of direct imaging at `photons`, decided by `decide`, over `TRIALS` trials of all held-out frames."""
    done = run_trials(frames, photons, "counting", decide, trials=TRIALS, seed=0)
    whole, first = done.measured(), done.measured(200)
    return {
        "value": 100 * whole.accuracy_mean,
        "first_200": 100 * first.accuracy_mean,
        "spread_trials": 100 * whole.accuracy_std,
        "error_objects": 100 * whole.accuracy_se_objects,
        "objects": whole.objects,
        "clicks": whole.clicks_mean,
        "photons": whole.photons_mean,
        "illumination": whole.illumination if task.light == "transmission" else 0.0,
    }


def equal_tables(rows: Rows) -> list[Table]:
    """Return every row, how far ours is ahead of the better direct way at each level, and the public sets over their seeds."""
    sets = [row for row in rows if row["way"] in SET_WAYS]
    rows = [row for row in rows if row["way"] not in SET_WAYS]
    ordered = sorted(rows, key=lambda row: (TASKS.index(row["task"]), row["asked"], WAYS.index(row["way"])))
    compared = [found for row in ordered if row["way"] not in DIRECT and (found := ahead(row, rows)) is not None]
    ours = [way for way in WAYS if way not in DIRECT]
    claims = [claim(f"`{way}`", "the better direct way", [r for r in compared if r["way"] == way]) for way in ours]
    heading = "## Beside the better direct way"
    tables = [Table(columns("equal"), ordered), Table(columns("ahead"), compared, heading, claims)]
    return tables + (_set_tables(sets) if sets else [])


def ahead(row: Row, rows: Rows) -> Row | None:
    """Return a row of ours with `beside` (the better direct way at its task and level), `ahead` in points, `error` and `verdict`.

    `error` is the standard error from having few objects, of both together, as if they had been drawn for each: the pairs are not kept.
    None where no direct way was measured.
    """
    there = [
        other
        for other in rows
        if other["way"] in DIRECT and (other["task"], other["asked"]) == (row["task"], row["asked"])
    ]
    if not there:
        return None
    best = max(there, key=lambda other: float(other["value"]))
    compared = against(row["value"], best["value"], row["error_objects"], best["error_objects"])
    return row | {"beside": best["way"]} | compared


# ---- the public sets, over several seeds ----


def set_recipe(way: str, photons: float, light: float, seed: int) -> Options:
    """Return what fixed patterns are trained with: held to `photons`, or to `light`, what direct imaging sends for them."""
    shared = Options(features=SET_FEATURES, alpha=0.0, seed=seed, **SET_SCHEDULE)
    return replace(shared, photons=AIM * photons) if way == HELD else replace(shared, illumination=light)


def recipe_of_row(row: Row) -> Options:
    """Return what a row of the page with `options` would be trained with today."""
    if row["way"] not in SET_WAYS:
        return recipe_of(row["task"], row["way"], row["asked"])
    photons = max(SET_PHOTONS) if row["way"] == DIMMED else row["asked"]
    light = photons / MEAN_TRANSMISSION[row["task"]]
    return set_recipe(SENT if row["way"] == SENT else HELD, photons, light, row["options"]["seed"])


def _set_rows(asked: Asked) -> Iterator[Row]:
    """Yield the rows of the public sets, one seed after the other, so that a killed run has as many of each as it can."""
    for seed in range(asked.seeds):
        for name in SETS:
            for way in (HELD, SENT):
                for photons in SET_PHOTONS:
                    yield from _set_row(asked, name, way, photons, seed)


def _set_row(asked: Asked, name: str, way: str, photons: float, seed: int) -> Rows:
    """Return the row of one training, and behind it those of its patterns dimmed to fewer photons; none where it is missing."""
    path = asked.cache / f"equal-{name}-{way.replace(' ', '-')}-{photons:g}-seed{seed}.json"
    light = photons / MEAN_TRANSMISSION[name]
    options = set_recipe(way, photons, light, seed)
    found = finished(path, options)
    if found is None:
        if asked.collect:
            asked.report(
                f"{name}, {way}, {photons:g} photons, seed {seed}: not trained yet (pans reproduce equal-photons)"
            )
            return []
        found = _set_made(path, _task(name, asked.data_dir), way, photons, options)
        asked.report(f"{name}, {way}, {photons:g} photons, seed {seed}: {found['rows'][0]['value']:.2f} %")
    rows: Rows = found["rows"]
    return rows


def _set_made(path: Path, task: Task, way: str, photons: float, options: Options) -> Row:
    started = time.process_time()
    trained = train(task, load_profile(PROFILE), options)
    facts = {"task": task.name, "seed": options.seed, "options": plain_options(options)}
    facts["transmission"] = (
        float(task.test.images.mean()) / 255
    )  # photons that direct imaging detects of the light it sends
    rows = [facts | {"way": way, "asked": photons} | measure(task.name, task, trained)]
    rows[0]["cpu_seconds"] = time.process_time() - started
    if way == HELD and photons == max(SET_PHOTONS):
        levels = [level for level in SET_PHOTONS if level < photons]
        rows += [facts | {"way": DIMMED, "asked": level} | _dimmed(task, trained, level / photons) for level in levels]
    whole = {"options": plain_options(options), "rows": rows}
    replace_file(path, json.dumps(whole, indent=1).encode())
    return whole


def _dimmed(task: Task, trained: Trained, eta: float) -> Row:
    """Return the figures of patterns with all light times `eta`, the head as it is."""
    assert trained.quantised is not None
    patterns = replace(trained.quantised, photons_per_level=eta * trained.quantised.photons_per_level)
    found = measure(task.name, task, replace(trained, quantised=patterns))
    return found | {"illumination": eta * found["illumination"]}


def _set_tables(rows: Rows) -> list[Table]:
    """Return means over the seeds, each beside direct imaging at its photons and at its illumination."""
    keys = dict.fromkeys((SETS.index(row["task"]), row["asked"], SET_WAYS.index(row["way"])) for row in rows)
    means = []
    for task, asked, way in sorted(keys):
        means.append(
            _set_mean([r for r in rows if (r["task"], r["asked"], r["way"]) == (SETS[task], asked, SET_WAYS[way])])
        )
    claims = [
        claim(
            f"`{way}`", f"direct imaging at equal {words}", [row[f"at_{words}"] for row in means if row["way"] == way]
        )
        for words in ("photons", "illumination")
        for way in SET_WAYS
    ]
    return [Table(columns("equal_sets"), means, "## FashionMNIST and MNIST: fixed patterns from several seeds", claims)]


def _set_mean(mine: Rows) -> Row:
    """Return means over seeds, the standard error of that mean (None of one seed), and the comparisons with direct imaging."""
    summed = ("value", "first_200", "error_objects", "clicks", "photons", "illumination")
    mean: Row = {key: statistics.fmean(row[key] for row in mine) for key in summed}
    error = statistics.stdev(row["value"] for row in mine) / math.sqrt(len(mine)) if len(mine) > 1 else None
    mean |= {key: mine[0][key] for key in ("task", "asked", "way", "options")}
    if "cpu_seconds" in mine[0]:
        mean["cpu_seconds"] = statistics.fmean(row["cpu_seconds"] for row in mine)
    of_light = mean["illumination"] * mine[0]["transmission"]
    for words, photons in (("photons", mean["photons"]), ("illumination", of_light)):
        there = direct_at(mean["task"], photons)
        errors = (error or 0.0, mean["error_objects"], 100 * there["accuracy_se_objects"])
        theirs = 100 * there["accuracy_mean"]
        mean[f"at_{words}"] = {"value": theirs, "photons": photons} | against(mean["value"], theirs, *errors)
    return mean | {"trainings": len(mine), "error_seeds": error}


PAGES = pages({"equal-photons": (equal_page, equal_tables)})
