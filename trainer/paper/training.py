"""How our training compares: gradient estimators against the exact gradient, and the time to the paper's accuracy.

Owns the pages `estimators` and `time`. SIMULATED on the profile `ideal`; FashionMNIST; seconds are of one processor thread.

**estimators**: at eight patterns, where the exact gradient is known. Bias and variance are those of the gradient in the pattern weights
of one batch, head and normalisation fixed, at three stages of one training. Accuracies are exact expectations over all test images.

**time**: the goal is the paper's simulated accuracy on the first 200 test images at no more than its clicks + 5 %. Measuring and loading
the data are left out of the seconds.

- *ours*: schedules of growing length; the first that reaches the goal at its end counts, with its own seconds. A schedule has one
  end: there is no stopping at a lucky moment.
- *the paper's*: straight-through, Adam, 1e-3 in front and 1e-4 in the head, batches of 128, 512 hidden units (paper, appendix on the
  training procedure). It may stop at the first epoch that reaches the goal, which favours it. Its clicks are held by the same
  weights as ours, which spares it the search for an alpha. It is given `CAP` times the seconds of all our schedules together, those
  that ended below the goal too.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pans.runtime.instrument.click_law import object_transmission
from pans.runtime.instrument.profile import load_profile
from pans.runtime.outputs import replace_file
from pans.trainer.model.detection import click_probability, click_words, sample_clicks
from pans.trainer.model.estimators import ESTIMATORS, cross_entropy
from pans.trainer.options import Options
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.data import TrainingData, encoder_input
from pans.trainer.train.head_fit import joint_distribution
from pans.trainer.train.loop import Run, Trained, train
from pans.trainer.verdicts import against, claim, sampling_error, training_spread

from .active import recipe
from .page import Asked, Made, Row, Rows, Table, cached_row, columns, pages
from .tables import ACTIVE, CLICKS_TOLERANCE, FIRST_OBJECTS, ActiveRow

TASK = "fashion-mnist"
FEATURES = 8
OBJECTS = 512
REPEATS = 300
STAGES = (1, 4, 16)  # epochs of training before the gradients are compared
EPOCHS = 12
SEEDS = (0, 1)
TESTED = 10_000  # test images, all of them
BASE = Options(features=FEATURES, alpha=5e-4, hidden=128, head_rate=3e-3, epochs=EPOCHS)
COMPARED = tuple(name for name in ESTIMATORS if name != "identity")  # that one is on the page `ablations`
WAYS = {name: {"estimator": name, "warm": 0.0} for name in COMPARED} | {
    "ste, then exact": {"estimator": "exact", "warm": 0.3},
    "ste, then local": {"estimator": "local", "warm": 0.3},
}

TIME_ROWS = (10, 32)
TIME_EPOCHS = (8, 12, 18, 27, 40)
CAP = 10.1
TIME_TRIALS = 100


# ---- estimators ----


@dataclass(frozen=True, slots=True)
class GradientRow:
    """Of one estimator at one stage, relative to the length of the exact gradient."""

    epochs: int
    estimator: str
    bias: float  # |E[g] - exact|, freed of the sampling error of the mean
    bias_error: float  # what that sampling error was
    spread: float  # root of the summed variance of one estimate
    cosine: float  # between E[g] and the exact gradient


def gradient_rows(trained: Trained, images: Tensor, labels: Tensor, epochs: int) -> list[GradientRow]:
    """Compare all estimators on one batch of transmissions (n, pixels) at the patterns and head of `trained`."""
    weight = torch.from_numpy(trained.float_patterns).sqrt().requires_grad_()
    fixed = _Fixed(trained.head)
    random = torch.Generator().manual_seed(epochs)

    def estimate(name: str) -> Tensor:
        weight.grad = None
        p = click_probability(images @ (weight**2).T, trained.law)
        ESTIMATORS[name](p, labels, fixed, cross_entropy, random).backward()
        assert weight.grad is not None
        return weight.grad.flatten().double()

    exact = estimate("exact")
    length = float(exact.norm())
    rows = []
    for name in COMPARED:
        drawn = torch.stack([estimate(name) for _ in range(1 if name == "exact" else REPEATS)])
        mean = drawn.mean(dim=0)
        variance = float(drawn.var(dim=0, correction=1).sum()) if len(drawn) > 1 else 0.0
        noise = variance / len(drawn)
        bias = max(0.0, float((mean - exact).square().sum()) - noise) ** 0.5
        cosine = float(mean @ exact) / max(float(mean.norm()) * length, 1e-300)
        rows.append(GradientRow(epochs, name, bias / length, noise**0.5 / length, variance**0.5 / length, cosine))
    return rows


def estimators_page(asked: Asked) -> Made:
    """Return one row per stage and estimator, then one per way to train and seed; finished parts lie in the cache."""
    cache, data_dir, report = asked.cache, asked.data_dir, asked.report
    task, profile = load_task(TASK, data_dir), load_profile("ideal")
    shown = torch.from_numpy(object_transmission(profile, task.test.images.reshape(len(task.test), -1), "float32"))
    labels = torch.from_numpy(task.test.labels)

    def gradients(epochs: int) -> Row:
        trained = train(task, profile, Options(**(asdict(BASE) | {"estimator": "ste", "epochs": epochs})))
        return {"rows": [asdict(row) for row in gradient_rows(trained, shown[:OBJECTS], labels[:OBJECTS], epochs)]}

    def training(way: str, seed: int) -> Row:
        start = time.process_time()
        trained = train(task, profile, Options(**(asdict(BASE) | WAYS[way] | {"seed": seed})))
        seconds = time.process_time() - start
        assert trained.quantised is not None, "active encoders have levels"
        patterns = trained.quantised.patterns()
        light = shown.double() @ torch.from_numpy(patterns).T
        p = click_probability(light, trained.law)
        with torch.no_grad():
            decided = trained.head(click_words(FEATURES)).argmax(dim=1)
        joint = joint_distribution(p, labels, len(task.classes))
        return {
            "way": way,
            "seed": seed,
            "accuracy": float(joint[torch.arange(len(decided)), decided].sum()),
            "clicks": float(p.sum(dim=1).mean()),
            "photons": float(light.sum(dim=1).mean()),
            "illumination": float(patterns.sum()),
            "cpu_seconds": seconds,
        }

    stages = [_kept(cache / f"estimators-gradient-{e}.json", partial(gradients, e), report) for e in STAGES]
    runs = []
    for way in WAYS:
        for seed in SEEDS:
            path = cache / f"estimators-{way.replace(', ', '-').replace(' ', '-')}-{seed}.json"
            runs.append(_kept(path, partial(training, way, seed), report))
    return Made([*(row for stage in stages for row in stage["rows"]), *runs])


class _Fixed:
    """A head whose normalisation stays."""

    def __init__(self, head: Any) -> None:
        self.head = head.eval()

    def __call__(self, clicks: Tensor, mean: Tensor | None = None) -> Tensor:
        scores: Tensor = self.head(clicks)
        return scores

    def flipped(self, clicks: Tensor, mean: Tensor) -> Tensor:
        scores: Tensor = self.head.flipped(clicks, self.head.norm.running_mean)
        return scores


def _kept(path: Path, make: Callable[[], Row], report: Callable[[str], None]) -> Row:
    found = cached_row(path)
    if found is not None:
        return found
    report(f"measuring {path.stem}")
    made = make()
    replace_file(path, json.dumps(made).encode())
    return made


def estimators_tables(rows: Rows) -> list[Table]:
    """Return the gradients of every stage and estimator, and what trainings reach: mean over seeds, their spread in brackets."""
    of_way: dict[str, Rows] = {}
    for row in rows:
        if "way" in row:
            of_way.setdefault(row["way"], []).append(row)
    trained: Rows = []
    for way, runs in of_way.items():
        keys = ("accuracy", "clicks", "photons", "illumination", "cpu_seconds")
        means = {key: sum(run[key] for run in runs) / len(runs) for key in keys}
        accuracies = [run["accuracy"] for run in runs]
        errors = (100 * training_spread(accuracies) / len(runs) ** 0.5, sampling_error(100 * means["accuracy"], TESTED))
        facts = {"way": way, "trainings": len(runs), "error": math.hypot(*errors)}
        trained.append(facts | {"over_seeds": max(accuracies) - min(accuracies), **means})
    exact = next((row for row in trained if row["way"] == "exact"), None)
    for row in trained:
        row["beside"] = None if exact is None or row is exact else _held_against(row, exact)
    gradients = [row for row in rows if "estimator" in row]
    return [
        Table(columns("gradients"), gradients, "## Gradients"),
        Table(
            columns("trainings"), trained, "## Trainings", [claim("Others", "exact", [r["beside"] for r in trained])]
        ),
    ]


def _held_against(row: Row, exact: Row) -> Row:
    """A way to train beside the exact gradient: means over the seeds, with the errors of both from few seeds and few objects."""
    return against(100 * row["accuracy"], 100 * exact["accuracy"], row["error"], exact["error"])


# ---- time ----


def time_page(asked: Asked) -> Made:
    """Return one row per number of patterns; finished rows lie in the cache."""
    found = []
    for row in ACTIVE[TASK]:
        if row.features in (asked.rows or TIME_ROWS):
            path = asked.cache / f"time-{row.features}.json"
            found.append(_kept(path, partial(_race, row, asked.data_dir, asked.report), asked.report))
    return Made(found)


def _race(row: ActiveRow, data_dir: str | None, report: Callable[[str], None]) -> Row:
    judge = _Judge(row, data_dir)
    ours: Rows = []
    for epochs in TIME_EPOCHS:
        options = replace(recipe(TASK, row), epochs=epochs, starts=1, restarts=1, shots=1, mix=0.0)
        ours.append(judge.train(options, each_epoch=False, cap=float("inf")))
        report(f"time d_f={row.features}: ours, {epochs} epochs: {ours[-1]}")
        if ours[-1]["reached"]:
            break
    paper = Options(
        features=row.features,
        clicks=recipe(TASK, row).clicks,
        alpha=0.0,
        estimator="ste",
        epochs=500,
        batch=128,
        front_rate=1e-3,
        head_rate=1e-4,
        constant=True,
    )
    theirs = judge.train(paper, each_epoch=True, cap=CAP * sum(each["seconds"] for each in ours))
    report(f"time d_f={row.features}: the paper's recipe: {theirs}")
    return {"features": row.features, "goal": row.simulation[0], "ours": ours[-1], "schedules": ours, "paper": theirs}


class _Judge:
    """The data, and the accuracy on the first 200 test images."""

    def __init__(self, row: ActiveRow, data_dir: str | None) -> None:
        self.row = row
        self.profile = load_profile("ideal")
        self.task = load_task(TASK, data_dir)
        self.data = TrainingData(self.task, self.profile, Options(features=row.features))
        self.shown = encoder_input(self.task, self.task.test, self.profile, Options(features=row.features))
        self.labels = torch.from_numpy(self.task.test.labels)

    def train(self, options: Options, *, each_epoch: bool, cap: float) -> Row:
        """Train to the end, or with `each_epoch` to the goal or the cap; return the last figures and the seconds."""
        run = Run(self.data, self.profile, options, 0)
        seconds, best = 0.0, 0.0
        while True:
            start = time.process_time()
            run.one_epoch()
            seconds += time.process_time() - start
            last = run.epoch == options.epochs or seconds >= cap
            if not (each_epoch or last):
                continue
            accuracy, clicks, photons = self.measure(run, FIRST_OBJECTS, TIME_TRIALS)
            reached = accuracy >= self.row.simulation[0] and clicks <= CLICKS_TOLERANCE * self.row.clicks
            best = max(best, accuracy)
            if reached or last:
                whole, _, _ = self.measure(run, len(self.labels), 3)
                return {
                    "reached": reached,
                    "seconds": seconds,
                    "epochs": run.epoch,
                    "accuracy": accuracy,
                    "best_accuracy": best,
                    "accuracy_all": whole,
                    "clicks": clicks,
                    "photons": photons,
                    "illumination": float(run.encoder.illumination()),
                }

    def measure(self, run: Run, count: int, trials: int) -> tuple[float, float, float]:
        """Return accuracy in %, clicks and photons of the first `count` test images."""
        random = torch.Generator().manual_seed(1)
        with torch.no_grad():
            light = run.encoder(self.shown[:count])
            p = click_probability(light.double(), run.law())
            run.head.eval()
            right: list[Tensor] = []
            for _ in range(trials):
                decided = run.head(sample_clicks(p, random).float()).argmax(dim=1)
                right.append((decided == self.labels[:count]).double().mean())
        return 100 * float(torch.stack(right).mean()), float(p.sum(dim=1).mean()), float(light.sum(dim=1).mean())


def time_tables(rows: Rows) -> list[Table]:
    """Return both ways at every number of patterns, and how much longer the paper's recipe takes."""
    ways, ratios = [], []
    for row in rows:
        for key, words in (("ours", "ours"), ("paper", "the paper's recipe")):
            reached = "yes" if row[key]["reached"] else "no"
            errors = [sampling_error(value, FIRST_OBJECTS) for value in (row[key]["accuracy"], row["goal"])]
            compared = against(row[key]["accuracy"], row["goal"], *errors)
            facts = {"features": row["features"], "goal": row["goal"], "way": words, "beside": compared}
            ways.append(row[key] | facts | {"reached": reached})
        theirs, tried = row["paper"]["seconds"], sum(schedule["seconds"] for schedule in row["schedules"])
        than = "" if row["paper"]["reached"] else "more than "
        over = {"over_ours": theirs / row["ours"]["seconds"], "over_all": theirs / tried}
        ratios.append({"features": row["features"], "than": than, "tried": tried} | over)
    claims = [
        claim(f"Last epoch, {words}:", "the goal", [row["beside"] for row in ways if row["way"] == words])
        for words in ("ours", "the paper's recipe")
    ]
    return [Table(columns("raced"), ways, claims=claims), Table(columns("ratios"), ratios)]


PAGES = pages({"estimators": (estimators_page, estimators_tables), "time": (time_page, time_tables)})
