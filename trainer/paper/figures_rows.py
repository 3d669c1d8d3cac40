"""Plots over all rows of the active tables, as small PNG files (extra `plot`).

Owns axes and colours; never measures. Every function writes one file, beside its place first, and closes its figure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pans.trainer.figures import new_figure, save_figure
from pans.trainer.paper_tables import ACTIVE, FIRST_OBJECTS

FIRST = f"first_{FIRST_OBJECTS}"
TITLES = {"fashion-mnist": "FashionMNIST", "mnist": "MNIST"}


def multi_shot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw accuracy over d_f x K, one curve per d_f: the paper's simulation, ours on its images, ours on all."""
    figure, panels = new_figure(width=12.0, height=7.4, panels=3, rows=2)
    for across, table in zip(panels, ACTIVE):
        mine = [row for row in rows if row["table"] == table]
        for axis, whose in zip(across, ("paper, simulation", f"ours, first {FIRST_OBJECTS}", "ours, all 10 000")):
            for i, row in enumerate(ACTIVE[table]):
                curve = [point for point in mine if point["features"] == row.features]
                part = FIRST if "first" in whose else "all"
                values = [_value(point, whose, part) for point in curve]
                axis.errorbar(
                    [point["detections"] for point in curve],
                    [value for value, _ in values],
                    [spread for _, spread in values],
                    fmt="o-",
                    ms=3.5,
                    lw=1.2,
                    capsize=2,
                    color=f"C{i}",
                    label=f"d_f = {row.features}",
                )
            axis.set(xscale="log", xlabel="detections, d_f x K", title=f"{TITLES[table]}: {whose}")
            plain_ticks(axis)
            axis.grid(alpha=0.3)
        low = min((axis.get_ylim()[0] for axis in across), default=0.0)
        for axis in across:
            axis.set_ylim(low, max(other.get_ylim()[1] for other in across))
        across[0].set_ylabel("accuracy, %")
        across[2].legend(fontsize=8, loc="lower right")
    figure.suptitle("K = 1, 2, 3, 5 along each curve; bars: spread of one trial (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def _value(point: dict[str, Any], whose: str, part: str) -> tuple[float, float]:
    if whose.startswith("paper"):
        return point["paper"]["simulation"], point["paper"]["simulation_std"]
    return 100 * point[part]["accuracy_mean"], 100 * point[part]["accuracy_std"]


def plain_ticks(axis: Any) -> None:
    """Name powers of two on a logarithmic axis of detections, none between."""
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    axis.xaxis.set_major_locator(FixedLocator([2.0**k for k in range(1, 10)]))
    axis.xaxis.set_major_formatter(ScalarFormatter())
    axis.xaxis.set_minor_locator(NullLocator())


def fig_3(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw accuracy over d_f at one shot: the paper's experiment and band of simulation, ours on its images and on all."""
    figure, panels = new_figure(width=11.0, height=4.6)
    for axis, table in zip(panels, ACTIVE):
        mine = [row for row in rows if row["table"] == table]
        x = [row["features"] for row in mine]
        simulation = [row["paper"]["simulation"] for row in mine]
        band = [3 * row["paper"]["simulation_std"] for row in mine]
        axis.fill_between(
            x,
            [value - width for value, width in zip(simulation, band)],
            [value + width for value, width in zip(simulation, band)],
            color="C3",
            alpha=0.15,
            lw=0,
            label="paper, simulation, mean ± 3 spreads",
        )
        experiment = [row["paper"]["experiment"] for row in mine]
        spread = [row["paper"]["experiment_std"] for row in mine]
        axis.errorbar(x, experiment, spread, fmt="s", ms=5, capsize=3, color="C3", label="paper, experiment")
        for part, colour, words in ((FIRST, "C0", f"ours, first {FIRST_OBJECTS}"), ("all", "C2", "ours, all 10 000")):
            y = [100 * row[part]["accuracy_mean"] for row in mine]
            bars = [100 * row[part]["accuracy_std"] for row in mine]
            axis.errorbar(x, y, bars, fmt="o-", ms=4, capsize=3, color=colour, label=words)
        for row in mine:
            axis.annotate(
                f"{row['all']['clicks_mean']:.1f}",
                (row["features"], 100 * row["all"]["accuracy_mean"]),
                textcoords="offset points",
                xytext=(5, -13),
                fontsize=8,
                color="C2",
            )
        axis.margins(x=0.1)
        axis.set(xlabel="patterns, d_f", ylabel="accuracy, %", title=f"{TITLES[table]}, K = 1")
        axis.grid(alpha=0.3)
        axis.legend(loc="lower right", fontsize=9)
    figure.suptitle("bars: spread of one trial; numbers: our clicks per decision, all images (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def robustness(path: Path, rows: list[dict[str, Any]], sweep: str) -> None:
    """Draw accuracy over the light or the dark counts, one curve per d_f: the paper's images, and all."""
    label, mark = {"eta": ("light, times the trained (eta)", 1.0), "dark": ("dark counts of an exposure", 0.1)}[sweep]
    figure, panels = new_figure(width=11.0, height=4.8)
    swept = [row for row in rows if row["setting"] != "trained"]
    for axis, (part, words) in zip(panels, ((FIRST, f"first {FIRST_OBJECTS}"), ("all", "all 10 000"))):
        for i, row in enumerate(ACTIVE["fashion-mnist"]):
            curve = [point for point in swept if point["features"] == row.features]
            axis.errorbar(
                [point["setting"] for point in curve],
                [100 * point[part]["accuracy_mean"] for point in curve],
                [100 * point[part]["accuracy_std"] for point in curve],
                fmt="o-",
                ms=3,
                lw=1.1,
                capsize=2,
                color=f"C{i}",
                label=f"d_f = {row.features}",
            )
        axis.axvline(mark, color="grey", lw=0.8, ls=":")
        axis.axhline(10, color="grey", lw=0.8, ls="--")
        axis.set(xscale="log", xlabel=label, ylabel="accuracy, %", title=f"FashionMNIST, {words}, K = 1", ylim=(0, 90))
        axis.grid(alpha=0.3)
    panels[1].legend(fontsize=8, loc="lower center" if sweep == "eta" else "lower left")
    figure.suptitle("bars: spread of one trial; dashed: guessing (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def confusions(path: Path, rows: list[dict[str, Any]], table: str) -> None:
    """Draw one matrix per row of a table, all images: true class down, decision across, numbers in % of the true class."""
    figure, panels = new_figure(width=13.5, height=8.6, panels=4, rows=2)
    axes = panels.ravel()
    shown = None
    for place, (axis, row) in enumerate(zip(axes, rows)):
        matrix, classes = row["all"]["matrix"], row["classes"]
        shown = axis.imshow(matrix, cmap="Blues", vmin=0, vmax=1)
        for i, line in enumerate(matrix):
            for j, share in enumerate(line):
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
    figure.suptitle(
        f"{TITLES[table]}, K = 1, all 10 000 test images; decision across, numbers in % from 1 % on (SIMULATED)",
        fontsize=10,
    )
    save_figure(figure, path)
