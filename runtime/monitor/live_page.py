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
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.events import RangesUpdate, Reset
from bokeh.models import (
    Button,
    ColumnDataSource,
    DataRange1d,
    Div,
    HoverTool,
    LinearColorMapper,
    Range1d,
    Select,
    TextInput,
)
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
from pans.runtime.watch.metrics import is_loopback, is_public

from .alarms import Alarms
from .figures import (
    NAME_CHARACTERS,
    class_rows,
    decision_row,
    duration,
    headline,
    health,
    latest_rows,
    rows_of,
    title_of,
)
from .history import BINS, LEVELS, SUMS, Bin, History
from .monitor import NOTE_CHARACTERS

SESSIONS_MAX = 12
REFRESH_MS, LAST_LOOK_S = 1000, 0.6
PER_ROW, ROW_HEIGHT = 8, 1.3  # patterns, and the height of a row with its text, in widths of a pattern
SPANS = {"1 minute": 60, "10 minutes": 600, "1 hour": 3600, "6 hours": 21_600, "1 day": 86_400, "1 week": 604_800}
SPANS |= {"6 weeks": 3_628_800}
LEAST, LEAST_DARK = ("1", "30", "100", "300", "1000", "10000"), 10  # decisions of a point, and dark counts
PATHS = re.compile(r"/|/ws|/static/[\w./-]+|/favicon\.ico")
BLUE, ORANGE, GREEN, RED, GREY = (
    "#3b82c4",
    "#d9670b",
    "#2e9a6f",
    "#d1495b",
    "#7d8289",
)  # 3:1 on the white and the dark ground
STYLES = ((BLUE, "solid"), (ORANGE, "dashed"))  # of the lines of a figure
LIMITS = ("chance", "deadline", "stated", "expected_high")  # drawn dotted
LEVEL_COLOURS = {"bad": RED, "warn": ORANGE, "note": GREEN}
TEXTS = ("head", "health", "alarms", "word", "latest", "classes", "figures")
POLICY = "default-src 'none'; script-src 'self' {}; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
POLICY += "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
Columns = dict[str, Any]
F64 = NDArray[np.float64]


class Plot(NamedTuple):
    """A figure: its unit, its lines (column: legend), whether the first has an interval, and scale and ends of its y axis."""

    unit: str
    lines: dict[str, str]
    band: bool = False
    scale: str = "linear"
    ends: tuple[float | None, float | None] = (0, None)


PLOTS = {
    "accuracy": Plot("right decisions (%)", {"accuracy": "right", "chance": "guessing"}, band=True, ends=(0, 100)),
    "latency": Plot("after the exposure (us)", {"p50": "50 %", "p99": "99 %", "deadline": "deadline"}, scale="log"),
    "dark": Plot(
        "clicks per dark exposure", {"dark": "measured", "expected_high": "expected, at most"}, band=True, scale="log"
    ),
    "light": Plot("per decision", {"clicks": "clicks", "photons": "photons", "stated": "clicks stated"}),
    "late": Plot("per second", {"lost": "lost exposures", "late": "late decisions"}),
    "rate": Plot("per second", {"rate": "decisions"}),
    "drift": Plot("ppm against this computer", {"drift": "clock drift"}, ends=(None, None)),
}


def columns(history: History, level: float, least: float) -> dict[str, F64]:
    """Return the curves in bins of `level` seconds, float64 (bins,) each, `s` in seconds of the run, NaN where nothing is known.

    A point takes its bin and as many before it as hold `least` decisions together, of the dark counts LEAST_DARK.
    """
    bins = [one for one in history.bins[level] if one.end_s > one.begin_s]
    n, picture, begun = len(bins), history.picture, history.begin
    at = np.array([(one.begin_s, one.end_s) for one in bins]).reshape(n, 2)
    total = _added_up(np.array([one.sums for one in bins], np.float64).reshape(n, len(SUMS)))
    begin = _begins(total[:, SUMS.index("decisions")], least)
    begin_dark = _begins(total[:, SUMS.index("dark_clicks")], LEAST_DARK)
    own = dict(zip(SUMS, np.diff(total, axis=0).T))
    sums, dark = dict(zip(SUMS, (total[1:] - total[begin]).T)), dict(zip(SUMS, (total[1:] - total[begin_dark]).T))
    found = [history.accuracy({"known": known, "right": right}) for known, right in zip(sums["known"], sums["right"])]
    accuracy = np.array([(np.nan,) * 3 if one is None else one for one in found]).reshape(n, 3).T * 100
    low, high = (
        np.array([wilson_interval(*one) for one in zip(dark["dark_clicks"], dark["dark_exposures"])]).reshape(n, 2).T
    )
    drawn = low[low > 0].min(initial=picture.get("dark_low") or 1.0) / 3  # a logarithm has no place for 0
    with np.errstate(divide="ignore", invalid="ignore"):
        curves = {
            "clicks": sums["clicks"] / sums["decisions"],
            "photons": sums["photons"] / sums["photons_known"],
            "dark": np.where(dark["dark_clicks"] > 0, dark["dark_clicks"] / dark["dark_exposures"], np.nan),
            **dict(zip(("accuracy", "accuracy_low", "accuracy_high"), accuracy)),
            **{"dark_low": np.maximum(low, drawn), "dark_high": high},
            **_quantiles(bins, begin, p50=0.5, p99=0.99),
        }
    curves = {name: np.where(own["decisions"] > 0, curve, np.nan) for name, curve in curves.items()}
    limits = {
        "chance": 100 / len(begun["classes"]) if begun.get("classes") else None,
        **{"deadline": begun.get("deadline_us") or None, "stated": begun.get("clicks_stated")},
        **{"expected_low": picture.get("dark_low"), "expected_high": picture.get("dark_high")},
    }
    seconds = at[:, 1] - at[begin, 0]
    return curves | {
        "s": at.mean(axis=1),
        "over": seconds,
        "rate": sums["decisions"] / seconds,
        **{name: own[name] / (at[:, 1] - at[:, 0]) for name in ("late", "lost")},
        "drift": np.array([np.nan if one.drift_ppm is None else one.drift_ppm for one in bins]),
        **{name: np.full(n, np.nan if value is None else value, np.float64) for name, value in limits.items()},
    }


def _added_up(rows: F64) -> F64:
    return np.vstack([np.zeros((1, rows.shape[1])), rows.cumsum(axis=0)])


def _begins(made: F64, least: float) -> NDArray[np.int64]:
    """Return the first bin of each bin's point, so that `made`, added up, grows by `least` in it; int64 (bins,)."""
    return np.clip(np.searchsorted(made, made[1:] - least, side="right") - 1, 0, np.arange(len(made) - 1))


def _quantiles(bins: list[Bin], begin: NDArray[np.int64], **wanted: float) -> Columns:
    """Return quantiles of the latencies in us, float64 (bins,), of the bins from `begin` up to each."""
    keys = sorted({key for one in bins for key in one.latency}) or [0]
    place, counts = {key: at for at, key in enumerate(keys)}, np.zeros((len(bins), len(keys)))
    for row, one in zip(counts, bins):
        row[[place[key] for key in one.latency]] = list(one.latency.values())
    total = _added_up(counts)
    shares = (total[1:] - total[begin]).cumsum(axis=1)
    at = {name: (shares >= np.maximum(1, np.ceil(q * shares[:, -1:]))).argmax(axis=1) for name, q in wanted.items()}
    return {name: np.where(shares[:, -1] > 0, np.array(keys)[one] / 1000, np.nan) for name, one in at.items()}


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
        self._began = datetime.now().astimezone()

    def take(self, message: dict[str, Any]) -> None:
        """Take a message of the run."""
        self.history.take(message)
        self._made.clear()
        if self.history.picture:
            self._began = datetime.now().astimezone() - timedelta(seconds=float(self.history.picture["elapsed_s"]))
            self.alarms.take(self.history)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` gives, made once per picture."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def milliseconds(self, s: Any) -> Any:
        """Return seconds of the run as milliseconds of the time of day here, which Bokeh takes for UTC."""
        return (self._began.timestamp() + (self._began.utcoffset() or timedelta()).total_seconds() + s) * 1000

    def texts(self) -> dict[str, str]:
        """Return the parts of the page that are text, as HTML."""
        history, picture = self.history, self.history.picture
        if not picture:
            return {"head": str(self.parts.waiting(title_of(history)))}
        word, names = (
            picture.get("word"),
            [one_line(name, NAME_CHARACTERS) for name in history.begin.get("classes", ())],
        )
        facts = {
            "title": title_of(history),
            "state": picture["state"],
            "ended": one_line(picture["ended"], 200),
            "elapsed": duration(picture["elapsed_s"]),
            "headline": headline(history),
            "progress": (picture["decisions"], history.begin.get("expected", 0)),
            "health": health(history),
            "alarms": list(self.alarms.all)[::-1],
            "clock": lambda s: f"{self._began + timedelta(seconds=s):%d %b %H:%M:%S}",
            "word": word,
            "decision": None if word is None else decision_row(history, word["decision"]),
            "chances": [] if word is None else sorted(zip(word["posterior"], names), reverse=True)[:PER_ROW],
            "encoder": history.begin.get("encoder"),
            "latest": latest_rows(history),
            "classes": class_rows(history),
            "figures": rows_of(history),
        }
        return {name: str(getattr(self.parts, name)(facts)) for name in TEXTS}

    def curves(self, level: float, least: float) -> Columns:
        """Return the columns of the figures."""
        found = columns(self.history, level, least)
        return found | {"x": self.milliseconds(found["s"])}

    def marks(self) -> Columns:
        """Return the alarms as columns."""
        now_s, some = float(self.history.picture.get("elapsed_s", 0.0)), self.alarms.all
        return {
            "begin": [self.milliseconds(one.begin_s) for one in some],
            "end": [self.milliseconds(now_s if one.end_s is None else one.end_s) for one in some],
            "colour": [LEVEL_COLOURS[one.level] for one in some],
        }

    def patterns(self) -> Columns:
        """Return the patterns of the latest word as columns: an image each, where it stands, and what is written below."""
        word, pixels = self.history.picture.get("word") or {"patterns": [], "clicks": []}, self.history.pixels
        known = [(n, clicks, pixels[str(n)]) for n, clicks in zip(word["patterns"], word["clicks"]) if str(n) in pixels]
        grey = [np.frombuffer(base64.b64decode(one["grey"]), np.uint8).reshape(one["shape"]) for _, _, one in known]
        at = np.arange(len(known))
        return {
            "image": [one[::-1] for one in grey],
            "x": at % PER_ROW + 0.06,
            "y": -(at // PER_ROW) - 0.68,
            "text": [f"{n} {'●' if clicks else '○'}{f' {clicks}' if clicks > 1 else ''}" for n, clicks, _ in known],
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
        self._drawn = (0.0, 0.0, 0.0)  # level, least, time
        self._decision: Any = None
        self._curves, self._marks = ColumnDataSource(page.curves(LEVELS[0], 1)), ColumnDataSource(page.marks())
        self._patterns, self._range = ColumnDataSource(page.patterns()), Range1d(0, 1)
        self._style: dict[str, Any] = {"stylesheets": [str(page.parts.style())]}
        wide = self._style | {"sizing_mode": "stretch_width"}
        self._divs = {name: Div(name=name, disable_math=True, **wide) for name in TEXTS}
        self._span = Select(name="span", title="Time shown", value="10 minutes", options=list(SPANS), **wide)
        least = "A point takes at least (decisions)"
        self._least = Select(name="least", title=least, value="100", options=list(LEAST), **wide)
        now = Button(name="now", label="Follow the run", **wide)
        self._span.on_change("value", lambda attr, old, new: self._redraw(follows=True))
        self._least.on_change("value", lambda attr, old, new: self._redraw(follows=self._follows))
        now.on_click(lambda: self._redraw(follows=True))
        roots = [*self._divs.values(), self._span, self._least, now, self._picture()]
        roots += [self._figure(name, plot) for name, plot in PLOTS.items()]
        with document.models.freeze():  # the models are counted once, not with each root
            for root in [*roots, *(self._controls(wide) if page.control else ())]:
                document.add_root(root)
        document.template, document.title = page.template, title_of(page.history)
        document.template_variables["control"] = page.control

    def _figure(self, name: str, plot: Plot) -> Any:
        (low, high), curves, first = plot.ends, self._curves, next(iter(plot.lines))
        ends = DataRange1d(only_visible=True) if plot.scale == "log" or low is None else DataRange1d(start=low)
        one = _ground(
            name=name,
            height=260,
            sizing_mode="stretch_width",
            x_axis_type="datetime",
            y_axis_type=plot.scale,
            x_range=self._range,
            y_range=ends if high is None else Range1d(low, high),
            tools="xpan,xbox_zoom,xwheel_zoom,reset,save",
            y_axis_label=plot.unit,
        )
        one.toolbar.logo, one.xgrid.visible, one.min_border_right = None, False, 16
        one.vstrip(x0="begin", x1="end", source=self._marks, fill_color="colour", fill_alpha=0.15, line_color=None)
        one.vspan(x="begin", source=self._marks, line_color="colour", line_dash="dashed")
        tips = [("at", "@x{%F %T}"), *((legend, f"@{column}{{0.[0000]}}") for column, legend in plot.lines.items())]
        bands = {"expected": ("expected", GREEN)} if name == "dark" else {}
        bands |= {first: ("95 % interval", BLUE)} if plot.band else {}
        for column, (legend, colour) in bands.items():
            between = {"y1": f"{column}_low", "y2": f"{column}_high"}
            one.varea(x="x", **between, source=curves, fill_color=colour, fill_alpha=0.25, legend_label=legend)
            tips.append((legend, f"@{column}_low{{0.[00000]}} to @{column}_high{{0.[00000]}}"))
        for (column, legend), style in zip(plot.lines.items(), (*STYLES, (RED, "dotted"))):
            colour, dash = (RED, "dotted") if column in LIMITS else style
            line = {"x": "x", "y": column, "source": curves, "color": colour}
            drawn = one.line(line_width=2, line_dash=dash, legend_label=legend, **line)
            if column == first:
                one.scatter(size=3, **line)
                hover = {
                    "mode": "vline",
                    "formatters": {"@x": "datetime"},
                    "tooltips": [*tips, ("over", "@over{0.[0]} s")],
                }
                one.add_tools(HoverTool(renderers=[drawn], **hover))
        one.add_layout(one.legend[0], "below")
        one.legend[0].update(orientation="horizontal", ncols=2, border_line_color=None, background_fill_alpha=0)
        one.legend[0].update(padding=0, margin=2, spacing=12, **self._style)
        one.on_event(RangesUpdate, lambda event: self._redraw(follows=False))  # moved by hand, it stays
        one.on_event(Reset, lambda event: self._redraw(follows=True))
        return one

    def _picture(self) -> Any:
        """The patterns of a click word."""
        one = self._words = _ground(
            name="patterns",
            x_range=Range1d(0, PER_ROW),
            y_range=Range1d(-1, 0),
            sizing_mode="scale_width",
            aspect_ratio=PER_ROW / ROW_HEIGHT,
            tools="",
            toolbar_location=None,
            outline_line_color=None,
        )
        one.axis.visible = one.grid.visible = False
        grey = LinearColorMapper([f"#{level:02x}{level:02x}{level:02x}" for level in range(256)], low=0, high=255)
        place: dict[str, Any] = {"x": "x", "y": "y", "source": self._patterns}
        one.image(image="image", dw=0.86, dh=0.66, color_mapper=grey, **place)
        one.block(width=0.86, height=0.66, fill_color=None, line_color="colour", line_width=3, **place)
        one.text(text="text", y_offset=4, text_baseline="top", text_font_size="12px", text_color="colour", **place)
        return one

    def _controls(self, wide: dict[str, Any]) -> list[Any]:
        title = f"Note (at most {NOTE_CHARACTERS} characters)"
        note = TextInput(name="note", title=title, max_length=NOTE_CHARACTERS, **wide)
        mark = Button(name="mark", label="Mark this moment", button_type="primary", **self._style)
        stop = Button(name="stop", label="Stop the run", button_type="danger", **self._style)

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
        return [note, mark, stop]

    def _redraw(self, *, follows: bool) -> None:
        """Draw the curves for the range and the smoothing that are asked for."""
        self._follows, self._drawn = follows, (0.0, 0.0, 0.0)
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
        decision = (page.history.picture.get("word") or {}).get("decision")
        if decision != self._decision:
            self._decision, self._patterns.data = decision, page.once("patterns", page.patterns)
            rows = max(1, -(-len(self._patterns.data["text"]) // PER_ROW))
            if self._words.y_range.start != -rows:
                self._words.y_range.start, self._words.aspect_ratio = -rows, PER_ROW / rows / ROW_HEIGHT

    def _draw(self) -> None:
        page, picture = self._page, self._page.history.picture
        now_s = float(picture.get("elapsed_s", 0.0))
        if self._follows:
            first_s = max(0.0, now_s - SPANS[self._span.value])
            first, last = (float(page.milliseconds(s)) for s in (first_s, max(now_s, first_s + 10)))
            self._range.update(start=first, end=last)
        shown_s = (max(self._range.end, page.milliseconds(now_s)) - self._range.start) / 1000
        level = next((one for one in LEVELS if BINS * one >= shown_s), LEVELS[-1])
        least, (was, wanted, at_s) = float(self._least.value), self._drawn
        if (was, wanted) == (level, least) and now_s - at_s < min(10.0, level / 5) and not picture.get("ended"):
            return
        self._drawn = level, least, now_s
        self._curves.data = page.once((level, least), lambda: page.curves(level, least))
        self._marks.data = page.once("marks", page.marks)


def _ground(**facts: Any) -> Any:
    """Return an empty figure on the ground of the page."""
    return figure(background_fill_color=None, border_fill_color=None, **({"toolbar_location": "above"} | facts))


class _Door(Router):
    """Lets requests through to Bokeh's server that name this host, where `local`, and a path of the page; websockets of this origin."""

    def __init__(self, app: BokehTornado, *, local: bool) -> None:
        self._app, self._local = app, local

    def find_handler(self, request: Any, **kwargs: Any) -> Any:
        """Return who answers."""
        origin = request.headers.get("Origin")
        if self._local and not is_loopback(request.host_name.strip("[]")):
            return _refusal(request, 403, "This page is for the machine that it runs on.")
        if PATHS.fullmatch(request.path) is None or request.method not in ("GET", "HEAD"):
            return _refusal(request, 404, "There is no such page.")
        if request.path == "/ws" and origin is not None and urlsplit(origin).netloc.lower() != request.host.lower():
            return _refusal(request, 403, "A page of another origin has asked.")
        if request.path == "/" and len(self._app.get_sessions("/")) >= SESSIONS_MAX:
            full = f"{SESSIONS_MAX} pages follow this run already. Close one, wait 15 seconds and try again."
            return _refusal(request, 503, full)
        return self._app.find_handler(request, **kwargs)


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
        inline: list[bytes] = []
        if headers.get("Content-Type", "").startswith("text/html"):
            inline = re.findall(rb"<script(?![^>]*\ssrc=)[^>]*>(.*?)</script>", chunk, re.DOTALL)
            headers["Cache-Control"] = "no-store"
        hashes = (f"'sha256-{base64.b64encode(hashlib.sha256(one).digest()).decode()}'" for one in inline)
        headers["Content-Security-Policy"] = POLICY.format(" ".join(hashes))
        headers["X-Content-Type-Options"], headers["Referrer-Policy"], headers["Server"] = (
            "nosniff",
            "no-referrer",
            "pans",
        )
        return status_code, headers, chunk


async def serve(
    listening: socket.socket, history: History, draws: list[Callable[[History], None]], *, address: str, control: bool
) -> None:
    """Serve the page at the socket `listening`, bound to `address`, until standard input ends; `draws` show `history` elsewhere, too."""
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # nobody reads them beside a run
    loop, ended, page = IOLoop.current(), asyncio.Event(), Page(history, control=control)
    app = BokehTornado(
        {"/": Application(FunctionHandler(page.open))},
        extra_websocket_origins=["*"],  # the door has looked
        unused_session_lifetime_milliseconds=10_000,
        check_unused_sessions_milliseconds=3000,
        websocket_max_message_size_bytes=1 << 16,
        include_headers=[],
        include_cookies=[],
    )
    app.transforms.append(_Headers)
    limits = {"idle_connection_timeout": 20, "body_timeout": 5, "max_header_size": 1 << 14, "max_body_size": 1 << 12}
    http = HTTPServer(_Door(app, local=not is_public(address)), **limits)
    http.add_socket(listening)
    server = BaseServer(loop, app, http)
    server.start()
    gc.freeze()  # what is loaded stays: Bokeh collects twice for each session that ends

    def take(line: str) -> None:
        page.take(json.loads(line))
        for draw in draws:
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
    server.stop()
