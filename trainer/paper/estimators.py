"""Gradient estimators compared at eight patterns, where the exact gradient is known: bias, variance, accuracy against time.

Owns the measurement; the estimators are in estimators.py. Bias and variance are those of the gradient in the pattern weights of one
batch, head and normalisation fixed, at three stages of one training. Accuracies are exact expectations over all test
images. SIMULATED on the profile `ideal`, FashionMNIST.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pans.runtime.container import replace_file
from pans.runtime.instrument.click_law import object_transmission
from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.detection import click_probability, click_words
from pans.trainer.model.estimators import ESTIMATORS, cross_entropy
from pans.trainer.options import Options
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.head_fit import joint_distribution
from pans.trainer.train.loop import Trained, train

from .page import Asked

FEATURES = 8
OBJECTS = 512
REPEATS = 300
STAGES = (1, 4, 16)  # epochs of training before the gradients are compared
EPOCHS = 12
SEEDS = (0, 1)
BASE = Options(features=FEATURES, alpha=5e-4, hidden=128, head_rate=3e-3, epochs=EPOCHS)
WAYS = {name: {"estimator": name, "warm": 0.0} for name in ESTIMATORS} | {
    "ste, then exact": {"estimator": "exact", "warm": 0.3},
    "ste, then local": {"estimator": "local", "warm": 0.3},
}


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
    for name in ESTIMATORS:
        drawn = torch.stack([estimate(name) for _ in range(1 if name == "exact" else REPEATS)])
        mean = drawn.mean(dim=0)
        variance = float(drawn.var(dim=0, correction=1).sum()) if len(drawn) > 1 else 0.0
        noise = variance / len(drawn)
        bias = max(0.0, float((mean - exact).square().sum()) - noise) ** 0.5
        cosine = float(mean @ exact) / max(float(mean.norm()) * length, 1e-300)
        rows.append(GradientRow(epochs, name, bias / length, noise**0.5 / length, variance**0.5 / length, cosine))
    return rows


def estimator_table(asked: Asked) -> dict[str, Any]:
    """Return rows and Markdown; finished parts lie in the cache."""
    cache, data_dir, report = asked.cache, asked.data_dir, asked.report
    task, profile = load_task("fashion-mnist", data_dir), load_profile("ideal")
    shown = torch.from_numpy(object_transmission(profile, task.test.images.reshape(len(task.test), -1), "float32"))
    labels = torch.from_numpy(task.test.labels)

    def gradients(epochs: int) -> dict[str, Any]:
        trained = train(task, profile, Options(**(asdict(BASE) | {"estimator": "ste", "epochs": epochs})))
        return {"rows": [asdict(row) for row in gradient_rows(trained, shown[:OBJECTS], labels[:OBJECTS], epochs)]}

    def training(way: str, seed: int) -> dict[str, Any]:
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
    rows = [row for stage in stages for row in stage["rows"]]
    return {"rows": [*rows, *runs], "markdown": _markdown(rows, runs)}


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


def _kept(path: Path, make: Callable[[], dict[str, Any]], report: Callable[[str], None]) -> dict[str, Any]:
    if path.is_file():
        found: dict[str, Any] = json.loads(path.read_text())
        return found
    report(f"measuring {path.stem}")
    made = make()
    replace_file(path, json.dumps(made).encode())
    return made


def _markdown(rows: list[dict[str, Any]], runs: list[dict[str, Any]]) -> str:
    lines = [
        "# Gradient estimators against the exact gradient",
        "",
        f"SIMULATED, FashionMNIST, {FEATURES} patterns, profile `ideal`. Command: `pans reproduce estimators`. "
        f"Gradient in the pattern weights of one batch of {OBJECTS} objects, head fixed, {REPEATS} estimates each; relative to the length "
        "of the exact gradient. The stages are epochs of straight-through training.",
        "",
        "| epochs | estimator | bias (+- its sampling error) | spread of one estimate | cosine of the mean |",
        "| --- | --- | --- | --- | --- |",
        *(
            f"| {r['epochs']} | {r['estimator']} | {r['bias']:.3f} +- {r['bias_error']:.3f} | {r['spread']:.2f} | {r['cosine']:.3f} |"
            for r in rows
        ),
        "",
        f"Training with nothing else changed: {EPOCHS} epochs, alpha {BASE.alpha:g}, {BASE.hidden} hidden units, one thread; "
        "mean over seeds "
        f"{', '.join(map(str, SEEDS))} (spread over the seeds in brackets), all test images, exact expectation.",
        "",
        "| way | accuracy % | clicks | photons | illumination | processor seconds |",
        "| --- | --- | --- | --- | --- | --- |",
        *(_run_line(way, [run for run in runs if run["way"] == way]) for way in WAYS),
        "",
        "The paper calls the damped straight-through estimator unbiased. It is not, unless the loss is affine in every click: the",
        "true gradient is exp(-lambda) E[L(1) - L(0)], the estimator's mean exp(-lambda) (p E[L'(1)] + (1 - p) E[L'(0)]).",
        "",
    ]
    return "\n".join(lines)


def _run_line(way: str, runs: list[dict[str, Any]]) -> str:
    def mean(key: str) -> float:
        return sum(run[key] for run in runs) / len(runs)

    spread = max(run["accuracy"] for run in runs) - min(run["accuracy"] for run in runs)
    return (
        f"| {way} | {100 * mean('accuracy'):.2f} ({100 * spread:.2f}) | {mean('clicks'):.2f} | {mean('photons'):.1f} "
        f"| {mean('illumination'):.0f} | {mean('cpu_seconds'):.0f} |"
    )
