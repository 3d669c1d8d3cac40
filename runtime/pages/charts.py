"""Charts as inline SVG: curves with bands, bars, shaded tables, with axes, units and words for screen readers.

Colours are classes of the page's style, so that they follow light and dark. A chart is drawn for a given width in pixels: a page holds a
wide and a narrow form, so that letters keep their size on a telephone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pans.runtime import safe_text

LEFT, RIGHT, TOP, BOTTOM = 62, 12, 24, 40
POINTS_MAX = 500  # of a curve


def number(value: float) -> str:
    """Return a number for an axis: three digits, no trailing zeros."""
    if value == 0 or not math.isfinite(value):
        return "0" if value == 0 else "∞"
    if abs(value) >= 1e5 or abs(value) < 1e-3:
        mantissa, exponent = (
            f"{value:.2g}".partition("e")[::2] if "e" in f"{value:.2g}" else (f"{value:.1e}".split("e"))
        )
        return f"{float(mantissa):g}e{int(exponent)}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def percent(value: float) -> str:
    """Return a share for an axis."""
    return f"{100 * value:.3g} %"


def span(us: float) -> str:
    """Return microseconds for an axis, in the unit that fits."""
    return f"{us / 1e6:.3g} s" if us >= 1e6 else f"{us / 1e3:.3g} ms" if us >= 1e3 else f"{us:.3g} us"


def seconds(value: float) -> str:
    """Return seconds for an axis, in the unit that fits."""
    return f"{value:.3g} s" if value < 300 else f"{value / 60:.3g} min" if value < 18_000 else f"{value / 3600:.3g} h"


@dataclass(frozen=True, slots=True)
class Axis:
    """Title with its unit, ends, whether it is logarithmic, and how a number is written."""

    title: str
    low: float
    high: float
    log: bool = False
    text: Callable[[float], str] = number

    def at(self, values: ArrayLike) -> np.ndarray:
        """Return the places of `values`, 0 at the low end and 1 at the high one; values beyond are at the ends."""
        low, high, found = self.low, self.high, np.asarray(values, np.float64)
        if self.log:
            low, high, found = math.log(low), math.log(high), np.log(np.maximum(found, 1e-300))
        return np.clip((found - low) / ((high - low) or 1.0), 0.0, 1.0)

    def ticks(self, most: int) -> list[float]:
        """Return at most about `most` round numbers."""
        if self.log:
            least, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            stride = max(1, -(-(last - least + 1) // most))
            found = [10.0**power for power in range(least, last + 1, stride)]
            return found if len(found) > 1 else [self.low, self.high]
        reach = (self.high - self.low) or 1.0
        unit = 10.0 ** math.floor(math.log10(reach / most))
        steps = (factor * unit for factor in (1, 2, 5, 10, 20, 50))
        step = next(one for one in steps if reach / one <= most)
        first = math.ceil(self.low / step - 1e-9)
        return [n * step for n in range(first, math.floor(self.high / step + 1e-9) + 1)]


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
class Chart:
    """What is drawn; `label` says in words what there is to see."""

    label: str
    x: Axis
    y: Axis
    curves: Sequence[Curve] = ()
    bars: Sequence[Bars] = ()
    marks: Sequence[Mark] = ()
    height: int = 230
    heat: bytes = b""  # a PNG that fills the axes

    @property
    def names(self) -> list[tuple[str, str]]:
        """The kind and the name of what has one, for a legend; empty for a single one."""
        drawn: list[Curve | Bars] = [*self.curves, *self.bars]
        named = [(one.kind, one.name) for one in drawn if one.name]
        return named if len(named) > 1 else []

    def svg(self, width: int) -> str:
        """Return the chart `width` pixels wide."""
        inner = width - LEFT - RIGHT, self.height - TOP - BOTTOM
        parts = [_frame(self, width, inner)]
        if self.heat:
            parts.append(_image(self.heat, (LEFT, TOP), inner))
        for bars in self.bars:
            parts.append(_bars(self, bars, inner))
        for curve in self.curves:
            parts.append(_band(self, curve, inner))
            parts.append(_curve(self, curve, inner))
        parts += [_mark(self, mark, inner, width) for mark in self.marks]
        label = safe_text.html(self.label)
        size = f'viewBox="0 0 {width} {self.height}" width="{width}" height="{self.height}"'
        return f'<svg {size} role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _frame(chart: Chart, width: int, inner: tuple[int, int]) -> str:
    parts = []
    for value in chart.y.ticks(5 if chart.height > 160 else 3):
        y = TOP + inner[1] * (1 - float(chart.y.at(value)))
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{width - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(
            f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{safe_text.html(chart.y.text(value))}</text>'
        )
    for value in chart.x.ticks(max(3, width // 130)):
        x = LEFT + inner[0] * float(chart.x.at(value))
        parts.append(f'<line class="tick" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP + inner[1]}" y2="{TOP + inner[1] + 5}"/>')
        anchor = "end" if x > width - RIGHT - 20 else "middle"
        place = f'x="{x:.1f}" y="{TOP + inner[1] + 18}" text-anchor="{anchor}"'
        parts.append(f"<text {place}>{safe_text.html(chart.x.text(value))}</text>")
    parts.append(f'<text class="title" x="2" y="13">{safe_text.html(chart.y.title)}</text>')
    place = f'x="{width - RIGHT}" y="{chart.height - 5}" text-anchor="end"'
    parts.append(f'<text class="title" {place}>{safe_text.html(chart.x.title)}</text>')
    return "".join(parts)


def _places(chart: Chart, x: ArrayLike, y: ArrayLike, inner: tuple[int, int]) -> np.ndarray:
    return np.stack([LEFT + inner[0] * chart.x.at(x), TOP + inner[1] * (1 - chart.y.at(y))], axis=-1)


def extremes(values: np.ndarray, stretches: int) -> np.ndarray:
    """Return the places of the least and the largest of `values` in each of `stretches` parts, in order, without doubles; NaN is neither.

    >>> extremes(np.array([0.0, 1.0, 9.0, 1.0, 0.0, 0.0]), 2).tolist()
    [0, 2, 3, 4]
    """
    parts = np.array_split(np.arange(len(values)), stretches)
    low, high = np.where(np.isnan(values), np.inf, values), np.where(np.isnan(values), -np.inf, values)
    places = [int(part[ends.argmin()]) for part in parts if len(part) for ends in (low[part], -high[part])]
    return np.unique(places)


def _thinned(curve: Curve) -> list[np.ndarray | None]:
    """The curve with at most POINTS_MAX points; outliers stay."""
    arrays = [None if one is None else np.asarray(one, np.float64) for one in (curve.x, curve.y, curve.low, curve.high)]
    y = arrays[1]
    assert y is not None
    if len(y) <= POINTS_MAX:
        return arrays
    kept = extremes(y, POINTS_MAX // 2)
    return [None if one is None else one[kept] for one in arrays]


def _curve(chart: Chart, curve: Curve, inner: tuple[int, int]) -> str:
    x, y, _, _ = _thinned(curve)
    assert x is not None
    assert y is not None
    known = np.isfinite(y) & np.isfinite(x)
    points = _places(chart, x[known], y[known], inner)
    if curve.dots or len(points) == 1:
        return "".join(f'<circle class="dot {curve.kind}" cx="{a:.1f}" cy="{b:.1f}" r="2.6"/>' for a, b in points)
    breaks = np.flatnonzero(np.diff(np.flatnonzero(known)) > 1) + 1
    strokes = (" ".join(f"{a:.1f},{b:.1f}" for a, b in part) for part in np.split(points, breaks))
    return "".join(f'<polyline class="curve {curve.kind}" points="{stroke}"/>' for stroke in strokes if stroke)


def _band(chart: Chart, curve: Curve, inner: tuple[int, int]) -> str:
    x, _, low, high = _thinned(curve)
    if x is None or low is None or high is None:
        return ""
    known = np.isfinite(low) & np.isfinite(high)
    if curve.dots:
        ends = zip(_places(chart, x[known], low[known], inner), _places(chart, x[known], high[known], inner))
        return "".join(
            f'<line class="error {curve.kind}" x1="{a[0]:.1f}" x2="{a[0]:.1f}" y1="{a[1]:.1f}" y2="{b[1]:.1f}"/>'
            for a, b in ends
        )
    there, back = _places(chart, x[known], high[known], inner), _places(chart, x[known], low[known], inner)[::-1]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in np.concatenate([there, back]))
    return f'<polygon class="band {curve.kind}" points="{points}"/>'


def _bars(chart: Chart, bars: Bars, inner: tuple[int, int]) -> str:
    edges, heights = np.asarray(bars.edges, np.float64), np.asarray(bars.heights, np.float64)
    base = np.broadcast_to(np.asarray(bars.base, np.float64), heights.shape)
    low, high = _places(chart, edges[:-1], base, inner), _places(chart, edges[1:], base + heights, inner)
    gap = 1.0 if len(heights) * 3 < inner[0] else 0.0
    return "".join(
        f'<rect class="bar {bars.kind}" x="{a[0]:.1f}" y="{b[1]:.1f}" width="{max(b[0] - a[0] - gap, 0.5):.1f}" '
        f'height="{max(a[1] - b[1], 0):.1f}"/>'
        for a, b, height in zip(low, high, heights)
        if height > 0
    )


def _mark(chart: Chart, mark: Mark, inner: tuple[int, int], width: int) -> str:
    name = safe_text.html(mark.name)
    if mark.upright:
        x = LEFT + inner[0] * float(chart.x.at(mark.at))
        anchor, shift = ("end", -5) if x > width * 0.6 else ("start", 5)
        line = f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{TOP + inner[1]}"/>'
        return f'{line}<text class="mark" x="{x + shift:.1f}" y="{TOP + 12}" text-anchor="{anchor}">{name}</text>'
    y = TOP + inner[1] * (1 - float(chart.y.at(mark.at)))
    line = f'<line class="mark" x1="{LEFT}" x2="{width - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
    return f'{line}<text class="mark" x="{width - RIGHT - 2}" y="{y - 4:.1f}" text-anchor="end">{name}</text>'


def _image(data: bytes, place: tuple[int, int], size: tuple[int, int]) -> str:
    import base64

    source = f"data:image/png;base64,{base64.b64encode(data).decode()}"
    where = f'x="{place[0]}" y="{place[1]}" width="{size[0]}" height="{size[1]}"'
    return f'<image class="pixels" {where} preserveAspectRatio="none" href="{source}"/>'
