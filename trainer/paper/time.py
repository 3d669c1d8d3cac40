"""Time to the paper's accuracy: our schedule against the paper's own recipe, on one machine in one run.

Owns the race; the training is that of train.py in both cases. The goal is the paper's simulated accuracy on the first 200 FashionMNIST
test images at no more than its clicks + 5 %. Processor seconds of one thread, measuring left out; loading the data left out.

- **ours**: schedules of growing length; the first that reaches the goal at its end counts, with its own seconds. A schedule has one
  end: there is no stopping at a lucky moment.
- **the paper's**: straight-through, Adam, 1e-3 in front and 1e-4 in the head, batches of 128, 512 hidden units (paper, appendix on the
  training procedure). It may stop at the first epoch that reaches the goal, which favours it. Its clicks are held by the same
  weights as ours, which spares it the search for an alpha. It is given `CAP` times the seconds of all our schedules together, those
  that ended below the goal too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pans.runtime.container import replace_file
from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.detection import click_probability, sample_clicks
from pans.trainer.options import Options
from pans.trainer.paper_tables import ACTIVE, CLICKS_TOLERANCE, FIRST_OBJECTS, ActiveRow
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.data import TrainingData, encoder_input
from pans.trainer.train.loop import Run

from .active import recipe
from .page import Asked

TASK = "fashion-mnist"
ROWS = (10, 32)
EPOCHS = (8, 12, 18, 27, 40)
CAP = 10.1
TRIALS = 100


def time_table(asked: Asked) -> dict[str, Any]:
    """Return rows and Markdown; finished rows lie in the cache."""
    found = []
    for row in ACTIVE[TASK]:
        if row.features in (asked.rows or ROWS):
            path = asked.cache / f"time-{row.features}.json"
            if not path.is_file():
                made = _race(row, asked.data_dir, asked.report)
                replace_file(path, json.dumps(made, indent=1).encode())
            found.append(json.loads(path.read_text()))
    return {"rows": found, "markdown": _markdown(found)}


def _race(row: ActiveRow, data_dir: str | None, report: Callable[[str], None]) -> dict[str, Any]:
    judge = _Judge(row, data_dir)
    ours: list[dict[str, Any]] = []
    for epochs in EPOCHS:
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

    def train(self, options: Options, *, each_epoch: bool, cap: float) -> dict[str, Any]:
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
            accuracy, clicks, photons = self.measure(run, FIRST_OBJECTS, TRIALS)
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


def _markdown(rows: list[dict[str, Any]]) -> str:
    lines = [
        "# Time to the paper's accuracy",
        "",
        "SIMULATED, FashionMNIST, profile `ideal`, first 200 test images, K = 1, clicks within +5 % of the paper's. Command: "
        "`pans reproduce time`. Processor seconds of one thread, both in one run on one machine.",
        "",
        "| d_f | goal % | way | reached | seconds | epochs | first 200 % | all 10 000 % | clicks | photons | illumination |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        for name, way in (("ours", row["ours"]), ("the paper's recipe", row["paper"])):
            lines.append(
                f"| {row['features']} | {row['goal']:.2f} | {name} | {'yes' if way['reached'] else 'no'} | {way['seconds']:.0f} "
                f"| {way['epochs']} | {way['accuracy']:.2f} (best {way['best_accuracy']:.2f}) | {way['accuracy_all']:.2f} "
                f"| {way['clicks']:.2f} | {way['photons']:.1f} | {way['illumination']:.0f} |"
            )
    for row in rows:
        ratio = row["paper"]["seconds"] / row["ours"]["seconds"]
        more = "" if row["paper"]["reached"] else "more than "
        tried = sum(schedule["seconds"] for schedule in row["schedules"])
        lines.append(
            f"\nd_f = {row['features']}: the paper's recipe takes {more}{ratio:.1f} times as long; "
            f"{more}{row['paper']['seconds'] / tried:.1f} times, "
            f"if the shorter schedules that ended below the goal count too ({tried:.0f} s in all)."
        )
    lines += [
        "",
        "Our schedules are tried from short to long; the first that ends at the goal counts. The paper's recipe may stop at any epoch.",
        "Seed 0 of both, one run each; 200 images are few, so that a goal reached by 0.1 points is reached by luck as well.",
        "It runs without the paper's slope annealing and clamping, whose schedules the paper does not give.",
    ]
    return "\n".join([*lines, ""])
