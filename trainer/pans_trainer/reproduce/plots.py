"""Pictures of the pages, as small PNG files (extra `plot`): every function draws the rows of a page into one file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans_trainer.evaluate.walks import FIRST_OBJECTS
from pans_trainer.figures import new_figure, save_figure, use_files_alone

from .rows import Column, Row, Rows, of_table

FRAME_TRIALS, PIPELINE_TRIALS = 5, 6
SHAPES = {16: (4, 4), 32: (4, 8)}  # rows and columns of a frame of clicks
CELL = 5  # points of a frame's cell, the gap between frames is one
SAMPLES = 3  # pictures given back of an object
CELLS = ("C0", "C1", "C2", "0.6")  # classes of cells in passing

Image = NDArray[np.floating]


# ---- curves ----


def curves(path: Path, rows: Rows, spec: Row) -> None:
    """Draw panels of curves over the rows of a page as a [plots] entry of pages.toml describes them."""
    from matplotlib.ticker import LogLocator, NullFormatter

    panels, down = spec["panels"], spec.get("down", 1)
    width, height = spec["size"]
    figure, axes = new_figure(width, height, len(panels) // down, down)
    named: dict[str, Any] = {}
    numbers: dict[str, int] = {}  # of the labels, for one colour and marker in all panels
    for axis, panel in zip(np.atleast_1d(axes).ravel(), panels):
        if "plane" in panel:
            _plane(figure, axis, of_table(rows, panel["plane"]), spec)
        for line in panel.get("lines", ()):
            _lines(
                axis, rows, numbers, {**spec.get("line", {}), **panel.get("line", {}), **line}, spec.get("families", {})
            )
        axis.set(**spec.get("set", {}) | panel.get("set", {}))
        axis.grid(alpha=0.3)
        for scale, ticks in ((axis.get_xscale(), axis.xaxis), (axis.get_yscale(), axis.yaxis)):
            if scale == "log":
                ticks.set_major_locator(LogLocator(subs=(1, 2, 5)))
                ticks.set_major_formatter("{x:g}")
                ticks.set_minor_formatter(NullFormatter())
        named = dict(zip(*reversed(axis.get_legend_handles_labels()))) | named
    figure.legend(named.values(), named, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle(f"{spec['title']} (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def _plane(figure: Any, axis: Any, points: Rows, spec: Row) -> None:
    """Draw points by their photons and illumination, coloured by accuracy; ringed are those on the front."""
    if not points:
        return
    for marker, kind in spec["markers"].items():
        mine = [row for row in points if _family(row["way"], spec["families"])[2] == marker]
        places = [[row[key] for row in mine] for key in ("photons", "illumination", "value")]
        rings = ["k" if row.get("front") else "none" for row in mine]
        drawn = axis.scatter(
            *places[:2], c=places[2], vmin=50, vmax=100, marker=marker, edgecolors=rings, s=28, cmap="turbo"
        )
        axis.scatter([], [], color="0.6", marker=marker, edgecolors="k", label=f"{kind} (ringed: on the front)")
    figure.colorbar(drawn, ax=axis, label="accuracy, %", extend="min")


def _family(label: str, families: dict[str, list[str]]) -> list[str]:
    """The colour, the name in the legend and the marker of the family of which `label` contains the word; of none "" and its own name."""
    return next((families[word] for word in families if word in label), ["", label, ""])


def _lines(axis: Any, rows: Rows, numbers: dict[str, int], line: Row, families: dict[str, list[str]]) -> None:
    """Draw one line per label: `y` over `x` of the rows of a table, with error bars and notes where they are asked for.

    A label that contains a word of `families` has that one's colour, and its name in the legend. Rows that lack a key of the label, or a
    value, are left out.
    """
    x, y, label = line["x"], line["y"], Column("", line["label"])
    groups: dict[str, Rows] = {}
    for row in of_table(rows, line["of"]) if "of" in line else rows:
        wanted = all(row.get(key) == value for key, value in line.get("where", {}).items())
        if wanted and all(row.get(key) is not None for key in (x, y, *label.keys)):
            groups.setdefault(label.cell(row), []).append(row)
    for name, mine in groups.items():
        number = numbers.setdefault(name, len(numbers))
        mine.sort(key=lambda row: float(row[x]))
        errors = [row.get(line["bars"]) or 0.0 for row in mine] if "bars" in line else None
        colour, family, _ = _family(name, families)
        line_style = {
            "fmt": f"{'os^DvP*X<>'[number % 10 if colour else number // 10 % 4]}-",
            "color": colour or f"C{number % 10}",
            "ms": 3.5,
            "lw": 1.2,
            "capsize": 2,
        }
        style = line_style | line.get("style", {})
        axis.errorbar([row[x] for row in mine], [row[y] for row in mine], errors, label=family, **style)
        for row in mine if "note" in line else ():
            words = line["note"].format(**row)
            axis.annotate(words, (row[x], row[y]), textcoords="offset points", xytext=(4, -10), fontsize=7)


# ---- pictures given back ----


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What was wanted and shown, uint8 (n, height, width), and what came back, uint8 (n, samples, height, width), of so many clicks."""

    pictures: NDArray[np.uint8]
    shown: NDArray[np.uint8]
    given_back: NDArray[np.uint8]
    clicks: NDArray[np.int64]  # (n, samples)


def samples(path: Path, name: str, cells: list[tuple[str, Samples]]) -> None:
    """Draw the objects and their speckle above, and for every model (title, samples) the pictures that came back."""
    first = cells[0][1]
    lines: list[tuple[str, Any, Any]] = [
        ("shown to the fibre", first.pictures, None),
        ("speckle behind it", first.shown, None),
    ]
    for title, each in cells:
        lines += [("" if i else title, each.given_back[:, i], each.clicks[:, i]) for i in range(SAMPLES)]
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
    figure.suptitle(
        f"{name}: the first held-out digit of every class, {SAMPLES} single shots each (SIMULATED)", fontsize=9
    )
    save_figure(figure, path)


# ---- trained rows ----


def confusions(path: Path, rows: Rows, name: str) -> None:
    """Draw one matrix per row of a table, all images: true class down, decision across, numbers in % of the true class."""
    figure, panels = new_figure(width=13.5, height=8.6, panels=4, rows=2)
    axes = panels.ravel()
    for place, (axis, row) in enumerate(zip(axes, rows)):
        matrix, classes = np.array(row["matrix"]), row["classes"]
        axis.imshow(matrix, cmap="Blues", vmin=0, vmax=1)
        for (i, j), share in np.ndenumerate(matrix):
            if share >= 0.01:
                ink = "white" if share > 0.55 else "black"
                axis.text(j, i, f"{100 * share:.0f}", ha="center", va="center", fontsize=6.5, color=ink)
        axis.set_xticks(range(len(classes)), classes, rotation=90, fontsize=7)
        axis.set_yticks(range(len(classes)), classes if place % 4 == 0 else [""] * len(classes), fontsize=7)
        light = f"{row['clicks']:.1f} clicks, {row['photons']:.0f} photons"
        axis.set_title(
            f"d_f = {row['features']}: {row['value']:.1f} % (first {FIRST_OBJECTS}: {row['first_200']:.1f} %)\n{light}",
            fontsize=8.5,
        )
    for axis in axes[len(rows) :]:
        axis.set_axis_off()
    words = "K = 1, all 10 000 test images; true class down, decision across, numbers in % from 1 % on (SIMULATED)"
    figure.suptitle(f"{name}, {words}", fontsize=10)
    save_figure(figure, path)


# ---- single shots ----


def _click_frame(word: str) -> Image:
    shape = SHAPES.get(len(word), (1, len(word)))
    return np.kron(np.array([float(bit) for bit in word]).reshape(shape), np.ones((CELL, CELL)))


def _mosaic(tiles: Sequence[Sequence[Image]], gap: float = 0.45) -> Image:
    """Return tiles of equal shape side by side, one point of brightness `gap` apart."""
    return np.block([[np.pad(tile, (0, 1), constant_values=gap) for tile in line] for line in tiles])[:-1, :-1]


def _middles(count: int, size: int) -> list[float]:
    """Return the middles of the tiles of a mosaic, along one side."""
    return [(size + 1) * i + (size - 1) / 2 for i in range(count)]


def click_frames(path: Path, shown: Rows) -> None:
    """Draw the images, and below them the clicks of several trials for every d_f (white: a click)."""
    figure, panels = new_figure(width=11.0, height=1.6 + 2.7 * len(shown), panels=1, rows=1 + len(shown))
    images = [np.array(image) / 255 for image in shown[0]["images"]]
    panels[0].imshow(_mosaic([images]), cmap="gray", vmin=0, vmax=1)
    panels[0].set_xticks(
        _middles(len(images), images[0].shape[1]), [one["class"] for one in shown[0]["objects"]], fontsize=8
    )
    panels[0].xaxis.tick_top()
    panels[0].set_yticks([])
    for axis, one in zip(panels[1:], shown):
        tiles = [[_click_frame(each["words"][trial]) for each in one["objects"]] for trial in range(FRAME_TRIALS)]
        axis.imshow(_mosaic(tiles), cmap="gray", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
        height, width = tiles[0][0].shape
        axis.set_yticks(_middles(FRAME_TRIALS, height), [f"trial {i + 1}" for i in range(FRAME_TRIALS)], fontsize=8)
        labels = [f"{each['clicks']:.1f} clicks\n{each['photons']:.0f} photons" for each in one["objects"]]
        axis.set_xticks(_middles(len(labels), width), labels, fontsize=7)
        axis.set_title(f"d_f = {one['features']}", fontsize=9)
    words = "first test image of every class; clicks of single shots (white), expected clicks and photons (SIMULATED)"
    figure.suptitle(words, fontsize=10)
    save_figure(figure, path)


def pipeline(path: Path, one: Row, name: str) -> None:
    """Draw one image, the patterns, and of several trials the clicks, the outputs and the decision (green: right)."""
    from matplotlib import pyplot

    use_files_alone()
    classes = one["classes"]
    label = classes.index(name)
    shot, image = one["objects"][label], np.array(one["images"][label])
    figure = pyplot.figure(figsize=(10.5, 7.0), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1, 1.55))
    above, below = halves[0].subplots(2, 1, height_ratios=(1, 2.2))
    above.imshow(image, cmap="gray", vmin=0, vmax=255)
    above.set_title(f"{name}, test image {shot['object']}", fontsize=9)
    shape = SHAPES.get(one["features"], (1, one["features"]))
    patterns = np.sqrt(one["patterns"].reshape(*shape, *image.shape))
    below.imshow(_mosaic(patterns / patterns.max()), cmap="inferno", vmin=0, vmax=1)
    below.set_title(f"the {one['features']} patterns (brightness: square root of the light)", fontsize=9)
    for axis in (above, below):
        axis.set_axis_off()
    for trial, (frame, bars) in enumerate(halves[1].subplots(PIPELINE_TRIALS, 2, width_ratios=(1, 4))):
        frame.imshow(_click_frame(shot["words"][trial]), cmap="gray", vmin=0, vmax=1)
        frame.set(xticks=[], yticks=[])
        frame.set_ylabel(f"trial {trial + 1}", fontsize=8)
        decided, last = shot["decided"][trial], trial == PIPELINE_TRIALS - 1
        colours = ["C2" if i == label else "C3" if i == decided else "C7" for i in range(len(classes))]
        bars.bar(range(len(classes)), shot["outputs"][trial], color=colours)
        bars.set(ylim=(0, 1.05), yticks=[0, 0.5, 1])
        bars.set_xticks(range(len(classes)), classes if last else [], rotation=60, fontsize=7)
        bars.set_title(f"decided: {classes[decided]}", fontsize=8, color="C2" if decided == label else "C3", pad=2)
    words = f"d_f = {one['features']}, single shots: clicks (white) and outputs (softmax; green: the true class)"
    figure.suptitle(f"FashionMNIST, {words} (SIMULATED)", fontsize=10)
    save_figure(figure, path)


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
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    words = f"{len(one['objects'][0]['decided'])} single shots of the first test image of every class (bold)"
    figure.suptitle(f"FashionMNIST, d_f = {one['features']}: {words} (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def shot_maps(path: Path, shown: Rows) -> None:
    """Draw t-SNE maps of single shots, one panel per d_f."""
    titles = [f"d_f = {one['features']}: neighbours tell {100 * one['near']['map']:.0f} %" for one in shown]
    panels = [{"map": one["places"], "labels": one["labels"], "title": title} for one, title in zip(shown, titles)]
    _maps(path, panels, shown[0]["classes"], len(panels), "t-SNE of single shots of FashionMNIST test images")


def readout_maps(path: Path, panels: Rows, classes: Sequence[str]) -> None:
    """Draw t-SNE maps of readouts: ways across where there are two, levels of photons across otherwise."""
    drawn = [
        row | {"title": f"{row['way']}, {row['asked']:g} photons: neighbours tell {row['neighbours']:.0f} %"}
        for row in panels
    ]
    across = 2 if len({row["way"] for row in panels}) > 1 else len(panels)
    _maps(path, drawn, classes, across, "t-SNE of one readout of each test image")


def _maps(path: Path, panels: Rows, classes: Sequence[str], across: int, title: str) -> None:
    down = -(-len(panels) // across)
    figure, axes = new_figure(width=4.6 * across, height=4.4 * down + 0.6, panels=across, rows=down)
    flat = list(np.atleast_1d(axes).ravel())
    for axis, panel in zip(flat, panels):
        places, labels = np.array(panel["map"]), np.array(panel["labels"])
        for label, name in enumerate(classes):
            axis.scatter(*places[labels == label].T, s=8, color=f"C{label}", label=name)
        axis.set(xticks=[], yticks=[])
        axis.set_title(panel["title"], fontsize=9)
    figure.legend(*flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8, markerscale=2)
    figure.suptitle(f"{title} (SIMULATED)", fontsize=9)
    save_figure(figure, path)


# ---- frames, information and the alternatives ----


def frames(path: Path, classes: Sequence[str], shown: dict[float, NDArray[np.float32]]) -> None:
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


# ---- trainings, cells in passing, the frontier ----


def sequence(path: Path, found: Row, margin: float) -> None:
    """Draw a strip of passing cells, the clicks of every frame, the outputs, and truth beside decision; `margin` is half a window."""
    words, outputs_of, strip = np.array(found["words"]), np.array(found["outputs"]), np.array(found["strip"]).T
    n, n_bits = len(words), 10
    figure, axes = new_figure(width=11.0, height=6.4, panels=1, rows=4)
    bright = {"vmin": 0, "vmax": float(np.quantile(strip, 0.995))}
    axes[0].imshow(strip, cmap="gray", aspect="auto", extent=(-margin, n + margin, 0, 1), **bright)
    axes[0].set(yticks=[], ylabel="strip")
    bits = words[None, :] >> np.arange(n_bits)[:, None] & 1
    axes[1].imshow(bits, cmap="gray_r", aspect="auto", interpolation="nearest", extent=(0, n, n_bits, 0))
    axes[1].set(ylabel="pattern", yticks=[0.5, n_bits - 0.5], yticklabels=["1", str(n_bits)])
    for label, (name, colour) in enumerate(zip(found["classes"], CELLS)):
        axes[2].plot(np.arange(n) + 0.5, outputs_of[:, label], color=colour, lw=0.9, label=name)
        for y, labels in ((1, np.array(found["truth"])), (0, outputs_of.argmax(axis=1))):
            at = np.flatnonzero(labels == label)
            axes[3].scatter(at + 0.5, np.full(len(at), y), color=colour, marker="|", s=60, lw=1.2)
    axes[2].set(ylabel="outputs", ylim=(0, 1))
    axes[3].set(yticks=[0, 1], yticklabels=["decided", "truth"], ylim=(-0.6, 1.6), xlabel="frame")
    for axis in axes:
        axis.set_xlim(0, n)
    figure.legend(*axes[2].get_legend_handles_labels(), loc="outside lower center", ncols=len(CELLS), fontsize=8)
    words_above = "cells in passing, one shot of ten patterns per frame; truth is empty in between (SIMULATED)"
    figure.suptitle(words_above, fontsize=10)
    save_figure(figure, path)


def patterns(path: Path, lines: dict[str, Image], title: str) -> None:
    """Draw patterns (n, pixels), one line per key with its own scale, by the root of the light; above each its sum."""
    figure, axes = new_figure(
        1.1 * len(next(iter(lines.values()))) + 1, 1.35 * len(lines) + 0.6, len(next(iter(lines.values()))), len(lines)
    )
    for across, (label, shown) in zip(np.atleast_2d(axes), lines.items()):
        for axis, pattern in zip(across, shown):
            root = np.sqrt(pattern).reshape(math.isqrt(pattern.size), -1)
            axis.imshow(root, cmap="magma", vmin=0, vmax=max(float(np.sqrt(shown.max())), 1e-12))
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"{pattern.sum():.3g}", fontsize=7)
        across[0].set_ylabel(label, fontsize=8)
    figure.suptitle(f"{title} (SIMULATED)", fontsize=9)
    save_figure(figure, path)
