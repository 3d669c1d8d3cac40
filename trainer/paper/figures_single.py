"""Plots of single shots, as small PNG files (extra `plot`): click frames, the pipeline of one image, outputs over trials, t-SNE.

Owns axes and colours; never measures. Every function writes one file, beside its place first, and closes its figure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.trainer.figures import new_figure, save_figure, use_files_alone

FRAME_TRIALS = 5
PIPELINE_TRIALS = 6
SHAPES = {16: (4, 4), 32: (4, 8)}  # rows and columns of a frame
CELL = 5  # points of a frame's cell, the gap between frames is one
_GREY = 0.45


def _frame(word: str) -> NDArray[np.float64]:
    clicks = np.array([float(bit) for bit in word])
    return np.kron(clicks.reshape(SHAPES.get(len(word), (1, len(word)))), np.ones((CELL, CELL)))


def _mosaic(tiles: list[list[NDArray[np.float64]]]) -> NDArray[np.float64]:
    """Tiles of equal shape side by side, one grey point apart."""
    height, width = tiles[0][0].shape
    canvas = np.full((len(tiles) * (height + 1) - 1, len(tiles[0]) * (width + 1) - 1), _GREY)
    for i, line in enumerate(tiles):
        for j, tile in enumerate(line):
            canvas[i * (height + 1) : i * (height + 1) + height, j * (width + 1) : j * (width + 1) + width] = tile
    return canvas


def frames(path: Path, shown: list[dict[str, Any]]) -> None:
    """Draw the images, and below them the clicks of several trials for every d_f (white: a click)."""
    figure, panels = new_figure(width=11.0, height=1.6 + 2.7 * len(shown), panels=1, rows=1 + len(shown))
    objects = shown[0]["objects"]
    images = [np.array(image) / 255 for image in shown[0]["images"]]
    panels[0].imshow(_mosaic([images]), cmap="gray", vmin=0, vmax=1)
    width = images[0].shape[1] + 1
    panels[0].set_xticks(
        [width * i + width / 2 - 1 for i in range(len(images))], [one["class"] for one in objects], fontsize=8
    )
    panels[0].xaxis.tick_top()
    panels[0].set_yticks([])
    for axis, one in zip(panels[1:], shown):
        tiles = [[_frame(each["words"][trial]) for each in one["objects"]] for trial in range(FRAME_TRIALS)]
        axis.imshow(_mosaic(tiles), cmap="gray", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
        high, wide = (side + 1 for side in tiles[0][0].shape)
        axis.set_yticks(
            [high * i + high / 2 - 1 for i in range(FRAME_TRIALS)],
            [f"trial {i + 1}" for i in range(FRAME_TRIALS)],
            fontsize=8,
        )
        labels = [f"{each['clicks']:.1f} clicks\n{each['photons']:.0f} photons" for each in one["objects"]]
        axis.set_xticks([wide * i + wide / 2 - 1 for i in range(len(labels))], labels, fontsize=7)
        axis.set_title(f"d_f = {one['features']}", fontsize=9)
    for axis in panels:
        axis.tick_params(length=0)
    figure.suptitle(
        "first test image of every class; clicks of single shots (white), expected clicks and photons (SIMULATED)",
        fontsize=10,
    )
    save_figure(figure, path)


def maps(path: Path, shown: list[dict[str, Any]]) -> None:
    """Draw the t-SNE of single shots, one panel per d_f, coloured by class."""
    figure, panels = new_figure(width=5.0 * len(shown) + 1.5, height=5.0, panels=len(shown))
    for axis, one in zip(np.atleast_1d(panels), shown):
        place, labels = np.array(one["places"]), np.array(one["labels"])
        for label, name in enumerate(one["classes"]):
            chosen = labels == label
            axis.scatter(place[chosen, 0], place[chosen, 1], s=8, color=f"C{label}", label=name)
        axis.set(xticks=[], yticks=[])
        axis.set_title(
            f"d_f = {one['features']}, {one['all']['clicks_mean']:.1f} clicks, {one['all']['photons_mean']:.0f} photons",
            fontsize=9,
        )
    np.atleast_1d(panels)[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(
        f"t-SNE of {len(shown[0]['labels'])} single shots, one per test image; distances mean no more than near or far (SIMULATED)",
        fontsize=9,
    )
    save_figure(figure, path)


def pipeline(path: Path, one: dict[str, Any], name: str) -> None:
    """Draw one image, the patterns, and of several trials the clicks, the outputs and the decision."""
    from matplotlib import pyplot

    use_files_alone()
    classes = one["classes"]
    label = classes.index(name)
    shot = one["objects"][label]
    figure = pyplot.figure(figsize=(10.5, 7.0), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1, 1.55))
    left, right = halves
    above, below = left.subplots(2, 1, height_ratios=(1, 2.2))
    above.imshow(np.array(one["images"][label]), cmap="gray", vmin=0, vmax=255)
    above.set_title(f"{name}, test image {shot['object']}", fontsize=9)
    side = SHAPES.get(one["features"], (1, one["features"]))
    images = np.sqrt(one["patterns"].reshape(*side, *np.array(one["images"][label]).shape))
    tiles = _mosaic([list(line) for line in images / images.max()])
    below.imshow(tiles, cmap="inferno", vmin=0, vmax=1)
    below.set_title(f"the {one['features']} patterns (brightness: square root of the light)", fontsize=9)
    for axis in (above, below):
        axis.set_axis_off()
    panels = right.subplots(PIPELINE_TRIALS, 2, width_ratios=(1, 4))
    for trial, (frame, bars) in enumerate(panels):
        frame.imshow(_frame(shot["words"][trial]), cmap="gray", vmin=0, vmax=1)
        frame.set(xticks=[], yticks=[])
        frame.set_ylabel(f"trial {trial + 1}", fontsize=8)
        decided = shot["decided"][trial]
        colours = ["C2" if i == label else "C3" if i == decided else "C7" for i in range(len(classes))]
        bars.bar(range(len(classes)), shot["outputs"][trial], color=colours)
        bars.set(ylim=(0, 1.05), yticks=[0, 0.5, 1])
        bars.tick_params(labelsize=7)
        last = trial == PIPELINE_TRIALS - 1
        bars.set_xticks(
            range(len(classes)), classes if last else [], rotation=60, ha="right" if last else "center", fontsize=7
        )
        bars.set_title(f"decided: {classes[decided]}", fontsize=8, color="C2" if decided == label else "C3", pad=2)
    figure.suptitle(
        f"FashionMNIST, d_f = {one['features']}, single shots: clicks (white) and outputs (softmax; green: the true class) (SIMULATED)",
        fontsize=10,
    )
    save_figure(figure, path)


def outputs(path: Path, one: dict[str, Any]) -> None:
    """Draw for every image the outputs of all trials over each other, the share of trials per decision and its expectation."""
    figure, panels = new_figure(width=13.0, height=5.6, panels=5, rows=2)
    classes = one["classes"]
    x = np.arange(len(classes))
    for place, (axis, shot) in enumerate(zip(panels.ravel(), one["objects"])):
        share = np.bincount(shot["decided"], minlength=len(classes)) / len(shot["decided"])
        axis.bar(x, share, color="C0", alpha=0.25, label="share of trials decided so")
        for i, output in enumerate(shot["outputs"]):
            axis.plot(
                x,
                output,
                "-",
                color="black",
                alpha=0.12,
                lw=1.2,
                label="outputs, one line per trial" if i == 0 else None,
            )
        axis.plot(x, shot["expected"], "x", color="C3", ms=5, label="expected share of decisions")
        axis.set_title(f"{shot['class']}: {shot['clicks']:.1f} clicks, {shot['photons']:.0f} photons", fontsize=9)
        axis.set_xticks(x, classes, rotation=90, fontsize=7)
        axis.get_xticklabels()[place].set_fontweight("bold")
        axis.set(ylim=(0, 1.03))
        axis.grid(axis="y", alpha=0.3)
        if place % 5 == 0:
            axis.set_ylabel("output or share")
        else:
            axis.set_yticklabels([])
    handles, labels = panels[0, 0].get_legend_handles_labels()
    legend = figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    for handle in legend.legend_handles:
        handle.set_alpha(0.7)
    figure.suptitle(
        f"FashionMNIST, d_f = {one['features']}: {len(one['objects'][0]['decided'])} single shots of the first test image of "
        "every class (bold) (SIMULATED)",
        fontsize=10,
    )
    save_figure(figure, path)
