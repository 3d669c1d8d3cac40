"""Charts of the pages: arrays in, inline SVG out, drawn by matplotlib (extra `plot`), which is loaded with the first of them.

A chart is drawn once, so small that it can be read on a telephone, and scales with its column. Its colours are variables of the page's
style, so that they follow light, dark and print.
"""

from __future__ import annotations

import importlib
import io
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.cli.finding import missing_extra
from pans.runtime.safe_text import html, one_line

WIDTH, HEIGHT = 440, 240  # pixels
POINTS_MAX = 500  # of a curve
BLUES = ("#eef3fa", "#5e94cd", "#08265c")  # light to dark, so that more is darker on paper too
# A colour that stands for a variable of page.css, and is replaced by it.
_INKS = {
    "a": "#fe01a0",
    "b": "#fe01b0",
    "c": "#fe01c0",
    "d": "#fe01d0",
    "bad": "#fe01e0",
    "soft": "#fe01f0",
    "line": "#fe0110",
}
_DASHES = {"a": "-", "b": (0, (5, 2)), "c": (0, (1.5, 2)), "d": (0, (7, 2, 2, 2))}
_STYLE = {
    **{"font.size": 13, "svg.fonttype": "none", "text.parse_math": False, "axes.spines.top": False, "axes.spines.right": False},
    **{"axes.edgecolor": _INKS["line"], "axes.labelcolor": _INKS["soft"], "text.color": _INKS["soft"]},
    **{"xtick.color": _INKS["soft"], "ytick.color": _INKS["soft"], "axes.titlesize": 13, "axes.titlecolor": _INKS["soft"]},
    **{"xtick.labelsize": 12, "ytick.labelsize": 12, "grid.color": _INKS["line"], "grid.linewidth": 0.8, "legend.fontsize": 12},
}  # fmt: skip


def needed(name: str, what: str = "a page") -> ModuleType:
    """Return the module `name` of the extra `plot`; UsageError that says what needs it where it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise missing_extra(what, name.partition(".")[0], "plot") from error


def need_extra() -> None:
    """Raise the UsageError of `needed` where a page cannot be made, before anything is read or measured for it."""
    for name in ("matplotlib", "jinja2", "PIL"):
        needed(name)


# ---- numbers on axes ----


def number(value: float) -> str:
    """Return a number in three digits, thousands with commas.

    >>> number(0.000012), number(1234.5), number(0.25)
    ('1.2e-05', '1,234', '0.25')
    """
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def percent(value: float) -> str:
    """Return a share in percent."""
    return f"{100 * value:.3g} %"


def whole(value: float) -> str:
    """Return a count; nothing between two of them."""
    return f"{value:.0f}" if value == round(value) else ""


def seconds(value: float) -> str:
    """Return seconds, in the unit that fits."""
    return f"{value:.3g} s" if value < 300 else f"{value / 60:.3g} min" if value < 18_000 else f"{value / 3600:.3g} h"


def span(us: float) -> str:
    """Return microseconds, in the unit that fits."""
    return f"{us / 1e6:.3g} s" if us >= 1e6 else f"{us / 1e3:.3g} ms" if us >= 1e3 else f"{us:.3g} us"


# ---- what is drawn ----


@dataclass(frozen=True, slots=True)
class Axis:
    """Title with its unit, ends, whether it is logarithmic, and how a number is written."""

    title: str
    low: float
    high: float
    log: bool = False
    text: Callable[[float], str] = number


@dataclass(frozen=True, slots=True)
class Curve:
    """Points that are joined (or `dots`), NaN where there is none; `low` and `high` are the ends of a band around it."""

    x: ArrayLike
    y: ArrayLike
    name: str = ""
    kind: str = "a"  # a to d: its colour and its stroke
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    dots: bool = False

    def thinned(self) -> list[NDArray[np.float64] | None]:
        """Return x, y, low and high with at most POINTS_MAX points; outliers stay."""
        given = (self.x, self.y, self.low, self.high)
        arrays = [None if one is None else np.asarray(one, np.float64) for one in given]
        if len(y := np.asarray(self.y, np.float64)) <= POINTS_MAX:
            return arrays
        kept = extremes(y, POINTS_MAX // 2)
        return [None if one is None else one[kept] for one in arrays]


@dataclass(frozen=True, slots=True)
class Bars:
    """Counts between `edges` (n + 1), from `base` up."""

    edges: ArrayLike
    heights: ArrayLike
    base: ArrayLike | float = 0.0
    name: str = ""
    kind: str = "a"


@dataclass(frozen=True, slots=True)
class Mark:
    """A straight line at `at` across the chart, with its name."""

    at: float
    name: str
    upright: bool = False


@dataclass(frozen=True, slots=True)
class Node:
    """A picture of a tree: its level, place from left (0) to right (1), lines below it, and the numbers of the nodes after it, -1: none."""

    level: int
    place: float
    picture: NDArray[np.float64]
    lines: tuple[str, ...]
    leads: tuple[int, ...]


def extremes(values: NDArray[np.float64], stretches: int) -> NDArray[np.int64]:
    """Return the places of the least and the largest of `values` in each of `stretches` parts, in order, without doubles; NaN is neither.

    >>> extremes(np.array([0.0, 1.0, 9.0, 1.0, 0.0, 0.0]), 2).tolist()
    [0, 2, 3, 4]
    """
    parts = np.array_split(np.arange(len(values)), stretches)
    low, high = np.where(np.isnan(values), np.inf, values), np.where(np.isnan(values), -np.inf, values)
    return np.unique([int(part[ends.argmin()]) for part in parts if len(part) for ends in (low[part], -high[part])])


def chart(
    label: str,
    x: Axis,
    y: Axis,
    *,
    curves: Sequence[Curve] = (),
    bars: Sequence[Bars] = (),
    marks: Sequence[Mark] = (),
    heat: NDArray[np.float64] | None = None,
    height: int = HEIGHT,
) -> Any:
    """Return a chart as markup; `label` says in words what there is to see.

    `heat`, float64 (rows, columns), fills the axes from their low ends on, in shades from 0 to its highest number; NaN stays empty.
    """
    with _figure(label, height) as (figure, drawn):
        axes = figure.add_subplot()
        axes.set_title(one_line(y.title), loc="left")
        axes.set(xlabel=one_line(x.title), xlim=(x.low, x.high), ylim=(y.low, y.high))
        for axis, one in ((axes.xaxis, x), (axes.yaxis, y)):
            (axes.set_xscale if one is x else axes.set_yscale)("log" if one.log else "linear")
            axis.set_major_formatter(lambda value, _, one=one: one_line(one.text(value)))
            axis.set_minor_formatter(lambda value, _: "")
            (axis.get_major_locator().set_params)(**({"numticks": 6} if one.log else {"nbins": 5}))
        if heat is not None:
            _heat(figure, axes, (x.low, x.high, y.low, y.high), heat)
        else:
            axes.grid(axis="y")
            axes.set_axisbelow(True)
        named: list[tuple[Any, str]] = []
        for bar in bars:
            edges = np.asarray(bar.edges, np.float64)
            named.append(
                (
                    axes.bar(edges[:-1], bar.heights, np.diff(edges), bar.base, align="edge", color=_INKS[bar.kind]),
                    bar.name,
                )
            )
        for curve in curves:
            named.append((_curve(axes, curve), curve.name))
        for mark in marks:
            _mark(axes, mark, x, y)
        if len(told := [(artist, one_line(name)) for artist, name in named if name]) > 1:
            columns = 2 if max(len(name) for _, name in told) < 20 else 1
            where = {
                "loc": "outside upper left",
                "ncols": columns,
                "frameon": False,
                "handlelength": 1.6,
                "borderpad": 0,
            }
            figure.legend(*zip(*told), **where)
    return drawn()


def _curve(axes: Any, curve: Curve) -> Any:
    x, y, low, high = curve.thinned()
    colour = _INKS[curve.kind]
    if low is not None and high is not None:
        if curve.dots or len(np.atleast_1d(curve.x)) == 1:
            axes.vlines(x, low, high, colors=colour, alpha=0.6, lw=1.2)
        else:
            axes.fill_between(x, low, high, color=colour, alpha=0.22, lw=0)
    if curve.dots or np.isfinite(np.asarray(y)).sum() == 1:
        return axes.plot(x, y, "o", color=colour, ms=4)[0]
    return axes.plot(x, y, ls=_DASHES[curve.kind], color=colour, lw=1.8)[0]


def _mark(axes: Any, mark: Mark, x: Axis, y: Axis) -> None:
    (axes.axvline if mark.upright else axes.axhline)(mark.at, color=_INKS["bad"], ls=(0, (4, 3)), lw=1)
    one = x if mark.upright else y
    low, at, high = ((math.log(v) if one.log else v) for v in (one.low, mark.at, one.high))
    far = (at - low) / ((high - low) or 1.0) > 0.6
    if mark.upright:
        place, align = {"xy": (mark.at, 1), "xycoords": ("data", "axes fraction")}, ("right" if far else "left", "top")
        shift = (-4 if far else 4, -2)
    else:
        place, align = (
            {"xy": (1, mark.at), "xycoords": ("axes fraction", "data")},
            ("right", "top" if far else "bottom"),
        )
        shift = (0, -3 if far else 2)
    where = {"xytext": shift, "textcoords": "offset points", "ha": align[0], "va": align[1]}
    axes.annotate(one_line(mark.name), **place, **where, color=_INKS["bad"], fontsize=12)


def _heat(figure: Any, axes: Any, extent: tuple[float, ...], heat: NDArray[np.float64]) -> None:
    colours = needed("matplotlib.colors").LinearSegmentedColormap.from_list("blues", BLUES)
    top = float(np.nanmax(heat)) if np.isfinite(heat).any() else 1.0
    shades = {"cmap": colours, "vmin": 0.0, "vmax": top or 1.0, "interpolation": "none"}
    image = axes.imshow(heat, extent=extent, origin="lower", aspect="auto", **shades)
    figure.colorbar(image, ax=axes, pad=0.02, fraction=0.06, format=lambda value, _: number(value)).outline.set_visible(
        False
    )


def tree(label: str, nodes: Sequence[Node]) -> Any:
    """Return pictures at the places of their nodes, the first level on top, with lines between them: solid to the last of `leads`."""
    levels, widest = max(one.level for one in nodes) + 1, max(np.bincount([one.level for one in nodes]))
    size, step = min(80, WIDTH / widest - 6), min(80, WIDTH / widest - 6) + 58
    height = round(levels * step)
    with _figure(label, height, layout="none") as (figure, drawn):
        line = needed("matplotlib.lines").Line2D
        for one in nodes:
            top = height - one.level * step
            for outcome, lead in enumerate(one.leads):
                if lead >= 0:
                    ends = (
                        (one.place, nodes[lead].place),
                        ((top - size - 34) / height, (height - nodes[lead].level * step) / height),
                    )
                    last = outcome == len(one.leads) - 1
                    figure.add_artist(
                        line(*ends, color=_INKS["b" if last else "soft"], lw=1.8, ls="-" if last else (0, (4, 3)))
                    )
            axes = figure.add_axes((one.place - size / WIDTH / 2, (top - size) / height, size / WIDTH, size / height))
            axes.imshow(one.picture, cmap="gray", vmin=0.0, interpolation="none")
            axes.set_axis_off()
            for number_, text in enumerate(one.lines):
                where = one.place, (top - size - 13 - 15 * number_) / height
                figure.text(*where, text, ha="center", fontsize=12)
    return drawn()


def spark(label: str, shares: Sequence[float]) -> Any:
    """Return shares in their order as a line of text height, 0 at its foot and 1 at its top."""
    with _figure(label, 24, 120, layout="none") as (figure, drawn):  # axes would take four times as long
        places = np.linspace(0.01, 0.99, len(shares)), 0.05 + 0.9 * np.asarray(shares)
        figure.add_artist(needed("matplotlib.lines").Line2D(*places, color=_INKS["a"], lw=1.5))
    return drawn()


@contextmanager
def _figure(
    label: str, height: int, width: int = WIDTH, layout: str = "constrained"
) -> Iterator[tuple[Any, Callable[[], Any]]]:
    """Yield an empty figure and the function that returns it as markup, once it is drawn."""
    matplotlib, markup = needed("matplotlib"), needed("markupsafe").Markup
    stream = io.StringIO()
    with warnings.catch_warnings(), matplotlib.rc_context({**_STYLE, "svg.hashsalt": one_line(label)}):
        warnings.simplefilter("ignore")  # letters that the font for measuring lacks
        figure = needed("matplotlib.figure").Figure(figsize=(width / 72, height / 72), layout=layout)
        yield figure, lambda: markup(_page_svg(stream.getvalue(), label))
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(stream, format="svg", transparent=True, metadata=nothing)


def _page_svg(text: str, label: str) -> str:
    """The SVG as a part of a page: no prologue, no names that repeat from chart to chart, colours and letters of the page."""
    body = text[text.index("<defs>") : text.rindex("</svg>")] if "<defs>" in text else text
    body = re.sub(r"<style.*?</style>|<metadata>.*?</metadata>|<!--.*?-->|\n\s*", " ", body, flags=re.DOTALL)
    body = re.sub(r' id="[A-Za-z0-9.]+_\d+"', "", body)
    body = re.sub(r"font(?:-family)?: [^;\"]*'[^;\"]+;? ?", "", body)
    body = body.replace("xlink:href", "href")
    for name, colour in _INKS.items():
        body = body.replace(colour, f"var(--{name})")
    box = re.search(r'viewBox="[^"]+"', text)
    assert box is not None
    return f'<svg {box[0]} role="img" aria-label="{html(label)}">{body}</svg>'
