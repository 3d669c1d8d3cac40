"""Pictures of the pages, as small PNG files (extra `plot`): every function draws the rows of a page into one file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.trainer.evaluate.picture_samples import SAMPLES, Samples
from pans.trainer.figures import new_figure, save_figure, use_files_alone

from .page import FIRST_OBJECTS, Row, Rows, of_table
from .printed import ACTIVE, PASSIVE

PANS, ENVELOPE = "PANS", "end-to-end, envelope"  # ways that are drawn apart from the others
TITLES = {"fashion-mnist": "FashionMNIST", "mnist": "MNIST"}
FIRST, ALL = ("first_200", "first_spread"), ("value", "spread_trials")
PARTS = ((FIRST, f"first {FIRST_OBJECTS}"), (ALL, "all 10 000"))
FRAME_TRIALS, PIPELINE_TRIALS = 5, 6
SHAPES = {16: (4, 4), 32: (4, 8)}  # rows and columns of a frame of clicks
CELL = 5  # points of a frame's cell, the gap between frames is one
CELLS = ("C0", "C1", "C2", "0.6")  # classes of cells in passing

Image = NDArray[np.floating]


def _xy(axis: Any, rows: Rows, x: str, y: str, style: str = "o-", **more: Any) -> None:
    axis.plot([row[x] for row in rows], [row[y] for row in rows], style, **more)


def _bars(axis: Any, rows: Rows, x: str, of: tuple[str, str], **style: Any) -> None:
    """Draw a figure over `x` with the spread of one trial; `of` names both."""
    line: dict[str, Any] = {"fmt": "o-", "ms": 3.5, "lw": 1.2, "capsize": 2}
    axis.errorbar([row[x] for row in rows], [row[of[0]] for row in rows], [row[of[1]] for row in rows], **line | style)


def _note(axis: Any, text: str, x: float, y: float, away: tuple[int, int], **style: Any) -> None:
    axis.annotate(text, (x, y), textcoords="offset points", xytext=away, **{"fontsize": 8} | style)


def _ticks(axis: Any, places: Sequence[float]) -> None:
    """Set plain numbers at these places of a logarithmic x axis."""
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    axis.xaxis.set_major_locator(FixedLocator(list(places)))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(ScalarFormatter())


def _finish(figure: Any, axes: Any, path: Path, title: str, legend: str | None = None, **settings: Any) -> None:
    """Set what the axes share, a grid, a legend in each where `legend` says, and save."""
    for axis in np.atleast_1d(axes).ravel():
        axis.set(**settings)
        axis.grid(alpha=0.3)
        if legend and axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=8, loc=legend)
    figure.suptitle(f"{title} (SIMULATED)", fontsize=10)
    save_figure(figure, path)


# ---- tables of the tasks ----


def accuracy_against_photons(path: Path, name: str, rows: Rows) -> None:
    """Draw the first 200 test images against clicks, as the paper does, and all of them against photons."""
    figure, (left, right) = new_figure()
    one = [row for row in of_table(rows, "shots") if row["shots"] == 1]
    for kind, style in (("simulation", "o--"), ("experiment", "s:")):
        _xy(left, one, "paper_clicks", kind, style, label=f"paper, {kind}")
    _xy(left, one, "first_clicks", "first_200", label="ours")
    left.set(xlabel="clicks per decision", title=f"{name}, first {FIRST_OBJECTS} test images, K = 1")
    ordered = sorted(of_table(rows, "direct"), key=lambda row: float(row["photons"]))
    for key, label in (("value", "ours"), ("direct", "direct imaging, exact likelihood")):
        _xy(right, ordered, "photons", key, label=label)
    for row in ordered:
        _note(right, str(row["features"]), row["photons"], row["value"], (4, -10))
    right.set(xlabel="photons per decision", xscale="log", title="all test images, at equal photons (numbers: d_f)")
    _ticks(right, [5, 10, 20, 30, 50, 100, 200, 500])
    _finish(figure, (left, right), path, name, "best", ylabel="accuracy, %")


def measure_over_patterns(path: Path, name: str, rows: Rows) -> None:
    """Draw accuracy or SSIM over the number of patterns, one colour per dark count: ours solid, the paper's dashed."""
    table = PASSIVE[name]
    figure, axis = new_figure(width=6.0, panels=1)
    for i, dark in enumerate(table.dark):
        printed = [row for row in table.rows if row.values]
        axis.plot([r.features for r in printed], [r.values[i] for r in printed], "o--", color=f"C{i}", alpha=0.6)
        if mine := [row for row in rows if row["dark"] == dark]:
            _xy(axis, mine, "features", "value", color=f"C{i}", label=f"dark counts {dark:g}")
    whose = "ours solid, the paper's dashed" if any(row.values for row in table.rows) else "ours"
    unit = "" if table.measure == "SSIM" else ", %"
    _finish(figure, axis, path, f"{name}: {whose}", "best", xlabel="patterns, d_f", ylabel=table.measure + unit)


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


def fibre_field(path: Path, rows: Rows, direct: Rows) -> None:
    """Draw accuracy over the number of detectors beside the paper's for its input, and over photons beside direct imaging."""
    figure, (over, light) = new_figure(width=10.5, panels=2)
    _xy(over, rows, "features", "value", label="ours")
    _xy(over, rows, "features", "paper", "s--", color="0.6", label="the paper, its own input")
    _xy(light, rows, "photons", "value", label="ours, photons detected")
    _xy(light, rows, "reaching", "value", "x:", color="C0", label="ours, must reach the optics")
    _xy(light, direct, "photons", "value", "k-", label="direct imaging")
    over.set(xlabel="detectors, d_f")
    light.set(xlabel="photons per digit", xscale="log")
    title = "digits behind a fibre as a field, W complex and conserving"
    _finish(figure, (over, light), path, title, "lower right", ylabel="accuracy, %")


# ---- trained rows ----


def fig_3(path: Path, rows: Rows) -> None:
    """Draw accuracy over d_f at one shot: the paper's experiment and band of simulation, ours on its images and on all."""
    figure, panels = new_figure(width=11.0, height=4.6)
    for axis, name in zip(panels, ACTIVE):
        mine = [row for row in rows if row["set"] == name]
        x, simulation, band = (
            np.array([row[key] for row in mine]) for key in ("features", "simulation", "simulation_std")
        )
        shade = {"color": "C3", "alpha": 0.15, "lw": 0, "label": "paper, simulation, mean ± 3 spreads"}
        axis.fill_between(x, simulation - 3 * band, simulation + 3 * band, **shade)
        _bars(axis, mine, "features", ("experiment", "experiment_std"), fmt="s", color="C3", label="paper, experiment")
        for (of, words), colour in zip(PARTS, ("C0", "C2")):
            _bars(axis, mine, "features", of, color=colour, label=f"ours, {words}")
        for row in mine:
            _note(axis, f"{row['clicks']:.1f}", row["features"], row["value"], (5, -13), color="C2")
        axis.set_title(f"{TITLES[name]}, K = 1")
    title = "bars: spread of one trial; numbers: our clicks per decision, all images"
    _finish(figure, panels, path, title, "lower right", xlabel="patterns, d_f", ylabel="accuracy, %")


def multi_shot(path: Path, rows: Rows) -> None:
    """Draw accuracy over d_f x K, one curve per d_f: the paper's simulation, ours on its images, ours on all."""
    figure, panels = new_figure(width=12.0, height=7.4, panels=3, rows=2)
    sets = ((("simulation", "simulation_std"), "paper, simulation"), *((of, f"ours, {words}") for of, words in PARTS))
    for across, name in zip(panels, ACTIVE):
        for axis, (of, whose) in zip(across, sets):
            for i, row in enumerate(ACTIVE[name]):
                curve = [point for point in rows if (point["set"], point["features"]) == (name, row.features)]
                _bars(axis, curve, "detections", of, color=f"C{i}", label=f"d_f = {row.features}")
            axis.set(xscale="log", title=f"{TITLES[name]}: {whose}")
            _ticks(axis, [2.0**k for k in range(1, 10)])
            axis.sharey(across[0])
        across[0].set_ylabel("accuracy, %")
        across[2].legend(fontsize=8, loc="lower right")
    _finish(
        figure, panels, path, "K = 1, 2, 3, 5 along each curve; bars: spread of one trial", xlabel="detections, d_f x K"
    )


def robustness(path: Path, rows: Rows, sweep: str) -> None:
    """Draw accuracy over the light or the dark counts, one curve per d_f: the paper's images, and all."""
    label, mark = {"eta": ("light, times the trained (eta)", 1.0), "dark": ("dark counts of an exposure", 0.1)}[sweep]
    figure, panels = new_figure(width=11.0, height=4.8)
    for axis, (of, words) in zip(panels, PARTS):
        for i, features in enumerate(dict.fromkeys(row["features"] for row in rows)):
            curve = [point for point in rows if point["features"] == features]
            _bars(axis, curve, "setting", of, color=f"C{i}", label=f"d_f = {features}")
        axis.axvline(mark, color="grey", lw=0.8, ls=":")
        axis.axhline(10, color="grey", lw=0.8, ls="--")
        axis.set(xscale="log", title=f"FashionMNIST, {words}, K = 1", ylim=(0, 90))
    free = "lower center" if sweep == "eta" else "lower left"
    _finish(
        figure, panels, path, "bars: spread of one trial; dashed: guessing", free, xlabel=label, ylabel="accuracy, %"
    )


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
    figure.suptitle(f"{TITLES[name]}, {words}", fontsize=10)
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


def information(path: Path, rows: Rows) -> None:
    """Draw bits, and Fisher's ratios, over photons: frames and click words."""
    figure, panels = new_figure(width=13.0, panels=3)
    for way in dict.fromkeys(row["way"] for row in rows):
        mine = [row for row in rows if row["way"] == way]
        for axis, key in zip(panels, ("bits", "trace", "discriminant")):
            _xy(axis, [row for row in mine if row.get(key) is not None], "photons", key, label=way)
    panels[0].axhline(np.log2(10), color="grey", lw=0.8, ls=":")  # all there is to know of ten classes
    panels[0].set(ylabel="bits of the label, at least", ylim=(0, 3.5))
    panels[1].set(ylabel="Fisher: tr(S_b) / tr(S_w)", yscale="log", ylim=(1e-4, 3))
    panels[2].set(ylabel="Fisher: tr(S_w^-1 S_b)")
    title = "what 784 photon counters and ten click words tell of the label, FashionMNIST"
    _finish(figure, panels, path, title, "best", xlabel="photons per decision", xscale="log")


def paradigms(path: Path, rows: Rows) -> None:
    """Draw accuracy as the paper does (PANS over clicks, the others over photons), over photons, and over illumination."""
    figure, panels = new_figure(width=15.0, height=5.6, panels=3)
    for number, way in enumerate(dict.fromkeys(row["way"] for row in rows)):
        mine, ours = [row for row in rows if row["way"] == way], way == PANS
        style: dict[str, Any] = (
            {"color": "k", "lw": 2, "ms": 5} if ours else {"color": f"C{number}", "lw": 1.2, "ms": 3}
        )
        places = ("first_clicks" if ours else "first_photons", "photons", "illumination")
        for axis, x, y in zip(panels, places, ("first_200", "value", "value")):
            _xy(axis, mine, x, y, "o--" if "posterior" in way else "o-", label=way, **style)
            for row in mine if ours else ():
                _note(axis, str(row["features"]), row[x], row[y], (5, -9), fontsize=7)
    for kind, line, colour in (("simulation", "^:", "r"), ("experiment", "s:", "m")):
        printed = ACTIVE["fashion-mnist"]
        values = [getattr(row, kind)[0] for row in printed]
        panels[0].plot(
            [row.clicks for row in printed], values, line, color=colour, ms=4, label=f"the paper's PANS, {kind}"
        )
    panels[0].set(
        xlabel="PANS: clicks; the others: photons",
        ylabel="accuracy, %",
        title="first 200 test images, as the paper counts",
    )
    panels[1].set(xlabel="photons detected per decision", title="all test images, at equal photons detected")
    panels[2].set(xlabel="illumination (sum of pattern intensities)", title="all test images, at equal illumination")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    title = (
        "FashionMNIST, K = 1; baselines with perfect photon counters, PANS with thresholded detectors (numbers: d_f)"
    )
    _finish(figure, panels, path, title, xscale="log", ylim=(5, 92))


def end_to_end(path: Path, rows: Rows) -> None:
    """Draw one curve per number of patterns, light to dark, and the envelope as a thick one."""
    from matplotlib import colormaps

    figure, axis = new_figure(width=7.0, height=4.6, panels=1)
    ways = list(dict.fromkeys(row["way"] for row in rows))
    for number, way in enumerate(ways):
        green = colormaps["Greens"](0.3 + 0.65 * number / max(1, len(ways) - 2))
        style: dict[str, Any] = (
            {"color": "k", "lw": 4, "alpha": 0.35, "style": "-"} if way == ENVELOPE else {"color": green, "lw": 1}
        )
        mine = [row for row in rows if row["way"] == way]
        _xy(axis, mine, "photons", "value", ms=3, label=way.removeprefix("end-to-end, "), **style)
    axis.axhline(10, color="grey", lw=0.8, ls=":")
    axis.set(xscale="log", xlabel="photons detected per decision", ylabel="accuracy, %")
    _finish(figure, axis, path, "conventional end-to-end, FashionMNIST, all test images", "best")


def sensing_map(path: Path, rows: Rows) -> None:
    """Draw accuracy of compressive sensing over the number of patterns (down) and photons (across), with the numbers."""
    levels, features = (list(dict.fromkeys(row[key] for row in rows)) for key in ("photons_asked", "features"))
    values = np.array([row["value"] for row in rows]).reshape(len(features), len(levels))
    figure, axis = new_figure(width=6.8, height=4.4, panels=1)
    shown = axis.imshow(values, cmap="viridis", vmin=10, vmax=85, aspect="auto", origin="lower")
    for (y, x), value in np.ndenumerate(values):
        axis.text(x, y, f"{value:.1f}", ha="center", va="center", fontsize=9, color="w" if value < 60 else "k")
    axis.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
    axis.set_yticks(range(len(features)), [str(each) for each in features])
    axis.set(xlabel="photons detected per decision", ylabel="patterns d_f")
    figure.colorbar(shown, label="accuracy, all test images, %")
    axis.set_title("compressive sensing, trained on clean measurements (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def sensing_training(path: Path, rows: Rows) -> None:
    """Draw loss and accuracy on clean measurements over the epochs, one colour per number of patterns."""
    figure, (left, right) = new_figure(width=10.0, height=4.0)
    for number, row in enumerate(rows):
        epochs, style = row["epochs"], {"color": f"C{number}", "ms": 3}
        x, label = range(1, len(epochs["loss"]) + 1), f"d_f = {row['features']}"
        left.plot(x, epochs["loss"], "o-", label=label, **style)
        right.plot(x, epochs["training"], ":", **style)
        right.plot(x, epochs["held_out"], "o-", label=label, **style)
    left.set(ylabel="training loss")
    right.set(ylabel="accuracy on clean measurements, %", title="dotted: training objects, solid: test images")
    _finish(
        figure, (left, right), path, "compressive sensing, random binary patterns, FashionMNIST", "best", xlabel="epoch"
    )


# ---- trainings, cells in passing, the frontier ----


def courses(path: Path, rows: Rows) -> None:
    """Draw training and held-out accuracy and illumination over the epochs, one panel per training."""
    figure, axes = new_figure(width=3.1 * len(rows) + 0.6, height=3.3, panels=len(rows))
    panels = list(np.atleast_1d(axes))
    for axis, row in zip(panels, rows):
        epochs = row["epochs"]
        x = range(1, len(epochs["training"]) + 1)
        lines = axis.plot(x, epochs["training"], color="C0", label="training objects")
        lines += axis.plot(x, epochs["held_out"], color="C1", label="test images")
        illumination = axis.twinx()
        lines += illumination.plot(x, epochs["illumination"], "--", color="C2", label="illumination (right)")
        illumination.set_ylim(0, 1.15 * max(epochs["illumination"]))
        axis.set_title(f"d_f = {row['features']}, alpha = {row['alpha']:g}", fontsize=9)
        if axis is panels[0]:
            axis.set_ylabel("accuracy, %")
            axis.legend(handles=lines, fontsize=7, loc="lower right")
    lowest = min(min(row["epochs"]["held_out"]) for row in rows)
    title = "FashionMNIST, K = 1, one draw of clicks after every epoch"
    _finish(figure, panels, path, title, xlabel="epoch", ylim=(lowest - 2, 92))


def stages(path: Path, patterns: dict[int, Image], peaks: list[float]) -> None:
    """Draw normalised patterns (mean 1 over all), one row per stage with its own scale, and the largest value over the epochs.

    Above each pattern stands its mean. The colours follow the square root: few pixels hold most of the light.
    """
    from matplotlib import pyplot
    from matplotlib.colors import PowerNorm

    use_files_alone()
    count = len(next(iter(patterns.values())))
    figure = pyplot.figure(figsize=(1.0 * count + 1.2, 1.3 * len(patterns) + 2.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.3 * len(patterns), 2.2))
    axes: Any = parts[0].subplots(len(patterns), count, squeeze=False)
    for line, letter, (after, normal) in zip(axes, "abcdefgh", patterns.items()):
        top = float(normal.max())
        for axis, pattern in zip(line, normal):
            axis.imshow(
                pattern.reshape(math.isqrt(pattern.size), -1), cmap="magma", norm=PowerNorm(0.5, vmin=0, vmax=top)
            )
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"{pattern.mean():.2f}", fontsize=7)
        line[0].set_ylabel(f"{letter}: epoch {after}\nto {top:.0f}", fontsize=8)
    axis = parts[1].subplots()
    axis.plot(range(1, len(peaks) + 1), peaks, "o-", ms=3)
    axis.set(xlabel="epoch", ylabel="largest over mean", ylim=(0, None))
    parts[0].suptitle("patterns over their common mean; numbers: mean of a pattern (SIMULATED)", fontsize=9)
    save_figure(figure, path)


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


def patterns(path: Path, levels: Any, side: int) -> None:
    """Draw patterns (n, side * side), each by the root of its light over its brightest; above each its illumination."""
    shown = np.sqrt(np.array(levels)).reshape(-1, side, side)
    across = (len(shown) + 1) // 2
    figure, axes = new_figure(width=1.9 * across, height=4.2, panels=across, rows=2)
    for axis in axes.ravel():
        axis.set_axis_off()
    for number, (axis, pattern) in enumerate(zip(axes.ravel(), shown)):
        axis.imshow(pattern, cmap="magma", vmin=0, vmax=max(float(pattern.max()), 1e-12))
        axis.set_title(f"{number + 1}: {float(np.sum(levels[number])):.1f}", fontsize=8)
    figure.suptitle("patterns, root of the light; above each: its illumination (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def frontier(path: Path, points: Rows) -> None:
    """Draw a row of two panels per task: accuracy on all images over photons and over clicks, and the paper's points over clicks."""
    figure, panels = new_figure(width=12.5, height=10.5, panels=2, rows=len(TITLES))
    ways = list(dict.fromkeys(row["way"] for row in points))
    for across, name in zip(panels, TITLES):
        for axis, key in zip(across, ("photons", "clicks")):
            for number, way in enumerate(ways):
                curve = sorted((r for r in points if (r["task"], r["way"]) == (name, way)), key=lambda r: float(r[key]))
                errors = [math.hypot(row["error_seeds"] or 0.0, row["error_objects"]) for row in curve]
                style = {
                    "color": f"C{number % 10}",
                    "fmt": "os^Dv"[number // 10] + ("-" if "automaton" in way else "--"),
                }
                x, y = ([row[of] for row in curve] for of in (key, "value"))
                axis.errorbar(x, y, errors, label=way, ms=4, lw=1.2, capsize=2, **style)
            axis.set(xscale="log", xlabel=f"{key} per decision", ylabel="accuracy, %", title=TITLES[name])
            _ticks(axis, [1, 2, 4, 6, 10, 17, 40, 100, 200])
            axis.grid(alpha=0.3)
        printed = ACTIVE[name]
        values = [row.simulation[0] for row in printed]
        across[1].plot(
            [row.clicks for row in printed], values, "kx:", label=f"paper, fixed patterns, first {FIRST_OBJECTS}"
        )
    figure.legend(*panels[0][1].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle("all 10 000 test images; bars: standard errors (SIMULATED)", fontsize=10)
    save_figure(figure, path)
