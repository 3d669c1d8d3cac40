"""A small HTTP server for one page: one thread, few connections, little time and few bytes for each, so that no client reaches the loop.

Owns sockets, limits and the few words of HTTP that a scrape needs; the page is the caller's. Whatever clients do, the thread handles a
few events every ROUND_S and sleeps between, makes the page at most every PAGE_KEPT_S, and holds MAX_CLIENTS connections: a further one
takes the place of the oldest, so that those who open many and say nothing cannot shut out one who asks.
"""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

MAX_CLIENTS = 8
REQUEST_S = 2.0  # from the connection to the last byte of the answer
HEADER_MAX_BYTES = 8192
ROUND_S = 0.01
ACCEPTS_PER_ROUND = 4  # fewer than MAX_CLIENTS: who asks at once is heard before others can take the place
BACKLOG = 128  # in the kernel, where they cost nothing
PAGE_KEPT_S = 0.25
POLL_S = 0.25  # how long the end of the server may have to wait
PATHS = (b"/", b"/metrics")


class _Client:
    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.since_s = time.monotonic()
        self.heard = b""
        self.answer = b""


class PageServer:
    """Serves what `page` returns, text in UTF-8 of the type `kind`, at `host`, until `close`; OSError if it cannot listen there."""

    def __init__(self, host: str, port: int, kind: str, page: Callable[[], bytes]) -> None:
        self._kind, self._page = kind, page
        self._made_s, self._made = -PAGE_KEPT_S, b""
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
        self._selector.close()
        self._listener.close()

    def _serve(self) -> None:
        while not self._ending.is_set():
            for key, _ in self._selector.select(POLL_S):
                if key.data is None:
                    self._accept()
                else:
                    self._attend(key.data)
            now_s = time.monotonic()
            for client in [one for one in self._clients.values() if now_s - one.since_s > REQUEST_S]:
                self._drop(client)
            self._ending.wait(ROUND_S)

    def _accept(self) -> None:
        for _ in range(ACCEPTS_PER_ROUND):
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setblocking(False)
            if len(self._clients) == MAX_CLIENTS:
                self._drop(next(iter(self._clients.values())))
            client = self._clients[connection.fileno()] = _Client(connection)
            self._selector.register(connection, selectors.EVENT_READ, client)

    def _attend(self, client: _Client) -> None:
        if client.connection.fileno() not in self._clients:
            return  # dropped for a new one in this round
        try:
            if not client.answer:
                self._hear(client)
            if client.answer:
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
        elif not data:
            self._drop(client)

    def _answer_to(self, head: bytes) -> bytes:
        words = head.split(b"\r\n", 1)[0].split(b" ")
        if len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            return _answer("400 Bad Request")
        if words[0] not in (b"GET", b"HEAD"):
            return _answer("405 Method Not Allowed")
        if words[1].split(b"?", 1)[0] not in PATHS:
            return _answer("404 Not Found")
        now_s = time.monotonic()
        if now_s - self._made_s >= PAGE_KEPT_S:
            try:
                self._made_s, self._made = now_s, self._page()
            except Exception:  # figures that change while they are read: the next scrape has them
                return _answer("500 Internal Server Error")
        return _answer("200 OK", self._kind, self._made, head=words[0] == b"HEAD")

    def _drop(self, client: _Client) -> None:
        if self._clients.pop(client.connection.fileno(), None) is not None:
            with suppress(KeyError, ValueError):
                self._selector.unregister(client.connection)
        client.connection.close()


def _answer(status: str, kind: str = "text/plain", body: bytes = b"", *, head: bool = False) -> bytes:
    lines = f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    return lines.encode() + (b"" if head else body)
