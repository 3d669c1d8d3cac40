"""The pages of the package as pictures: accuracy against photons, clicks and the light at the optics, one colour per way.

Owns axes, colours and labels; never measures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pans.trainer.figures import new_figure, save_figure
from pans.trainer.paper.page import Rows
from pans.trainer.paper.plots import TITLES
from pans.trainer.paper.tables import FIRST

from .fixed import FIXED, FIXED_BUDGET, FIXED_LIGHT, FIXED_SENT, PAPER
from .summary import error_of
from .ways import (
    AUTOMATON,
    DIRECT,
    EARLY,
    HADAMARD,
    HELD_TO_CLICKS,
    LARGER,
    LARGER_ON,
    MASKS,
    ON,
    SMALL,
    STOPPING,
    TASKS,
)

STYLES: dict[str, dict[str, Any]] = {
    AUTOMATON: {"color": "C3", "marker": "o", "lw": 2.2, "zorder": 5},
    ON: {"color": "C3", "marker": "*", "ms": 10, "mfc": "w", "ls": "", "zorder": 6},
    LARGER: {"color": "C8", "marker": "o", "ls": "", "zorder": 6},
    LARGER_ON[0]: {"color": "C8", "marker": "D", "ms": 5, "mfc": "w", "ls": "", "zorder": 6},
    LARGER_ON[1]: {"color": "C8", "marker": "*", "ms": 10, "mfc": "w", "ls": "", "zorder": 6},
    SMALL: {"color": "C3", "marker": "o", "mfc": "w", "lw": 1.2, "ls": "--", "zorder": 4},
    HELD_TO_CLICKS: {"color": "C3", "marker": "^", "lw": 1.0, "ls": ":", "zorder": 4},
    EARLY: {"color": "C6", "marker": "o", "mfc": "w", "lw": 1.0, "ls": ":", "zorder": 4},
    FIXED: {"color": "C1", "marker": "s"},
    FIXED_LIGHT: {"color": "C1", "marker": "s", "mfc": "w", "ls": "--"},
    FIXED_BUDGET: {"color": "C5", "marker": "s"},
    FIXED_SENT: {"color": "C5", "marker": "s", "mfc": "w", "ls": "--"},
    PAPER: {"color": "k", "marker": "x", "ls": ":"},
    DIRECT: {"color": "C0", "marker": "."},
    STOPPING: {"color": "C0", "marker": "v", "mfc": "w", "ls": "--"},
    MASKS: {"color": "C2", "marker": "D", "ms": 4},
    HADAMARD: {"color": "C4", "marker": "P"},
}
REACHING: dict[str, dict[str, Any]] = {  # by encoder
    "unconstrained": {"color": "C3", "marker": "o", "ls": ""},
    "conserving": {"color": "C1", "marker": "s", "ls": "--"},
    "of intensities, conserving": {"color": "C2", "marker": "D", "ls": "--"},
}
MISSING = " (not measured yet)"
AXES = (("photons_mean", "photons detected per decision"), ("clicks_mean", "clicks per decision"))


def frontier(path: Path, points: Rows) -> None:
    """Draw a row of two panels per task: accuracy on all images (the paper's: on its 200) over photons and over clicks."""
    from matplotlib.ticker import NullFormatter, ScalarFormatter

    figure, panels = new_figure(width=12.5, height=10.5, panels=2, rows=len(TASKS))
    for across, name in zip(panels, TASKS):
        for axis, (key, label) in zip(across, AXES):
            _ways(axis, [row for row in points if row["task"] == name], key)
            axis.set(xscale="log", xlabel=label, ylabel="accuracy, %", title=TITLES[name])
            axis.xaxis.set_major_formatter(ScalarFormatter())
            axis.xaxis.set_minor_formatter(NullFormatter())
            ticks = [1, 2, 4, 6, 10, 17, 40, 100, 200] if key == "photons_mean" else [1, 2, 5, 10, 20, 50, 100]
            low, high = axis.get_xlim()
            axis.set_xticks([tick for tick in ticks if low <= tick <= high])
            axis.grid(alpha=0.3)
    measured = {row["way"] for row in points}
    handles: dict[str, Any] = {}
    for across in panels:
        for handle, label in zip(*across[0].get_legend_handles_labels()):
            way = label.removesuffix(MISSING)
            if way not in measured or label == way:  # of a task that it is measured for, if of any
                handles.setdefault(way if way in measured else label, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, fontsize=9)
    words = "all 10 000 test images, the paper's points on its first 200 with the least photons of its clicks; bars: standard errors"
    figure.suptitle(f"{words} (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def _ways(axis: Any, points: Rows, key: str) -> None:
    for way, style in STYLES.items():
        part = FIRST if way == PAPER else "all"
        curve = sorted(
            (row for row in points if row["way"] == way and part in row), key=lambda row: float(row[part][key])
        )
        if not curve:
            axis.plot([], [], **style, label=f"{way}{MISSING}")
            continue
        errors = None if way == PAPER else [100 * error_of(row) for row in curve]
        words = f"{way}{', photons at least' if way == PAPER else ''}"
        shared = {"ms": 5, "lw": 1.3, "capsize": 2} | style
        x, y = ([row[part][k] for row in curve] for k in (key, "accuracy_mean"))
        axis.errorbar(x, [100 * value for value in y], errors, **shared, label=words)


def reaching(path: Path, rows: Rows) -> None:
    """Draw a panel per task: accuracy over the light that must reach the optics, of both kinds of W and of direct imaging there."""
    names = list(dict.fromkeys(row["task"] for row in rows))
    figure, panels = new_figure(width=11, height=8.5, panels=2, rows=-(-len(names) // 2))
    for axis, name in zip(np.ravel(panels), names):
        of_task = sorted((row for row in rows if row["task"] == name), key=lambda row: float(row["reaching"]))
        for kind, style in REACHING.items():
            part = [row for row in of_task if row["encoder"] == kind]
            if not part:
                continue
            axis.plot(
                [row["reaching"] for row in part], [row["value"] for row in part], label=f"PANS, W {kind}", **style
            )
        direct = sorted({(row["direct"]["photons"], row["direct"]["value"]) for row in of_task})
        ways = " or ".join(dict.fromkeys(row["direct"]["way"] for row in of_task))
        axis.plot(*zip(*direct), color="C0", marker=".", label=f"direct imaging, {ways}")
        words = "photons that must reach the optics, per decision"
        axis.set(xscale="log", xlabel=words, ylabel="accuracy, %", title=name, ylim=(45, 101))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="lower right")
    figure.suptitle("held-out objects of our generators, no dark counts in direct imaging (SIMULATED)", fontsize=10)
    save_figure(figure, path)
