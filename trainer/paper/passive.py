"""The paper's tables of the other tasks: accuracy or SSIM over patterns and dark counts, ours beside the paper's.

Owns the measuring of a row, the pages, and a few pictures given back, kept beside a cell of the table of pictures; the recipes are in
passive_recipes.py. One model per row and dark count, trained with that dark count in the click law. SIMULATED on the profile `ideal`.

`mmf-mnist` and `mmf-mnist-image` are fully specified in the release and use its way for comparison (speckle *intensity*, normalised
over a batch, fed as a real field to a real W), see tasks/mmf.py for what is unphysical in it.
`barcode` is judged on all 1024 strings by their exact weights. The images of the other tasks are ours: equal difficulty is meant, equal
figures are no proof.
"""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pans.runtime.instrument.profile import Profile, load_profile
from pans.runtime.outputs import replace_file
from pans.trainer.baselines import strings
from pans.trainer.baselines.bayes import bayes
from pans.trainer.baselines.common import Measurement, run_trials
from pans.trainer.baselines.common import measure as measure_frames
from pans.trainer.evaluate.picture_samples import Samples, first_of_each_class, keep_samples, read_samples, take_samples
from pans.trainer.export.writer import analyser_of, export_trained
from pans.trainer.model.detection import click_probability, click_words, sample_clicks, word_probabilities
from pans.trainer.model.encoders import ActiveIllumination
from pans.trainer.model.ssim import ssim
from pans.trainer.options import EXACT_FEATURES_MAX, Options, plain_options
from pans.trainer.tasks import barcode as task_barcode
from pans.trainer.tasks.registry import Objects, Task, load_task
from pans.trainer.train.anomaly_search import search
from pans.trainer.train.barcode_search import solve, solve_patterns
from pans.trainer.train.data import CHUNK, encoder_input
from pans.trainer.train.loop import Trained, train
from pans.trainer.verdicts import Claim, against, claim, sampling_error

from . import images, plots
from .page import Asked, Column, Draw, Made, Row, Rows, Table, check_cached_bundle, columns, finished, kept, pages
from .paradigms import accuracy_at
from .passive_recipes import SEARCH_SIZE, TASKS, basis_of, load, recipe
from .tables import PASSIVE, UNPRINTED, PassiveRow, PassiveTable, table_of

PROFILE = "ideal"
TRIALS = 5
SHOWN_CELLS = ((4, 0.01), (32, 0.01), (64, 0.01), (64, 0.05))  # the paper draws the last three
POSTERIOR = "posterior"
STRING_LEVELS = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 30.0, 50.0)  # photons of direct imaging
SPECKLE_LEVELS = (10.0, 20.0, 30.0, 50.0, 100.0, 200.0, 300.0, 600.0, 1000.0)
PRINTED = 0.005  # points: of two exact figures, those that differ by no printed digit are level
FLOOR = (
    5e-3  # of the mean light, by which the posterior lifts every pixel: the middle one of those that it may choose from
)
SPECKLE = ("mmf-mnist", "mmf-mnist-image")  # in the release's way: images that no instrument sees


def finished_cell(cache: Path, name: str, row: PassiveRow, dark: float, data_seed: int = 0) -> Row | None:
    """Return the figures of a model that was trained by the present recipe, or None."""
    return finished(_path(cache, name, row.features, dark, data_seed), recipe(name, row, dark))


def other_draws(cache: Path, name: str, row: PassiveRow, dark: float) -> Rows:
    """Return the figures of the same recipe on other draws of the generator (`data_seed` above 0), in the order of their seeds."""
    paths = cache.glob(f"{_path(cache, name, row.features, dark).stem}-data*.json")
    found = [figures for path in paths if (figures := finished(path, recipe(name, row, dark))) is not None]
    return sorted(found, key=lambda figures: figures["data_seed"])


def _path(cache: Path, name: str, features: int, dark: float, data_seed: int = 0) -> Path:
    return cache / (f"{name}-{features}-{dark:g}" + (f"-data{data_seed}" if data_seed else "") + ".json")


def make_cell(asked: Asked, row: PassiveRow, dark: float) -> Row:
    """Train and measure one model of the table `asked.name`, on the draw `asked.data_seed` of a drawn task.

    Its figures go to the cache and are returned.
    """
    name, data_seed = asked.name, asked.data_seed
    options = recipe(name, row, dark)
    path = _path(asked.cache, name, row.features, dark, data_seed)
    check_cached_bundle(path.with_suffix(".pans"))
    task, profile = load(name, asked.data_dir, data_seed), load_profile(PROFILE)
    started = time.process_time()
    trained = _trained(name, task, profile, options)
    seconds = time.process_time() - started
    figures = {
        "task": name,
        "features": row.features,
        "dark": dark,
        "data_seed": data_seed,
        "options": plain_options(options),
        "cpu_seconds": seconds,
        **measure(name, task, trained),
    }
    if name == "barcode" and dark == 0:
        best = solve_patterns(options, profile, "balanced")[0][0]
        figures["balanced"] = {"value": 100 * best.accuracy, "clicks": best.clicks}
    if task.target == "image":
        objects = first_of_each_class(task.test)
        p = click_probability(light_of(task, objects, trained), trained.law)
        keep_samples(path.with_suffix(".npz"), take_samples(trained.head, p, objects))
    if name not in SPECKLE:  # what a bundle looks at must be what the task shows
        provenance = {
            "task_argument": TASKS.get(name, name),
            "command": f"pans reproduce {name} --rows {row.features} --dark {dark:g}"
            + (f" --data-seed {data_seed}" if data_seed else ""),
            "options": plain_options(options),
        }
        title = f"{name}-{row.features}-dark{dark:g}"
        exported = export_trained(
            path.with_suffix(".pans"), trained, task, profile, name=title, provenance=provenance, force=True
        )
        figures |= {"sha256": exported.sha256, "score_difference": exported.score_difference}
    asked.report(f"{name} d_f={row.features} dark={dark:g}: {figures['value']:.3f} at {figures['clicks']:.2f} clicks")
    replace_file(path, json.dumps(figures, indent=1).encode())
    return figures


def _trained(name: str, task: Task, profile: Profile, options: Options) -> Trained:
    if name == "barcode":
        return solve(options, profile)
    if name in SEARCH_SIZE:
        return search(task, profile, options, SEARCH_SIZE[name])
    return train(task, profile, options, basis=basis_of(name, task, options))


def measure(name: str, task: Task, trained: Trained) -> Row:
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
            value, over_trials, of_object = _similarity(trained, p, task.test.pictures)
        else:
            value, over_trials, of_object = _accuracy(trained, p, torch.from_numpy(objects.labels), share)
        return {
            "value": value,
            "spread_trials": over_trials,
            "error_objects": float(of_object.std()) / len(of_object) ** 0.5 if name != "barcode" else 0.0,
            "first_200": float(of_object[:200].mean()) if name != "barcode" else None,
            "objects": len(objects),
            "clicks": float((p.sum(dim=1) * share).sum()),
            "photons": float((light.sum(dim=1) * share).sum()),
            "illumination": float(trained.encoder.illumination()),
        } | _reaching(name, task, objects, trained)


def _reaching(name: str, task: Task, objects: Objects, trained: Trained) -> Row:
    """Photons per object that must reach optics that give what W gives: its amplification times the light of the field.

    Nothing for active encoders, whose light is `illumination`, and for the release's speckle, which is no field of an instrument.
    """
    if isinstance(trained.encoder, ActiveIllumination) or name in SPECKLE:
        return {}
    return {"reaching": analyser_of(trained, task, load_profile(PROFILE)).reaching(objects.images)}


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


def _similarity(trained: Trained, p: Tensor, images: Any) -> tuple[float, float | None, Tensor]:
    """SSIM of the pictures given back, as the paper's release counts it (ssim.py): one trial, hence no spread over trials."""
    random = torch.Generator().manual_seed(1)
    wanted = torch.from_numpy(images.astype(np.float32) / 255)
    found = torch.cat([trained.head(sample_clicks(part, random).float()) for part in p.split(CHUNK)])
    pictures = found.clamp(0, 1).reshape(wanted.shape)
    values = torch.cat([ssim(a, b) for a, b in zip(pictures.split(CHUNK), wanted.split(CHUNK))]).double()
    return float(values.mean()), None, values


# ---- the pages ----


def samples_of(cache: Path, name: str, rows: Rows) -> list[tuple[str, Samples]]:
    """Return titles and samples of those rows of a table of pictures whose samples are drawn: the paper's choice, as far as it is done."""
    kept = []
    for row in rows:
        path = _path(cache, name, row["features"], row["dark"]).with_suffix(".npz")
        if (row["features"], row["dark"]) in SHOWN_CELLS and path.is_file():
            kept.append((f"d_f = {row['features']}, dark {row['dark']:g}\nSSIM {row['value']:.3f}", read_samples(path)))
    return kept


def passive_page(asked: Asked) -> Made:
    """Return one row per number of patterns and dark count; after them those of other draws of the generator."""
    table, name = table_of(asked.name), asked.name
    done, others = [], []
    for row in table.rows:
        for dark in table.dark:
            if not asked.wants(row.features) or not (asked.dark is None or dark in asked.dark):
                continue
            figures = finished_cell(asked.cache, name, row, dark, asked.data_seed)
            if figures is None and not asked.collect:
                figures = make_cell(asked, row, dark)
            if figures is not None:
                done.append(figures)
            if not asked.data_seed:
                others += other_draws(asked.cache, name, row, dark)
    pictures: dict[str, Draw] = {"": partial(plots.measure_over_patterns, name=name, rows=done)}
    if samples := samples_of(asked.cache, name, done):
        pictures["-pictures"] = partial(images.samples, name=name, cells=samples)
    direct = direct_rows(asked)
    return Made([row | _beside_direct(name, row, direct) for row in done] + others + direct, pictures)


def passive_tables(name: str, rows: Rows) -> list[Table]:
    """Return the table of draw 0, that of other draws, and of `barcode` that of classes equally likely."""
    light = "passive_reaching" if any("reaching" in row for row in rows) else "passive"
    shown = columns("passive_ssim" if table_of(name).measure == "SSIM" else light)
    seeded = (*shown[:2], Column("data seed", "{data_seed}"), *shown[2:])
    direct = [row for row in rows if "way" in row]
    rows = [row | _beside(name, row) for row in rows if "way" not in row]
    balanced = [row for row in rows if "balanced" in row]
    others = [row for row in rows if row.get("data_seed")]
    of_draw_0 = [row for row in rows if not row.get("data_seed")]
    found = [Table(shown, of_draw_0, claims=_claims(of_draw_0))]
    if others:
        found.append(Table(seeded, others, "## Other draws of the generator", _claims(others)))
    if balanced:
        claims = _claims([row["balanced"] for row in balanced])
        found.append(Table(columns("balanced"), balanced, "## Classes equally likely, without dark counts", claims))
    return found + _direct_tables(name, of_draw_0, direct)


def _claims(rows: Rows) -> list[Claim]:
    compared = [row for row in rows if "verdict" in row]
    return [claim("Ours", "the paper", compared)] if compared else []


def _beside(name: str, row: Row) -> Row:
    """What the paper prints for a row, and how far ours is ahead of it; nothing where it prints nothing."""
    table = table_of(name)
    (printed,) = [printed for printed in table.rows if printed.features == row["features"]]
    if not printed.values:
        return {}
    value = printed.values[table.dark.index(row["dark"])]
    clicks = printed.clicks if row["dark"] == table.dark[0] else None
    balanced = row.get("balanced")
    theirs = _their_error(table, value, row)
    more = {"balanced": balanced | against(balanced["value"], value, theirs)} if balanced else {}
    return {"paper": value, "paper_clicks": clicks} | against(row["value"], value, row["error_objects"], theirs) | more


def _their_error(table: PassiveTable, value: float, row: Row) -> float:
    """The paper's sampling error, which it does not print: binomial; of SSIM that of ours, as if its objects varied as much."""
    if table.measure == "SSIM":
        return float(row["error_objects"]) * (row["objects"] / table.objects) ** 0.5
    return sampling_error(value, table.objects)


# ---- direct imaging (paper, Fig. 4E and 5B) ----


def direct_rows(asked: Asked) -> Rows:
    """Return one row per way and level of photons for the two tasks of which the paper draws direct imaging; none for others."""
    if asked.name == "barcode":
        shared = {"task": asked.name, "way": POSTERIOR, "error_objects": 0.0}
        return [
            shared
            | {"dark": dark, "asked": n, "balanced": strings.at_photons(n, dark, "balanced")["value"]}
            | strings.at_photons(n, dark)
            for dark in table_of(asked.name).dark
            for n in STRING_LEVELS
        ]
    if asked.name != "mmf-mnist":
        return []
    frames = functools.cache(lambda: measure_frames(load_task(asked.name, asked.data_dir), None))
    rows = []
    for photons in SPECKLE_LEVELS:
        path = asked.cache / f"mmf-mnist-direct-{POSTERIOR}-{photons:g}.json"
        made_with = {"way": POSTERIOR, "photons": photons, "floor": FLOOR}
        found = kept(path, made_with, partial(_speckle, asked, frames, photons), collect=asked.collect)
        if found is None:
            asked.report(
                f"mmf-mnist: direct imaging at {photons:g} photons is not measured yet (pans reproduce mmf-mnist)"
            )
        else:
            rows.append({key: value for key, value in found.items() if key != "made_with"})
    return rows


def _speckle(asked: Asked, frames: Callable[[], Measurement], photons: float) -> Row:
    """A camera at the end of the fibre, ideal shot noise, all held-out digits once."""
    decide, _ = bayes(frames(), photons, "counting", seed=0, floor=FLOOR)
    done = run_trials(frames(), photons, "counting", decide, trials=1, seed=0)
    every, first = done.measured(), done.measured(200)
    row = {"task": asked.name, "way": POSTERIOR, "dark": 0.0, "asked": photons, "value": 100 * every.accuracy_mean}
    row |= {"first_200": 100 * first.accuracy_mean, "error_objects": 100 * every.accuracy_se_objects}
    row |= {"clicks": every.clicks_mean, "photons": every.photons_mean, "illumination": 0.0}
    asked.report(f"mmf-mnist, direct imaging, {photons:g} photons: {row['value']:.2f} %")
    return row


def _beside_direct(name: str, row: Row, direct: Rows) -> Row:
    """Direct imaging with the photons of a row, and of barcodes with its clicks; nothing where none was measured there."""
    if name == "barcode":
        there = strings.at_photons(row["photons"], row["dark"])
        found = {"photons": there | against(row["value"], there["value"], PRINTED)}
        as_many = strings.at_clicks(row["clicks"], row["dark"])
        return {
            "direct": found
            | ({"clicks": as_many | against(row["value"], as_many["value"], PRINTED)} if as_many else {})
        }
    value, error = (accuracy_at(direct, row["photons"], "photons", of) for of in ("value", "error_objects"))
    if value is None or error is None:
        return {}
    clicks = accuracy_at(direct, row["photons"], "photons", "clicks")
    compared = against(row["value"], value, row["error_objects"], error)
    return {"direct": {"photons": {"value": value, "clicks": clicks} | compared}}


def _direct_tables(name: str, rows: Rows, direct: Rows) -> list[Table]:
    if not direct:
        return []
    beside = [row for row in rows if "direct" in row]
    claims = [claim("Ours", "direct imaging at equal photons", [row["direct"]["photons"] for row in beside])]
    if name == "barcode":
        claims.append(claim("Ours", "direct imaging at equal clicks", [row["direct"].get("clicks") for row in beside]))
    shown = columns("beside_direct_strings" if name == "barcode" else "beside_direct")
    curve = columns("direct_strings" if name == "barcode" else "direct_frames_of_speckle")
    return [
        Table(shown, beside, "## Beside direct imaging", claims),
        Table(curve, direct, "## Direct imaging"),
    ]


PAGES = pages({name: (passive_page, partial(passive_tables, name)) for name in (*PASSIVE, *UNPRINTED)})
