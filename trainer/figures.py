"""Plots of results, as small PNG files (extra `plot`).

Owns axes and colours; never measures. Every function writes one file, beside its place first, and closes its figure.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from .paper_tables import PASSIVE, UNPRINTED, ActiveRow, PassiveRow

DPI = 90


def use_files_alone() -> None:
    """Choose the back end of matplotlib that needs no screen."""
    import matplotlib

    matplotlib.use("Agg")


def new_figure(width: float = 10.0, height: float = 4.0, panels: int = 2, rows: int = 1) -> tuple[Any, Any]:
    use_files_alone()
    from matplotlib import pyplot

    return pyplot.subplots(rows, panels, figsize=(width, height), layout="constrained")


def save_figure(figure: Any, path: Path) -> None:
    from matplotlib import pyplot

    beside = path.with_name(path.name + ".part")
    figure.savefig(beside, dpi=DPI, format="png")
    pyplot.close(figure)
    os.replace(beside, path)


def accuracy_against_photons(path: Path, name: str, done: list[tuple[ActiveRow, dict[str, Any]]]) -> None:
    """Draw the first 200 test images against clicks, as the paper does, and all of them against photons."""
    from matplotlib.ticker import ScalarFormatter

    figure, (left, right) = new_figure()
    clicks = [figures["first_200"]["1"]["clicks_mean"] for _, figures in done]
    left.plot([row.clicks for row, _ in done], [row.simulation[0] for row, _ in done], "o--", label="paper, simulation")
    left.plot([row.clicks for row, _ in done], [row.experiment[0] for row, _ in done], "s:", label="paper, experiment")
    left.plot(clicks, [100 * f["first_200"]["1"]["accuracy_mean"] for _, f in done], "o-", label="ours")
    left.set(xlabel="clicks per decision", ylabel="accuracy, %", title=f"{name}, first 200 test images, K = 1")
    photons = [figures["all"]["1"]["photons_mean"] for _, figures in done]
    order = sorted(range(len(done)), key=photons.__getitem__)
    for kind, label in (("all", "ours"), ("direct", "direct imaging, exact likelihood")):
        values = [100 * (f["all"]["1"] if kind == "all" else f[kind])["accuracy_mean"] for _, f in done]
        right.plot([photons[i] for i in order], [values[i] for i in order], "o-", label=label)
    for (row, figures), x in zip(done, photons):
        right.annotate(
            str(row.features),
            (x, 100 * figures["all"]["1"]["accuracy_mean"]),
            textcoords="offset points",
            xytext=(4, -10),
        )
    right.set(xlabel="photons per decision", xscale="log", title="all test images, at equal photons (numbers: d_f)")
    right.xaxis.set_major_formatter(ScalarFormatter())
    right.xaxis.set_minor_formatter(ScalarFormatter())
    for axis in (left, right):
        axis.grid(alpha=0.3)
        axis.legend()
    figure.suptitle("SIMULATED", fontsize=9)
    save_figure(figure, path)


def measure_over_patterns(path: Path, name: str, done: list[tuple[PassiveRow, dict[str, Any]]]) -> None:
    """Draw accuracy or SSIM over the number of patterns, one colour per dark count: ours solid, the paper's dashed."""
    table = PASSIVE.get(name) or UNPRINTED[name]
    figure, axis = new_figure(width=6.0, panels=1)
    for i, dark in enumerate(table.dark):
        measured = [(row, figures) for row, figures in done if figures["dark"] == dark]
        printed = [row for row in table.rows if row.values]
        axis.plot([r.features for r in printed], [r.values[i] for r in printed], "o--", color=f"C{i}", alpha=0.6)
        if measured:
            x, y = [row.features for row, _ in measured], [figures["value"] for _, figures in measured]
            axis.plot(x, y, "o-", color=f"C{i}", label=f"dark counts {dark:g}")
    axis.set(xlabel="patterns", ylabel=table.measure, title=f"{name}: ours solid, the paper's dashed (SIMULATED)")
    axis.grid(alpha=0.3)
    if done:
        axis.legend()
    save_figure(figure, path)
