"""Charts of the pages: arrays in, inline SVG out, drawn by matplotlib (extra `plot`), which is loaded with the first of them.

A chart is drawn once, so small that it can be read on a telephone, and scales with its column. Its colours are variables of the page's
style, so that they follow light, dark and print.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.console import html, needed, one_line
from pans.base.numbers import number

WIDTH, HEIGHT = 440, 240  # pixels
BLUES = ("#eef3fa", "#5e94cd", "#08265c")  # light to dark, so that more is darker on paper too
# A colour that stands for a variable of page.css, and is replaced by it.
_INKS = {name: f"#fe01{place}0" for place, name in enumerate(("a", "b", "c", "d", "bad", "soft", "line"))}
_DASHES = {"a": "-", "b": (0, (5, 2)), "c": (0, (1.5, 2)), "d": (0, (7, 2, 2, 2))}
_POINTS = {"a": "o", "b": "X", "c": "_", "d": "D"}
_STYLE = {
    **{"font.size": 13, "svg.fonttype": "none", "text.parse_math": False, "axes.spines.top": False, "axes.spines.right": False},
    **{"axes.edgecolor": _INKS["line"], "axes.labelcolor": _INKS["soft"], "text.color": _INKS["soft"]},
    **{"xtick.color": _INKS["soft"], "ytick.color": _INKS["soft"], "axes.titlesize": 13, "axes.titlecolor": _INKS["soft"]},
    **{"xtick.labelsize": 12, "ytick.labelsize": 12, "grid.color": _INKS["line"], "grid.linewidth": 0.8, "legend.fontsize": 12},
}  # fmt: skip


def need_extra() -> None:
    """Raise the UsageError of `needed` where a page cannot be made, before anything is read or measured for it."""
    for name in ("matplotlib", "jinja2", "PIL"):
        needed(name)


# ---- numbers on axes ----


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
    """Points that are joined (or `dots`), NaN where there is none; `low` and `high` are the ends of a band around it.

    Of a joined curve matplotlib leaves out the points that nobody could tell apart.
    """

    x: ArrayLike
    y: ArrayLike
    name: str = ""
    kind: str = "a"  # a to d: its colour, stroke and points
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    dots: bool = False


@dataclass(frozen=True, slots=True)
class Bars:
    """Counts between `edges` (n + 1); several stand one upon the other."""

    edges: ArrayLike
    heights: ArrayLike
    name: str = ""
    kind: str = "a"


@dataclass(frozen=True, slots=True)
class Mark:
    """A straight line at `at` across the chart, with its name for the legend."""

    at: float
    name: str
    upright: bool = False


def chart(
    label: str,
    x: Axis,
    y: Axis,
    *,
    curves: Sequence[Curve] = (),
    bars: Sequence[Bars] = (),
    marks: Sequence[Mark] = (),
    heat: NDArray[np.float64] | None = None,
    shades: str = "",
    height: int = HEIGHT,
) -> Any:
    """Return a chart as markup; `label` says in words what there is to see.

    `heat`, float64 (rows, columns), fills the axes from their low ends on, in `shades` from 0 to its highest number; NaN stays empty.
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
            _heat(figure, axes, (x.low, x.high, y.low, y.high), heat, one_line(shades))
        else:
            axes.grid(axis="y")
            axes.set_axisbelow(True)
        named: list[tuple[Any, str]] = []
        base: Any = 0.0
        for bar in bars:
            edges, ink = np.asarray(bar.edges, np.float64), _INKS[bar.kind]
            shape = axes.bar(edges[:-1], bar.heights, np.diff(edges), base, align="edge", color=ink)
            named, base = [*named, (shape, bar.name)], base + np.asarray(bar.heights)
        named += [(_curve(axes, curve), curve.name) for curve in curves]
        for mark, dashes in zip(marks, cycle(((4, 3), (1.5, 2), (7, 2, 1.5, 2)))):
            line = axes.axvline if mark.upright else axes.axhline
            named.append((line(mark.at, color=_INKS["bad"], ls=(0, dashes), lw=1), mark.name))
        if (told := [(artist, one_line(name)) for artist, name in named if name]) and (marks or len(told) > 1):
            columns = 2 if max(len(name) for _, name in told) < 20 else 1
            where = {"loc": "outside upper left", "ncols": columns, "frameon": False, "borderpad": 0}
            figure.legend(*zip(*told), handlelength=1.6, **where)
    return drawn()


def _curve(axes: Any, curve: Curve) -> Any:
    x, y, low, high = curve.x, np.asarray(curve.y), curve.low, curve.high
    colour, one = _INKS[curve.kind], np.isfinite(y).sum() == 1
    if low is not None and high is not None:
        if curve.dots or one:
            axes.vlines(x, low, high, colors=colour, alpha=0.6, lw=1.2)
        else:
            axes.fill_between(x, low, high, color=colour, alpha=0.22, lw=0)
    if curve.dots or one:
        return axes.plot(x, y, _POINTS[curve.kind], color=colour, ms=8 if curve.kind == "c" else 5)[0]
    return axes.plot(x, y, ls=_DASHES[curve.kind], color=colour, lw=1.8)[0]


def _heat(figure: Any, axes: Any, extent: tuple[float, ...], heat: NDArray[np.float64], title: str) -> None:
    colours = needed("matplotlib.colors").LinearSegmentedColormap.from_list("blues", BLUES)
    top = float(np.nanmax(heat)) if np.isfinite(heat).any() else 1.0
    shades = {"cmap": colours, "vmin": 0.0, "vmax": top or 1.0, "interpolation": "none"}
    image = axes.imshow(heat, extent=extent, origin="lower", aspect="auto", **shades)
    bar = figure.colorbar(image, ax=axes, pad=0.02, fraction=0.06, format=lambda value, _: number(value))
    bar.set_label(title)
    bar.outline.set_visible(False)


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
