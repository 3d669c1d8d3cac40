"""Plots of the course of trainings, as small PNG files (extra `plot`).

Owns axes and colours; never measures. Every function writes one file, beside its place first, and closes its figure.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.trainer.figures import new_figure, save_figure


def courses(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw training and held-out accuracy and illumination over the epochs, one panel per training (paper's colours)."""
    figure, axes = new_figure(width=3.1 * len(rows) + 0.6, height=3.3, panels=len(rows))
    panels = list(np.atleast_1d(axes))
    lowest = min(min(row["epochs"]["held_out"]) for row in rows)
    for axis, row in zip(panels, rows):
        epochs = row["epochs"]
        x = range(1, len(epochs["training"]) + 1)
        lines = axis.plot(x, epochs["training"], color="C0", label="training objects")
        lines += axis.plot(x, epochs["held_out"], color="C1", label="test images")
        light = axis.twinx()
        lines += light.plot(x, epochs["illumination"], "--", color="C2", label="illumination (right)")
        light.set_ylim(0, 1.15 * max(epochs["illumination"]))
        light.tick_params(axis="y", labelcolor="C2", labelsize=8)
        axis.set(xlabel="epoch", title=f"d_f = {row['features']}, alpha = {row['alpha']:g}", ylim=(lowest - 2, 92))
        axis.title.set_fontsize(9)
        axis.grid(alpha=0.3)
        if axis is panels[0]:
            axis.set_ylabel("accuracy, %")
            axis.legend(handles=lines, fontsize=7, loc="lower right")
    light.set_ylabel("illumination, photoelectrons", color="C2", fontsize=8)
    figure.suptitle("FashionMNIST, K = 1, one draw of clicks after every epoch (SIMULATED)", fontsize=9)
    save_figure(figure, path)


def stages(
    path: Path, patterns: dict[int, NDArray[np.floating]], peaks: list[float], shape: tuple[int, int] = (28, 28)
) -> None:
    """Draw normalised patterns (mean 1 over all), one row per stage with its own scale, and the largest value over the epochs.

    Above each pattern stands its mean. The colours follow the square root: few pixels hold most of the light.
    """
    from matplotlib import pyplot
    from matplotlib.colors import PowerNorm

    new_figure(width=1, height=1, panels=1)  # chooses the back end
    pyplot.close("all")
    count = len(next(iter(patterns.values())))
    figure = pyplot.figure(figsize=(1.0 * count + 1.2, 1.3 * len(patterns) + 2.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.3 * len(patterns), 2.2))
    above, below = parts
    axes: Any = above.subplots(len(patterns), count, squeeze=False)
    for row, (letter, (after, normal)) in enumerate(zip("abcdefgh", patterns.items())):
        scale = PowerNorm(0.5, vmin=0, vmax=float(normal.max()))
        for column, pattern in enumerate(normal):
            axis = axes[row, column]
            shown = axis.imshow(pattern.reshape(shape), cmap="magma", norm=scale)
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"{pattern.mean():.2f}", fontsize=7)
        axes[row, 0].set_ylabel(f"{letter}: epoch {after}", fontsize=8)
        bar = above.colorbar(shown, ax=axes[row, :].tolist(), fraction=0.03, pad=0.01)
        top = float(normal.max())
        bar.set_ticks([0, 10 ** math.floor(math.log10(top) - 0.3), top])
        bar.ax.set_yticklabels([f"{value:.0f}" for value in bar.get_ticks()], fontsize=7)
    axis = below.subplots()
    axis.plot(range(1, len(peaks) + 1), peaks, "o-", ms=3)
    axis.set(xlabel="epoch", ylabel="largest over mean", ylim=(0, None))
    axis.grid(alpha=0.3)
    above.suptitle("patterns over their common mean; numbers: mean of a pattern (SIMULATED)", fontsize=9)
    save_figure(figure, path)
