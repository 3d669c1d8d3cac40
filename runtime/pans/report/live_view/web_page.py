"""The live view as a web page, by Bokeh's server (extra `ui`): curves to zoom into, alarms, the last objects, the figures.

What all pages show is made once after a picture; each page copies it once per second, for the range and the smoothing that it asks for.
A request that names another host is refused where only this machine may ask (DNS rebinding), and what another site's page asks for.
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
import tomllib
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.events import RangesUpdate, Reset
from bokeh.models import Button, ColumnDataSource, DataRange1d, Div, HoverTool, Range1d, Select, TextInput
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

from pans.base.files import grey_png
from pans.base.numbers import group_of, has_quantile, wilson_interval
from pans.live.watch import is_loopback

from . import figures
from .alarms import Alarms
from .history import BINS, LEVELS, SUMS, Bin, History
from .monitor import NOTE_CHARACTERS

SESSIONS_MAX = 12
REFRESH_MS, LAST_LOOK_S = 1000, 0.6
LEAST_DARK = 10  # dark counts of a point
PATHS = re.compile(r"/|/ws|/static/[\w./-]+|/favicon\.ico")
TEXTS = ("head", "health", "alarms", "word", "latest", "figures")
POLICY = (
    "default-src 'none'; script-src 'self' {}; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
LAYOUT: dict[str, Any] = tomllib.loads(files(__package__).joinpath("live.toml").read_text(encoding="utf-8"))
PLOTS, COLOURS, SPANS = LAYOUT["plots"], LAYOUT["colours"], LAYOUT["spans"]
F64 = NDArray[np.float64]


def columns(history: History, level: float, least: float) -> dict[str, F64]:
    """Return the curves in bins of `level` seconds, float64 (bins,) each, `s` in seconds of the run, NaN where nothing is known.

    A point takes its bin and as many before it as hold `least` decisions together, of the dark counts LEAST_DARK.
    """
    bins = [one for one in history.bins[level] if one.end_s > one.begin_s]
    n, picture, begun = len(bins), history.picture, history.begin
    at = np.array([(one.begin_s, one.end_s) for one in bins]).reshape(n, 2)
    own = np.array([one.sums for one in bins], np.float64).reshape(n, len(SUMS))
    begin, sums = _points(own, "decisions", least)
    _, dark = _points(own, "dark_clicks", LEAST_DARK)
    made, late, lost = (own[:, SUMS.index(name)] for name in ("decisions", "late", "lost_exposures"))
    found = [history.accuracy({"judged": n, "right": right}) for n, right in zip(sums["judged"], sums["right"])]
    group = group_of(picture) if picture else "decisions"
    accuracy = np.array(found).reshape(n, 3).T * 100
    intervals = [wilson_interval(*one) for one in zip(dark["dark_clicks"], dark["dark_exposures"])]
    low, high = np.array(intervals).reshape(n, 2).T
    drawn = low[low > 0].min(initial=picture.get("dark_low") or 1.0) / 3  # a logarithm has no place for 0
    with np.errstate(divide="ignore", invalid="ignore"):
        curves = {
            "clicks": sums[f"{group}_clicks"] / sums[group],
            "photons": sums[f"{group}_photons"] / sums[f"{group}_photons_known"],
            "dark": np.where(dark["dark_clicks"] > 0, dark["dark_clicks"] / dark["dark_exposures"], np.nan),
            **dict(zip(("accuracy", "accuracy_low", "accuracy_high"), accuracy)),
            **{"dark_low": np.maximum(low, drawn), "dark_high": high},
            **_quantiles(bins, begin, p50=0.5, p99=0.99),
        }
    limits = {
        "chance": 100 / len(begun["classes"]) if begun.get("classes") else None,
        **{"deadline": begun.get("deadline_us") or None, "stated": begun.get("clicks_stated")},
        **{"expected_low": picture.get("dark_low"), "expected_high": picture.get("dark_high")},
    }
    own_s = at[:, 1] - at[:, 0]
    return {
        **{name: np.where(made > 0, curve, np.nan) for name, curve in curves.items()},
        **{name: np.full(n, np.nan if value is None else value, np.float64) for name, value in limits.items()},
        **{"s": at.mean(axis=1), "over": at[:, 1] - at[begin, 0], "late": late / own_s, "lost": lost / own_s},
    }


def _points(own: F64, name: str, least: float) -> tuple[NDArray[np.int64], dict[str, F64]]:
    """Return the first bin of each bin's point, so that `name` grows by `least` in it, int64 (bins,), and the point's sums."""
    total = _added_up(own)
    made = total[:, SUMS.index(name)]
    begin = np.clip(np.searchsorted(made, made[1:] - least, side="right") - 1, 0, np.arange(len(own)))
    return begin, dict(zip(SUMS, (total[1:] - total[begin]).T))


def _added_up(rows: F64) -> F64:
    return np.vstack([np.zeros((1, rows.shape[1])), rows.cumsum(axis=0)])


def _quantiles(bins: list[Bin], begin: NDArray[np.int64], **wanted: float) -> dict[str, F64]:
    """Return quantiles of the latencies in us, float64 (bins,), of the bins from `begin` up to each; NaN of too few."""
    keys = sorted({key for one in bins for key in one.latency}) or [0]
    place, counts = {key: at for at, key in enumerate(keys)}, np.zeros((len(bins), len(keys)))
    for row, one in zip(counts, bins):
        row[[place[key] for key in one.latency]] = list(one.latency.values())
    total = _added_up(counts)
    shares = (total[1:] - total[begin]).cumsum(axis=1)
    at = {name: (shares >= np.maximum(1, np.ceil(q * shares[:, -1:]))).argmax(axis=1) for name, q in wanted.items()}
    enough = {name: [has_quantile(n, q) for n in shares[:, -1].tolist()] for name, q in wanted.items()}
    return {name: np.where(enough[name], np.array(keys)[one] / 1000, np.nan) for name, one in at.items()}


class Page:
    """What all sessions show of a run, made once after each picture; `open` fills the document of a new one."""

    def __init__(self, history: History, *, control: bool) -> None:
        self.history, self.control, self.alarms = history, control, Alarms()
        environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        environment.globals |= {"say": figures, "plots": PLOTS, "control": control, "zip": zip}
        self.template = environment.from_string(files(__package__).joinpath("live.html").read_text(encoding="utf-8"))
        self.parts: Any = self.template.module  # the macros
        self.views: dict[Document, _View] = {}
        self._made: dict[Any, Any] = {}
        self._asked_s = 0.0
        self._began_s = 0.0  # as the time of day here, which Bokeh takes for UTC
        self.zone = f"{datetime.now().astimezone():%Z}"

    def take(self, message: dict[str, Any]) -> None:
        """Take a message of the run."""
        pixels = message.get("pixels", {})
        for number, one in pixels.items():
            grey = np.frombuffer(base64.b64decode(one["grey"]), np.uint8).reshape(one["shape"])
            pixels[number] = f"data:image/png;base64,{base64.b64encode(grey_png(grey)).decode()}"
        self.history.take(message)
        self._made.clear()
        if self.history.picture:
            here_s = datetime.now().replace(tzinfo=UTC).timestamp()
            self._began_s = here_s - float(self.history.picture["elapsed_s"])
            self.alarms.take(self.history)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` gives, made once per picture."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def milliseconds(self, s: Any) -> Any:
        """Return seconds of the run as milliseconds of the time of day here."""
        return (self._began_s + s) * 1000

    def clock(self, s: float) -> str:
        """Return seconds of the run as the time of day here."""
        return f"{datetime.fromtimestamp(self._began_s + s, UTC):%d %b %H:%M:%S}"

    def texts(self) -> dict[str, str]:
        """Return the parts of the page that are text, as HTML."""
        names = TEXTS if self.history.picture else TEXTS[:1]
        return {name: str(getattr(self.parts, name)(self)) for name in names}

    def curves(self, level: float, least: float) -> dict[str, Any]:
        """Return the columns of the figures."""
        found = columns(self.history, level, least)
        return found | {"x": self.milliseconds(found["s"])}

    def marks(self) -> dict[str, Any]:
        """Return the alarms as columns."""
        now_s, some = float(self.history.picture.get("elapsed_s", 0.0)), self.alarms.all
        return {
            "begin": [self.milliseconds(one.begin_s) for one in some],
            "end": [self.milliseconds(now_s if one.end_s is None else one.end_s) for one in some],
            "colour": [COLOURS[one.level] for one in some],
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
        self._curves, self._marks = ColumnDataSource(page.curves(LEVELS[0], 1)), ColumnDataSource(page.marks())
        self._style: dict[str, Any] = {"stylesheets": [str(page.parts.style())]}
        self._wide = self._style | {"sizing_mode": "stretch_width"}
        self._divs = {name: Div(name=name, disable_math=True, **self._wide) for name in TEXTS}
        self._span = self._choice("span", "Time shown", SPANS, "10 minutes")
        self._least = self._choice("least", "Decisions of a point, at least", LAYOUT["least"], "100")
        self._range = Range1d(0, 1)
        now = Button(name="now", label="Follow the run", **self._wide)
        now.on_click(lambda: self._redraw(follows=True))
        roots = [*self._divs.values(), self._span, self._least, now, *(self._controls() if page.control else ())]
        with document.models.freeze():  # the models are counted once, not with each root
            for root in [*roots, *(self._figure(name, **plot) for name, plot in PLOTS.items())]:
                document.add_root(root)
        document.template, document.title = page.template, figures.title_of(page.history)

    def _choice(self, name: str, title: str, options: Iterable[str], value: str) -> Any:
        choice = Select(name=name, title=title, options=list(options), value=value, **self._wide)
        choice.on_change("value", lambda attr, old, new: self._redraw(follows=self._follows or name == "span"))
        return choice

    def _figure(self, name: str, **plot: Any) -> Any:
        lines, limits, fixed = plot["lines"], plot.get("limits", {}), plot.get("ends", ())
        y_range = Range1d(*fixed) if len(fixed) == 2 else DataRange1d(**dict(zip(("start",), fixed)))
        axes = {"x_range": self._range, "y_range": y_range, "y_axis_type": plot.get("scale", "linear")}
        one = figure(name=name, y_axis_label=plot["unit"], **axes, **LAYOUT["figure"])
        one.toolbar.logo, one.xgrid.visible = None, False
        one.vstrip(x0="begin", x1="end", source=self._marks, fill_color="colour", fill_alpha=0.15, line_color=None)
        one.vspan(x="begin", source=self._marks, line_color="colour", line_dash="dashed")
        source: dict[str, Any] = {"x": "x", "source": self._curves}
        tips = [("at", "@x{%F %T}"), *((legend, f"@{key}{{0.[0000]}}") for key, legend in (lines | limits).items())]
        for key, legend in plot.get("bands", {}).items():
            ends, colour = {"y1": f"{key}_low", "y2": f"{key}_high"}, COLOURS["first" if key in lines else "note"]
            one.varea(**source, **ends, fill_color=colour, fill_alpha=0.25, legend_label=legend)
            tips.append((legend, f"@{key}_low{{0.[00000]}} to @{key}_high{{0.[00000]}}"))
        styles = [("first", "solid"), ("second", "dashed")][: len(lines)] + [("limit", "dotted")] * len(limits)
        drawn = []
        for (key, legend), (colour, dash) in zip((lines | limits).items(), styles):
            look = source | {"y": key, "color": COLOURS[colour]}
            drawn.append(one.line(line_width=2, line_dash=dash, legend_label=legend, **look))
            if key in lines:
                one.scatter(size=3, **look)
        tips.append(("over", "@over{0.[0]} s"))
        one.add_tools(HoverTool(renderers=drawn[:1], mode="vline", formatters={"@x": "datetime"}, tooltips=tips))
        one.add_layout(one.legend[0], "below")
        one.legend[0].update(**LAYOUT["legend"], **self._style)
        one.on_event(RangesUpdate, lambda event: self._redraw(follows=False))  # moved by hand, it stays
        one.on_event(Reset, lambda event: self._redraw(follows=True))
        return one

    def _controls(self) -> list[Any]:
        title = f"Note (at most {NOTE_CHARACTERS} characters)"
        note = TextInput(name="note", title=title, max_length=NOTE_CHARACTERS, **self._wide)
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
        if page.history.picture:
            self._document.config.notify_connection_status = not page.history.picture[
                "ended"
            ]  # else it is lost in order
            self._document.title = f"{page.history.picture['state']}: {figures.title_of(page.history)}"
            self._draw()

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


class _Server(BokehTornado):  # type: ignore[misc]  # Bokeh is untyped here
    """Bokeh's server, with the requests for a page that it has not answered yet: their sessions are on the way, and in no list of Bokeh."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.unanswered: set[Any] = set()
        super().__init__(*args, **kwargs)

    def log_request(self, handler: Any) -> None:
        """Note that a request has its answer, whatever it is."""
        self.unanswered.discard(handler.request)


class _Door(Router):
    """Lets requests through to Bokeh's server that name this host, where `local`, and a path of the page; none of another site's page.

    Places are counted here, before a session is made, which takes memory and time.
    """

    def __init__(self, app: _Server, *, local: bool) -> None:
        self._app, self._local = app, local

    def find_handler(self, request: Any, **kwargs: Any) -> Any:
        """Return who answers."""
        if self._local and not is_loopback(request.host_name.strip("[]")):
            return _refusal(request, 403, "This page is for the machine that it runs on.")
        if PATHS.fullmatch(request.path) is None or request.method not in ("GET", "HEAD"):
            return _refusal(request, 404, "There is no such page.")
        if {"Content-Length", "Transfer-Encoding"} & {*request.headers}:  # its answer would wait for a body, on a place
            return _refusal(request, 400, "A request for a page has no body.")
        if _is_foreign(request):
            return _refusal(request, 403, "A page of another site has asked. Open this one by its address.")
        if request.path == "/":
            if len(self._app.get_sessions("/")) + len(self._app.unanswered) >= SESSIONS_MAX:
                full = f"{SESSIONS_MAX} pages follow this run already. Close one, wait 15 seconds and try again."
                return _refusal(request, 503, full)
            self._app.unanswered.add(request)
        return self._app.find_handler(request, **kwargs)


def _is_foreign(request: Any) -> bool:
    """Return whether a browser says that a page of another origin has asked, also for a picture; a websocket names its origin alone."""
    origin, site = request.headers.get("Origin"), request.headers.get("Sec-Fetch-Site", "none")
    if origin is not None and urlsplit(origin).netloc.lower() != request.host.lower():
        return True
    return request.path != "/ws" and site not in ("none", "same-origin")


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
        headers.update({"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Server": "pans"})
        return status_code, headers, chunk


async def serve(
    listening: socket.socket, history: History, draws: list[Callable[[History], None]], *, local: bool, control: bool
) -> None:
    """Serve the page at the socket `listening` until standard input ends; `draws` show `history` elsewhere, too."""
    listening.setblocking(False)
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # nobody reads them beside a run
    loop, ended, page = IOLoop.current(), asyncio.Event(), Page(history, control=control)
    app = _Server(
        {"/": Application(FunctionHandler(page.open))},
        extra_websocket_origins=["*"],  # the door has looked
        **LAYOUT["server"],
    )
    app.transforms.append(_Headers)
    http = HTTPServer(_Door(app, local=local), **LAYOUT["http"])
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
