"""The light watch on simulated decisions: false alarms, and how soon an efficiency that is a tenth lower is found.

Owns the measurement (SIMULATED): clicks of the shipped bundle's patterns, on a twentieth of their light, on the shipped images
in random order, at an efficiency that stays, drops by a tenth at once, or falls slowly. It fails when drops take longer than
stated (mean over the runs, and nine in ten within twice as long).
"""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.options import option
from pans.firmware_sim.scene.optics import expected_photoelectrons
from pans.firmware_sim.scene.still import load_scene
from pans.runtime.bundle.model import load_bundle
from pans.runtime.core.plan import exposure_us
from pans.runtime.instrument.click_law import click_law, click_probability
from pans.runtime.instrument.light_level import LightWatch
from pans.runtime.instrument.profile import load_profile

from . import Report, Trial, rows_report

PROFILE, SCENE, BUNDLE = "oled-qcmos", "fashion200", "fashion10.pans"
CHUNK = 10_000
DIM = 0.05  # of the shipped light: at all of it a tenth of efficiency is 0.9 % of the clicks, which nothing finds soon
SLOW = 2e-5  # of the efficiency, per decision: a tenth in 5000 decisions


class Decisions:
    """Clicks of decisions on random objects, at a given efficiency."""

    def __init__(self, seed: int, light: float = DIM) -> None:
        profile = load_profile(PROFILE)
        bundle, _ = load_bundle(Path(str(importlib.resources.files("pans.runtime") / "shipped" / BUNDLE)))
        exposure = exposure_us(profile, bundle)
        self._light = light * expected_photoelectrons(profile, load_scene(SCENE), bundle.pattern_levels, exposure)
        self._law = click_law(profile, exposure)
        self._rng = np.random.default_rng(seed)

    def sensitivity(self) -> float:
        """Relative change of the mean clicks over the relative change of the efficiency, for a tenth less of it."""
        whole, less = (float(click_probability(self._law, self._light * eta).sum(axis=1).mean()) for eta in (1.0, 0.9))
        return (whole - less) / whole / 0.1

    def clicks(self, efficiency: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the clicks of decisions at `efficiency` (n,), relative to the calibrated one."""
        rows = self._rng.integers(0, len(self._light), len(efficiency))
        p = click_probability(self._law, self._light[rows] * efficiency[:, None])
        return (self._rng.random(p.shape) < p).sum(axis=1)


def false_alarm_row(seed: int, decisions: int) -> dict[str, Any]:
    """Count what is found while nothing changes."""
    source, watch, alarms = Decisions(seed), LightWatch(), 0
    for _ in range(0, decisions, CHUNK):
        for clicks in source.clicks(np.ones(CHUNK)).tolist():
            alarms += bool(watch.take(clicks))
    stated = decisions / watch.report()["false_alarm_every_decisions"]
    return {
        "name": "nothing changes",
        "decisions": decisions,
        "alarms": alarms,
        "stated": stated,
        "fine": alarms <= 3 * stated + 3,
    }


def change_row(name: str, slow: bool, runs: int, seed: int) -> dict[str, Any]:
    """Measure the decisions from a drop by a tenth (or from the begin of a slow fall) to the finding."""
    delays, stated, missed = [], [], 0
    for run in range(runs):
        source, watch = Decisions(seed * 10_007 + run), LightWatch()
        while watch.baseline is None:
            for clicks in source.clicks(np.ones(1000)).tolist():
                watch.take(clicks)
        stated.append(watch.report()["found_after_decisions"])
        start = watch.decisions
        while not watch.found and watch.decisions < start + 100_000:
            at = np.arange(watch.decisions, watch.decisions + 1000) - start
            efficiency = np.maximum(0.5, 1.0 - SLOW * at) if slow else np.full(1000, 0.9)
            for clicks in source.clicks(efficiency).tolist():
                if watch.take(clicks):
                    break
        if watch.found:
            delays.append(watch.decisions - start)
        else:
            missed += 1
    mean, ninety = (float(np.mean(delays)), float(np.quantile(delays, 0.9))) if delays else (np.inf, np.inf)
    promise = float(np.mean(stated)) + (0.1 / SLOW if slow else 0.0)
    return {
        "name": name,
        "runs": runs,
        "sensitivity": Decisions(seed).sensitivity(),
        "missed": missed,
        "decisions_mean": mean,
        "decisions_90_percent": ninety,
        "stated": promise,
        "fine": not missed and mean <= promise and ninety <= 2 * promise,
    }


@dataclass(frozen=True, slots=True)
class Settings:
    """How much to draw."""

    runs: int = option(200, "changes per row (default 200)")
    decisions: int = option(10_000_000, "without a change (default 10 million)")
    seed: int = option(1, "of objects and clicks (default 1)")


def run(settings: Settings) -> Report:
    """Run all rows."""
    rows = [
        change_row("a tenth at once", False, settings.runs, settings.seed),
        change_row("a tenth in 5000 decisions", True, settings.runs, settings.seed),
        false_alarm_row(settings.seed, settings.decisions),
    ]
    return rows_report(rows, all(row["fine"] for row in rows), simulated=True)


TRIAL = Trial(Settings, run)
