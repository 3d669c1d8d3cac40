"""The paper's other tasks: accuracy or SSIM over patterns and dark counts, ours beside the paper's and direct imaging.

One model per row and dark count is trained with that dark count in the click law, on the profile `ideal`. `mmf-mnist` and
`mmf-mnist-image` use the release's input (`release_intensity` says what is unphysical in it); `mmf-mnist-field` is what an instrument could
measure. `barcode` is judged on all 1024 strings by their exact weights. The images of the other tasks are our generators'.
"""

from __future__ import annotations

import functools
import json
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.base.files import npz_bytes, replace_file
from pans.bundle.sensor import scatter
from pans.instrument.profile import load_profile
from pans_trainer.baselines import strings
from pans_trainer.baselines.bayes import bayes
from pans_trainer.baselines.common import measure as measure_frames
from pans_trainer.baselines.common import run_trials
from pans_trainer.evaluate.accuracy import row_of
from pans_trainer.export.writer import analyser_of, export_trained
from pans_trainer.model.detection import click_probability, click_words, sample_clicks, word_probabilities
from pans_trainer.model.encoders import ActiveIllumination
from pans_trainer.model.heads import Heads
from pans_trainer.model.ssim import ssim
from pans_trainer.options import EXACT_FEATURES_MAX, Options, plain_options
from pans_trainer.tasks import barcode as task_barcode
from pans_trainer.tasks.registry import Objects, Task, load_task
from pans_trainer.train.gradient.data import CHUNK, encoder_input
from pans_trainer.train.gradient.exact_search import search, solve, solve_patterns
from pans_trainer.train.gradient.loop import Trained, train

from . import plots
from .active import PROFILE
from .page import (
    FIRST_OBJECTS,
    Asked,
    Draw,
    Made,
    Row,
    Rows,
    against,
    beside_curve,
    check_cached_bundle,
    finished,
    flat,
    sampling_error,
)
from .printed import PASSIVE, PassiveRow, recipe, recipe_facts

RELEASE_BATCH = 128
TRIALS = 5
SAMPLE_SEED = 2  # of pictures that are drawn: not the clicks that the table is made of
SHOWN_CELLS = ((4, 0.01), (32, 0.01), (64, 0.01), (64, 0.05))  # the paper draws the last three
SPECKLE_LEVELS = (10.0, 20.0, 30.0, 50.0, 100.0, 200.0, 300.0, 600.0, 1000.0)  # photons of direct imaging
FIELD = "mmf-mnist-field"
FLOOR = 5e-3  # of the mean light, by which the posterior lifts every pixel
PRINTED = 0.005  # points: of two exact figures, those that differ by no printed digit are level


# ---- the input ----


@functools.lru_cache(maxsize=1)  # the rows of a table share it
def load(name: str, data_dir: str | None, data_seed: int = 0) -> Task:
    """Return the task of a page, with the release's input where its recipe says `speckle`."""
    facts = recipe_facts(name)
    task = load_task(facts.get("task", name), data_dir, data_seed=data_seed)
    if not facts.get("speckle"):
        return task
    train, test = (Objects(_speckle(part.images), part.labels, behind=part.images) for part in (task.train, task.test))
    return replace(task, light="field", optics="none", train=train, test=test, imaged=_speckle)


def release_intensity(images: NDArray[np.uint8], batch: int = RELEASE_BATCH) -> NDArray[np.float32]:
    """Return speckle intensities min-max normalised over batches of `batch` images, float32 (n, 28, 28) in [0, 1].

    The release's input of `mmf-mnist`, for comparison with the field that our tasks take: a *real vector* for a coherent encoder. Two
    things are unphysical in it: an intensity is no field, and the normalisation lets every image depend on the brightest grain of its
    batch. The release's batch is not known; ours is 128. The paper (appendix "MNIST through multimode fiber") calls the matrix random
    unitary, and speaks of grey speckle images as input.
    """
    intensity = np.abs(scatter(images)) ** 2
    for start in range(0, len(intensity), batch):
        part = intensity[start : start + batch]
        low, high = part.min(), part.max()
        part -= low
        part /= max(float(high - low), 1e-12)
    return intensity.astype(np.float32, copy=False)


def _speckle(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.rint(255 * release_intensity(images)).astype(np.uint8)


# ---- measuring ----


def light_of(task: Task, objects: Objects, trained: Trained) -> Tensor:
    """Return photoelectrons, float64 (n, d_f), of `objects` through the trained optics; active ones in whole levels."""
    x = encoder_input(task, objects, load_profile(PROFILE), trained.options)
    with torch.no_grad():
        if trained.quantised is not None:
            return x.double() @ torch.from_numpy(trained.quantised.patterns()).T
        return torch.cat([trained.encoder(part).double() for part in x.split(CHUNK)])


def measure(name: str, task: Task, trained: Trained) -> Row:
    """Return accuracy in % (or SSIM), its spreads, clicks, photons and illumination over the held-out objects.

    `reaching` (of passive encoders of a real field): photons per object that must reach optics which give what W gives.
    """
    objects, weights, strings_alone = task.test, np.full(len(task.test), 1 / len(task.test)), name == "barcode"
    if strings_alone:  # all strings there are
        bars, labels = task_barcode.all_strings()
        objects, weights = Objects((bars * np.uint8(255))[:, None, :], labels), task_barcode.weights()
    light = light_of(task, objects, trained)
    p, share = click_probability(light, trained.law), torch.from_numpy(weights)
    with torch.no_grad():
        if task.target == "image":
            value, over_trials, of_object = _similarity(trained, p, task.test.pictures)
        else:
            value, over_trials, of_object = _accuracy(trained, p, torch.from_numpy(objects.labels), share)
        found = {
            "value": value,
            "spread_trials": over_trials,
            "error_objects": 0.0 if strings_alone else float(of_object.std()) / len(of_object) ** 0.5,
            "first_200": None if strings_alone else float(of_object[:FIRST_OBJECTS].mean()),
            "objects": len(objects),
            "clicks": float((p.sum(dim=1) * share).sum()),
            "photons": float((light.sum(dim=1) * share).sum()),
            "illumination": float(trained.encoder.illumination()),
        }
    if isinstance(trained.encoder, ActiveIllumination) or task.imaged is not None:
        return found
    return found | {"reaching": analyser_of(trained, task, load_profile(PROFILE)).reaching(objects.images)}


def _accuracy(trained: Trained, p: Tensor, labels: Tensor, share: Tensor) -> tuple[float, float, Tensor]:
    """Return accuracy in %, spread over trials, and each object's: exact where the words can be enumerated, else of 5 trials."""
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
    """Return the SSIM of the pictures given back, as the paper's release counts it: one trial, hence no spread over trials."""
    random = torch.Generator().manual_seed(1)
    wanted = torch.from_numpy(images.astype(np.float32) / 255)
    found = torch.cat([trained.head(sample_clicks(part, random).float()) for part in p.split(CHUNK)])
    pictures = found.clamp(0, 1).reshape(wanted.shape)
    values = torch.cat([ssim(a, b) for a, b in zip(pictures.split(CHUNK), wanted.split(CHUNK))]).double()
    return float(values.mean()), None, values


# ---- cells of a table ----


def cell_path(cache: Path, name: str, features: int, dark: float, data_seed: int = 0) -> Path:
    """Return where the figures of one cell are kept."""
    return cache / (f"{name}-{features}-{dark:g}" + (f"-data{data_seed}" if data_seed else "") + ".json")


def make_cell(asked: Asked, row: PassiveRow, dark: float) -> Row:
    """Train, export and measure one model of the table `asked.name`; return its figures, which stay in the cache."""
    name, options, profile = asked.name, recipe(asked.name, row, dark), load_profile(PROFILE)
    path = cell_path(asked.cache, name, row.features, dark, asked.data_seed)
    check_cached_bundle(path.with_suffix(".pans"))
    task = load(name, asked.data_dir, asked.data_seed)
    trained = _trained(name, task, options)
    figures: Row = {"options": plain_options(options)} | measure(name, task, trained)
    if name == "barcode" and dark == 0:
        best = solve_patterns(options, profile, "balanced")[0][0]
        figures |= {"balanced": 100 * best.accuracy, "balanced_clicks": best.clicks}
    if task.target == "image":
        objects = first_of_each_class(task.test)
        p = click_probability(light_of(task, objects, trained), trained.law)
        replace_file(path.with_suffix(".npz"), npz_bytes(**asdict(take_samples(trained.head, p, objects))))
    if task.imaged is None:  # what a bundle looks at must be what the task shows
        command = f"pans reproduce {name} --rows {row.features} --dark {dark:g} --data-seed {asked.data_seed}"
        facts = {"task_argument": recipe_facts(name).get("task", name), "command": command}
        facts |= {"options": figures["options"]}
        title, out = f"{name}-{row.features}-dark{dark:g}", path.with_suffix(".pans")
        exported = export_trained(out, trained, task, profile, name=title, provenance=facts, force=True)
        figures["sha256"] = exported.sha256
    asked.report(f"{name} d_f={row.features} dark={dark:g}: {figures['value']:.3f} at {figures['clicks']:.2f} clicks")
    replace_file(path, json.dumps(figures, indent=1).encode())
    return figures


def first_of_each_class(objects: Objects) -> Objects:
    """Return the first object of every class that there is, in the order of the classes: not the best ones."""
    return objects.take(np.unique(objects.labels, return_index=True)[1])


def take_samples(head: Heads, p: Tensor, objects: Objects) -> plots.Samples:
    """Return pictures that a model gives back of `objects`, whose click probabilities are `p` (n, d_f)."""
    random = torch.Generator().manual_seed(SAMPLE_SEED)
    clicks = torch.stack([sample_clicks(p, random) for _ in range(plots.SAMPLES)], dim=1)
    with torch.no_grad():
        given_back = torch.stack([head(drawn.float()) for drawn in clicks.unbind(1)], dim=1).clamp(0, 1)
    pixels = (255 * given_back).round().to(torch.uint8).unflatten(2, objects.pictures.shape[1:])
    return plots.Samples(objects.pictures, objects.images, pixels.numpy(), clicks.sum(dim=2).long().numpy())


def _trained(name: str, task: Task, options: Options) -> Trained:
    profile = load_profile(PROFILE)
    if name == "barcode":
        return solve(options, profile)
    return search(task, profile, options) if options.search else train(task, profile, options)


def beside_paper(name: str, row: PassiveRow, dark: float, figures: Row) -> Row:
    """Return a cell beside the paper's figure, whose sampling error is binomial; of SSIM it is as if its objects varied as much as ours."""
    table = PASSIVE[name]
    found = {"table": name, "features": row.features, "dark": dark} | figures
    if not row.values:
        return found
    paper = row.values[table.dark.index(dark)]
    theirs = sampling_error(paper, table.objects) if table.measure == "accuracy" else 0.0
    if table.measure == "SSIM":
        theirs = figures["error_objects"] * (figures["objects"] / table.objects) ** 0.5
    found |= {"paper": paper, "paper_clicks": row.clicks if dark == table.dark[0] else None}
    found |= against(figures["value"], paper, figures["error_objects"], theirs)
    if "balanced" in figures:
        found |= against(figures["balanced"], paper, theirs, prefix="balanced_")
    return found


def passive_page(asked: Asked) -> Made:
    """Return one row per number of patterns and dark count, then direct imaging for the task of which the paper draws it."""
    name, table, direct, rows = asked.name, PASSIVE[asked.name], speckle_rows(asked), []
    samples = []
    for row in table.rows:
        for dark in table.dark:
            if not asked.wants(row.features) or not (asked.dark is None or dark in asked.dark):
                continue
            path = cell_path(asked.cache, name, row.features, dark, asked.data_seed)
            figures = finished(path, recipe(name, row, dark))
            if figures is None and not asked.collect:
                figures = make_cell(asked, row, dark)
            if figures is None:
                continue
            rows.append(beside_paper(name, row, dark, figures) | beside_direct(name, figures, dark, direct))
            if (row.features, dark) in SHOWN_CELLS and path.with_suffix(".npz").is_file():
                title = f"d_f = {row.features}, dark {dark:g}\nSSIM {figures['value']:.3f}"
                with np.load(path.with_suffix(".npz"), allow_pickle=False) as archive:
                    samples.append((title, plots.Samples(**archive)))
    pictures: dict[str, Draw] = {}
    if samples:
        pictures["-pictures"] = partial(plots.samples, name=name, cells=samples)
    return Made(rows + direct, pictures)


# ---- direct imaging (paper, Fig. 4E and 5B; of scenes in scenes.py) ----


def speckle_rows(asked: Asked) -> Rows:
    """Return direct imaging of the speckle, one row per level of photons, for the page `mmf-mnist` and that of its field; else nothing."""
    if asked.name not in ("mmf-mnist", FIELD):
        return []
    rows = []
    for photons in SPECKLE_LEVELS:
        made_with = {"way": "posterior", "photons": photons, "floor": FLOOR}
        make = partial(_speckle_figures, asked.data_dir, photons)
        found = asked.kept(f"mmf-mnist-direct-posterior-{photons:g}", made_with, make)
        if found is not None:
            rows.append({key: value for key, value in found.items() if key != "made_with"} | {"table": "direct"})
    return rows


def _speckle_figures(data_dir: str | None, photons: float) -> Row:
    """A camera at the end of the fibre, ideal shot noise, all held-out digits once."""
    frames = measure_frames(load_task("mmf-mnist", data_dir), None)
    decide, _ = bayes(frames, photons, "counting", seed=0, floor=FLOOR)
    done = run_trials(frames, photons, "counting", decide, trials=1, seed=0)
    return flat(row_of(done.measured()), row_of(done.measured(FIRST_OBJECTS)))


def beside_direct(name: str, figures: Row, dark: float, direct: Rows) -> Row:
    """Return direct imaging with the photons of a cell, and of barcodes with its clicks; nothing where none was measured there."""
    if name == "barcode":
        there = strings.at_photons(figures["photons"], dark)
        found = {"direct_there": there["value"], "direct_illumination": there["illumination"]}
        found |= against(figures["value"], there["value"], PRINTED, prefix="direct_")
        as_many = strings.at_clicks(figures["clicks"], dark)
        if as_many:
            found["clicks_there"] = as_many["value"]
            found |= against(figures["value"], as_many["value"], PRINTED, prefix="clicks_")
        return found
    return beside_curve(figures, direct, "photons", "direct_")


def beside_camera(figures: Row, camera: Rows) -> Row:
    """Return a row beside a camera with the photons that it detects, and with the light that must reach its optics."""
    line: Row = {}
    for prefix, photons in (("direct_", figures["photons"]), ("optics_", figures["reaching"])):
        place = min([photons, *(row["photons"] for row in camera[-1:])])  # more photons tell nothing more
        line |= beside_curve(figures, camera, "photons", prefix, place)
    return line


# ---- digits behind a fibre as a field ----


def field_page(asked: Asked) -> Made:
    """Return one row per number of detectors, beside direct imaging with the photons detected and with those that must reach the optics."""
    direct, rows = speckle_rows(asked), []
    for row in PASSIVE["mmf-mnist"].rows:
        if row.features > 32 or not asked.wants(row.features):  # those of the paper's figure
            continue
        options = recipe(FIELD, row)

        def figures(options: Options = options) -> Row:
            task = load_task("mmf-mnist", asked.data_dir)
            return measure(FIELD, task, train(task, load_profile(PROFILE), options))

        found = asked.kept(f"{FIELD}-{row.features}", {"options": plain_options(options)}, figures)
        if found is not None:
            rows.append(field_row(row, found, direct))
    return Made(rows + direct)


def field_row(row: PassiveRow, found: Row, direct: Rows) -> Row:
    """Return the figures of one number of detectors beside direct imaging."""
    line: Row = {"table": "field", "features": row.features, "paper": row.values[0], "paper_clicks": row.clicks} | found
    return line | beside_camera(found, direct)
