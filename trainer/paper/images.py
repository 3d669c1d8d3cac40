"""Pictures of the pages, as small PNG files (extra `plot`): matrices, frames, patterns, maps, and outputs of single shots.

Owns axes and colours; never measures. Every function writes one file, beside its place first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.trainer.evaluate.picture_samples import SAMPLES, Samples
from pans.trainer.figures import new_figure, save_figure, use_files_alone

from .page import Row, Rows
from .plots import TITLES
from .tables import FIRST, FIRST_OBJECTS

FRAME_TRIALS = 5
PIPELINE_TRIALS = 6
SHAPES = {16: (4, 4), 32: (4, 8)}  # rows and columns of a frame of clicks
CELL = 5  # points of a frame's cell, the gap between frames is one
_GREY = 0.45

Image = NDArray[np.floating]


def _shape(d_f: int) -> tuple[int, int]:
    return SHAPES.get(d_f, (1, d_f))


def _click_frame(word: str) -> Image:
    clicks = np.array([float(bit) for bit in word])
    return np.kron(clicks.reshape(_shape(len(word))), np.ones((CELL, CELL)))


def _mosaic(tiles: Sequence[Sequence[Image]], gap: float = _GREY) -> Image:
    """Tiles of equal shape side by side, one point of brightness `gap` apart."""
    height, width = tiles[0][0].shape
    canvas = np.full((len(tiles) * (height + 1) - 1, len(tiles[0]) * (width + 1) - 1), gap)
    for i, line in enumerate(tiles):
        for j, tile in enumerate(line):
            canvas[i * (height + 1) : i * (height + 1) + height, j * (width + 1) : j * (width + 1) + width] = tile
    return canvas


def _middles(count: int, size: int) -> list[float]:
    """Where tiles of a mosaic have their middles, along one side."""
    return [(size + 1) * i + (size - 1) / 2 for i in range(count)]


# ---- matrices ----


def confusions(path: Path, rows: Rows, table: str) -> None:
    """Draw one matrix per row of a table, all images: true class down, decision across, numbers in % of the true class."""
    figure, panels = new_figure(width=13.5, height=8.6, panels=4, rows=2)
    axes = panels.ravel()
    shown = None
    for place, (axis, row) in enumerate(zip(axes, rows)):
        matrix, classes = row["all"]["matrix"], row["classes"]
        shown = axis.imshow(matrix, cmap="Blues", vmin=0, vmax=1)
        for (i, j), share in np.ndenumerate(matrix):
            if share >= 0.01:
                ink = "white" if share > 0.55 else "black"
                axis.text(j, i, f"{100 * share:.0f}", ha="center", va="center", fontsize=6.5, color=ink)
        ticks = range(len(classes))
        axis.set_xticks(ticks, classes, rotation=90, fontsize=7)
        axis.set_yticks(ticks, classes if place % 4 == 0 else [""] * len(classes), fontsize=7)
        whole, first = row["all"], row[FIRST]
        axis.set_title(
            f"d_f = {row['features']}: {100 * whole['accuracy_mean']:.1f} % (first {FIRST_OBJECTS}: "
            f"{100 * first['accuracy_mean']:.1f} %)\n{whole['clicks_mean']:.1f} clicks, {whole['photons_mean']:.0f} photons",
            fontsize=8.5,
        )
        if place % 4 == 0:
            axis.set_ylabel("true class")
    for axis in axes[len(rows) :]:
        axis.set_axis_off()
    if shown is not None:
        figure.colorbar(shown, ax=list(axes), label="share of the true class", shrink=0.5, aspect=40)
    words = "K = 1, all 10 000 test images; decision across, numbers in % from 1 % on (SIMULATED)"
    figure.suptitle(f"{TITLES[table]}, {words}", fontsize=10)
    save_figure(figure, path)


def sensing_map(path: Path, rows: Rows) -> None:
    """Draw accuracy of compressive sensing over the number of patterns (down) and photons (across), with the numbers."""
    levels = [f"{cell['photons_asked']:g}" for cell in rows[0]["cells"]]
    values = np.array([[100 * cell["accuracy_mean"] for cell in row["cells"]] for row in rows])
    figure, axis = new_figure(width=6.8, height=4.4, panels=1)
    shown = axis.imshow(values, cmap="viridis", vmin=10, vmax=85, aspect="auto", origin="lower")
    for (y, x), value in np.ndenumerate(values):
        axis.text(x, y, f"{value:.1f}", ha="center", va="center", fontsize=9, color="w" if value < 60 else "k")
    axis.set_xticks(range(len(levels)), levels)
    axis.set_yticks(range(len(rows)), [str(row["features"]) for row in rows])
    axis.set(xlabel="photons detected per decision", ylabel="patterns d_f")
    figure.colorbar(shown, label="accuracy, all test images, %")
    axis.set_title("compressive sensing, trained on clean measurements (SIMULATED)", fontsize=10)
    save_figure(figure, path)


# ---- frames of a camera ----


def frames(path: Path, classes: tuple[str, ...], shown: dict[float, Image]) -> None:
    """Draw frames, `shown` being photons -> (classes, draws, height, width): a row per class, a column per draw."""
    drawn = np.concatenate(list(shown.values()), axis=1)
    height, width = drawn.shape[2:]
    brightest = np.maximum(1.0, drawn.max(axis=(2, 3), keepdims=True))
    figure, axis = new_figure(width=7.6, height=7.4, panels=1)
    axis.imshow(_mosaic(drawn / brightest, gap=1.0), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axis.set_yticks(_middles(len(classes), height), classes, fontsize=8)
    titles = [f"{photons:g}" for photons, draws in shown.items() for _ in range(draws.shape[1])]
    axis.set_xticks(_middles(len(titles), width), titles, fontsize=8)
    axis.tick_params(length=0, top=False, labeltop=True, bottom=False, labelbottom=False)
    axis.set_title("photon counts of single frames; above: photons per frame, on average (SIMULATED)", fontsize=9)
    save_figure(figure, path)


def frame_maps(path: Path, classes: tuple[str, ...], maps: Rows) -> None:
    """Draw t-SNE maps of frames, one panel per photon level, one colour per class."""
    titles = [f"{row['photons_asked']:g} photons: neighbours agree for {100 * row['neighbours']:.0f} %" for row in maps]
    words = f"t-SNE of {len(maps[0]['labels'])} frames of FashionMNIST test images (SIMULATED)"
    _maps(path, [(row["map"], row["labels"], title) for row, title in zip(maps, titles)], classes, words)


def shot_maps(path: Path, shown: Rows) -> None:
    """Draw the t-SNE of single shots, one panel per d_f, coloured by class."""
    panels = []
    for one in shown:
        title = (
            f"d_f = {one['features']}, {one['all']['clicks_mean']:.1f} clicks, {one['all']['photons_mean']:.0f} photons"
        )
        panels.append((one["places"], one["labels"], title))
    words = f"t-SNE of {len(shown[0]['labels'])} single shots, one per test image; distances mean no more than near or far (SIMULATED)"
    _maps(path, panels, shown[0]["classes"], words)


def _maps(path: Path, panels: list[tuple[Any, Any, str]], classes: Sequence[str], words: str) -> None:
    figure, axes = new_figure(width=4.6 * len(panels), height=5.0, panels=len(panels))
    for axis, (places, labels, title) in zip(np.atleast_1d(axes), panels):
        for label, name in enumerate(classes):
            axis.scatter(*np.array(places)[np.array(labels) == label].T, s=8, color=f"C{label}", label=name)
        axis.set(xticks=[], yticks=[])
        axis.set_title(title, fontsize=9)
    named = np.atleast_1d(axes)[0].get_legend_handles_labels()
    figure.legend(*named, loc="outside lower center", ncols=len(classes), fontsize=8, markerscale=2)
    figure.suptitle(words, fontsize=9)
    save_figure(figure, path)


# ---- single shots ----


def click_frames(path: Path, shown: Rows) -> None:
    """Draw the images, and below them the clicks of several trials for every d_f (white: a click)."""
    figure, panels = new_figure(width=11.0, height=1.6 + 2.7 * len(shown), panels=1, rows=1 + len(shown))
    images = [np.array(image) / 255 for image in shown[0]["images"]]
    panels[0].imshow(_mosaic([images]), cmap="gray", vmin=0, vmax=1)
    names = [one["class"] for one in shown[0]["objects"]]
    panels[0].set_xticks(_middles(len(images), images[0].shape[1]), names, fontsize=8)
    panels[0].xaxis.tick_top()
    panels[0].set_yticks([])
    for axis, one in zip(panels[1:], shown):
        tiles = [[_click_frame(each["words"][trial]) for each in one["objects"]] for trial in range(FRAME_TRIALS)]
        axis.imshow(_mosaic(tiles), cmap="gray", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
        height, width = tiles[0][0].shape
        trials = [f"trial {i + 1}" for i in range(FRAME_TRIALS)]
        axis.set_yticks(_middles(FRAME_TRIALS, height), trials, fontsize=8)
        labels = [f"{each['clicks']:.1f} clicks\n{each['photons']:.0f} photons" for each in one["objects"]]
        axis.set_xticks(_middles(len(labels), width), labels, fontsize=7)
        axis.set_title(f"d_f = {one['features']}", fontsize=9)
    for axis in panels:
        axis.tick_params(length=0)
    words = "first test image of every class; clicks of single shots (white), expected clicks and photons (SIMULATED)"
    figure.suptitle(words, fontsize=10)
    save_figure(figure, path)


def pipeline(path: Path, one: Row, name: str) -> None:
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
    image = np.array(one["images"][label])
    above.imshow(image, cmap="gray", vmin=0, vmax=255)
    above.set_title(f"{name}, test image {shot['object']}", fontsize=9)
    patterns = np.sqrt(one["patterns"].reshape(*_shape(one["features"]), *image.shape))
    below.imshow(_mosaic(patterns / patterns.max()), cmap="inferno", vmin=0, vmax=1)
    below.set_title(f"the {one['features']} patterns (brightness: square root of the light)", fontsize=9)
    for axis in (above, below):
        axis.set_axis_off()
    for trial, pair in enumerate(right.subplots(PIPELINE_TRIALS, 2, width_ratios=(1, 4))):
        _one_trial(pair, shot, trial, classes, label)
    words = f"d_f = {one['features']}, single shots: clicks (white) and outputs (softmax; green: the true class)"
    figure.suptitle(f"FashionMNIST, {words} (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def _one_trial(pair: Any, shot: Row, trial: int, classes: list[str], label: int) -> None:
    """The clicks of a trial, its outputs, and what was decided: green where it is right, red where not."""
    frame, bars = pair
    frame.imshow(_click_frame(shot["words"][trial]), cmap="gray", vmin=0, vmax=1)
    frame.set(xticks=[], yticks=[])
    frame.set_ylabel(f"trial {trial + 1}", fontsize=8)
    decided = shot["decided"][trial]
    colours = ["C2" if i == label else "C3" if i == decided else "C7" for i in range(len(classes))]
    bars.bar(range(len(classes)), shot["outputs"][trial], color=colours)
    bars.set(ylim=(0, 1.05), yticks=[0, 0.5, 1])
    bars.tick_params(labelsize=7)
    last = trial == PIPELINE_TRIALS - 1
    turned: dict[str, Any] = {"rotation": 60, "ha": "right" if last else "center", "fontsize": 7}
    bars.set_xticks(range(len(classes)), classes if last else [], **turned)
    bars.set_title(f"decided: {classes[decided]}", fontsize=8, color="C2" if decided == label else "C3", pad=2)


def outputs(path: Path, one: Row) -> None:
    """Draw for every image the outputs of all trials over each other, the share of trials per decision and its expectation."""
    figure, panels = new_figure(width=13.0, height=5.6, panels=5, rows=2)
    classes = one["classes"]
    x = np.arange(len(classes))
    for place, (axis, shot) in enumerate(zip(panels.ravel(), one["objects"])):
        share = np.bincount(shot["decided"], minlength=len(classes)) / len(shot["decided"])
        axis.bar(x, share, color="C0", alpha=0.25, label="share of trials decided so")
        trials = axis.plot(x, np.array(shot["outputs"]).T, "-", color="black", alpha=0.12, lw=1.2)
        trials[0].set_label("outputs, one line per trial")
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
    named = panels[0, 0].get_legend_handles_labels()
    legend = figure.legend(*named, loc="outside lower center", ncols=3, fontsize=8)
    for handle in legend.legend_handles:
        handle.set_alpha(0.7)
    words = f"{len(one['objects'][0]['decided'])} single shots of the first test image of every class (bold)"
    figure.suptitle(f"FashionMNIST, d_f = {one['features']}: {words} (SIMULATED)", fontsize=10)
    save_figure(figure, path)


# ---- patterns and pictures ----


def stages(path: Path, patterns: dict[int, Image], peaks: list[float], shape: tuple[int, int] = (28, 28)) -> None:
    """Draw normalised patterns (mean 1 over all), one row per stage with its own scale, and the largest value over the epochs.

    Above each pattern stands its mean. The colours follow the square root: few pixels hold most of the light.
    """
    from matplotlib import pyplot
    from matplotlib.colors import PowerNorm

    use_files_alone()
    count = len(next(iter(patterns.values())))
    figure = pyplot.figure(figsize=(1.0 * count + 1.2, 1.3 * len(patterns) + 2.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.3 * len(patterns), 2.2))
    above, below = parts
    axes: Any = above.subplots(len(patterns), count, squeeze=False)
    for line, letter, (after, normal) in zip(axes, "abcdefgh", patterns.items()):
        top = float(normal.max())
        for axis, pattern in zip(line, normal):
            shown = axis.imshow(pattern.reshape(shape), cmap="magma", norm=PowerNorm(0.5, vmin=0, vmax=top))
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"{pattern.mean():.2f}", fontsize=7)
        line[0].set_ylabel(f"{letter}: epoch {after}", fontsize=8)
        bar = above.colorbar(shown, ax=line.tolist(), fraction=0.03, pad=0.01)
        bar.set_ticks([0, 10 ** math.floor(math.log10(top) - 0.3), top])
        bar.ax.set_yticklabels([f"{value:.0f}" for value in bar.get_ticks()], fontsize=7)
    axis = below.subplots()
    axis.plot(range(1, len(peaks) + 1), peaks, "o-", ms=3)
    axis.set(xlabel="epoch", ylabel="largest over mean", ylim=(0, None))
    axis.grid(alpha=0.3)
    above.suptitle("patterns over their common mean; numbers: mean of a pattern (SIMULATED)", fontsize=9)
    save_figure(figure, path)


def samples(path: Path, name: str, cells: list[tuple[str, Samples]]) -> None:
    """Draw the objects and their speckle above, and for every model (title, samples) the pictures that came back."""
    first = cells[0][1]
    lines: list[tuple[str, Any, Any]] = [
        ("shown to the fibre", first.pictures, None),
        ("speckle behind it", first.shown, None),
        *(
            ("" if i else title, each.given_back[:, i], each.clicks[:, i])
            for title, each in cells
            for i in range(SAMPLES)
        ),
    ]
    n = len(first.pictures)
    figure, axes = new_figure(width=0.95 * n + 1.9, height=1.02 * len(lines) + 0.4, panels=n, rows=len(lines))
    for line, (title, pictures, clicks) in zip(axes, lines):
        for i, (axis, picture) in enumerate(zip(line, pictures)):
            brightest = max(1, int(picture.max())) if pictures is first.shown else 255
            axis.imshow(picture, cmap="gray", vmin=0, vmax=brightest)
            axis.set(xticks=[], yticks=[])
            if clicks is not None:
                axis.set_title(f"clicks: {int(clicks[i])}", fontsize=7, pad=2)
        line[0].set_ylabel(title, rotation=0, ha="right", va="center", fontsize=8)
    words = f"{name}: the first held-out digit of every class, {SAMPLES} single shots each (SIMULATED)"
    figure.suptitle(words, fontsize=9)
    save_figure(figure, path)
