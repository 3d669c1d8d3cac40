"""The live page: what the server sends and refuses, and the page in a real browser at both widths, in light and dark."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import browser, clipped, console, look, picture, serious, unreachable

from pans.runtime.monitor.history import History
from pans.runtime.monitor.server import LivePage, page
from pans.runtime.watch.http import MAX_LISTENERS

NASTY = '<img src=x onerror="document.title=1">\x1b[2J'
GREY = "AAECAwQFBgcICQoLDA0ODw=="  # 16 pixels


def a_history(pictures: int = 30) -> History:
    history = History()
    classes = [NASTY, "T-shirt/top", "a rather long name of a class of objects", *map(str, range(7))]
    begin = {"bundle": NASTY, "title": f"{NASTY} on a device", "classes": classes, "expected": 1000}
    history.take({"kind": "begin", "simulated": True, "deadline_us": 2000.0, "encoder": "automaton", **begin})
    for k in range(1, pictures + 1):
        facts: dict[str, Any] = {
            **dict.fromkeys(("lost", "gaps", "reconnects", "contradictions"), 0),
            **{name: 20 * k for name in ("decisions", "known", "objects", "photons_known")},
            **{
                "state": "running",
                "ended": "",
                "abstained": k,
                "right": 15 * k,
                "clicks": 90 * k,
                "photons": 160.0 * k,
            },
            **{"walk_light": 7e3 * k, "exposures": 600 * k, "late": k // 10, "trouble": NASTY},
            **{"latency": [[300_000 + 10_000 * (k % 5), 18], [900_000, 2]], "latency_max_us": 1500.0},
            "recording": "run.pansrec",
            **{"dark_exposures": 50 * k, "dark_clicks": k, "dark_expected": 0.015, "dark_high": 0.02, "dark_words": ""},
            **{"clock_drift_ppm": -20 + k % 3, "clock_uncertainty_us": 70.0, "disk_free_bytes": 1 << 36},
            **{"recording_bytes": 1 << 22, "class_decided": list(range(10)), "class_truth": [10] * 10},
            **{"class_right": [5] * 10, "latest": [[k, k, 0, 0.9, 4, 0, 0], [k, k, 1, 0.5, 2, 0, 0]]},
            **{"word": {"patterns": list(range(32)), "clicks": [0, 1] * 16}},
            **{"pixels": {str(n): {"shape": [4, 4], "grey": GREY} for n in range(32)}},
        }
        history.take({"kind": "picture", "elapsed_s": 120.0 * k, **facts})
    return history


@pytest.fixture
def served() -> Iterator[LivePage]:
    live = LivePage("127.0.0.1", 0, a_history())
    yield live
    live.close()


def ask(live: LivePage, words: str) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", live.port), timeout=5)
    client.sendall(f"{words} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    return client


def until(client: socket.socket, mark: bytes) -> bytes:
    data = b""
    while mark not in data and (piece := client.recv(1 << 16)):
        data += piece
    return data


def test_the_process_that_draws_loads_little() -> None:
    loads = "import sys, pans.runtime.monitor.child, pans.runtime.monitor.server as s; print('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", loads], capture_output=True, text=True).stdout == "False\n"


def test_the_page_is_one_small_file_that_loads_nothing() -> None:
    text = page().decode()
    assert len(text) < 100_000
    assert "innerHTML" not in text
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in text
    assert text.count("<script>") == text.count("<style>") == 1


def test_the_policy_lets_nothing_else_run(served: LivePage) -> None:
    with ask(served, "HEAD /") as client:
        head = until(client, b"\r\n\r\n").decode()
    assert "default-src 'none'; script-src 'sha256-" in head
    assert "unsafe" not in head
    assert "frame-ancestors 'none'" in head


def test_more_than_a_few_followers_are_refused_and_a_gone_one_makes_room(served: LivePage) -> None:
    held = [ask(served, "GET /events") for _ in range(MAX_LISTENERS)]
    for client in held:
        assert until(client, b"event: curves")[9:12] == b"200"
    with ask(served, "GET /events") as client:
        assert until(client, b"\n")[9:12] == b"503"
    held.pop().close()
    for _ in range(100):
        held.append(ask(served, "GET /events"))
        if until(held[-1], b"\n")[9:12] == b"200":
            break
        held.pop().close()
        time.sleep(0.02)
    assert len(held) == MAX_LISTENERS
    for client in held:
        client.close()


def test_the_page_in_a_browser(served: LivePage, tmp_path: Path) -> None:
    with browser(tmp_path) as driver:
        look(driver, 1280)
        driver.get(f"http://127.0.0.1:{served.port}/")
        wait_for(driver, "return document.querySelectorAll('svg').length == 5")
        assert driver.title == "running: SIMULATED · " + NASTY.replace("\x1b", "\\x1b") + " on a device"
        words = driver.find_element("tag name", "body").text
        for text in ("75.0%", "600 of 1,000", "SIMULATED", "0.02 per exposure", "<img src=x onerror="):
            assert text in words
        for width in (1280, 390):
            for dark in (False, True):
                look(driver, width, dark=dark)
                time.sleep(0.3)  # charts are drawn anew after a change of the width
                picture(driver, tmp_path / f"live-{width}-{dark}.png")
                assert clipped(driver) == []
        assert driver.execute_script("return document.querySelectorAll('#word canvas').length") == 32
        assert driver.execute_script("return [...document.querySelectorAll('#word li.click')].length") == 16
        assert unreachable(driver) == []
        assert console(driver) == []
        for dark in (False, True):
            look(driver, 1280, dark=dark)
            assert serious(driver) == []


def wait_for(driver: Any, script: str) -> None:
    for _ in range(100):
        if driver.execute_script(script):
            return
        time.sleep(0.05)
    pytest.fail(script)


def test_the_page_says_when_the_run_is_over(tmp_path: Path) -> None:
    history = a_history(3)
    live = LivePage("127.0.0.1", 0, history)
    with browser(tmp_path) as driver:
        try:
            driver.get(f"http://127.0.0.1:{live.port}/")
            wait_for(driver, "return document.querySelector('#state').textContent == 'running'")
            history.picture |= {"ended": "completed", "state": "stopped"}
            live.draw()
        finally:
            live.close()
        wait_for(driver, "return document.querySelector('#state').textContent == 'the run has ended'")
        time.sleep(0.5)
        assert driver.find_element("id", "state").text == "the run has ended"
