"""The picture of `pans evaluate --dose-cap curve`: accuracy against the illumination that an object receives.

Owns what is on it; the figures are dose.py's. SIMULATED, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pans.runtime.outputs import make_folder
from pans.trainer.figures import new_figure, save_figure

MARKERS = ("o", "s", "^", "D", "v", "P")
Points = Sequence[Mapping[str, Any]]


def draw_dose(folder: Path, curves: Mapping[str, Points], *, force: bool = False) -> Path:
    """Write dose.png into `folder`, a curve by name of each bundle or sample, and return its path.

    Left against illumination, right against the photons that come back. Bars are the error from trials and objects together.
    """
    make_folder(folder)
    figure, axes = new_figure(width=10.0, height=4.0, panels=2)
    for axis, key in zip(axes, ("illumination", "photons_mean")):
        for marker, (name, points) in zip(MARKERS * len(curves), curves.items()):
            axis.errorbar(
                [point[key] for point in points],
                [100 * (point["accuracy_mean"] or 0.0) for point in points],
                yerr=[100 * _error(point) for point in points],
                marker=marker,
                markersize=4,
                linewidth=1,
                capsize=2,
                label=name,
            )
        axis.set_ylim(0, 100)
        axis.grid(alpha=0.3)
    axes[0].set_xlabel("illumination of an object (photoelectrons, mean)")
    axes[1].set_xlabel("photoelectrons detected (mean)")
    axes[0].set_ylabel("accuracy (%), SIMULATED")
    axes[0].legend(fontsize=8, loc="lower right")
    path = folder / "dose.png"
    save_figure(figure, path, force=force)
    return path


def _error(point: Mapping[str, Any]) -> float:
    return math.hypot(point["accuracy_se_objects"] or 0.0, point["accuracy_se_trials"])
