"""The live view as a web page, by Bokeh's server (extra `ui`): curves to zoom into, alarms, the last objects, the figures.

What all pages show is made once after a picture; each page copies it once per second, for the range and the smoothing that it asks for.
A request that names another host is refused where only this machine may ask (DNS rebinding), and so is a websocket of another origin.
"""

from __future__ import annotations

import asyncio
import base64
import gc
import hashlib
import json
import logging
import re
import socket
import sys
import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from importlib.resources import files
from ipaddress import ip_address
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.events import RangesUpdate, Reset
from bokeh.models import Button, ColumnDataSource, DataRange1d, Div, HoverTool, LinearColorMapper, Range1d, Select, TextInput
from bokeh.plotting import figure
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from jinja2 import Environment, StrictUndefined
from numpy.typing import NDArray
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.routing import Router
from tornado.web import Application as Answers
from tornado.web import OutputTransform, RequestHandler

from pans.runtime.intervals import wilson_interval
from pans.runtime.safe_text import one_line
from pans.runtime.watch.metrics import is_public

from .alarms import Alarms
from .figures import NAME_CHARACTERS, class_rows, decision_row, duration, headline, health, latest_rows, rows_of, title_of
from .history import BINS, LEVELS, SUMS, Bin, History
from .monitor import NOTE_CHARACTERS

SESSIONS_MAX = 16
REFRESH_MS, LAST_LOOK_S = 1000, 0.6
PER_ROW, ROW_HEIGHT = 8, 1.3  # patterns, and the height of a row with its text, in widths of a pattern
SPANS = {"1 minute": 60, "10 minutes": 600, "1 hour": 3600, "6 hours": 21_600, "1 day": 86_400, "1 week": 604_800}
SPANS |= {"6 weeks": 3_628_800}
LEAST_DARK = 10  # dark counts of a point
LEAST = ("1", "30", "100", "300", "1000", "10000")  # decisions that a point takes
PATHS = re.compile(r"/|/ws|/static/[\w./-]+|/favicon\.ico")
BLUE, ORANGE, GREEN, RED, GREY = "#3b82c4", "#d9670b", "#2e9a6f", "#d1495b", "#7d8289"  # 3:1 and more on white and on the dark ground
POLICY = "default-src 'none'; script-src 'self' {}; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
POLICY += "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
Columns = dict[str, Any]


class Plot(NamedTuple):
    """A figure: its unit, lines (column, legend, colour, dash), a band (low, high, legend), and the kind and ends of its y axis."""

    unit: str
    lines: tuple[tuple[str, str, str, str], ...]
    band: tuple[str, str, str] | None = None
    scale: str = "linear"
    ends: tuple[float | None, float | None] = (None, None)
    expected: tuple[str, str, str] | None = None


PLOTS = {
    "accuracy": Plot(
        "right decisions (%)",
        (("accuracy", "right", BLUE, "solid"), ("chance", "guessing", RED, "dotted")),
        ("accuracy_low", "accuracy_high", "95 % interval"),
        ends=(0, 100),
    ),
    "latency": Plot(
        "after the exposure (us)",
        (("p50", "50 %", BLUE, "solid"), ("p99", "99 %", ORANGE, "dashed"), ("deadline", "deadline", RED, "dotted")),
        scale="log",
    ),
    "dark": Plot(
        "clicks per dark exposure",
        (("dark", "measured", BLUE, "solid"),),
        ("dark_low", "dark_high", "95 % interval"),
        "log",
        expected=("expected_low", "expected_high", "expected"),
    ),
    "late": Plot(
        "per second",
        (("late", "late decisions", ORANGE, "solid"), ("lost", "lost exposures", BLUE, "dashed")),
        ends=(0, None),
    ),
    "light": Plot(
        "per decision",
        (
            ("clicks", "clicks", BLUE, "solid"),
            ("photons", "photons", GREEN, "dashed"),
            ("stated", "clicks stated", RED, "dotted"),
        ),
        ends=(0, None),
    ),
    "rate": Plot("per second", (("rate", "decisions", BLUE, "solid"),), ends=(0, None)),
    "drift": Plot("ppm against this computer", (("drift", "clock drift", BLUE, "solid"),)),
}


def columns(history: History, level: float, least: float) -> dict[str, NDArray[np.float64]]:
    """Return the curves in bins of `level` seconds, float64 (bins,) each, `s` in seconds of the run, NaN where nothing is known.

    A point takes its bin and as many before it as hold `least` decisions together, of the dark counts LEAST_DARK.
    """
    bins = [one for one in history.bins[level] if one.end_s > one.begin_s]
    n, nothing = len(bins), np.full(len(bins), np.nan)
    at = np.array([(one.begin_s, one.end_s) for one in bins]).reshape(n, 2)
    total = _added_up(np.array([one.sums for one in bins], np.float64).reshape(n, len(SUMS)))
    made = total[:, SUMS.index("decisions")]
    dark_made = total[:, SUMS.index("dark_clicks")]
    begin, begin_dark = _begins(made, least), _begins(dark_made, LEAST_DARK)
    sums = dict(zip(SUMS, (total[1:] - total[begin]).T))
    dark_sums = dict(zip(SUMS, (total[1:] - total[begin_dark]).T))
    seconds = at[:, 1] - at[begin, 0]
    quiet = np.diff(made) == 0
    found = [history.accuracy({"known": known, "right": right}) for known, right in zip(sums["known"], sums["right"])]
    accuracy = np.array([(np.nan,) * 3 if one is None else one for one in found]).reshape(n, 3) * 100
    dark = np.array([wilson_interval(*one) for one in zip(dark_sums["dark_clicks"], dark_sums["dark_exposures"])]).reshape(n, 2)
    picture, begun = history.picture, history.begin
    limits = {
        "chance": 100 / len(begun["classes"]) if begun.get("classes") else None,
        "deadline": begun.get("deadline_us"),
        "stated": begun.get("clicks_stated"),
        "expected_low": picture.get("dark_low"),
        "expected_high": picture.get("dark_high"),
    }
    with np.errstate(divide="ignore", invalid="ignore"):
        curves = {
            "rate": sums["decisions"] / seconds,
            "clicks": sums["clicks"] / sums["decisions"],
            "photons": sums["photons"] / sums["photons_known"],
            "dark": dark_sums["dark_clicks"] / dark_sums["dark_exposures"],
            **dict(zip(("accuracy", "accuracy_low", "accuracy_high"), accuracy.T)),
            **_quantiles(bins, begin, p50=0.5, p99=0.99),
        }
    own = np.diff(total, axis=0).T / np.maximum(at[:, 1] - at[:, 0], 1e-9)
    floor = _floor(curves["dark"], dark[:, 1], limits["expected_low"])
    curves |= {"dark_low": np.maximum(dark[:, 0], floor), "dark_high": dark[:, 1]}
    for name, curve in curves.items():
        curves[name] = np.where(quiet & (name != "rate"), np.nan, curve)
    curves["dark"][curves["dark"] <= 0] = np.nan  # a logarithm has no place for it
    return {
        "s": at.mean(axis=1),
        **curves,
        **{name: own[SUMS.index(name)] for name in ("late", "lost")},
        "drift": np.array([np.nan if one.drift_ppm is None else one.drift_ppm for one in bins]),
        **{name: nothing if value is None else np.full(n, max(float(value), 1e-12)) for name, value in limits.items()},
        "over": seconds,
    }


def _added_up(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.vstack([np.zeros((1, rows.shape[1])), rows.cumsum(axis=0)])


def _begins(made: NDArray[np.float64], least: float) -> NDArray[np.int64]:
    """Return the first bin of each bin's point, so that `made`, added up, grows by `least` in it; int64 (bins,)."""
    return np.clip(np.searchsorted(made, made[1:] - least, side="right") - 1, 0, np.arange(len(made) - 1))


def _floor(*known: Any) -> float:
    """Return the lower end of a logarithmic band: a third of the smallest value above 0."""
    some = np.concatenate([np.atleast_1d(np.asarray(one, np.float64)) for one in known if one is not None])
    return float(some[some > 0].min(initial=1.0)) / 3


def _quantiles(bins: list[Bin], begin: NDArray[np.int64], **wanted: float) -> Columns:
    """Return quantiles of the latencies in us, float64 (bins,), of the bins from `begin` up to each."""
    keys = sorted({key for one in bins for key in one.latency}) or [0]
    place = {key: at for at, key in enumerate(keys)}
    counts = np.zeros((len(bins), len(keys)))
    for row, one in zip(counts, bins):
        row[[place[key] for key in one.latency]] = list(one.latency.values())
    total = _added_up(counts)
    shares = (total[1:] - total[begin]).cumsum(axis=1)
    found = {}
    for name, q in wanted.items():
        at = (shares >= np.maximum(1, np.ceil(q * shares[:, -1:]))).argmax(axis=1)
        found[name] = np.where(shares[:, -1] > 0, np.array(keys)[at] / 1000, np.nan)
    return found


class Page:
    """What all sessions show of a run, made once after each picture; `open` fills the document of a new one."""

    def __init__(self, history: History, *, control: bool) -> None:
        self.history, self.control, self.alarms = history, control, Alarms()
        environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        self.template = environment.from_string(files(__package__).joinpath("live.html").read_text(encoding="utf-8"))
        self.parts: Any = self.template.module
        self.views: dict[Document, _View] = {}
        self._made: dict[Any, Any] = {}
        self._asked_s = 0.0
        now = datetime.now().astimezone()
        self._began, self._zone = now, now.utcoffset() or timedelta()

    def take(self, message: dict[str, Any]) -> None:
        """Take a message of the run."""
        self.history.take(message)
        self._made.clear()
        if self.history.picture:
            now = datetime.now().astimezone()
            self._began = now - timedelta(seconds=float(self.history.picture["elapsed_s"]))
            self.alarms.take(self.history)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` gives, made once per picture."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def milliseconds(self, s: Any) -> Any:
        """Return seconds of the run as milliseconds of the time of day here, which Bokeh takes for UTC."""
        return (self._began.timestamp() + self._zone.total_seconds() + s) * 1000

    def clock(self, s: float) -> str:
        """Return seconds of the run as the time of day here."""
        return f"{self._began + timedelta(seconds=s):%d %b %H:%M:%S}"

    def texts(self) -> dict[str, str]:
        """Return the parts of the page that are text, as HTML."""
        history, parts = self.history, self.parts
        if not history.picture:
            return {"head": str(parts.waiting(title_of(history)))}
        picture, word = history.picture, history.picture.get("word")
        names, state = history.begin.get("classes", ()), picture["state"]
        shown = None if word is None else decision_row(history, word["decision"])
        chances = [] if word is None else sorted(zip(word["posterior"], names), key=lambda one: -one[0])[:PER_ROW]
        done, expected = picture["decisions"], history.begin.get("expected", 0)
        ended = one_line(picture["ended"], 200)
        return {
            "head": str(parts.head(title_of(history), state, ended, duration(picture["elapsed_s"]), headline(history), done, expected)),
            "health": str(parts.health(health(history))),
            "figures": str(parts.figures(rows_of(history))),
            "alarms": str(parts.alarms(list(self.alarms.all)[::-1], self.clock)),
            "word": str(parts.word(shown, word, [(share, one_line(name, NAME_CHARACTERS)) for share, name in chances], history.begin.get("encoder"))),
            "latest": str(parts.latest(latest_rows(history))),
            "classes": str(parts.classes(class_rows(history))),
        }

    def curves(self, level: float, least: float) -> Columns:
        """Return the columns of the figures."""
        found = columns(self.history, level, least)
        return found | {"x": self.milliseconds(found["s"])}

    def marks(self) -> Columns:
        """Return the alarms as columns."""
        now_s, some = float(self.history.picture["elapsed_s"]), list(self.alarms.all)
        ends = [now_s if one.end_s is None else one.end_s for one in some]
        colours = {"bad": RED, "warn": ORANGE, "note": GREEN}
        return {
            "begin": [self.milliseconds(one.begin_s) for one in some],
            "end": [self.milliseconds(end) for end in ends],
            "colour": [colours[one.level] for one in some],
        }

    def patterns(self) -> Columns:
        """Return the patterns of the latest word as columns: an image each, where it stands, and what is written below."""
        word = self.history.picture.get("word") or {"patterns": [], "clicks": []}
        some = [(n, clicks, self.history.pixels.get(str(n))) for n, clicks in zip(word["patterns"], word["clicks"])]
        known = [(n, clicks, pixels) for n, clicks, pixels in some if pixels is not None]
        at = np.arange(len(known))
        return {
            "image": [
                np.frombuffer(base64.b64decode(pixels["grey"]), np.uint8).reshape(pixels["shape"])[::-1]
                for _, _, pixels in known
            ],
            "x": at % PER_ROW + 0.06,
            "y": -(at // PER_ROW) - 0.68,
            "text": [f"{n} ●" + (f" {clicks}" if clicks > 1 else "") if clicks else f"{n} ○" for n, clicks, _ in known],
            "colour": [ORANGE if clicks else GREY for _, clicks, _ in known],
        }

    def ask(self, **what: Any) -> None:
        """Send what was asked for on a page to the run, once per second at most."""
        if self.control and time.monotonic() - self._asked_s > 1:
            self._asked_s = time.monotonic()
            print(json.dumps(what), flush=True)

    def open(self, document: Document) -> None:
        """Fill the document of a new session."""
        view = self.views[document] = _View(document, self)
        document.add_periodic_callback(view.refresh, REFRESH_MS)
        document.on_session_destroyed(lambda context: self.views.pop(document, None))
        view.refresh()


class _View:
    """One session: its range of time, its smoothing, and the models that show the page."""

    def __init__(self, document: Document, page: Page) -> None:
        self._page, self._document, self._number, self._follows = page, document, -1, True
        self._drawn: tuple[float, float, float] = (0.0, 0.0, 0.0)  # level, least, time
        self._decision: Any = None
        self._curves = ColumnDataSource(page.curves(LEVELS[0], 1))
        self._marks = ColumnDataSource({"begin": [], "end": [], "colour": []})
        self._patterns = ColumnDataSource({"image": [], "x": [], "y": [], "text": [], "colour": []})
        self._range = Range1d(0, 1)
        self._style = str(page.parts.style())
        wide: dict[str, Any] = {"sizing_mode": "stretch_width", "stylesheets": [self._style]}
        self._divs = {
            name: Div(name=name, disable_math=True, **wide)
            for name in ("head", "health", "figures", "alarms", "word", "latest", "classes")
        }
        self._span = Select(name="span", title="Time shown", value="10 minutes", options=list(SPANS), **wide)
        self._least = Select(name="least", title="A point takes at least (decisions)", value="100", options=list(LEAST), **wide)
        self._now = Button(name="now", label="Follow the run", **wide)
        self._span.on_change("value", lambda attr, old, new: self._follow())
        self._least.on_change("value", lambda attr, old, new: self.redraw())
        self._now.on_click(self._follow)
        for root in (*self._divs.values(), self._span, self._least, self._now):
            document.add_root(root)
        for name, plot in PLOTS.items():
            document.add_root(self._figure(name, plot))
        document.add_root(self._picture())
        if page.control:
            self._controls(document)
        document.template, document.title = page.template, title_of(page.history)
        document.template_variables["control"] = page.control

    def _figure(self, name: str, plot: Plot) -> Any:
        low, high = plot.ends
        ends = Range1d(low, high) if high is not None else DataRange1d(only_visible=True, **({} if low is None else {"start": low}))
        one = figure(
            name=name,
            height=260,
            sizing_mode="stretch_width",
            x_axis_type="datetime",
            y_axis_type=plot.scale,
            x_range=self._range,
            y_range=ends,
            tools="xpan,xbox_zoom,xwheel_zoom,reset,save",
            y_axis_label=plot.unit,
            background_fill_color=None,
            border_fill_color=None,
            toolbar_location="above",
        )
        one.toolbar.logo = None
        one.xgrid.visible, one.min_border_right = False, 16
        strips = one.vstrip(x0="begin", x1="end", source=self._marks, fill_color="colour", fill_alpha=0.15, line_color=None)
        one.vspan(x="begin", source=self._marks, line_color="colour", line_dash="dashed")
        strips.level = "underlay"
        for band, colour, alpha in ((plot.expected, GREEN, 0.3), (plot.band, plot.lines[0][2], 0.25)):
            if band is not None:
                one.varea(x="x", y1=band[0], y2=band[1], source=self._curves, fill_color=colour, fill_alpha=alpha, legend_label=band[2])
        for column, legend, colour, dash in plot.lines:
            line = one.line(x="x", y=column, source=self._curves, color=colour, line_width=2, line_dash=dash, legend_label=legend)
            if column == plot.lines[0][0]:
                one.scatter(x="x", y=column, source=self._curves, color=colour, size=3)
                tips = [("at", "@x{%F %T}"), *((text, f"@{key}{{0.[0000]}}") for key, text, _, _ in plot.lines)]
                tips += [] if plot.band is None else [(plot.band[2], "@{%s}{0.[00000]} to @{%s}{0.[00000]}" % plot.band[:2])]
                tips.append(("over", "@over{0.[0]} s"))
                one.add_tools(HoverTool(renderers=[line], mode="vline", tooltips=tips, formatters={"@x": "datetime"}))
        one.add_layout(one.legend[0], "below")
        one.legend[0].update(orientation="horizontal", border_line_color=None, background_fill_alpha=0, padding=0, margin=2, spacing=12)
        one.legend[0].update(ncols=2, stylesheets=[self._style])
        one.on_event(RangesUpdate, lambda event: self._hold())
        one.on_event(Reset, lambda event: self._follow())
        return one

    def _picture(self) -> Any:
        """The patterns of a click word."""
        one = self._words = figure(
            name="patterns",
            x_range=Range1d(0, PER_ROW),
            y_range=Range1d(-1, 0),
            sizing_mode="scale_width",
            aspect_ratio=PER_ROW / ROW_HEIGHT,
            tools="",
            toolbar_location=None,
            background_fill_color=None,
            border_fill_color=None,
            outline_line_color=None,
        )
        one.axis.visible = one.grid.visible = False
        grey = LinearColorMapper([f"#{level:02x}{level:02x}{level:02x}" for level in range(256)], low=0, high=255)
        place: dict[str, Any] = {"x": "x", "y": "y", "source": self._patterns}
        one.image(image="image", dw=0.86, dh=0.66, color_mapper=grey, **place)
        one.block(width=0.86, height=0.66, fill_color=None, line_color="colour", line_width=3, **place)
        one.text(text="text", y_offset=4, text_baseline="top", text_font_size="12px", text_color="colour", **place)
        return one

    def _controls(self, document: Document) -> None:
        note = TextInput(name="note", title=f"Note (at most {NOTE_CHARACTERS} characters)", max_length=NOTE_CHARACTERS, sizing_mode="stretch_width", stylesheets=[self._style])
        mark = Button(name="mark", label="Mark this moment", button_type="primary")
        stop = Button(name="stop", label="Stop the run", button_type="danger")

        def write() -> None:
            self._page.ask(note=note.value[:NOTE_CHARACTERS] or "marked")
            note.value = ""

        def end() -> None:  # the first press asks
            if stop.label == "Press again to stop":
                self._page.ask(stop=True)
                stop.update(label="Stopping", disabled=True)
            else:
                stop.label = "Press again to stop"

        mark.on_click(write)
        stop.on_click(end)
        for root in (note, mark, stop):
            document.add_root(root)

    def _follow(self) -> None:
        self._follows = True
        self.redraw()

    def _hold(self) -> None:
        """The range was moved by hand: it stays."""
        self._follows = False
        self.redraw()

    def redraw(self) -> None:
        """Draw the curves for the range and the smoothing that are asked for."""
        self._drawn = (0.0, 0.0, 0.0)
        self._draw()

    def refresh(self) -> None:
        """Show what is new."""
        page = self._page
        if page.history.number == self._number:
            return
        self._number = page.history.number
        for name, text in page.once("texts", page.texts).items():
            if self._divs[name].text != text:
                self._divs[name].text = text
        if not page.history.picture:
            return
        self._document.title = f"{page.history.picture['state']}: {title_of(page.history)}"
        self._draw()
        word = page.history.picture.get("word")
        if word is not None and word["decision"] != self._decision:
            self._decision, self._patterns.data = word["decision"], page.once("patterns", page.patterns)
            rows = max(1, -(-len(self._patterns.data["text"]) // PER_ROW))
            if self._words.y_range.start != -rows:
                self._words.y_range.start, self._words.aspect_ratio = -rows, PER_ROW / rows / ROW_HEIGHT

    def _draw(self) -> None:
        page, now_s = self._page, float(self._page.history.picture.get("elapsed_s", 0.0))
        if self._follows:
            first_s = max(0.0, now_s - SPANS[self._span.value])
            self._range.update(start=float(page.milliseconds(first_s)), end=float(page.milliseconds(max(now_s, first_s + 10))))
        span_s = (self._range.end - self._range.start) / 1000
        began_s = now_s - (page.milliseconds(now_s) - self._range.start) / 1000
        level = next((one for one in LEVELS if BINS * one >= max(span_s, now_s - began_s)), LEVELS[-1])
        drawn = level, float(self._least.value), now_s
        if drawn[:2] == self._drawn[:2] and now_s - self._drawn[2] < min(10.0, level / 5) and not page.history.picture["ended"]:
            return
        self._drawn = drawn
        self._curves.data = page.once(drawn[:2], lambda: page.curves(*drawn[:2]))
        self._marks.data = page.once("marks", page.marks) if page.history.picture else dict(self._marks.data)


class _Door(Router):
    """Lets requests through to Bokeh's server that name this host, where `local`, and a path of the page; websockets of this origin."""

    def __init__(self, app: BokehTornado, *, local: bool) -> None:
        self._app, self._local = app, local

    def find_handler(self, request: Any, **kwargs: Any) -> Any:
        """Return who answers."""
        origin = request.headers.get("Origin")
        if self._local and not _is_here(request.host_name):
            return _refusal(request, 403, "This page is for the machine that it runs on.")
        if PATHS.fullmatch(request.path) is None or request.method not in ("GET", "HEAD"):
            return _refusal(request, 404, "There is no such page.")
        if request.path == "/ws" and origin is not None and urlsplit(origin).netloc.lower() != request.host.lower():
            return _refusal(request, 403, "A page of another origin has asked.")
        if request.path == "/" and len(self._app.get_sessions("/")) >= SESSIONS_MAX:
            return _refusal(request, 503, f"{SESSIONS_MAX} pages follow this run already. Close one, wait 15 seconds and try again.")
        return self._app.find_handler(request, **kwargs)


def _is_here(name: str) -> bool:
    try:
        return ip_address(name.strip("[]")).is_loopback
    except ValueError:
        return name == "localhost"


def _refusal(request: Any, status: int, words: str) -> Any:
    class Refusal(RequestHandler):
        def prepare(self) -> None:
            self.set_status(status)
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            self.finish(words + "\n")

    return Answers([(".*", Refusal)], transforms=[_Headers]).find_handler(request)


class _Headers(OutputTransform):
    """Adds the headers that let a page run its own scripts alone: inline ones by their SHA-256. Bokeh's styles need 'unsafe-inline'."""

    def transform_first_chunk(self, status_code: int, headers: Any, chunk: bytes, finishing: bool) -> Any:
        """Return what is sent first."""
        hashes = ""
        if headers.get("Content-Type", "").startswith("text/html"):
            inline = re.findall(rb"<script(?![^>]*\ssrc=)[^>]*>(.*?)</script>", chunk, re.DOTALL)
            hashes = " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(one).digest()).decode()}'" for one in inline)
            headers["Cache-Control"] = "no-store"
        headers["Content-Security-Policy"] = POLICY.format(hashes)
        headers["X-Content-Type-Options"], headers["Referrer-Policy"], headers["Server"] = "nosniff", "no-referrer", "pans"
        return status_code, headers, chunk


def serve(listening: socket.socket, history: History, draw: Callable[[History], None], *, address: str, control: bool) -> None:
    """Serve the page at the socket `listening` until standard input ends; `draw` shows `history` elsewhere, too."""
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # nobody reads them beside a run
    asyncio.run(_serve(listening, history, draw, local=not is_public(address), control=control))


async def _serve(listening: socket.socket, history: History, draw: Callable[[History], None], *, local: bool, control: bool) -> None:
    loop, ended, page = IOLoop.current(), asyncio.Event(), Page(history, control=control)
    app = BokehTornado(
        {"/": Application(FunctionHandler(page.open))},
        extra_websocket_origins=["*"],  # the door has looked
        unused_session_lifetime_milliseconds=10_000,
        check_unused_sessions_milliseconds=3000,
        stats_log_frequency_milliseconds=1 << 30,
        websocket_max_message_size_bytes=1 << 16,
        include_headers=[],
        include_cookies=[],
    )
    app.transforms.append(_Headers)
    server = HTTPServer(_Door(app, local=local), idle_connection_timeout=20, body_timeout=5, max_header_size=1 << 14, max_body_size=1 << 12)
    server.add_socket(listening)
    bokeh = BaseServer(loop, app, server)
    bokeh.start()
    gc.freeze()  # what is loaded stays: Bokeh collects twice for each session that ends

    def take(line: str) -> None:
        page.take(json.loads(line))
        draw(history)

    def read() -> None:
        for line in sys.stdin:
            loop.add_callback(take, line)
        loop.add_callback(ended.set)

    threading.Thread(target=read, daemon=True).start()
    await ended.wait()
    for document, view in page.views.items():
        document.add_next_tick_callback(view.refresh)
    await asyncio.sleep(LAST_LOOK_S)
    bokeh.stop()
