"""Draws docs/pictures/frontier.png from docs/results/frontier.json: FashionMNIST accuracy by photons and by light sent. SIMULATED.

python docs/pictures/frontier.py       (extras `train` and `plot`)

A curve joins the points of its kind that no other of the kind beats with less; bars are two standard errors. docs/results/frontier.md has
all points.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from matplotlib.ticker import NullFormatter

from pans_trainer.figures import new_figure, save_figure
from pans_trainer.reproduce.curves import error_of

HERE = Path(__file__).parent
# name, colour, and where the name stands in each panel (x, accuracy, horizontal alignment)
CURVES = {
    "adaptive,\nfew photons": ("#d1495b", (0.45, 88, "left"), (230, 66, "left")),
    "adaptive,\nlittle light": ("#7b3fa0", (3.6, 55, "right"), (4.5, 89, "left")),
    "camera": ("#1f6fb2", (3.0, 37, "right"), (16, 37, "left")),
    "fixed patterns": ("#a86400", (14, 58, "left"), (36, 52, "left")),
}
AXES = {"photons": "photons detected", "illumination": "light sent (illumination)"}


def curve_of(way: str) -> int | None:
    """The curve that a way of the frontier belongs to."""
    if "automaton" in way:
        return int("light sent" in way or "both" in way)
    return 2 if way.startswith("direct, stops") else 3 if way.startswith("ours, fixed, held") else None


def front(points: list[dict[str, Any]], axis: str) -> list[dict[str, Any]]:
    """The points that are better than all with less."""
    best: list[dict[str, Any]] = []
    for point in sorted(points, key=lambda point: (point[axis], -point["value"])):
        if not best or point["value"] > best[-1]["value"]:
            best.append(point)
    return best


def main() -> None:
    """Draw both panels."""
    table = json.loads((HERE.parent / "results/frontier.json").read_text())["tables"]["fashion-mnist"]
    rows = [dict(zip(table["columns"], row)) for row in table["rows"]]
    figure, axes = new_figure(8.9, 5.2)
    for panel, (axis, (key, label)) in enumerate(zip(axes, AXES.items())):
        for number, (name, (colour, *places)) in enumerate(CURVES.items()):
            points = front([row for row in rows if curve_of(row["way"]) == number], key)
            x, y = ([point[of] for point in points] for of in (key, "value"))
            bars = [2 * error_of(point) for point in points]
            axis.errorbar(x, y, bars, color=colour, lw=2.5, marker="o", ms=5, capsize=3)
            at_x, at_y, side = places[panel]
            axis.text(at_x, at_y, name, color=colour, fontsize=15, ha=side, va="center", weight="bold")
        axis.set(xscale="log", ylim=(30, 95), xlim=((0.4, 420), (4, 3500))[panel])
        axis.set_xlabel(label, fontsize=16)
        ticks = [1, 3, 10, 30, 100, 300] if key == "photons" else [10, 30, 100, 300, 1000]
        axis.set_xticks(ticks, [str(tick) for tick in ticks])
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.tick_params(labelsize=15)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("right decisions, %", fontsize=16)
    axes[1].tick_params(labelleft=False)
    figure.suptitle("SIMULATED: FashionMNIST, mean photoelectrons per decision", fontsize=15)
    save_figure(figure, HERE / "frontier.png")


if __name__ == "__main__":
    main()
