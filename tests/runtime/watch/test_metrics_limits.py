"""The server under clients that mean no good: few connections and threads, and scrapes still answered."""

import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from pans.runtime.errors import UsageError
from pans.runtime.watch.http import MAX_CLIENTS, REQUEST_S, PageServer
from pans.runtime.watch.metrics import check_address, is_public, parse_address

HALF_OPEN = 60


@pytest.fixture
def server() -> Iterator[PageServer]:
    one = PageServer("127.0.0.1", 0, lambda: b"figures\n" * 2000, {})
    yield one
    one.close()


def dial(server: PageServer, words: bytes = b"") -> socket.socket:
    client = socket.create_connection(("127.0.0.1", server.port), timeout=10)
    client.sendall(words)
    return client


def scrape(server: PageServer, path: str = "/metrics") -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}{path}", timeout=10) as answer:
        return bytes(answer.read())


def all_of(client: socket.socket) -> bytes:
    data = b""
    try:
        while piece := client.recv(1 << 16):
            data += piece
    except ConnectionResetError:
        pass
    return data


def test_half_open_connections_are_few_and_shut_nobody_out(server: PageServer) -> None:
    threads, held = threading.active_count(), list[socket.socket]()
    for number in range(HALF_OPEN):
        held.append(dial(server, b"GET /metrics HTTP/1.1\r\nX: " if number % 2 else b""))
        assert len(server._clients) <= MAX_CLIENTS
        if number % 20 == 10:
            assert len(scrape(server)) == 16_000
    time.sleep(REQUEST_S + 1)
    assert server._clients == {}
    assert threading.active_count() <= threads
    assert all(all_of(client) == b"" for client in held)
    for client in held:
        client.close()


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (b"GET / HTTP/1.1\r\nX: " + b"x" * 100_000, b"431"),
        (b"POST / HTTP/1.1", b"501"),
        (b"GET /secret HTTP/1.1", b"404"),
        (b"GET /../../etc/passwd HTTP/1.1", b"404"),
        (b"HEAD /metrics HTTP/1.1\r\nHost: [::1]:8000", b"200"),
        (b"GET /metrics HTTP/1.1\r\nHost: evil.example:1", b"403"),
        (b"\0\xff", b"400"),
        (b"HEAD /metrics?x=1 HTTP/1.0", b"200"),
    ],
)
def test_requests(server: PageServer, words: bytes, status: bytes) -> None:
    with dial(server, words + b"\r\n\r\n") as client:
        answer = all_of(client)
    assert answer.startswith(b"HTTP/1.1 " + status)
    assert status != b"200" or answer.endswith(b"\r\n\r\n")


def test_a_page_that_cannot_be_made_ends_nothing() -> None:
    pages = iter([b"one"])
    server = PageServer("127.0.0.1", 0, lambda: next(pages), {})
    try:
        assert scrape(server) == b"one"
        time.sleep(0.3)
        with pytest.raises(urllib.error.HTTPError, match="500"):
            scrape(server)
        with pytest.raises(urllib.error.HTTPError, match="404"):
            scrape(server, "/other")
    finally:
        server.close()


@pytest.mark.parametrize("text", ["9464", "127.0.0.1:1", "[::1]:1", "localhost:1", "127.8.8.8:1", ":5"])
def test_an_address_is_on_this_machine(text: str) -> None:
    assert check_address(text, public=False) == text
    assert not is_public(text)


@pytest.mark.parametrize("text", ["0.0.0.0:1", "[::]:1", "192.168.1.2:1", "lab.example:1"])
def test_other_machines_may_read_only_if_it_is_said(text: str) -> None:
    with pytest.raises(UsageError, match="no password"):
        check_address(text, public=False)
    assert check_address(text, public=True) == text


def test_addresses() -> None:
    read = [parse_address(text) for text in ("9464", "0.0.0.0:1", "[::1]:80", ":5")]
    assert read == [("127.0.0.1", 9464), ("0.0.0.0", 1), ("::1", 80), ("127.0.0.1", 5)]
