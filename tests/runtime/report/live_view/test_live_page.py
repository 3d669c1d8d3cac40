"""The live page: what the server lets through, what its curves say, and the page in a real browser at both widths, in light and dark."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browser import DEEP, browser, clipped, console, look, picture, serious, unreachable

from pans.base.numbers.denominators import GROUPS
from pans.base.numbers.intervals import wilson_interval
from pans.report.live_view.history import LEVELS, History

live_page = pytest.importorskip("pans.report.live_view.web_page", reason="needs bokeh")
NASTY = '<img src=x onerror="document.title=1">\x1b[2J'
GREY = "AAECAwQFBgcICQoLDA0ODw=="  # 16 pixels
BOX = "scrollTo(0, 0); return deep(document, arguments[0])[0].getBoundingClientRect().toJSON()"
PROGRAM = [sys.executable, "-P", "-m", "pans.report.live_view.child"]


def messages(n: int = 30, step_s: float = 20.0, hot: range = range(0)) -> Iterator[dict[str, Any]]:
    """The pictures of a run; in those of `hot` the dark counts are 25 times as many."""
    classes = [NASTY, "T-shirt/top", "a rather long name of a class of objects", *map(str, range(7))]
    begin = {"bundle": NASTY, "title": f"{NASTY} on a device", "classes": classes, "expected": 1000}
    yield {
        "kind": "begin",
        "simulated": True,
        "deadline_us": 2000.0,
        "encoder": "automaton",
        "clicks_stated": 4.6,
        **begin,
    }
    dark = 0
    for k in range(1, n + 1):
        dark += 25 if k in hot else 1
        yield {
            **{"kind": "picture", "elapsed_s": step_s * k, "state": "running", "ended": "", "walk_light": 7e3 * k},
            **dict.fromkeys(("lost_exposures", "gaps", "reconnects", "contradictions"), 0),
            **{"decisions": 21 * k, **{name: 20 * k for name in ("decided", "judged", "objects")}},
            **{f"{of}_photons_known": 20 * k for of in GROUPS},
            **{f"{of}_{what}": n * k for of in GROUPS for what, n in (("clicks", 90), ("photons", 160.0))},
            **{"abstained": k, "right": 15 * k, "exposures": 600 * k},
            **{"late": k // 10, "last_error": NASTY, "events": [["note", NASTY, None]] if k == 5 else []},
            **{"latency": [[300_000 + 10_000 * (k % 5), 18], [900_000, 2]], "latency_max_us": 1500.0},
            **{"dark_exposures": 50 * k, "dark_clicks": dark, "dark_expected": 0.015, "dark_low": 0.014},
            **{"dark_high": 0.02, "dark_states": [["alarm", 25.0, "hot", 50 * (hot[0] - 2)]] if k in hot else []},
            **{"clock_drift_ppm": -20 + k % 3, "clock_uncertainty_us": 70.0, "disk_free_bytes": 1 << 36},
            **{"recording_bytes": 1 << 22, "latest": [[k, k, 1, 0.5, 2, 0, 0]]},
            "word": {
                **{"decision": [k, k, 0, 0.9, 16, 0, 0], "patterns": list(range(32)), "clicks": [0, 1] * 16},
                "posterior": [0.9, *[0.1 / 9] * 9],
            },
            "pixels": {str(n): {"shape": [4, 4], "grey": GREY} for n in range(32)},
        }


class Served:
    """A page in a process of its own."""

    def __init__(self, *more: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as listening:
            words = [*PROGRAM, "--serve", str(listening.fileno()), "--local", *more]
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            self.process = subprocess.Popen(words, pass_fds=[listening.fileno()], **pipes)
            self.port = listening.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"

    def tell(self, *some: dict[str, Any]) -> None:
        self.process.stdin.write("".join(json.dumps(one) + "\n" for one in some))
        self.process.stdin.flush()

    def ask(self, words: str, *headers: str) -> str:
        with socket.create_connection(("127.0.0.1", self.port), timeout=120) as client:
            client.sendall("\r\n".join((f"{words} HTTP/1.1", "Connection: close", *headers, "", "")).encode())
            return b"".join(iter(lambda: client.recv(1 << 16), b"")).decode()


@contextmanager
def page(*more: str) -> Iterator[Served]:
    served = Served(*more)
    try:
        yield served
    finally:
        served.process.stdin.close()
        assert served.process.wait(30) == 0
        served.process.stdout.close()


def test_curves_are_those_of_the_decisions_that_a_point_takes() -> None:
    history, rng, level, least = History(), np.random.default_rng(5), LEVELS[0], 40
    steps, sums = [], dict.fromkeys(("decisions", "decided", "judged", "right", "dark_exposures", "dark_clicks"), 0)
    given = {"kind": "picture", "latency": [], "dark_low": 0.02, "dark_high": 0.03}
    for k in range(1, 101):
        made, dark, ns = int(rng.integers(0, 20)), int(rng.integers(0, 4)), int(rng.integers(1, 9)) * 100_000
        grown = (made, made, made, int(rng.integers(0, made + 1)), 50, dark)
        sums = {name: value + more for (name, value), more in zip(sums.items(), grown)}
        history.take(given | sums | {"elapsed_s": float(k), "latency": [[ns, made]] if made else []})
        steps.append((*grown, ns))
    found = live_page.columns(history, level, least)
    for at in range(len(found["s"])):
        for wanted, of in ((least, 0), (live_page.LEAST_DARK, 5)):
            first = at
            while first and sum(step[of] for step in steps[first : at + 1]) < wanted:
                first -= 1
            some, known = steps[first : at + 1], sum(step[1] for step in steps[first : at + 1])
            if not steps[at][0]:
                assert np.isnan(found["accuracy"][at])
            elif of == 0:
                right, ns = sum(step[3] for step in some), sorted(step[6] for step in some for _ in range(step[0]))
                curves = [found[name][at] / 100 for name in ("accuracy", "accuracy_low", "accuracy_high")]
                assert curves == pytest.approx([right / known, *wilson_interval(right, known)])
                assert found["p50"][at] == ns[-(-len(ns) // 2) - 1] / 1000
                assert np.isnan(found["p99"][at]) == (len(ns) < 100)
                assert found["over"][at] == len(some)
            elif dark := sum(step[5] for step in some):
                assert found["dark"][at] == pytest.approx(dark / (50 * len(some)))
                assert found["dark_high"][at] == pytest.approx(wilson_interval(dark, 50 * len(some))[1])


def test_what_the_server_lets_through() -> None:
    with page() as served:
        head = served.ask("GET /", f"Host: localhost:{served.port}").partition("\r\n\r\n")[0]
        assert " 200 " in head
        assert "default-src 'none'; script-src 'self' 'sha256-" in head
        assert "unsafe" not in head.partition("style-src")[0]
        assert "unsafe-eval" not in head
        assert "frame-ancestors 'none'" in head
        assert " 403 " in served.ask("GET /", "Host: elsewhere.example")  # a name that was made to point here
        here, upgrade = f"Host: 127.0.0.1:{served.port}", ("Upgrade: websocket", "Sec-WebSocket-Version: 13")
        assert " 403 " in served.ask("GET /ws", here, *upgrade, "Origin: http://elsewhere.example")
        for path in ("/metadata", "/autoload.js", "/x"):
            assert " 404 " in served.ask(f"GET {path}", here)


def test_a_page_of_another_site_gets_nothing_and_takes_no_place() -> None:
    with page() as served:
        here, asked = f"Host: 127.0.0.1:{served.port}", "Sec-Fetch-Mode: no-cors\r\nSec-Fetch-Dest: image"
        for site in ("cross-site", "same-site"):
            for path in ("/", "/static/js/bokeh.min.js"):
                assert " 403 " in served.ask(f"GET {path}", here, f"Sec-Fetch-Site: {site}", asked)
        assert " 403 " in served.ask("GET /", here, "Origin: http://elsewhere.example")
        assert " 200 " not in served.ask("GET /", here, "Content-Length: 5")  # the body never comes
        for site in ("none", "same-origin"):
            assert " 200 " in served.ask("GET /", here, f"Sec-Fetch-Site: {site}", "Sec-Fetch-Dest: document")


def test_requests_that_come_at_once_get_no_more_places_than_there_are() -> None:
    with page() as served, ExitStack() as opened:
        here = f"Host: 127.0.0.1:{served.port}"
        assert " 200 " in served.ask("GET /", here)
        clients = [opened.enter_context(socket.create_connection(("127.0.0.1", served.port), 60)) for _ in range(60)]
        for client in clients:
            client.sendall(f"GET / HTTP/1.1\r\nConnection: close\r\n{here}\r\n\r\n".encode())
        codes = [b"".join(iter(partial(client.recv, 1 << 16), b"")).split()[1] for client in clients]
    assert codes.count(b"200") == live_page.SESSIONS_MAX - 1
    assert codes.count(b"503") == 60 - codes.count(b"200")


def test_who_comes_when_the_page_is_full_is_told() -> None:
    full = range(live_page.SESSIONS_MAX)
    app = SimpleNamespace(
        get_sessions=lambda path: full, unanswered=set(), find_handler=lambda request, **more: "let in"
    )
    asked = {"path": "/", "method": "GET", "host": "10.0.0.1", "host_name": "10.0.0.1", "connection": None}
    request, last = (type("Request", (), asked | {"headers": {}})() for _ in range(2))
    door = live_page._Door(app, local=False)
    assert door.find_handler(request) != "let in"
    full = full[1:]
    assert door.find_handler(request) == "let in"
    assert door.find_handler(last) != "let in"  # while the one before has no session yet
    live_page._Server.log_request(app, SimpleNamespace(request=request))  # it was refused after all
    assert door.find_handler(last) == "let in"
    assert live_page._Door(app, local=True).find_handler(request) != "let in"


def test_the_page_in_a_browser(tmp_path: Path) -> None:
    with browser(tmp_path) as driver, page("--control") as served:
        served.tell(*messages(hot=range(12, 20)))
        look(driver, 1400)
        driver.get(served.url)
        wait_for(driver, DEEP + "return deep(document, '.bk-canvas-events, .bk-events').length >= 5")
        assert driver.title == "running: SIMULATED · " + NASTY.replace("\x1b", "\\x1b") + " on a device"
        words = driver.execute_script(
            DEEP + "return deep(document, '.bk-clearfix').map(one => one.innerText).join(' ')"
        )
        for text in (
            "75.0%",
            "630 of 1,000",
            "of the 600 decisions",
            "SIMULATED",
            "dark counts",
            "hot",
            "noticed",
            "90.0",
            "○●○●",
            "<img src=x onerror=",
        ):
            assert text in words
        for width in (1400, 390):
            for dark in (False, True):
                look(driver, width, dark=dark)
                time.sleep(0.5)  # figures are drawn anew after a change of the width
                picture(driver, tmp_path / f"live-{width}-{dark}.png")
                # what a figure draws is cut off at its frame
                assert [one for one in clipped(driver) if "bk-GlyphRenderer" not in one] == []
                beside = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
                assert driver.execute_script(beside) == 0
        for dark in (False, True):
            look(driver, 1400, dark=dark)
            assert serious(driver) == []
        assert unreachable(driver) == []
        press = DEEP + "deep(document, 'button').find(one => one.textContent == arguments[0]).click()"
        driver.execute_script(press, "Mark this moment")
        assert json.loads(served.process.stdout.readline()) == {"note": "marked"}
        driver.execute_script(press, "Stop the run")
        wait_for(driver, DEEP + "return deep(document, 'button').some(one => one.textContent == 'Press again to stop')")
        time.sleep(1)  # nothing is taken more often
        driver.execute_script(press, "Press again to stop")
        assert json.loads(served.process.stdout.readline()) == {"stop": True}
        last = [*messages(31)][-1]
        served.tell(last | {"state": "stopped", "ended": "interrupted"})
        said = "return deep(document, 'b').some(one => one.textContent == 'The run has ended: interrupted')"
        assert console(driver) == []
        served.process.stdin.close()
        wait_for(driver, DEEP + said)
        wait_for(driver, DEEP + "return deep(document, '.entries > .error').length")  # Bokeh: the connection is lost
        for width in (390, 1400):
            look(driver, width)
            lost, simulated = (driver.execute_script(DEEP + BOX, one) for one in (".entries > .error", ".banner"))
            assert lost["top"] > simulated["bottom"] > simulated["top"] >= 0
            assert 0 <= lost["left"] < lost["right"] <= width


def wait_for(driver: Any, script: str) -> None:
    for _ in range(200):
        if driver.execute_script(script):
            return
        time.sleep(0.05)
    pytest.fail(script)
