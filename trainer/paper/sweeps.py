"""The paper's sweeps over shots, light and dark counts, for the shipped FashionMNIST bundle (paper, appendix on testing).

Owns which settings are measured and the page; the figures come from evaluate.py. Nothing is trained: the bundle stays as it is while K
(shots), eta (all light times eta) or the dark counts of an exposure change. SIMULATED on the profile it was trained for.
"""

from __future__ import annotations

import importlib.resources
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.instrument.profile import Profile, load_profile
from pans.trainer.evaluate.accuracy import Light, Measured, evaluate_exactly, evaluate_sampled, light_of
from pans.trainer.paper_tables import FIRST_OBJECTS
from pans.trainer.tasks.registry import Objects, load_task

from . import figures_light
from .page import Asked

SHOTS = (1, 2, 3, 5, 8, 13, 21)
ETAS = tuple(10.0 ** (exponent / 4) for exponent in range(-8, 9))
DARKS = tuple(10.0 ** (exponent / 4) for exponent in range(-12, 1))
TRIALS = {FIRST_OBJECTS: 100}
TRIALS_OF_ALL = 10
EXACT_WORK_MAX = 1 << 25  # objects times click words
SWEEPS = {"K": "shots", "eta": "all light times", "dark": "dark counts of an exposure"}


def shipped_bundle() -> Bundle:
    """Return the bundle that comes with the package: ten patterns, FashionMNIST."""
    return load_bundle(Path(str(importlib.resources.files("pans.runtime") / "shipped" / "fashion10.pans")))[0]


def sweep_table(asked: Asked) -> dict[str, Any]:
    """Return one row per setting (`sweep`, `setting`, `first_200`, `all`) and the Markdown."""
    bundle = shipped_bundle()
    profile, test = load_profile(str(bundle.provenance["profile"])), load_task(bundle.task, asked.data_dir).test
    settings = [("K", float(k)) for k in SHOTS] + [("eta", eta) for eta in ETAS] + [("dark", dark) for dark in DARKS]
    rows = []
    for sweep, setting in settings:
        row = measure_setting(bundle, profile, test, sweep, setting)
        asked.report(f"{SWEEPS[sweep]} {setting:.3g}: {100 * row['all']['accuracy_mean']:.2f} %")
        rows.append(row)
    pictures = {"": partial(figures_light.sweeps, rows=rows)}
    return {"rows": rows, "markdown": markdown(rows, bundle.name, profile.name), "pictures": pictures}


def measure_setting(bundle: Bundle, profile: Profile, test: Objects, sweep: str, setting: float) -> dict[str, Any]:
    """Return what `bundle` does where one thing of `SWEEPS` is set otherwise: `sweep`, `setting`, `first_200`, `all`."""
    row: dict[str, Any] = {"sweep": sweep, "setting": setting}
    eta, dark = setting if sweep == "eta" else 1.0, setting if sweep == "dark" else None
    for part, objects in parts_of(test).items():
        light = light_of(bundle, profile, objects.images, eta=eta, dark=dark)
        row[part] = asdict(_measured(bundle, light, objects, int(setting) if sweep == "K" else 1))
    return row


def parts_of(test: Objects) -> dict[str, Objects]:
    """Return the first test objects, which the paper takes, and all of them."""
    first = Objects(test.images[:FIRST_OBJECTS], test.labels[:FIRST_OBJECTS])
    return {f"first_{FIRST_OBJECTS}": first, "all": test}


def enumerable(bundle: Bundle, objects: int) -> bool:
    """Return whether a page enumerates all click words of one shot for that many objects, or samples them."""
    return objects << bundle.n_features <= EXACT_WORK_MAX


def _measured(bundle: Bundle, light: Light, objects: Objects, shots: int) -> Measured:
    if shots == 1 and enumerable(bundle, len(objects)):
        return evaluate_exactly(bundle, light, objects.labels)
    trials = TRIALS.get(len(objects), TRIALS_OF_ALL)
    return evaluate_sampled(bundle, light, objects.labels, shots=shots, trials=trials, seed=1)


def markdown(rows: list[dict[str, Any]], bundle: str, profile: str) -> str:
    """Return the page, one table per sweep."""
    lines = [
        "# Sweeps over shots, light and dark counts",
        "",
        f"SIMULATED: bundle `{bundle}` (shipped, d_f = 10) on the profile `{profile}`. Command: `pans reproduce sweeps`; nothing "
        "is trained, seed 1 of "
        "the trials. K = 1 is the exact expectation over all click words, more shots are 100 trials (first 200) or 10 trials "
        "(all 10 000). `trials` is the "
        "spread of one trial, `objects` the standard error from having few images; accuracies in %.",
        "",
    ]
    for sweep, words in SWEEPS.items():
        mine = [row for row in rows if row["sweep"] == sweep]
        lines += [
            f"## {words} ({sweep})",
            "",
            f"| {sweep} | first {FIRST_OBJECTS} | trials | objects | all | trials | objects | clicks | photons | illumination |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *(_line(row) for row in mine),
            "",
        ]
    return "\n".join([*lines, *_says(rows), ""])


def _line(row: dict[str, Any]) -> str:
    cells = [f"{row['setting']:.3g}"]
    for part in (row[f"first_{FIRST_OBJECTS}"], row["all"]):
        cells += [f"{100 * part[key]:.2f}" for key in ("accuracy_mean", "accuracy_std", "accuracy_se_objects")]
    of_all = row["all"]
    cells += [f"{of_all['clicks_mean']:.2f}", f"{of_all['photons_mean']:.2f}", f"{of_all['illumination']:.1f}"]
    return f"| {' | '.join(cells)} |"


def _says(rows: list[dict[str, Any]]) -> list[str]:
    """What the tables say, in numbers."""

    def best(sweep: str) -> dict[str, Any]:
        return max((row for row in rows if row["sweep"] == sweep), key=lambda row: float(row["all"]["accuracy_mean"]))

    def at(sweep: str, setting: float) -> float:
        mine = [row for row in rows if row["sweep"] == sweep]
        nearest = min(mine, key=lambda row: abs(np.log(row["setting"] / setting)))
        return 100 * float(nearest["all"]["accuracy_mean"])

    eta = best("eta")
    return [
        f"- Light: best at eta = {eta['setting']:.2f} ({100 * eta['all']['accuracy_mean']:.1f} %); at a tenth of the light "
        f"{at('eta', 0.1):.1f} %, at "
        f"ten times {at('eta', 10):.1f} %: too much light saturates thresholded detectors. The paper finds its peak near 1 as well.",
        f"- Dark counts: {at('dark', 1e-3):.1f} % at 0.001, {at('dark', 0.1):.1f} % at 0.1, {at('dark', 1):.1f} % at 1 per "
        "exposure, with a head that was not told.",
        f"- Shots: {at('K', 1):.1f} % at K = 1, {at('K', 5):.1f} % at 5, {at('K', 21):.1f} % at 21. Clicks, photons and "
        "illumination grow with K.",
    ]
