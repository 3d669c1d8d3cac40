"""The drawings of report pages, as SVG or PNG bytes (extra `plot`).

Owns axes, units and colours; never measures. matplotlib is imported by name when something is drawn: the lean runtime does not know it.
"""

from __future__ import annotations

import importlib
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import UsageError

F64 = NDArray[np.float64]
DPI = 90
PATTERNS_MAX = 64
CLASSES_MAX = 100
LEAST_US = 0.1
DARK_EDGE, CLICK_EDGE = "0.45", "C3"  # of a tree: no click, click


def pyplot(what: str = "a report") -> Any:
    """Return matplotlib.pyplot, which draws into memory; UsageError where it is not installed."""
    try:
        importlib.import_module("matplotlib").use("Agg")
        return importlib.import_module("matplotlib.pyplot")
    except ModuleNotFoundError as error:
        raise UsageError(
            f"{what} needs the package matplotlib, which is not installed", remedy="pip install 'pans-runtime[plot]'"
        ) from error


def _new(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Any, Any]:
    return pyplot().subplots(rows, columns, figsize=(width, height), layout="constrained", squeeze=False)


def _done(figure: Any, form: str = "svg") -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format=form, dpi=DPI, metadata={"Date": None} if form == "svg" else None)
    pyplot().close(figure)
    return stream.getvalue()


def confusion(counts: NDArray[np.int64], classes: Sequence[str]) -> bytes:
    """Draw how often truth (rows) was decided as what (columns); shades are shares of a row."""
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    size = min(9.0, 3.0 + 0.42 * len(classes))
    figure, axes = _new(size + 0.9, size)
    axis = axes[0, 0]
    shown = axis.imshow(share, cmap="Blues", vmin=0, vmax=1)
    if len(classes) <= 20:
        for (row, column), count in np.ndenumerate(counts):
            if count:
                ink = "white" if share[row, column] > 0.55 else "black"
                axis.text(column, row, str(count), ha="center", va="center", fontsize=8, color=ink)
    ticks = range(len(classes)) if len(classes) <= 40 else range(0, len(classes), len(classes) // 20)
    axis.set_xticks(list(ticks), [classes[i] for i in ticks], rotation=60, ha="right")
    axis.set_yticks(list(ticks), [classes[i] for i in ticks])
    axis.set(xlabel="decision", ylabel="truth")
    figure.colorbar(shown, ax=axis, label="share of the truth's decisions", shrink=0.8)
    return _done(figure)


def states_by_slot(slots: Sequence[NDArray[np.float32]], leaves: NDArray[np.float32]) -> bytes:
    """Draw how many states each slot has, the spread of their largest posterior (median and middle half), and that of the leaves."""
    figure, axes = _new(9.0, 4.2, 2, 2)
    (count, empty), (sure, of_leaves) = axes
    slot = np.arange(len(slots))
    count.bar(slot, [len(values) for values in slots], color="C0")
    count.set(ylabel="states", xlim=(-1, len(slots)))
    low, middle, high = np.array([np.quantile(values, (0.25, 0.5, 0.75)) for values in slots]).T
    sure.fill_between(slot, low, high, color="C0", alpha=0.25, lw=0, label="middle half of the states")
    sure.plot(slot, middle, color="C0", label="median")
    sure.set(xlabel="slot", ylabel="largest posterior", xlim=(-1, len(slots)), ylim=(0, 1))
    sure.legend(fontsize=7, loc="upper left")
    of_leaves.hist(leaves, bins=20, range=(0, 1), orientation="horizontal", color="C1")
    of_leaves.set(xlabel="leaves", ylim=(0, 1))
    empty.set_axis_off()
    figure.get_layout_engine().set(wspace=0.05)
    return _done(figure)


def reliability(bins: Sequence[tuple[float, float, float]], title: str) -> bytes:
    """Draw accuracy against the probability that was stated, and how many decisions stated it: (probability, accuracy, share) per bin."""
    figure, axes = _new(5.0, 5.4, 2)
    (upper,), (lower,) = axes
    axes[0, 0].get_gridspec().set_height_ratios([3, 1])
    probability, accuracy, share = (np.array(column) for column in zip(*bins)) if bins else (np.zeros(0),) * 3
    upper.plot([0, 1], [0, 1], color="0.6", lw=1, label="as sure as right")
    upper.plot(probability, accuracy, "o-", color="C0", ms=4, label="decisions")
    upper.set(xlim=(0, 1), ylim=(0, 1), ylabel="accuracy")
    upper.set_title(title, fontsize=9)
    upper.legend(fontsize=8)
    lower.bar(probability, share, width=0.04, color="C0")
    lower.set(xlim=(0, 1), xlabel="probability of the decision", ylabel="share")
    return _done(figure, "png")


def latencies(stages: Mapping[str, F64], deadline_us: float | None) -> bytes:
    """Draw the distribution of every stage, microseconds on a logarithmic axis; times below 0.1 us stand in the first bin."""
    figure, axes = _new(9.0, 1.5 * len(stages) + 0.5, len(stages))
    highest = max((float(values.max()) for values in stages.values() if len(values)), default=1.0)
    top = max(highest, deadline_us or 0.0, 1.0) * 1.3
    edges = np.geomspace(LEAST_US, top, 90)
    for axis, (name, values) in zip(axes[:, 0], stages.items()):
        axis.hist(np.clip(values, LEAST_US, top), bins=edges, color="C0")
        for quantile, style in ((0.5, "-"), (0.99, "--"), (0.999, ":")):
            if len(values):
                at = float(np.quantile(values, quantile))
                axis.axvline(
                    max(at, LEAST_US), color="black", lw=0.9, ls=style, label=f"p{100 * quantile:g} {at:.1f} us"
                )
        if deadline_us and name == next(iter(stages)):
            axis.axvline(deadline_us, color="C3", lw=1.4, label=f"deadline {deadline_us:g} us")
        axis.set(xscale="log", yscale="log", xlim=(LEAST_US, top), ylabel="decisions", ylim=(0.7, None))
        axis.yaxis.set_minor_formatter(importlib.import_module("matplotlib.ticker").NullFormatter())
        axis.set_title(name, fontsize=10, loc="left")
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes[-1, 0].set_xlabel("microseconds")
    return _done(figure)


def click_rates(seconds: F64, clicks: F64, exposures: F64, what: str) -> bytes:
    """Draw clicks per exposure over time and `what` (pattern or channel), from sums per bin (bins, channels); beside it the mean."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = np.where(exposures > 0, clicks / exposures, np.nan)
        mean = clicks.sum(axis=0) / np.maximum(exposures.sum(axis=0), 1)
    figure, (left, right) = pyplot().subplots(
        1,
        2,
        figsize=(9.0, min(6.0, 2.2 + 0.16 * clicks.shape[1])),
        layout="constrained",
        width_ratios=(4, 1),
        sharey=True,
    )
    shown = left.imshow(
        rate.T,
        aspect="auto",
        origin="lower",
        interpolation="nearest",
        extent=(seconds[0], seconds[-1], -0.5, clicks.shape[1] - 0.5),
    )
    left.set(xlabel="seconds since the first exposure", ylabel=what)
    figure.colorbar(shown, ax=left, label="clicks per exposure")
    error = np.sqrt(mean * (1 - mean) / np.maximum(exposures.sum(axis=0), 1))
    right.barh(np.arange(len(mean)), mean, xerr=error, color="C0")
    right.set(xlabel="mean", xlim=(0, None))
    return _done(figure)


def dark_rates(seconds: F64, clicks: F64, exposures: F64, intervals: F64, expected: float | None) -> bytes:
    """Draw dark clicks per dark exposure per bin with 95 % intervals (bins, 2), and what the profile says."""
    figure, axes = _new(9.0, 2.8)
    axis = axes[0, 0]
    rate = clicks / np.maximum(exposures, 1)
    low, high = np.maximum(rate - intervals[:, 0], 0), np.maximum(intervals[:, 1] - rate, 0)
    axis.errorbar(seconds, rate, yerr=[low, high], fmt="o", ms=3, lw=1, label="measured, 95 % interval")
    if expected is not None:
        axis.axhline(expected, color="C3", lw=1, label=f"expected {expected:.3g}")
    axis.set(xlabel="seconds since the first exposure", ylabel="dark clicks per exposure", ylim=(0, None))
    axis.legend(fontsize=8)
    return _done(figure)


def clock(seconds: F64, residual_us: F64, half_trip_us: F64, drift_ppm: float) -> bytes:
    """Draw the device's clock against a straight line through all probes, with the uncertainty of each (half its round trip)."""
    figure, axes = _new(9.0, 2.8)
    axis = axes[0, 0]
    axis.errorbar(
        seconds, residual_us, yerr=half_trip_us, fmt=".", ms=3, lw=0.6, ecolor="0.7", label="probe, half its round trip"
    )
    axis.axhline(0, color="black", lw=0.8)
    reach = 3 * float(np.quantile(np.abs(residual_us) + half_trip_us, 0.9)) + 1e-3
    outside = int((np.abs(residual_us) > reach).sum())
    axis.set(xlabel="seconds since the first probe", ylabel="offset from the line, us", ylim=(-reach, reach))
    if outside:
        axis.text(0.99, 0.03, f"{outside} probes lie outside", ha="right", transform=axis.transAxes, fontsize=8)
    axis.set_title(f"straight line: {drift_ppm:+.2f} ppm against the host's clock", fontsize=10, loc="left")
    axis.legend(fontsize=8, loc="upper left")
    return _done(figure)


def patterns(pictures: F64, unit: str) -> bytes:
    """Draw patterns (d_f, height, width) on one scale, at most 64 of them; `unit` names what a pixel's value is."""
    shown = pictures[:PATTERNS_MAX]
    columns = min(8, len(shown))
    rows = math.ceil(len(shown) / columns)
    flatness = max(0.35, min(1.0, shown.shape[1] / shown.shape[2]))
    figure, axes = _new(1.15 * columns + 1.0, 1.3 * rows * flatness + 0.5, rows, columns)
    low, high = float(min(shown.min(), 0.0)), float(shown.max())
    limit = max(-low, high)
    scale = (
        {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit} if low < 0 else {"cmap": "magma", "vmin": 0.0, "vmax": high}
    )
    image = None
    for number, axis in enumerate(axes.flat):
        axis.set_axis_off()
        if number < len(shown):
            image = axis.imshow(shown[number], interpolation="nearest", **scale)
            axis.set_title(str(number), fontsize=7, pad=2)
    figure.colorbar(image, ax=axes, label=unit, shrink=0.8)
    return _done(figure, "png")


def per_pattern(values: F64, label: str) -> bytes:
    """Draw one bar per pattern."""
    figure, axes = _new(min(9.0, 3.0 + 0.15 * len(values)), 2.6)
    axes[0, 0].bar(np.arange(len(values)), values, color="C0")
    axes[0, 0].set(xlabel="pattern", ylabel=label)
    return _done(figure)


def over_time(edges_s: F64, panels: Mapping[str, Mapping[str, NDArray[np.int64]]]) -> bytes:
    """Draw counts per bin over time, one panel above the other; in a panel the counts of each name (bins,) are stacked."""
    figure, axes = _new(9.0, 0.6 + 2.1 * len(panels), len(panels))
    for axis, (title, rows) in zip(axes[:, 0], panels.items()):
        base = np.zeros(len(edges_s) - 1, np.int64)
        for number, (name, counts) in enumerate(rows.items()):
            axis.stairs(
                base + counts,
                edges_s,
                baseline=base,
                fill=True,
                color=f"C{number}",
                label=f"{name} ({int(counts.sum())})",
            )
            base = base + counts
        axis.set(ylabel=f"{title}\nper {edges_s[1] - edges_s[0]:.3g} s", xlim=(edges_s[0], edges_s[-1]), ylim=(0, None))
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes[-1, 0].set_xlabel("seconds since the first decision")
    return _done(figure)


class TreeNode(NamedTuple):
    """A state of the tree: its level, which share of the walks came there, clicks per exposure, and the places of its two successors.

    A place is -1 where the successor is not drawn.
    """

    state: int
    level: int
    share: float
    rate: float
    leads: tuple[int, ...]


def tree(pictures: F64, nodes: list[TreeNode]) -> bytes:
    """Draw patterns (n, height, width) at the places of `nodes`, a level below the other, with edges between them."""
    levels = 1 + max(node.level for node in nodes)
    width, height = 9.6, 1.9 * levels + 0.3
    figure = pyplot().figure(figsize=(width, height))
    where = _places(nodes, levels)
    size = min(
        0.78 / levels, 0.9 / max(sum(node.level == level for node in nodes) for level in range(levels)) * width / height
    )
    canvas = figure.add_axes((0, 0, 1, 1))
    canvas.set(xlim=(0, 1), ylim=(0, 1))
    canvas.set_axis_off()
    for (x, y), node in zip(where, nodes):
        for click, lead in enumerate(node.leads):
            if lead >= 0:
                to = where[lead]
                colour = CLICK_EDGE if click else DARK_EDGE
                canvas.plot([x, to[0]], [y, to[1]], color=colour, lw=1.4, zorder=0)
    high = float(pictures.max()) or 1.0
    for (x, y), node, picture in zip(where, nodes, pictures):
        wide = size * height / width
        axis = figure.add_axes((x - wide / 2, y - size / 2, wide, size * 0.8))
        axis.imshow(picture, cmap="magma", vmin=0, vmax=high, interpolation="nearest")
        axis.set(xticks=[], yticks=[])
        rate = "never shown" if np.isnan(node.rate) else f"{100 * node.rate:.1f} % click"
        axis.set_title(f"{100 * node.share:.0f} % of walks\n{rate}", fontsize=6.5, pad=2)
    for label, colour in (("no click", DARK_EDGE), ("click", CLICK_EDGE)):
        canvas.plot([], [], color=colour, lw=1.4, label=label)
    canvas.legend(loc="upper right", fontsize=8, frameon=False)
    return _done(figure, "png")


def _places(nodes: list[TreeNode], levels: int) -> list[tuple[float, float]]:
    """Centres in the figure: levels from above, the states of one side by side, each below the middle of those that lead to it."""
    wanted: dict[int, list[float]] = {0: [0.5]}
    where: dict[int, tuple[float, float]] = {}
    for level in range(levels):
        here = sorted(
            (number for number, node in enumerate(nodes) if node.level == level),
            key=lambda at: np.mean(wanted.get(at, [0.5])),
        )
        for side, number in enumerate(here):
            x = (side + 0.5) / len(here)
            where[number] = (x, 1 - (level + 0.55) / levels)
            for click, lead in enumerate(nodes[number].leads):
                wanted.setdefault(lead, []).append(x + (click - 0.5) * 1e-3)
    return [where[number] for number in range(len(nodes))]


def lengths(exposures: NDArray[np.int64], clicks: NDArray[np.int64]) -> bytes:
    """Draw how many walks took 1, 2, ... exposures, and how many gave 0, 1, ... clicks."""
    figure, axes = _new(9.0, 2.8, 1, 2)
    left, right = axes[0]
    left.bar(1 + np.arange(len(exposures)), exposures, color="C0")
    left.set(xlabel="exposures of a walk", ylabel="walks", xlim=(0, len(exposures) + 1))
    right.bar(np.arange(len(clicks)), clicks, color="C1")
    right.set(xlabel="clicks of a walk", ylabel="walks")
    return _done(figure)
