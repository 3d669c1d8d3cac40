"""The page of a folder of runs: one line and a small picture each, and how accuracy, dark counts, light and lateness went over days.

Runs come as `pans runs` lists them, with their summaries; of a recording its decision log alone is read, and none of a large one.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from pans.base.numbers import FIGURES, Figure, Shown, shown
from pans.decide import is_judged
from pans.record.reading import skim_decisions
from pans.report.summary.words import accuracy_interval

from .charts import spark
from .page import render

SPARKS, LOG_MAX_BYTES = 24, 1 << 24  # stretches of a small picture; of a larger recording there is none
UNITS = (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0))  # of the time axis: the longest of which two fit
Run = Any  # of app/commands/runs.py, a package that comes later


def index_page(root: Path, runs: Sequence[Run], beside: Path) -> bytes:
    """Return the page of the runs in `root`, the newest first, with links from the folder `beside`."""
    rows = [(run, run.summary, accuracy_interval(run.summary), _link(run, beside), _spark(run)) for run in runs]
    trends = [(one, _trend(runs, one)) for one in shown(Shown.TREND)]
    simulated = any(run.simulated for run in runs)
    return render("index.html", root=root, rows=rows, trends=trends, columns=[*shown(Shown.INDEX)], simulated=simulated)


def _link(run: Run, beside: Path) -> str:
    """The relative address of the run's page, of its summary, or of its folder."""
    best = [*sorted(run.folder.glob("*.html")), *(one for one in run.files if one.suffix == ".md")]
    return quote(os.path.relpath(best[0] if best else run.folder, beside).replace(os.sep, "/"))


def _spark(run: Run) -> Any:
    """Accuracy over the run; "" where truth or decisions are not known."""
    right = accuracy_over([path for path in run.files if path.suffix == ".pansrec"])
    return spark(f"accuracy over the run of {run.started:%Y-%m-%d %H:%M}", right) if len(right) > 1 else ""


def accuracy_over(recordings: Sequence[Path]) -> list[float]:
    """Return the share of right decisions in stretches of a run; empty where it is not known or the recordings are large."""
    known = (rows[is_judged(rows)] for rows in skim_decisions(recordings, LOG_MAX_BYTES))
    right = [rows["label"] == rows["truth"] for rows in known]
    every = np.concatenate([np.zeros(0, np.bool_), *right])
    return [float(one.mean()) for one in np.array_split(every, min(SPARKS, len(every) // 10 or 1)) if len(one)]


# ---- trends ----


def _ends(figure: Figure, one: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """A figure of a summary, a count as a share of its total, with the ends of its interval; None where it is not known."""
    value, dark = figure.value(one), one.get("dark") or {}
    if figure.key == "dark.per_exposure":
        return (value, dark["low"], dark["high"]) if dark.get("exposures") else None
    if figure.key == "accuracy":
        ends = accuracy_interval(one)
        return None if value is None or ends is None else (value, *ends)
    if value is None or not one.get("decisions"):
        return None
    return (value / FIGURES[figure.total].value(one) if figure.total else value,) * 3


def _trend(runs: Sequence[Run], figure: Figure) -> dict[str, Any] | None:
    """One figure of all runs over time, as arrays (runs,); None where fewer than two know it.

    `expected` is that of the dark rate; `top` is the largest figure, `least` the least one above 0.
    """
    known = ((run, _ends(figure, run.summary)) for run in sorted(runs, key=lambda run: run.started))
    found = [(run, ends) for run, ends in known if ends is not None]
    if len(found) < 2:
        return None
    some = [run for run, _ in found]
    when, *figures = np.array([(run.started.timestamp(), *ends) for run, ends in found]).T
    unit, unit_s = next(one for one in UNITS if when[-1] - when[0] >= 2 * one[1] or one is UNITS[-1])
    is_dark = figure.key == "dark.per_exposure"
    dark = ((run.summary.get("dark") or {}).get("expected") if is_dark else None for run in some)
    expected, failed = np.array([one or np.nan for one in dark]), np.array([run.verdict == "FAIL" for run in some])
    every = np.array([*figures, expected])
    ends = {"top": float(np.nanmax(every)), "least": float(np.nanmin(every[every > 0], initial=1.0))}
    times = {"unit": unit, "since": (when - when[0]) / unit_s, "first": some[0].started.astimezone()}
    return times | ends | {"figures": figures, "expected": expected, "passed": ~failed, "failed": failed}
