"""Curves of the baselines over photons: which are measured for the paper's figures, each a command of `pans baseline`.

Owns the list of curves, their place in the cache folder, and what is read off them; measuring is the package baselines's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pans.trainer.baselines.common import silent
from pans.trainer.baselines.options import METHODS, BaselineOptions
from pans.trainer.baselines.rows import baseline_rows
from pans.trainer.tasks.registry import load_task

from .cache import kept
from .page import Asked

TASK = "fashion-mnist"
LEVELS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0, 1e3, 5e3, 1e4, 1e6)
POSTERIOR_LEVELS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0, 1e3)  # at more it is a nearest neighbour
SENSING_LEVELS = (5.0, 100.0)
NETWORK_LEVELS = (100.0, 1e3, 1e4)  # a training each
E2E_FEATURES = (3, 4, 6, 8, 10, 16, 24, 32, 64)  # the paper's
ENVELOPE = "end-to-end, envelope"

Rows = list[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Curve:
    """One way over photon levels, on `TASK`."""

    way: str
    options: BaselineOptions
    levels: tuple[float, ...]

    @property
    def words(self) -> tuple[str, ...]:
        """The words of `pans baseline` that measure the curve alone, but for the task; the cache knows the curve by them."""
        o = self.options
        of_patterns = () if o.paradigm == "direct" else ("--features", str(o.features))
        family = ("--patterns", o.patterns) if o.paradigm == "compressive" else ()
        method = () if o.method == METHODS["e2e"][0] else ("--method", o.method)
        epochs = () if o.epochs is None else ("--epochs", str(o.epochs))
        photons = ("--photons", *(f"{level:g}" for level in self.levels))
        return (o.paradigm, *of_patterns, *family, *method, *epochs, "--trials", str(o.trials), *photons)

    def command(self) -> str:
        """Return the command that measures the curve alone."""
        return f"pans baseline {self.words[0]} --task {TASK} {' '.join(self.words[1:])}"


CLEAN = Curve("direct, network of clean frames", BaselineOptions("direct", "clean-cnn", epochs=2, trials=2), LEVELS)
POSTERIOR = Curve("direct, exact posterior", BaselineOptions("direct", "bayes", trials=2), POSTERIOR_LEVELS)


def _sensing(family: str, method: str, trials: int) -> BaselineOptions:
    return BaselineOptions("compressive", method, features=64, patterns=family, trials=trials)


CURVES = (  # what takes longest is last
    CLEAN,
    POSTERIOR,
    Curve("random binary, clean features", _sensing("binary", "clean-mlp", 5), LEVELS),
    Curve("Hadamard, clean features", _sensing("hadamard", "clean-mlp", 5), LEVELS),
    Curve("random binary, exact posterior", _sensing("binary", "bayes", 2), SENSING_LEVELS),
    Curve("Hadamard, exact posterior", _sensing("hadamard", "bayes", 2), SENSING_LEVELS),
    Curve("direct, network of each level", BaselineOptions("direct", "cnn", epochs=2, trials=2), NETWORK_LEVELS),
)


def e2e_curve(features: int) -> Curve:
    """Return the curve of conventional end-to-end optimisation with that many patterns."""
    return Curve(f"end-to-end, d_f = {features}", BaselineOptions("e2e", "qat", features=features, trials=5), LEVELS)


def curve_rows(asked: Asked, curve: Curve) -> Rows:
    """Return the rows of a curve, each with its `way`; none where it was not measured and nothing is to be made."""
    name = "-".join(word.lstrip("-").replace(".", "") for word in curve.words[: curve.words.index("--photons")])

    def make() -> dict[str, Any]:
        rows = []
        for row in baseline_rows(load_task(TASK, asked.data_dir), curve.options, curve.levels, silent):
            asked.report(f"{curve.way}, {row['photons_asked']:g} photons: {100 * row['accuracy_mean']:.2f} %")
            rows.append(row)
        return {"rows": rows}

    found = kept(asked.cache / f"baseline-{name}.json", {"words": curve.words}, make, collect=asked.collect)
    if found is None:
        asked.report(f"{curve.way}: not measured yet ({curve.command()})")
        return []
    return [{"way": curve.way, **row} for row in found["rows"]]


def envelope(rows: Rows) -> Rows:
    """Return the best of all rows at each photon level, as rows of the way `ENVELOPE`; chosen by all test objects."""
    levels = sorted({row["photons_asked"] for row in rows})
    best = [max((r for r in rows if r["photons_asked"] == n), key=lambda r: float(r["accuracy_mean"])) for n in levels]
    return [row | {"way": ENVELOPE} for row in best]


def accuracy_at(rows: Rows, place: float, of: Callable[[dict[str, Any]], float]) -> float | None:
    """Return a curve's accuracy where `of(row)` is `place`, by interpolation in its logarithm; None outside of the curve."""
    known = sorted((of(row), float(row["accuracy_mean"])) for row in rows)
    if not known or not known[0][0] <= place <= known[-1][0]:
        return None
    return float(np.interp(math.log(place), [math.log(x) for x, _ in known], [y for _, y in known]))
