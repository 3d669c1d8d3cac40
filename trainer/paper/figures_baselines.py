"""Plots of the alternatives to PANS, as small PNG files (extra `plot`).

Owns axes and colours; never measures. Every function writes one file, beside its place first, and closes its figure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.trainer.figures import new_figure, save_figure
from pans.trainer.paper_tables import ActiveRow

PANS, ENVELOPE = "PANS", "end-to-end, envelope"
Rows = list[dict[str, Any]]


def paradigms(path: Path, rows: Rows, paper: tuple[ActiveRow, ...]) -> None:
    """Draw accuracy as the paper does (PANS over clicks, the others over photons), over photons, and over illumination."""
    figure, (left, middle, right) = new_figure(width=15.0, height=5.6, panels=3)
    ways = list(dict.fromkeys(row["way"] for row in rows))
    for panel, axis in enumerate((left, middle, right)):
        for number, way in enumerate(ways):
            mine = [row for row in rows if row["way"] == way]
            of = (lambda row: row["first_200"]) if panel == 0 else (lambda row: row)
            key = "illumination" if panel == 2 else "clicks_mean" if panel == 0 and way == PANS else "photons_mean"
            points = [(of(row)[key], 100 * of(row)["accuracy_mean"]) for row in mine]
            style = {"color": "k", "lw": 2, "ms": 5} if way == PANS else {"color": f"C{number}", "lw": 1.2, "ms": 3}
            axis.plot(*zip(*points), "o--" if "posterior" in way else "o-", label=way, **style)
            for row, point in zip(mine, points) if way == PANS else ():
                axis.annotate(str(row["features"]), point, textcoords="offset points", xytext=(5, -9), fontsize=7)
        axis.set(xscale="log", ylim=(5, 92))
        axis.grid(alpha=0.3)
    clicks = [row.clicks for row in paper]
    left.plot(clicks, [row.simulation[0] for row in paper], "^:", color="r", ms=5, label="the paper's PANS, simulation")
    left.plot(clicks, [row.experiment[0] for row in paper], "s:", color="m", ms=4, label="the paper's PANS, experiment")
    left.set(
        xlabel="PANS: clicks; the others: photons",
        ylabel="accuracy, %",
        title="first 200 test images, as the paper counts",
    )
    middle.set(xlabel="photons detected per decision", title="all test images, at equal photons detected")
    right.set(xlabel="illumination (sum of pattern intensities)", title="all test images, at equal illumination")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    figure.suptitle(
        "FashionMNIST, K = 1; baselines with perfect photon counters, PANS with thresholded detectors (numbers: d_f) (SIMULATED)",
        fontsize=10,
    )
    save_figure(figure, path)


def end_to_end(path: Path, rows: Rows) -> None:
    """Draw one curve per number of patterns, light to dark, and the envelope as a thick one."""
    from matplotlib import colormaps

    figure, axis = new_figure(width=7.0, height=4.6, panels=1)
    ways = [way for way in dict.fromkeys(row["way"] for row in rows) if way != ENVELOPE]
    for number, way in enumerate(ways):
        mine = [row for row in rows if row["way"] == way]
        colour = colormaps["Greens"](0.3 + 0.65 * number / max(1, len(ways) - 1))
        x, y = [row["photons_mean"] for row in mine], [100 * row["accuracy_mean"] for row in mine]
        axis.plot(x, y, "o-", ms=3, lw=1, color=colour, label=way.removeprefix("end-to-end, "))
    best = [row for row in rows if row["way"] == ENVELOPE]
    axis.plot(
        [r["photons_mean"] for r in best],
        [100 * r["accuracy_mean"] for r in best],
        color="k",
        lw=4,
        alpha=0.35,
        label="envelope",
    )
    axis.axhline(10, color="grey", lw=0.8, ls=":")
    axis.set(xscale="log", xlabel="photons detected per decision", ylabel="accuracy, %")
    axis.set_title("conventional end-to-end, FashionMNIST, all test images (SIMULATED)", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncols=2)
    save_figure(figure, path)


def sensing_training(path: Path, rows: Rows) -> None:
    """Draw loss and accuracy on clean measurements over the epochs, one colour per number of patterns."""
    figure, (left, right) = new_figure(width=10.0, height=4.0)
    for number, row in enumerate(rows):
        epochs, colour = row["epochs"], f"C{number}"
        x = range(1, len(epochs["loss"]) + 1)
        left.plot(x, epochs["loss"], "o-", ms=3, color=colour, label=f"d_f = {row['features']}")
        right.plot(x, epochs["training"], ":", color=colour)
        right.plot(x, epochs["held_out"], "o-", ms=3, color=colour, label=f"d_f = {row['features']}")
    left.set(xlabel="epoch", ylabel="training loss")
    right.set(
        xlabel="epoch", ylabel="accuracy on clean measurements, %", title="dotted: training objects, solid: test images"
    )
    right.title.set_fontsize(9)
    for axis in (left, right):
        axis.grid(alpha=0.3)
    right.legend(fontsize=8, loc="lower right")
    figure.suptitle("compressive sensing, random binary patterns, FashionMNIST (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def sensing_map(path: Path, rows: Rows) -> None:
    """Draw accuracy over the number of patterns (rows) and photons (columns), with the numbers."""
    levels = [cell["photons_asked"] for cell in rows[0]["cells"]]
    values = np.array([[100 * cell["accuracy_mean"] for cell in row["cells"]] for row in rows])
    figure, axis = new_figure(width=6.8, height=4.4, panels=1)
    shown = axis.imshow(values, cmap="viridis", vmin=10, vmax=85, aspect="auto", origin="lower")
    for (y, x), value in np.ndenumerate(values):
        axis.annotate(f"{value:.1f}", (x, y), ha="center", va="center", fontsize=9, color="w" if value < 60 else "k")
    axis.set(
        xticks=range(len(levels)),
        xticklabels=[f"{level:g}" for level in levels],
        xlabel="photons detected per decision",
    )
    axis.set(yticks=range(len(rows)), yticklabels=[str(row["features"]) for row in rows], ylabel="patterns d_f")
    figure.colorbar(shown, label="accuracy, all test images, %")
    axis.set_title("compressive sensing, trained on clean measurements (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def frames(path: Path, classes: tuple[str, ...], shown: dict[float, NDArray[np.floating]]) -> None:
    """Draw frames, `shown` being photons -> (classes, draws, height, width): a row per class, a column per draw."""
    places = [(photons, draw) for photons, drawn in shown.items() for draw in range(drawn.shape[1])]
    height, width = next(iter(shown.values())).shape[2:]
    canvas = np.ones((len(classes) * (height + 2), len(places) * (width + 2)))
    for column, (photons, draw) in enumerate(places):
        for row, frame in enumerate(shown[photons][:, draw]):
            top, left = row * (height + 2) + 1, column * (width + 2) + 1
            canvas[top : top + height, left : left + width] = frame / max(1.0, float(frame.max()))
    figure, axis = new_figure(width=7.6, height=7.4, panels=1)
    axis.imshow(canvas, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axis.set_yticks([(row + 0.5) * (height + 2) for row in range(len(classes))], classes, fontsize=8)
    titles = [f"{photons:g}" for photons, _ in places]
    axis.set_xticks([(column + 0.5) * (width + 2) for column in range(len(places))], titles, fontsize=8)
    axis.tick_params(length=0, top=False, labeltop=True, bottom=False, labelbottom=False)
    axis.set_title("photon counts of single frames; above: photons per frame, on average (SIMULATED)", fontsize=9)
    save_figure(figure, path)


def frame_maps(path: Path, classes: tuple[str, ...], maps: Rows) -> None:
    """Draw t-SNE maps of frames, one panel per photon level, one colour per class."""
    figure, axes = new_figure(width=4.4 * len(maps), height=4.9, panels=len(maps))
    for axis, row in zip(np.atleast_1d(axes), maps):
        place, labels = np.array(row["map"]), np.array(row["labels"])
        for number, name in enumerate(classes):
            axis.scatter(*place[labels == number].T, s=7, color=f"C{number}", label=name)
        axis.set(xticks=[], yticks=[])
        axis.set_title(
            f"{row['photons_asked']:g} photons: neighbours agree for {100 * row['neighbours']:.0f} %", fontsize=9
        )
    handles, labels_ = np.atleast_1d(axes)[0].get_legend_handles_labels()
    figure.legend(handles, labels_, loc="outside lower center", ncols=len(classes), fontsize=8, markerscale=2)
    figure.suptitle(f"t-SNE of {len(maps[0]['labels'])} frames of FashionMNIST test images (SIMULATED)", fontsize=10)
    save_figure(figure, path)
