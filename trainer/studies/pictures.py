"""Pictures of the pages of this package, as PNG files (extra `plot`).

Owns what is drawn and how; the rows are the pages'.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pans.trainer.figures import new_figure, save_figure
from pans.trainer.paper.page import Row, Rows

_COLOURS = ("C0", "C1", "C2", "0.6")


def sequence(path: Path, found: Row, margin: float) -> None:
    """Draw a strip of passing cells, the clicks of every frame, the outputs, and truth beside decision.

    `margin` is half a window in frames: a frame stands below its middle.
    """
    words, outputs = np.array(found["words"]), np.array(found["outputs"])
    n, n_bits = len(words), 10
    figure, axes = new_figure(width=11.0, height=6.4, panels=1, rows=4)
    strip = np.array(found["strip"]).T
    axes[0].imshow(
        strip,
        cmap="gray",
        aspect="auto",
        extent=(-margin, n + margin, 0, 1),
        vmin=0,
        vmax=float(np.quantile(strip, 0.995)),
    )
    axes[0].set(yticks=[], ylabel="strip")
    bits = words[None, :] >> np.arange(n_bits)[:, None] & 1
    axes[1].imshow(bits, cmap="gray_r", aspect="auto", interpolation="nearest", extent=(0, n, n_bits, 0))
    axes[1].set(ylabel="pattern", yticks=[0.5, n_bits - 0.5], yticklabels=["1", str(n_bits)])
    for label, (name, colour) in enumerate(zip(found["classes"], _COLOURS)):
        axes[2].plot(np.arange(n) + 0.5, outputs[:, label], color=colour, lw=0.9, label=name)
    axes[2].set(ylabel="outputs", ylim=(0, 1))
    truth, decided = np.array(found["truth"]), outputs.argmax(axis=1)
    for y, labels in ((1, truth), (0, decided)):
        for label, colour in enumerate(_COLOURS):
            at = np.flatnonzero(labels == label)
            axes[3].scatter(at + 0.5, np.full(len(at), y), color=colour, marker="|", s=60, lw=1.2)
    axes[3].set(yticks=[0, 1], yticklabels=["decided", "truth"], ylim=(-0.6, 1.6), xlabel="frame")
    for axis in axes:
        axis.set_xlim(0, n)
    names = axes[2].get_legend_handles_labels()  # below all axes: the outputs fill theirs
    figure.legend(*names, loc="outside lower center", ncols=len(_COLOURS), fontsize=8)
    figure.suptitle(
        "cells in passing, one shot of ten patterns per frame; truth is empty in between (SIMULATED)", fontsize=10
    )
    save_figure(figure, path)


def patterns(path: Path, levels: Any, side: int) -> None:
    """Draw patterns (n, side * side), each by the root of its light over its brightest."""
    shown = np.sqrt(np.array(levels)).reshape(-1, side, side)
    across = (len(shown) + 1) // 2
    figure, axes = new_figure(width=1.9 * across, height=4.2, panels=across, rows=2)
    for number, axis in enumerate(axes.ravel()):
        axis.set_axis_off()
        if number < len(shown):
            axis.imshow(shown[number], cmap="magma", vmin=0, vmax=max(float(shown[number].max()), 1e-12))
            axis.set_title(f"{number + 1}: {float(np.sum(levels[number])):.1f}", fontsize=8)
    figure.suptitle("patterns, root of the light; above each: its illumination (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def maps(path: Path, panels: Rows, classes: list[str]) -> None:
    """Draw t-SNE maps, ways across and levels of photons down, one colour per class."""
    levels = list(dict.fromkeys(row["asked"] for row in panels))
    ways = list(dict.fromkeys(row["way"] for row in panels))
    figure, axes = new_figure(width=5.0 * len(ways), height=4.6 * len(levels) + 0.6, panels=len(ways), rows=len(levels))
    grid = np.atleast_2d(axes)
    for row in panels:
        axis = grid[levels.index(row["asked"]), ways.index(row["way"])]
        places, labels = np.array(row["map"]), np.array(row["labels"])
        for label, name in enumerate(classes):
            axis.scatter(*places[labels == label].T, s=9, color=f"C{label}", label=name)
        axis.set(xticks=[], yticks=[])
        axis.set_title(
            f"{row['way']}, {row['photons']:.0f} photons: neighbours tell {100 * row['neighbours']:.0f} %", fontsize=9
        )
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8, markerscale=2
    )
    figure.suptitle("t-SNE of one readout of each test image (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def fibre_field(path: Path, rows: Rows, direct: Rows) -> None:
    """Draw accuracy over the number of detectors beside the paper's for its input, and over photons beside direct imaging."""
    figure, (over, light) = new_figure(width=10.5, panels=2)
    values, features = [row["value"] for row in rows], [row["features"] for row in rows]
    over.plot(features, values, "o-", label="ours")
    over.plot(features, [row["release"] for row in rows], "s--", color="0.6", label="the paper, its own input")
    light.plot([row["photons"] for row in rows], values, "o-", label="ours, photons detected")
    light.plot([row["reaching"] for row in rows], values, "x:", color="C0", label="ours, must reach the optics")
    light.plot([row["photons"] for row in direct], [row["value"] for row in direct], "k-", label="direct imaging")
    over.set(xlabel="detectors, d_f", ylabel="accuracy, %")
    light.set(xlabel="photons per digit", ylabel="accuracy, %", xscale="log")
    for axis in (over, light):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="lower right")
    figure.suptitle("digits behind a fibre as a field, W complex and conserving (SIMULATED)", fontsize=10)
    save_figure(figure, path)
