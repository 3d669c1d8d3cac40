"""Plots of the pages, as small PNG files (extra `plot`): accuracies and other figures over an axis.

Owns axes and colours; never measures. Every function draws the rows of a page into one file, written beside its place first.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pans.trainer.figures import new_figure, save_figure

from .page import Rows, at
from .tables import ACTIVE, FIRST, FIRST_OBJECTS, table_of

PANS, ENVELOPE = "PANS", "end-to-end, envelope"  # ways that are drawn apart from the others
TITLES = {"fashion-mnist": "FashionMNIST", "mnist": "MNIST"}
PARTS = ((FIRST, f"first {FIRST_OBJECTS}"), ("all", "all 10 000"))
SWEEPS = {  # label, where the legend leaves the curves free
    "K": ("shots K", "lower right"),
    "eta": ("light, times the trained", "lower center"),
    "dark": ("dark counts of an exposure", "lower left"),
}
LINE: dict[str, Any] = {"fmt": "o-", "ms": 3.5, "lw": 1.2, "capsize": 2}


def _plot(axis: Any, rows: Rows, x: str, y: str, style: str = "o-", scale: float = 1, **more: Any) -> None:
    """Draw `y` over `x`, dotted paths into the rows."""
    axis.plot([at(row, x) for row in rows], [scale * at(row, y) for row in rows], style, **more)


def _bars(axis: Any, rows: Rows, x: str, part: str, **style: Any) -> None:
    """Draw accuracy in % over `x` with the spread of one trial; `part` is that of the rows, or "paper"."""
    keys = ("simulation", "simulation_std") if part == "paper" else ("accuracy_mean", "accuracy_std")
    scale = 1 if part == "paper" else 100
    values, spreads = ([scale * at(row, f"{part}.{key}") for row in rows] for key in keys)
    axis.errorbar([at(row, x) for row in rows], values, spreads, **LINE | style)


def _finish(figure: Any, axes: Any, path: Path, title: str, legend: str | None = None, **settings: Any) -> None:
    """Set what the axes share, a grid, a legend in each where `legend` says, and save."""
    for axis in np.atleast_1d(axes).ravel():
        axis.set(**settings)
        axis.grid(alpha=0.3)
        if legend and axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=8, loc=legend)
    figure.suptitle(title, fontsize=10)
    save_figure(figure, path)


# ---- tables ----


def accuracy_against_photons(path: Path, name: str, rows: Rows) -> None:
    """Draw the first 200 test images against clicks, as the paper does, and all of them against photons."""
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    figure, (left, right) = new_figure()
    for kind, style in (("simulation", "o--"), ("experiment", "s:")):
        values = [row["paper"][kind][0] for row in rows]
        left.plot([row["paper"]["clicks"] for row in rows], values, style, label=f"paper, {kind}")
    _plot(left, rows, f"{FIRST}.1.clicks_mean", f"{FIRST}.1.accuracy_mean", scale=100, label="ours")
    left.set(xlabel="clicks per decision", title=f"{name}, first {FIRST_OBJECTS} test images, K = 1")
    ordered = sorted(rows, key=lambda row: float(row["all"]["1"]["photons_mean"]))
    for y, label in (("all.1.accuracy_mean", "ours"), ("direct.accuracy_mean", "direct imaging, exact likelihood")):
        _plot(right, ordered, "all.1.photons_mean", y, scale=100, label=label)
    for row in rows:
        one = row["all"]["1"]
        _beside(right, str(row["features"]), one["photons_mean"], 100 * one["accuracy_mean"], (4, -10))
    right.set(xlabel="photons per decision", xscale="log", title="all test images, at equal photons (numbers: d_f)")
    right.margins(0.08)  # so that the numbers at the ends stay inside
    right.xaxis.set_major_locator(FixedLocator([5, 10, 20, 30, 50, 100, 200, 500]))
    right.xaxis.set_minor_locator(NullLocator())
    right.xaxis.set_major_formatter(ScalarFormatter())
    _finish(figure, (left, right), path, "SIMULATED", "best", ylabel="accuracy, %")


def _beside(axis: Any, text: str, x: float, y: float, away: tuple[int, int], **style: Any) -> None:
    axis.annotate(text, (x, y), textcoords="offset points", xytext=away, **{"fontsize": 8} | style)


def measure_over_patterns(path: Path, name: str, rows: Rows) -> None:
    """Draw accuracy or SSIM over the number of patterns, one colour per dark count: ours solid, the paper's dashed."""
    table = table_of(name)
    figure, axis = new_figure(width=6.0, panels=1)
    for i, dark in enumerate(table.dark):
        printed = [row for row in table.rows if row.values]
        axis.plot([r.features for r in printed], [r.values[i] for r in printed], "o--", color=f"C{i}", alpha=0.6)
        if mine := [row for row in rows if row["dark"] == dark]:
            _plot(axis, mine, "features", "value", color=f"C{i}", label=f"dark counts {dark:g}")
    whose = "ours solid, the paper's dashed" if any(row.values for row in table.rows) else "ours"
    unit = "" if table.measure == "SSIM" else ", %"
    _finish(
        figure, axis, path, f"{name}: {whose} (SIMULATED)", "best", xlabel="patterns, d_f", ylabel=table.measure + unit
    )


# ---- trained rows ----


def fig_3(path: Path, rows: Rows) -> None:
    """Draw accuracy over d_f at one shot: the paper's experiment and band of simulation, ours on its images and on all."""
    figure, panels = new_figure(width=11.0, height=4.6)
    for axis, table in zip(panels, ACTIVE):
        mine = [row for row in rows if row["table"] == table]
        x = [row["features"] for row in mine]
        simulation = np.array([row["paper"]["simulation"] for row in mine])
        band = 3 * np.array([row["paper"]["simulation_std"] for row in mine])
        shade = {"color": "C3", "alpha": 0.15, "lw": 0, "label": "paper, simulation, mean ± 3 spreads"}
        axis.fill_between(x, simulation - band, simulation + band, **shade)
        experiment, spread = ([row["paper"][key] for row in mine] for key in ("experiment", "experiment_std"))
        axis.errorbar(x, experiment, spread, fmt="s", ms=5, capsize=3, color="C3", label="paper, experiment")
        for (part, words), colour in zip(PARTS, ("C0", "C2")):
            _bars(axis, mine, "features", part, color=colour, label=f"ours, {words}")
        for row in mine:
            clicks, y = f"{row['all']['clicks_mean']:.1f}", 100 * row["all"]["accuracy_mean"]
            _beside(axis, clicks, row["features"], y, (5, -13), color="C2")
        axis.margins(x=0.1)
        axis.set_title(f"{TITLES[table]}, K = 1")
    title = "bars: spread of one trial; numbers: our clicks per decision, all images (SIMULATED)"
    _finish(figure, panels, path, title, "lower right", xlabel="patterns, d_f", ylabel="accuracy, %")


def multi_shot(path: Path, rows: Rows) -> None:
    """Draw accuracy over d_f x K, one curve per d_f: the paper's simulation, ours on its images, ours on all."""
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    figure, panels = new_figure(width=12.0, height=7.4, panels=3, rows=2)
    sets = (("paper", "paper, simulation"), *((part, f"ours, {words}") for part, words in PARTS))
    for across, table in zip(panels, ACTIVE):
        for axis, (part, whose) in zip(across, sets):
            for i, row in enumerate(ACTIVE[table]):
                curve = [point for point in rows if (point["table"], point["features"]) == (table, row.features)]
                _bars(axis, curve, "detections", part, color=f"C{i}", label=f"d_f = {row.features}")
            axis.set(xscale="log", title=f"{TITLES[table]}: {whose}")
            axis.xaxis.set_major_locator(FixedLocator([2.0**k for k in range(1, 10)]))
            axis.xaxis.set_major_formatter(ScalarFormatter())
            axis.xaxis.set_minor_locator(NullLocator())
            axis.sharey(across[0])
        across[0].set_ylabel("accuracy, %")
        across[2].legend(fontsize=8, loc="lower right")
    title = "K = 1, 2, 3, 5 along each curve; bars: spread of one trial (SIMULATED)"
    _finish(figure, panels, path, title, xlabel="detections, d_f x K")


def robustness(path: Path, rows: Rows, sweep: str) -> None:
    """Draw accuracy over the light or the dark counts, one curve per d_f: the paper's images, and all."""
    label, mark = {"eta": ("light, times the trained (eta)", 1.0), "dark": ("dark counts of an exposure", 0.1)}[sweep]
    figure, panels = new_figure(width=11.0, height=4.8)
    for axis, (part, words) in zip(panels, PARTS):
        for i, row in enumerate(ACTIVE["fashion-mnist"]):
            curve = [point for point in rows if point["features"] == row.features and point["setting"] != "trained"]
            _bars(axis, curve, "setting", part, color=f"C{i}", label=f"d_f = {row.features}")
        axis.axvline(mark, color="grey", lw=0.8, ls=":")
        axis.axhline(10, color="grey", lw=0.8, ls="--")
        axis.set(xscale="log", title=f"FashionMNIST, {words}, K = 1", ylim=(0, 90))
    title = "bars: spread of one trial; dashed: guessing (SIMULATED)"
    _finish(figure, panels, path, title, SWEEPS[sweep][1], xlabel=label, ylabel="accuracy, %")


def sweeps(path: Path, rows: Rows) -> None:
    """Draw accuracy over shots, light and dark counts, of the first 200 and of all test images."""
    figure, panels = new_figure(width=13.0, panels=3)
    for axis, (sweep, (label, free)) in zip(panels, SWEEPS.items()):
        for part, words in PARTS:
            _bars(axis, [row for row in rows if row["sweep"] == sweep], "setting", part, label=words)
        axis.set(xlabel=label, xscale="log")
        axis.legend(loc=free)
    title = "shipped bundle, FashionMNIST, d_f = 10; bars: spread of one trial (SIMULATED)"
    _finish(figure, panels, path, title, ylabel="accuracy, %")


def information(path: Path, rows: Rows) -> None:
    """Draw bits, and Fisher's ratios, over photons: frames and click words."""
    figure, panels = new_figure(width=13.0, panels=3)
    left, middle, right = panels
    for way in ("frames", "click words"):
        mine = [row for row in rows if row["way"] == way]
        _plot(left, [row for row in mine if "bits" in row], "photons", "bits", label=way)
        _plot(middle, mine, "photons", "fisher.trace", label=way)
        right.plot([row["photons"] for row in mine], [row["fisher"]["discriminant"] for row in mine], "o-", label=way)
    left.axhline(np.log2(10), color="grey", lw=0.8, ls=":")  # all there is to know of ten classes
    left.set(ylabel="bits of the label, at least", ylim=(0, 3.5))
    middle.set(ylabel="Fisher: tr(S_b) / tr(S_w)", yscale="log", ylim=(1e-4, 3))
    right.set(ylabel="Fisher: tr(S_w^-1 S_b)")
    title = "what 784 photon counters and ten click words know of the label, FashionMNIST (SIMULATED)"
    _finish(figure, panels, path, title, "best", xlabel="photons per decision", xscale="log")


# ---- the alternatives ----


def paradigms(path: Path, rows: Rows) -> None:
    """Draw accuracy as the paper does (PANS over clicks, the others over photons), over photons, and over illumination."""
    figure, panels = new_figure(width=15.0, height=5.6, panels=3)
    for number, way in enumerate(dict.fromkeys(row["way"] for row in rows)):
        mine, ours = [row for row in rows if row["way"] == way], way == PANS
        style: dict[str, Any] = (
            {"color": "k", "lw": 2, "ms": 5} if ours else {"color": f"C{number}", "lw": 1.2, "ms": 3}
        )
        line = "o--" if "posterior" in way else "o-"
        places = (f"{FIRST}.{'clicks' if ours else 'photons'}_mean", "photons_mean", "illumination")
        for axis, x, y in zip(panels, places, (f"{FIRST}.accuracy_mean", "accuracy_mean", "accuracy_mean")):
            _plot(axis, mine, x, y, line, 100, label=way, **style)
            for row in mine if ours else ():
                _beside(axis, str(row["features"]), at(row, x), 100 * at(row, y), (5, -9), fontsize=7)
    left, middle, right = panels
    paper = ACTIVE["fashion-mnist"]
    for kind, line, colour in (("simulation", "^:", "r"), ("experiment", "s:", "m")):
        values = [getattr(row, kind)[0] for row in paper]
        left.plot([row.clicks for row in paper], values, line, color=colour, ms=4, label=f"the paper's PANS, {kind}")
    words = "first 200 test images, as the paper counts"
    left.set(xlabel="PANS: clicks; the others: photons", ylabel="accuracy, %", title=words)
    middle.set(xlabel="photons detected per decision", title="all test images, at equal photons detected")
    right.set(xlabel="illumination (sum of pattern intensities)", title="all test images, at equal illumination")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    title = "FashionMNIST, K = 1; baselines with perfect photon counters, PANS with thresholded detectors (numbers: d_f) (SIMULATED)"
    _finish(figure, panels, path, title, xscale="log", ylim=(5, 92))


def end_to_end(path: Path, rows: Rows) -> None:
    """Draw one curve per number of patterns, light to dark, and the envelope as a thick one."""
    from matplotlib import colormaps

    figure, axis = new_figure(width=7.0, height=4.6, panels=1)
    of_way = {way: [row for row in rows if row["way"] == way] for way in dict.fromkeys(row["way"] for row in rows)}
    for number, (way, mine) in enumerate(of_way.items()):
        green = colormaps["Greens"](0.3 + 0.65 * number / max(1, len(of_way) - 2))
        style: dict[str, Any] = {"color": green, "lw": 1, "style": "o-"}
        if way == ENVELOPE:
            style = {"color": "k", "lw": 4, "alpha": 0.35, "style": "-"}
        label = way.removeprefix("end-to-end, ")
        _plot(axis, mine, "photons_mean", "accuracy_mean", scale=100, ms=3, label=label, **style)
    axis.axhline(10, color="grey", lw=0.8, ls=":")
    axis.set(xscale="log", xlabel="photons detected per decision", ylabel="accuracy, %")
    axis.legend(fontsize=8, ncols=2)
    _finish(figure, axis, path, "conventional end-to-end, FashionMNIST, all test images (SIMULATED)")


def sensing_training(path: Path, rows: Rows) -> None:
    """Draw loss and accuracy on clean measurements over the epochs, one colour per number of patterns."""
    figure, (left, right) = new_figure(width=10.0, height=4.0)
    for number, row in enumerate(rows):
        epochs, style = row["epochs"], {"color": f"C{number}", "ms": 3}
        x = range(1, len(epochs["loss"]) + 1)
        left.plot(x, epochs["loss"], "o-", label=f"d_f = {row['features']}", **style)
        right.plot(x, epochs["training"], ":", **style)
        right.plot(x, epochs["held_out"], "o-", label=f"d_f = {row['features']}", **style)
    left.set(ylabel="training loss")
    right.set(ylabel="accuracy on clean measurements, %", title="dotted: training objects, solid: test images")
    right.legend(fontsize=8, loc="lower right")
    title = "compressive sensing, random binary patterns, FashionMNIST (SIMULATED)"
    _finish(figure, (left, right), path, title, xlabel="epoch")


# ---- the course of trainings ----


def courses(path: Path, rows: Rows) -> None:
    """Draw training and held-out accuracy and illumination over the epochs, one panel per training (paper's colours)."""
    figure, axes = new_figure(width=3.1 * len(rows) + 0.6, height=3.3, panels=len(rows))
    panels = list(np.atleast_1d(axes))
    lowest = min(min(row["epochs"]["held_out"]) for row in rows)
    for axis, row in zip(panels, rows):
        epochs = row["epochs"]
        x = range(1, len(epochs["training"]) + 1)
        lines = axis.plot(x, epochs["training"], color="C0", label="training objects")
        lines += axis.plot(x, epochs["held_out"], color="C1", label="test images")
        illumination = axis.twinx()
        lines += illumination.plot(x, epochs["illumination"], "--", color="C2", label="illumination (right)")
        illumination.set_ylim(0, 1.15 * max(epochs["illumination"]))
        illumination.tick_params(axis="y", labelcolor="C2", labelsize=8)
        axis.set_title(f"d_f = {row['features']}, alpha = {row['alpha']:g}", fontsize=9)
        if axis is panels[0]:
            axis.set_ylabel("accuracy, %")
            axis.legend(handles=lines, fontsize=7, loc="lower right")
    illumination.set_ylabel("illumination, photoelectrons", color="C2", fontsize=8)
    title = "FashionMNIST, K = 1, one draw of clicks after every epoch (SIMULATED)"
    _finish(figure, panels, path, title, xlabel="epoch", ylim=(lowest - 2, 92))
