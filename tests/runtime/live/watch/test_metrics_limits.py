"""The server of the metrics under clients that mean no good: scrapes still answered, nothing said on stderr, no thread left behind."""

import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing

import pytest

from pans.base.errors import UsageError
from pans.live.watch import metrics
from pans.live.watch.metrics import MetricsServer, check_address, is_public, parse_address

pytest.importorskip("prometheus_client", reason="needs the metrics extra")
HALF_OPEN = 20


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[MetricsServer]:
    monkeypatch.setattr(metrics._Handler, "timeout", 0.5)
    with closing(MetricsServer("0", lambda: {"decisions": 7, "latency_p99_us": 250.0})) as one:
        yield one


def dial(server: MetricsServer, words: bytes = b"") -> socket.socket:
    client = socket.create_connection(("127.0.0.1", server.port), timeout=10)
    client.sendall(words)
    return client


def scrape(server: MetricsServer) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/metrics", timeout=10) as answer:
        return str(answer.read().decode())


def all_of(client: socket.socket) -> bytes:
    data = b""
    while piece := client.recv(1 << 16):
        data += piece
    return data


def test_half_open_connections_end_and_shut_nobody_out(
    server: MetricsServer, capfd: pytest.CaptureFixture[str]
) -> None:
    threads = threading.active_count()
    held = [dial(server, b"GET /metrics HTTP/1.1\r\nX: " * (number % 2)) for number in range(HALF_OPEN)]
    assert "pans_decisions_total 7.0" in scrape(server)
    until_s = time.monotonic() + 10
    while threading.active_count() > threads and time.monotonic() < until_s:
        time.sleep(0.05)
    assert threading.active_count() <= threads
    for client in held:
        assert b"pans_" not in all_of(client)
        client.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (b"GET / HTTP/1.1\r\nX: " + b"x" * 100_000, b"431"),
        (b"POST / HTTP/1.1", b"405"),
        (b"GET /metrics HTTP/1.1\r\nHost: [::1]:8000", b"200"),
        (b"GET /metrics HTTP/1.1\r\nHost: localhost:8000", b"200"),
        (b"GET /metrics HTTP/1.1\r\nHost: evil.example:1", b"403"),
        (b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1.evil.example", b"403"),
        (b"\0\xff", b"400"),
        (b"GET /metrics?x=1 HTTP/1.0", b"200"),
    ],
)
def test_requests(server: MetricsServer, words: bytes, status: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with dial(server, words + b"\r\n\r\n") as client:
        answer = all_of(client)
    assert answer.split(b"\r\n")[0].split(b" ")[1] == status or b"Error code: " + status in answer
    assert (b"pans_latency_p99_seconds 0.00025" in answer) == (status == b"200")
    assert capfd.readouterr().err == ""


def test_figures_that_cannot_be_read_end_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    looks = iter([{"decisions": 7}])
    with closing(MetricsServer("0", lambda: next(looks))) as server:
        assert "pans_decisions_total 7.0" in scrape(server)
        with pytest.raises(urllib.error.HTTPError, match="500"):
            scrape(server)
    assert capfd.readouterr().err == ""


def test_a_busy_port_is_refused_at_once(server: MetricsServer) -> None:
    with pytest.raises(UsageError, match=f"{server.port}: cannot listen there: Address already in use"):
        MetricsServer(str(server.port))


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
