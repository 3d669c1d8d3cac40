"""The live view as a web page: one file without a build step, and server-sent events that fill it.

The page works without any network but this server: its policy (CSP) allows its own script and style, by their SHA-256, and nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import time
from functools import cache
from importlib.resources import files
from typing import Any

from pans.runtime.watch.http import PageServer

from .figures import class_rows, latest_rows, rows_of, series, title_of
from .history import History

SERIES_EVERY_S = 3.0
KIND = "text/html; charset=utf-8"


@cache
def page() -> bytes:
    """Return the page's file."""
    return files(__package__).joinpath("live.html").read_bytes()


def policy() -> dict[str, str]:
    """Return the headers that let the page run its own script and style alone."""
    text = page().decode()
    hashes = {
        name: " ".join(
            f"'sha256-{base64.b64encode(hashlib.sha256(part.encode()).digest()).decode()}'"
            for part in re.findall(rf"<{name}>(.*?)</{name}>", text, re.DOTALL)
        )
        for name in ("script", "style")
    }
    return {
        "Content-Security-Policy": f"default-src 'none'; script-src {hashes['script']}; style-src {hashes['style']}; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store",
    }


class Events:
    """The feed of the page: after each picture its figures, now and then the curves."""

    def __init__(self, history: History) -> None:
        self._history = history
        self.number = 0
        self._now = self._curves = b""
        self._curves_number, self._curves_due_s = 0, 0.0

    def renew(self) -> None:
        """Make the events anew, after a picture."""
        history, now_s = self._history, time.monotonic()
        self._now = _event("now", now_facts(history))
        if now_s >= self._curves_due_s or history.picture.get("ended"):
            self._curves_due_s = now_s + SERIES_EVERY_S
            self._curves = _event("curves", series(history))
            self._curves_number = self.number + 1
        self.number += 1

    def after(self, number: int) -> bytes:
        """See watch/http.Feed."""
        return self._now + (self._curves if number < self._curves_number else b"")


class LivePage:
    """Serves the page at `host` and `port` (0: any that is free) until `close`; OSError if it cannot listen there."""

    def __init__(self, host: str, port: int, history: History) -> None:
        self._events = Events(history)
        self._events.renew()
        self._server = PageServer(host, port, page, policy() | {"Content-Type": KIND}, self._events)
        self.port = self._server.port

    def draw(self) -> None:
        """Tell all who follow what is new."""
        self._events.renew()

    def close(self) -> None:
        """Send what is left and stop."""
        self._server.close()


def now_facts(history: History) -> dict[str, Any]:
    """Return what the page shows of the present moment, JSON-able; every text in it is inert."""
    picture = history.picture
    word = picture.get("word") or {"patterns": [], "clicks": []}
    return {
        "title": title_of(history),
        "simulated": bool(history.begin.get("simulated")),
        "state": picture.get("state", "setting up"),
        "ended": bool(picture.get("ended")),
        "elapsed_s": picture.get("elapsed_s", 0.0),
        "late": picture.get("late", 0),
        "lost": picture.get("lost", 0),
        "progress": [picture.get("decisions", 0), history.begin.get("expected", 0)],
        "deadline_us": history.begin.get("deadline_us", 0),
        "dark_expected": picture.get("dark_expected"),
        "dark_high": picture.get("dark_high"),
        "chance": 1 / len(history.begin["classes"]) if history.begin.get("classes") else None,
        "rows": rows_of(history),
        "classes": class_rows(history),
        "latest": latest_rows(history),
        "walk": history.begin.get("encoder") == "automaton",
        "passive": history.begin.get("encoder") in ("coherent", "incoherent"),
        "word": [
            {"pattern": pattern, "clicks": clicks, **history.pixels.get(str(pattern), {})}
            for pattern, clicks in zip(word["patterns"], word["clicks"])
        ],
    }


def _event(name: str, facts: dict[str, Any]) -> bytes:
    return f"event: {name}\ndata: {json.dumps(facts, allow_nan=False)}\n\n".encode()
