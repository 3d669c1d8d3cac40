"""Plots over light, shots and dark counts, as small PNG files (extra `plot`).

Owns axes and colours; never measures. Every function writes one file, beside its place first, and closes its figure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pans.trainer.figures import new_figure, save_figure
from pans.trainer.paper_tables import FIRST_OBJECTS

AXES = {  # sweep: label, where the legend leaves the curves free
    "K": ("shots K", "lower right"),
    "eta": ("light, times the trained", "lower center"),
    "dark": ("dark counts of an exposure", "lower left"),
}


def sweeps(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw accuracy over shots, light and dark counts, of the first 200 and of all test images."""
    figure, panels = new_figure(width=13.0, panels=3)
    for axis, (sweep, (label, free)) in zip(panels, AXES.items()):
        mine = [row for row in rows if row["sweep"] == sweep]
        x = [row["setting"] for row in mine]
        for part, words in ((f"first_{FIRST_OBJECTS}", f"first {FIRST_OBJECTS}"), ("all", "all 10 000")):
            y = [100 * row[part]["accuracy_mean"] for row in mine]
            axis.errorbar(x, y, [100 * row[part]["accuracy_std"] for row in mine], fmt="o-", ms=3, label=words)
        axis.set(xlabel=label, xscale="log", ylabel="accuracy, %")
        axis.grid(alpha=0.3)
        axis.legend(loc=free)
    figure.suptitle("shipped bundle, FashionMNIST, d_f = 10; bars: spread of one trial (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def information(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw bits, and Fisher's ratios, over photons: frames and click words."""
    figure, (left, middle, right) = new_figure(width=13.0, panels=3)
    for i, way in enumerate(("frames", "click words")):
        mine = [row for row in rows if row["way"] == way]
        known = [row for row in mine if "bits" in row]
        left.plot([r["photons"] for r in known], [r["bits"] for r in known], "o-", color=f"C{i}", label=way)
        x = [row["photons"] for row in mine]
        middle.plot(x, [row["fisher"]["trace"] for row in mine], "o-", color=f"C{i}", label=way)
        right.plot(x, [row["fisher"]["discriminant"] for row in mine], "o-", color=f"C{i}", label=way)
    left.axhline(3.3219, color="grey", lw=0.8, ls=":")
    left.set(ylabel="bits of the label, at least", ylim=(0, 3.5))
    middle.set(ylabel="Fisher: tr(S_b) / tr(S_w)", yscale="log", ylim=(1e-4, 3))
    right.set(ylabel="Fisher: tr(S_w^-1 S_b)")
    for axis in (left, middle, right):
        axis.set(xlabel="photons per decision", xscale="log")
        axis.grid(alpha=0.3)
        axis.legend()
    figure.suptitle(
        "what 784 photon counters and ten click words know of the label, FashionMNIST (SIMULATED)", fontsize=10
    )
    save_figure(figure, path)
