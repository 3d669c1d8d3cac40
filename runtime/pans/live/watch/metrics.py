"""The run's figures for Prometheus: the picture of the state file in base units, served by prometheus_client.

On this machine only, unless it is said twice that others may read: there is no password. Needs the extra `metrics`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from io import StringIO
from ipaddress import ip_address
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler

from pans.base.console import missing_extra
from pans.base.errors import UsageError, refusing
from pans.base.numbers import live_figures

LOOPBACK = "127.0.0.1"
REQUEST_S = 2.0  # without a byte from a client


def parse_address(text: str, option: str = "--metrics") -> tuple[str, int]:
    """Read `PORT`, `HOST:PORT` or `[HOST]:PORT`; a port alone means this machine only. `option` is named in errors."""
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") if colon else ""
    if not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise UsageError(f"{option} {text!r}: no address", remedy="write 127.0.0.1:PORT, for example 127.0.0.1:9464")
    return host or LOOPBACK, int(port)


def check_address(text: str, *, public: bool, option: str = "--metrics") -> str:
    """Return `text`; UsageError if it is no address, or one that other machines can reach without `public`."""
    if not (is_loopback(parse_address(text, option)[0]) or public):
        raise UsageError(
            f"{option} {text}: other machines could read the figures there, and there is no password",
            remedy=f"use 127.0.0.1, or say {option}-public if that is meant",
        )
    return text


def is_loopback(host: str) -> bool:
    """Whether `host`, a name or an address, is this machine itself."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_public(text: str) -> bool:
    """Whether other machines can reach this address."""
    return not is_loopback(parse_address(text)[0])


class Collector:
    """What prometheus_client asks for figures, at each scrape."""

    def __init__(self, look: Callable[[], dict[str, Any]]) -> None:
        self._look = look

    def collect(self) -> Iterator[Any]:
        """Yield one family for each figure that the picture holds."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        picture = self._look()
        if "disk_free_bytes" in picture:  # a recording is written: an alert needs the figure to be there at all times
            picture = {"disk_left_s": math.inf} | picture
        served = [
            (one, CounterMetricFamily if one.counts else GaugeMetricFamily) for one in live_figures() if one.metric
        ]
        for one, kind in served:
            if not one.label and picture.get(one.live) is not None:
                value = picture[one.live] * (1e-6 if one.unit == "us" else 1)  # Prometheus takes base units
                yield kind(one.metric, one.meaning, value=value)
        for one, kind in served:
            if one.label:  # also without a sample: a dashboard asks for the name
                family = kind(one.metric, one.meaning, labels=[one.label])
                for which, value in picture.get(one.live, {}).items():
                    family.add_metric([which], value)
                yield family
        words, running = "1 while the device measures and the loop turns", picture.get("state") == "running"
        yield GaugeMetricFamily("pans_running", words, value=float(running))
        if "last_verdict" in picture:
            words, failed = "1 if the latest run that ended did not PASS", picture["last_verdict"] != "PASS"
            family = GaugeMetricFamily("pans_last_run_failed", words, labels=["folder"])
            family.add_metric([picture.get("last_folder", "")], float(failed))
            yield family


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_S

    def handle(self) -> None:
        with suppress(OSError):  # a client that goes away, or says nothing
            super().handle()

    def get_stderr(self) -> StringIO:
        """Figures that change while they are read are answered by 500; the next scrape has them, and the live view stays whole."""
        return StringIO()

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""


class MetricsServer:
    """Serves the figures until `close`; `port` is the one that was given, or found for port 0.

    On a loopback address, requests that name another host are refused: a web page elsewhere could have made its own name point here (DNS
    rebinding).
    """

    def __init__(self, address: str, look: Callable[[], dict[str, Any]] = dict) -> None:
        self.look = look  # a run that is there later than its server gives its own
        self.host, port = parse_address(address)
        try:
            from prometheus_client import CollectorRegistry, make_wsgi_app, start_http_server
        except ImportError as error:
            raise missing_extra("--metrics", "prometheus-client", "metrics") from error
        registry = CollectorRegistry(auto_describe=False)
        with refusing(f"--metrics {address}: cannot listen there", "choose another port"):
            self._server, self._thread = start_http_server(port, self.host, registry)
        self.port = self._server.server_port
        self._server.RequestHandlerClass = _Handler
        self._app = make_wsgi_app(registry)
        self._server.set_app(self._answer)
        registry.register(Collector(lambda: self.look()))  # from here on there is something to read

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _answer(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        host = environ.get("HTTP_HOST", LOOPBACK).strip()  # every browser sends it
        name = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
        if is_loopback(self.host) and not is_loopback(name):
            start_response("403 Forbidden", [])
            return [b""]
        return self._app(environ, start_response)
