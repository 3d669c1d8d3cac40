"""A small HTTP server for one page and its events (server-sent events, WHATWG HTML 9.2), with few connections and little time for each.

A connection beyond MAX_CLIENTS takes the place of the oldest, so that those who open many and say nothing cannot shut out one who asks. On
a loopback address, requests that name another host are refused: a web page elsewhere could have made its own name point here (DNS
rebinding).
"""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from ipaddress import ip_address
from socketserver import ThreadingTCPServer
from typing import Any, Protocol

MAX_CLIENTS, MAX_LISTENERS = 8, 6
REQUEST_S = 2.0  # without a byte from a client
LISTENER_STUCK_S = 10.0
KEEP_ALIVE_S = 10.0  # without events a comment goes out, so that a browser that is gone is noticed
PAGE_KEPT_S = POLL_S = 0.25
LOOK_EVERY_S = 0.02  # for new events
GOODBYE_S = 1.0  # for the last events
PATHS, EVENTS_PATH = ("/", "/metrics"), "/events"


def is_loopback(host: str) -> bool:
    """Whether `host`, a name or an address, is this machine itself."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Feed(Protocol):
    """Events for browsers: `number` grows with each; `after(n)` returns what one who has seen those up to `n` (-1: none) must be sent."""

    @property
    def number(self) -> int:
        """How many there have been."""

    def after(self, number: int) -> bytes:
        """Return them in the form of server-sent events; older ones that a later one replaces are left out."""


class PageServer(ThreadingTCPServer):
    """Serves what `page` returns, with these `headers`, at `host`, until `close`; OSError if it cannot listen there.

    With `feed` its events are served at `/events`.
    """

    daemon_threads = allow_reuse_address = True
    request_queue_size = 128  # in the kernel, where they cost nothing

    def __init__(
        self, host: str, port: int, page: Callable[[], bytes], headers: dict[str, str], feed: Feed | None = None
    ) -> None:
        self.headers, self.feed, self.local = headers, feed, is_loopback(host)
        self.ending, self.listeners = threading.Event(), threading.BoundedSemaphore(MAX_LISTENERS)
        self._page, self._made_s, self._made, self._alone = page, -PAGE_KEPT_S, b"", threading.Lock()
        self._clients: dict[socket.socket, None] = {}  # the oldest first
        self.address_family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        super().__init__((str(address[0]), int(address[1])), _Handler)
        self.port = int(self.socket.getsockname()[1])
        self._thread = threading.Thread(target=self.serve_forever, args=(POLL_S,), name="pans-metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Send the last events and stop serving."""
        self.ending.set()
        self.shutdown()
        self._thread.join()
        self.server_close()
        until_s = time.monotonic() + GOODBYE_S
        for _ in range(MAX_LISTENERS):
            self.listeners.acquire(timeout=max(0.0, until_s - time.monotonic()))

    def page(self) -> bytes:
        """Return the page, made anew at most every PAGE_KEPT_S."""
        with self._alone:
            if time.monotonic() - self._made_s >= PAGE_KEPT_S:
                self._made_s, self._made = time.monotonic(), self._page()
            return self._made

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread of its own."""
        while len(self._clients) >= MAX_CLIENTS:
            self.forget(oldest := next(iter(self._clients)))
            with suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)
        self._clients[request] = None
        super().process_request(request, client_address)

    def forget(self, request: socket.socket) -> None:
        """Count a connection no longer: it has ended, or follows the events."""
        self._clients.pop(request, None)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self.forget(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away is no error of ours."""


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    timeout = REQUEST_S
    protocol_version = default_request_version = "HTTP/1.1"
    server_version, sys_version = "pans", ""

    def do_GET(self) -> None:
        self.close_connection = True
        path = self.path.split("?", 1)[0]
        if self.server.local and not self._names_this_machine():
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.server.feed is not None and path == EVENTS_PATH and self.command == "GET":
            self._follow(self.server.feed)
        elif path not in PATHS:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            try:
                page = self.server.page()
            except Exception:  # figures that change while they are read: the next scrape has them
                self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR)
                return
            self._begin(self.server.headers | {"Content-Length": str(len(page))})
            if self.command != "HEAD":
                self.wfile.write(page)

    do_HEAD = do_GET

    def _begin(self, headers: dict[str, str]) -> None:
        self.send_response(HTTPStatus.OK)
        for name, value in ({"X-Content-Type-Options": "nosniff", "Connection": "close"} | headers).items():
            self.send_header(name, value)
        self.end_headers()

    def _names_this_machine(self) -> bool:
        """Whether the Host line, if there is one, names a loopback address: every browser sends it."""
        host = (self.headers.get("Host") or "localhost").strip()
        return is_loopback(host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0])

    def _follow(self, feed: Feed) -> None:
        """Send events until the browser or the server ends."""
        if not self.server.listeners.acquire(blocking=False):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
            return
        try:
            self.server.forget(self.connection)
            self.connection.settimeout(LISTENER_STUCK_S)
            self._begin({"Content-Type": "text/event-stream", "Cache-Control": "no-store"})
            gone = selectors.DefaultSelector()
            gone.register(self.connection, selectors.EVENT_READ)
            seen, moved_s, ended = -1, time.monotonic(), False
            while not ended:
                ended = self.server.ending.is_set()
                if gone.select(LOOK_EVERY_S) and not self.connection.recv(1024):
                    return
                number, now_s = feed.number, time.monotonic()
                if number != seen:
                    self.wfile.write(feed.after(seen))
                    seen, moved_s = number, now_s
                elif now_s - moved_s > KEEP_ALIVE_S:
                    self.wfile.write(b":\n\n")
                    moved_s = now_s
        finally:
            self.server.listeners.release()

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""
