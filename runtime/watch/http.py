"""A small HTTP server for one page and its events: one thread, few connections, little time and few bytes for each.

Owns sockets, limits and the few words of HTTP that a scrape or a browser needs; page and events are the caller's. Whatever clients do, the
thread handles a few events every ROUND_S (CROWDED_ROUND_S while many connect) and sleeps between, makes the page at most every
PAGE_KEPT_S, and holds MAX_CLIENTS connections: a further one takes the place of the oldest, so that those who open many and say nothing
cannot shut out one who asks. A browser that follows the events (server-sent events, WHATWG HTML 9.2) is one of MAX_LISTENERS; one that
does not read misses events and is dropped after LISTENER_STUCK_S. On a loopback address, requests that name another host are refused: a
web page elsewhere could have made its own name point here (DNS rebinding).
"""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from typing import Protocol

MAX_CLIENTS = 8
REQUEST_S = 2.0  # from the connection to the last byte of the answer
HEADER_MAX_BYTES = 8192
ROUND_S = 0.01
# Under attack: whoever holds the interpreter's lock may lose the processor with it, and the loop of a run then waits for both.
CROWDED_ROUND_S = 0.1
CROWDED_S = 1.0  # for so long after a connection had to go for another one
ACCEPTS_PER_ROUND = 4  # fewer than MAX_CLIENTS: who asks at once is heard before others can take the place
BACKLOG = 128  # in the kernel, where they cost nothing
PAGE_KEPT_S = 0.25
POLL_S = 0.25  # how long the end of the server may have to wait
PATHS = (b"/", b"/metrics")
EVENTS_PATH = b"/events"
MAX_LISTENERS = 6
LISTENER_STUCK_S = 10.0
KEEP_ALIVE_S = 10.0  # without events a comment goes out, so that a browser that is gone is noticed


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


class _Client:
    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.since_s = time.monotonic()
        self.heard = b""
        self.answer = b""


class _Listener:
    """A browser that follows the events."""

    def __init__(self, connection: socket.socket, begin: bytes) -> None:
        self.connection, self.pending, self.seen = connection, begin, -1
        self.moved_s = time.monotonic()


class PageServer:
    """Serves what `page` returns, text in UTF-8 of the type `kind`, at `host`, until `close`; OSError if it cannot listen there.

    `headers` are further lines of its answers, each with its line end. With `feed` its events are served at `/events`.
    """

    def __init__(
        self,
        host: str,
        port: int,
        kind: str,
        page: Callable[[], bytes],
        *,
        headers: str = "",
        feed: Feed | None = None,
    ) -> None:
        self._kind, self._page, self._headers, self._feed = kind, page, headers, feed
        self._local = is_loopback(host)
        self._listeners: dict[int, _Listener] = {}  # by file descriptor
        self._made_s, self._made = -PAGE_KEPT_S, b""
        self._crowded_s = -CROWDED_S  # when a connection last had to go for another one
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        self._listener = socket.create_server(address[:2], family=family, backlog=BACKLOG)
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])
        self._clients: dict[int, _Client] = {}  # by file descriptor, the oldest first
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="pans-metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._ending.set()
        self._thread.join()
        for client in list(self._clients.values()):
            self._drop(client)
        for listener in list(self._listeners.values()):
            self._tell(listener, time.monotonic())  # the last word
            self._drop_listener(listener)
        self._selector.close()
        self._listener.close()

    def _serve(self) -> None:
        while not self._ending.is_set():
            for key, _ in self._selector.select(POLL_S):
                if key.data is None:
                    self._accept()
                elif isinstance(key.data, _Listener):
                    self._overhear(key.data)
                else:
                    self._attend(key.data)
            now_s = time.monotonic()
            for listener in list(self._listeners.values()):
                self._tell(listener, now_s)
            for client in [one for one in self._clients.values() if now_s - one.since_s > REQUEST_S]:
                self._drop(client)
            self._ending.wait(CROWDED_ROUND_S if now_s - self._crowded_s < CROWDED_S else ROUND_S)

    def _accept(self) -> None:
        for _ in range(ACCEPTS_PER_ROUND):
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setblocking(False)
            if len(self._clients) == MAX_CLIENTS:
                self._crowded_s = time.monotonic()
                self._drop(next(iter(self._clients.values())))
            client = self._clients[connection.fileno()] = _Client(connection)
            self._selector.register(connection, selectors.EVENT_READ, client)

    def _attend(self, client: _Client) -> None:
        if client.connection.fileno() not in self._clients:
            return  # dropped for a new one in this round
        try:
            if not client.answer:
                self._hear(client)
            if client.answer and client.connection.fileno() in self._clients:
                client.answer = client.answer[client.connection.send(client.answer) :]
                if not client.answer:
                    self._drop(client)
                else:
                    self._selector.modify(client.connection, selectors.EVENT_WRITE, client)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)

    def _hear(self, client: _Client) -> None:
        data = client.connection.recv(HEADER_MAX_BYTES)
        client.heard += data
        head, end, _ = client.heard.partition(b"\r\n\r\n")
        if len(head) > HEADER_MAX_BYTES:
            client.answer = _answer("431 Request Header Fields Too Large")
        elif end:
            client.answer = self._answer_to(head)
            if client.answer.startswith(EVENTS_BEGIN):
                self._follow(client)
        elif not data:
            self._drop(client)

    def _answer_to(self, head: bytes) -> bytes:
        words = head.split(b"\r\n", 1)[0].split(b" ")
        if len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            return _answer("400 Bad Request")
        if words[0] not in (b"GET", b"HEAD"):
            return _answer("405 Method Not Allowed")
        if self._local and not _names_this_machine(head):
            return _answer("403 Forbidden")
        path = words[1].split(b"?", 1)[0]
        if self._feed is not None and path == EVENTS_PATH and words[0] == b"GET":
            return _answer("503 Service Unavailable") if len(self._listeners) >= MAX_LISTENERS else EVENTS_BEGIN
        if path not in PATHS:
            return _answer("404 Not Found")
        now_s = time.monotonic()
        if now_s - self._made_s >= PAGE_KEPT_S:
            try:
                self._made_s, self._made = now_s, self._page()
            except Exception:  # figures that change while they are read: the next scrape has them
                return _answer("500 Internal Server Error")
        return _answer("200 OK", self._kind, self._made, head=words[0] == b"HEAD", headers=self._headers)

    # -- events --------------------------------------------------------------------------------------------------------

    def _follow(self, client: _Client) -> None:
        """Turn a client that asked for the events into a listener."""
        connection = client.connection
        del self._clients[connection.fileno()]
        listener = self._listeners[connection.fileno()] = _Listener(connection, client.answer)
        self._selector.modify(connection, selectors.EVENT_READ, listener)

    def _overhear(self, listener: _Listener) -> None:
        """Take note that a listener went away; it has nothing to say."""
        try:
            if not listener.connection.recv(HEADER_MAX_BYTES):
                self._drop_listener(listener)
        except BlockingIOError:
            pass
        except OSError:
            self._drop_listener(listener)

    def _tell(self, listener: _Listener, now_s: float) -> None:
        """Send what is new; whoever has not read the last event yet gets none."""
        assert self._feed is not None
        if not listener.pending:
            if self._feed.number != listener.seen:
                number = self._feed.number
                listener.pending, listener.seen = self._feed.after(listener.seen), number
            elif now_s - listener.moved_s > KEEP_ALIVE_S:
                listener.pending = b":\n\n"
        if not listener.pending:
            return
        try:
            listener.pending = listener.pending[listener.connection.send(listener.pending) :]
            listener.moved_s = now_s
        except BlockingIOError:
            if now_s - listener.moved_s > LISTENER_STUCK_S:
                self._drop_listener(listener)
        except OSError:
            self._drop_listener(listener)

    def _drop_listener(self, listener: _Listener) -> None:
        if self._listeners.pop(listener.connection.fileno(), None) is not None:
            with suppress(KeyError, ValueError):
                self._selector.unregister(listener.connection)
        listener.connection.close()

    def _drop(self, client: _Client) -> None:
        if self._clients.pop(client.connection.fileno(), None) is not None:
            with suppress(KeyError, ValueError):
                self._selector.unregister(client.connection)
        client.connection.close()


EVENTS_BEGIN = (
    b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nCache-Control: no-store\r\n"
    b"X-Content-Type-Options: nosniff\r\nConnection: close\r\n\r\n"
)


def _names_this_machine(head: bytes) -> bool:
    """Whether the Host line, if there is one, names a loopback address: every browser sends it."""
    for line in head.split(b"\r\n")[1:]:
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"host":
            host = value.strip().decode("latin-1")
            host = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
            return is_loopback(host)
    return True


def _answer(
    status: str, kind: str = "text/plain", body: bytes = b"", *, head: bool = False, headers: str = ""
) -> bytes:
    lines = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
        f"X-Content-Type-Options: nosniff\r\n{headers}Connection: close\r\n\r\n"
    )
    return lines.encode() + (b"" if head else body)
