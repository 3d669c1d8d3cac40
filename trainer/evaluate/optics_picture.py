"""The picture of `pans evaluate --optics tolerance`: accuracy against each misalignment by itself.

Owns what is on it; the figures are optics.py's. SIMULATED, and says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pans.runtime.outputs import make_folder
from pans.trainer.figures import new_figure, save_figure

AXES = {
    "shift_px": "shift to the right and down (pixels)",
    "rotation_deg": "rotation (degrees)",
    "psf_px": "blur, standard deviation (pixels)",
    "black": "light of a dark pixel / full pixel",
}
MARKERS = ("o", "s", "^", "D")
Curves = Mapping[str, Sequence[Mapping[str, Any]]]


def draw_optics(folder: Path, bundles: Mapping[str, Curves], *, force: bool = False) -> Path:
    """Write optics.png into `folder`, the curves of every bundle by name, and return its path."""
    make_folder(folder)
    figure, axes = new_figure(width=11.0, height=3.2, panels=len(AXES))
    for axis, (name, label) in zip(axes, AXES.items()):
        for marker, (bundle, curves) in zip(MARKERS * len(bundles), bundles.items()):
            points = curves[name]
            axis.plot(
                [point["value"] for point in points],
                [100 * (point["accuracy_mean"] or 0.0) for point in points],
                marker=marker,
                markersize=4,
                label=bundle,
            )
        axis.set_xlabel(label)
        axis.set_ylim(0, 100)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("accuracy (%), SIMULATED")
    axes[0].legend(fontsize=8, loc="lower left")
    path = folder / "optics.png"
    save_figure(figure, path, force=force)
    return path
